"""Least squares with bordered blocks: every block's own unknowns are eliminated onto those that blocks share.

The rows of an image, or of a point, touch its own unknowns and some shared ones. An orthogonal (Householder)
factorisation of these rows alone leaves a triangle for its own unknowns and fewer rows in the shared ones; all these
are factorised together. The cost is linear in the number of blocks, and the condition is that of the rows, not its
square as with normal equations (Golub and Van Loan, Matrix Computations, section 5.3; Triggs et al., Bundle
adjustment: a modern synthesis). Blocks of equal shape are factorised together.

Rows that connect what no single block owns are blocks without own unknowns: what they touch must be shared.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csr_array, diags_array

from adjust.fronts import Fronts
from adjust.multifrontal import of_normal_equations, reflected, reflections_cost, triangle_of
from adjust.normal_equations import Groups, border_square, spread_squares
from adjust.triangle import Triangle

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

REFLECTED = 1e9  # rows times columns squared in the shared unknowns up to which these rows are factorised themselves
SAFE = 1e-6  # reciprocal condition of the shared triangle down to which their normal equations will do


@dataclass(frozen=True)
class Blocks:
    """The rows of b blocks of equal shape: matrix (b, m, o + s) times the unknowns = right (b, m), of unit weight.

    own (b, o): numbers of every block's own unknowns among all; shared (b, s): numbers of the others that it touches,
    among the shared ones.
    """

    own: Indices
    shared: Indices
    matrix: Array
    right: Array


@dataclass(frozen=True)
class BlockFactors:
    """Their triangles (b, o, o): triangle own + border (b, o, s) shared = right (b, o)."""

    own: Indices
    shared: Indices
    triangle: Array
    border: Array
    right: Array


@dataclass(frozen=True)
class ReducedRows:
    """Rows of b blocks as own (b, m, o) times quantities of unit covariance plus through (b, m, s) times the scaled
    shared unknowns (b, s); these quantities are not correlated with each other nor with the shared unknowns.
    """

    own: Array
    shared: Indices
    through: Array


@dataclass(frozen=True)
class Factor:
    """The square root of the normal equations: the blocks' triangles, and that of the s shared unknowns.

    All columns are scaled: the unknowns are those of the rows times `scale` (n,), which makes every column's norm 1.
    The shared unknowns are the first s.
    """

    blocks: tuple[BlockFactors, ...]
    triangle: Triangle
    right: Array
    scale: Array

    @property
    def shared_count(self) -> int:
        return len(self.right)

    def solution(self) -> Array:
        """The unknowns (n,). Raises numpy.linalg.LinAlgError where a triangle is singular."""
        solution = np.empty(len(self.scale))
        shared = self.triangle.solve(self.right)
        solution[: self.shared_count] = shared
        for block in self.blocks:
            through = (block.border @ shared[block.shared][..., None])[..., 0]
            solution[block.own] = np.linalg.solve(block.triangle, (block.right - through)[..., None])[..., 0]
        return solution / self.scale

    def length(self) -> float:
        """Of the solution, in standard deviations: what that function of the unknowns moves which moves most."""
        squares = [(block.right**2).sum() for block in self.blocks]
        return float(np.sqrt((self.right**2).sum() + sum(squares)))

    def variances(self) -> Array:
        """The diagonal (n,) of the cofactor matrix."""
        variances = np.empty(len(self.scale))
        variances[: self.shared_count] = self.triangle.variances
        for block in self.blocks:
            own, through = self._roots(block)
            variances[block.own] = (own**2).sum(axis=2) + (through**2).sum(axis=2)
        return variances / self.scale**2

    def cofactors(self, groups: Indices) -> Array:
        """The cofactor matrices (g, k, k) of groups of unknowns (g, k), each of one block's own or of shared ones."""
        cofactors = np.empty((*groups.shape, groups.shape[1]))
        shared = groups[:, 0] < self.shared_count
        cofactors[shared] = self.triangle.cofactors_of(groups[shared])
        row = np.full(len(self.scale), -1, dtype=np.intp)
        for block in self.blocks:
            row[block.own] = np.arange(block.own.size).reshape(block.own.shape)
            members = np.flatnonzero(row[groups[:, 0]] >= 0)
            if len(members):
                root = np.concatenate(self._roots(block), axis=2)
                root = root.reshape(block.own.size, root.shape[2])[row[groups[members]]]
                cofactors[members] = root @ root.swapaxes(1, 2)
            row[block.own] = -1
        scale = self.scale[groups]
        return cofactors / (scale[:, :, None] * scale[:, None, :])

    def cofactor_of(self, functions: csr_array) -> Array:
        """The cofactor matrix (k, k) of linear functions (k, n) of the unknowns."""
        columns = (functions / self.scale).tocsc()
        shared = np.asarray(columns[:, : self.shared_count].toarray(), dtype=np.float64)
        used = np.diff(columns.indptr) > 0
        cofactor = np.zeros((len(shared), len(shared)))
        for block in self.blocks:
            for i in np.flatnonzero(used[block.own].any(axis=1)):
                own = columns[:, block.own[i]].toarray()
                rows = np.flatnonzero(own.any(axis=1))
                root = np.asarray(solve_triangular(block.triangle[i], own[rows].T, trans="T"), dtype=np.float64)
                cofactor[np.ix_(rows, rows)] += root.T @ root
                shared[np.ix_(rows, block.shared[i])] -= root.T @ block.border[i]
        through = self.triangle.solve_transposed(shared.T)
        return np.asarray(cofactor + through.T @ through)

    def cofactor_times(self, columns: Array) -> Array:
        """The cofactor matrix times columns (n, d)."""
        scaled = columns / self.scale[:, None]
        shared = scaled[: self.shared_count].copy()
        own = []
        for block in self.blocks:
            own.append(np.linalg.solve(block.triangle.transpose(0, 2, 1), scaled[block.own]))
            np.subtract.at(shared, block.shared, block.border.transpose(0, 2, 1) @ own[-1])
        result = np.empty_like(scaled)
        shared = self.triangle.cofactor_times(shared)
        result[: self.shared_count] = shared
        for block, root in zip(self.blocks, own, strict=True):
            result[block.own] = np.linalg.solve(block.triangle, root - block.border @ shared[block.shared])
        return result / self.scale[:, None]

    def row_roots(self, blocks: Iterable[Blocks]) -> Iterator[Array]:
        """G (b, m, k) of blocks as these were factorised: G G' are the cofactor matrices of each one's adjusted rows.

        The adjusted rows are the matrix times the unknowns.
        """
        for rows in self.reduced_rows(blocks):
            yield np.concatenate([rows.own, rows.through @ self.triangle.root_of(rows.shared)], axis=2)

    def reduced_rows(self, blocks: Iterable[Blocks]) -> Iterator["ReducedRows"]:
        """The adjusted rows of blocks that own and share what those factorised do, one after the other."""
        for rows, block in zip(blocks, self.blocks, strict=True):
            count = block.own.shape[1]
            matrix = rows.matrix / _columns(self.scale, rows)[:, None, :]
            own = matrix[..., :count] @ np.linalg.inv(block.triangle)
            yield ReducedRows(own, rows.shared, matrix[..., count:] - own @ block.border)

    def _roots(self, block: BlockFactors) -> tuple[Array, Array]:
        """Roots of the own unknowns' cofactor matrix: for shared unknowns held fixed, and what these add."""
        own = np.asarray(np.linalg.inv(block.triangle), dtype=np.float64)
        return own, -own @ (block.border @ self.triangle.root_of(block.shared))


@dataclass(frozen=True)
class Sums:
    """How the blocks' rows are summed up in the shared unknowns.

    rows: the same rows as blocks without own unknowns, arranged so that all rows of a block touch the same shared ones,
    the columns left out that blocks own. groups: shared unknowns that blocks meet together.
    """

    rows: Iterable[Blocks]
    groups: Groups


def eliminate(
    blocks: Iterable[Blocks],
    count: int,
    prior_root_weight: Array,
    prior_right: Array,
    damping: float = 0.0,
    sums: Sums | None = None,
    sharp: bool = True,
    fronts: Fronts | None = None,
) -> Factor:
    """Factorise the blocks and one row an unknown for its prior.

    The prior's row (count,) is prior_root_weight times unknown = prior_right. The shared unknowns are those that no
    block owns, and stand first. A damping holds every scaled unknown where it is (Levenberg and Marquardt).

    The rows that are left in the shared unknowns are factorised by reflections. Where that would take too long, and
    `sums` tell how, their normal equations are summed up and factorised (Cholesky). That squares the condition: of
    variances the relative error is at most some 1e-16 times the squared condition, 1e-4 where the condition is 1e6;
    where it is worse, reflections take their time. Not sharp: singular values below 1e-6 need not be told from that.

    fronts: of the shared unknowns, which stand in their order; a single one if they are not told.
    """
    squares, shared_count = prior_root_weight**2, count
    heights = []
    for block in blocks:
        squares += _column_squares(block, count)
        shared_count -= block.own.size
        if block.shared.size:
            heights.append((block.shared, min(block.right.shape[1], block.shared.shape[1] + 1)))
    fronts = fronts or Fronts.single(shared_count)
    scale = np.where(squares > 0.0, np.sqrt(squares), 1.0)
    priors = _prior_rows(prior_root_weight / scale, prior_right, damping)
    if sums is not None and reflections_cost(fronts, heights) > REFLECTED:
        lift = 0.0 if sharp else SAFE**2
        factor = _by_normal_equations(blocks, sums, scale, priors, fronts, lift)
        if factor is not None and (not sharp or factor.triangle.reciprocal_condition > SAFE):
            return factor
    factors = []
    rests = []
    for block in blocks:
        eliminated, rest = _eliminate_blocks(block, scale, priors)
        factors.append(eliminated)
        rests.append((block.shared, rest))
    triangle, right = reflected(fronts, rests, *(prior[:shared_count] for prior in priors))
    return Factor(tuple(factors), triangle, right, scale)


def _columns(values: Array, blocks: Blocks) -> Array:
    """The values (b, o + s), one an unknown, of what the blocks' columns stand for."""
    return np.concatenate([values[blocks.own], values[blocks.shared]], axis=1)


def _column_squares(blocks: Blocks, count: int) -> Array:
    """The sums (count,) of the squares in every column."""
    of_blocks = np.einsum("bmk,bmk->bk", blocks.matrix, blocks.matrix)
    columns = np.concatenate([blocks.own, blocks.shared], axis=1)
    return np.asarray(np.bincount(columns.ravel(), of_blocks.ravel(), count), dtype=np.float64)


def _prior_rows(root_weight: Array, right: Array, damping: float) -> tuple[Array, Array]:
    """One row an unknown that holds its prior's and its damping's together: its coefficient and its right side."""
    together = np.hypot(root_weight, np.sqrt(damping))
    return together, root_weight * right / np.where(together > 0.0, together, 1.0)


def _rows_of(priors: tuple[Array, Array], unknowns: Indices) -> Array:
    """The prior rows (..., k, k + 1) of some unknowns (..., k), the right side behind."""
    root_weight, right = priors
    rows = root_weight[unknowns][..., None] * np.eye(unknowns.shape[-1])
    return np.concatenate([rows, right[unknowns][..., None]], axis=-1)


def _eliminate_blocks(blocks: Blocks, scale: Array, priors: tuple[Array, Array]) -> tuple[BlockFactors, Array]:
    """The blocks' triangles, and their remaining rows (b, k, s + 1) in the shared unknowns, right side behind."""
    (count, height, width), own_count = blocks.matrix.shape, blocks.own.shape[1]
    rows = np.zeros((count, height + own_count, width + 1))
    np.divide(blocks.matrix, _columns(scale, blocks)[:, None, :], out=rows[:, :height, :-1])
    rows[:, :height, -1] = blocks.right
    prior_rows = _rows_of(priors, blocks.own)
    rows[:, height:, :own_count] = prior_rows[..., :-1]
    rows[:, height:, -1] = prior_rows[..., -1]
    triangle = triangle_of(rows)
    own = triangle[:, :own_count]
    factor = BlockFactors(blocks.own, blocks.shared, own[..., :own_count], own[..., own_count:-1], own[..., -1])
    return factor, triangle[:, own_count:, own_count:]


def _by_normal_equations(
    blocks: Iterable[Blocks],
    sums: Sums,
    scale: Array,
    priors: tuple[Array, Array],
    fronts: Fronts,
    lift: float,
) -> Factor | None:
    """None where the normal equations of the shared unknowns are not positive definite."""
    root_weight, prior_right = (prior[: fronts.count] for prior in priors)
    normal = csr_array(diags_array(root_weight**2 + lift))
    right = root_weight * prior_right
    for rows in sums.rows:
        matrix = rows.matrix / scale[rows.shared][:, None, :]
        normal = normal + spread_squares(rows.shared, matrix.swapaxes(1, 2) @ matrix, fronts.count)
        np.add.at(right, rows.shared, (matrix.swapaxes(1, 2) @ rows.right[..., None])[..., 0])
    factors = [_own_triangles(block, scale, priors) for block in blocks]
    normal = normal - border_square(
        sums.groups, ((factor.shared, factor.border) for factor in factors if factor.own.size)
    )
    for factor in factors:
        np.subtract.at(right, factor.shared, (factor.border.swapaxes(1, 2) @ factor.right[..., None])[..., 0])
    try:
        triangle, right = of_normal_equations(fronts, normal, right)
    except np.linalg.LinAlgError:
        return None
    return Factor(tuple(factors), triangle, right, scale)


def _own_triangles(blocks: Blocks, scale: Array, priors: tuple[Array, Array]) -> BlockFactors:
    """The blocks' triangles, without what remains in the shared unknowns."""
    own_count = blocks.own.shape[1]
    matrix = blocks.matrix / _columns(scale, blocks)[:, None, :]
    prior_rows = _rows_of(priors, blocks.own)
    own = np.concatenate([matrix[..., :own_count], prior_rows[..., :-1]], axis=1)
    orthonormal, triangle = np.linalg.qr(own)
    turned = orthonormal.swapaxes(1, 2)
    height = matrix.shape[1]
    right = turned[..., :height] @ blocks.right[..., None] + turned[..., height:] @ prior_rows[..., -1:]
    border = turned[..., :height] @ matrix[..., own_count:]
    return BlockFactors(blocks.own, blocks.shared, triangle, border, right[..., 0])

"""Block elimination in bordered least-squares problems: each block's own unknowns are reduced onto the shared ones.

The observations of an image, or of a point, depend on its own unknowns and on some shared ones. An orthogonal
(Householder) factorisation of these rows gives a triangle for the own unknowns and fewer rows in the shared ones; the
remaining rows of all blocks are factorised together. The cost is linear in the number of blocks, and the condition
number is that of the design matrix, not its square as with normal equations (Golub and Van Loan, Matrix Computations,
section 5.3; Triggs et al., Bundle adjustment: a modern synthesis). Blocks of equal shape are factorised together.

Observations that no single block contains form blocks without own unknowns: all their unknowns must be shared.

For many small blocks, for example points, whose rows involve few of the shared unknowns, the own unknowns of all blocks
are eliminated at once (Schur complement): their columns are orthonormalised by the Gram-Schmidt method, twice, which is
as accurate as Householder reflections (Giraud, Langou and Rozloznik 2005, The loss of orthogonality in the Gram-Schmidt
orthogonalization process). No dense blocks are formed. The reduced normal equations of the shared unknowns are
N = A'A - B'B, with the rows A and the borders B: products of block-sparse matrices.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_array, coo_array, csr_array

import compiled
from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import BlockFactors, Blocks, DenseBlocks, Factor, column_values
from adjust.linear_algebra.normal_equations import SharedEquations, SparseRows, SparsityPattern, batches, take_columns
from adjust.linear_algebra.sparse_factor import (
    SAFE,
    TEN_DIGITS,
    Fronts,
    Triangle,
    factorise_normal_equations,
    qr_triangle,
    reflect_fronts,
    reflections_cost,
)

COMPILED_OWN = 3  # largest number of own unknowns per block in kernels.c
CHEAP = 1e7  # rows times columns squared of the shared unknowns, up to which Householder QR is always used
REFLECTED = 1e9  # the same, up to which it is used where normal equations would lose digits


@dataclass(frozen=True)
class Border:
    """Border of r rows in the shared unknowns: block-sparse in the groups, and dense (r, t) in the single ones."""

    pattern: SparsityPattern
    parts: bsr_array
    alone: Array

    def times(self, shared: Array) -> Array:
        """Product (r,) with shared unknowns (s,)."""
        of_groups = np.append(shared, 0.0)[self.pattern.members.ravel()]
        return np.asarray(self.parts @ of_groups + self.alone @ shared[self.pattern.singles])

    def transposed_times(self, rows: Array) -> Array:
        """Product (s,) of the transpose with a vector (r,)."""
        result = np.zeros(self.pattern.count + 1)
        np.add.at(result, self.pattern.members.ravel(), self.parts.T @ rows)
        result[self.pattern.singles] += self.alone.T @ rows
        return result[:-1]

    def square(self) -> csr_array:
        """B'B (s, s)."""
        groups, singles, transposed = self.pattern.members.ravel(), self.pattern.singles, self.parts.T
        within = bsr_array(transposed @ self.parts).tocoo()
        across = coo_array(transposed @ self.alone)
        alone = coo_array(self.alone.T @ self.alone)
        rows = np.concatenate([groups[within.row], groups[across.row], singles[across.col], singles[alone.row]])
        columns = np.concatenate([groups[within.col], singles[across.col], groups[across.row], singles[alone.col]])
        data = np.concatenate([within.data, across.data, across.data, alone.data])
        there = (rows >= 0) & (columns >= 0)
        shape = self.pattern.count, self.pattern.count
        return csr_array(coo_array((data[there], (rows[there], columns[there])), shape=shape))


def eliminate_blocks(
    rows: SparseRows, root_weight: Array, prior_right: Array, scale: Array, equations: SharedEquations
) -> "SparseBlocks":
    """Eliminate all own unknowns.

    Parameters
    ----------
    root_weight, prior_right : (n,) priors of the scaled unknowns: root_weight times unknown = prior_right.
    scale : (n,) as in `Factor`.
    equations : normal equations of the shared unknowns, reduced in place by B'B of the borders B.
    """
    pattern, own, fronts = rows.pattern, rows.pattern.own[:-1], equations.fronts
    blocks = SparseBlocks(
        rows,
        triangle=np.empty((*own.shape, own.shape[1])),
        parts=np.empty((len(pattern.order), own.shape[1], pattern.members.shape[1])),
        alone=np.empty((*own.shape, len(pattern.singles))),
        right=np.empty(own.shape),
        orthonormal=np.empty((own.shape[1], 2, len(pattern.order))),
        scale=scale,
    )
    weight = np.where(own >= 0, (root_weight * scale)[own], 1.0)
    prior = np.where(own >= 0, prior_right[own], 0.0)
    if compiled.kernels is not None and own.shape[1] <= COMPILED_OWN:
        home = fronts.home(pattern.left_over[0][:-1, None])
        given = (
            rows.right, pattern.order, pattern.first, np.argsort(home, kind="stable"), home, *pattern.columns, own,
            pattern.groups, pattern.members, pattern.single, pattern.singles, weight, prior,
            fronts.table, fronts.later_unknowns,
        )  # fmt: skip
        found = blocks.triangle, blocks.right, blocks.orthonormal, blocks.parts, blocks.alone
        arrays = *map(np.ascontiguousarray, given), *found
        compiled.kernels.eliminate_blocks(rows.matrix, *arrays, equations.values, equations.right)
        return blocks
    _eliminate(blocks, weight, prior)
    border = blocks.border.square()
    for front, square in zip(fronts, equations.squares, strict=True):
        of_own = csr_array(border[front.own, front.first :]).tocoo()
        square[front.places(of_own.col.astype(np.intp) + front.first), of_own.row] -= of_own.data
    equations.right[...] -= blocks.border.transposed_times(blocks.right.ravel())
    return blocks


def _eliminate(blocks: "SparseBlocks", weight: Array, prior: Array) -> None:
    """Fill the blocks; weight, prior (b, o): coefficients and right sides of the own unknowns' priors."""
    rows, pattern, own = blocks.rows, blocks.rows.pattern, blocks.own
    alone = np.empty((*own.shape, len(pattern.singles) + 1))
    for members in batches(pattern.first):
        some = slice(pattern.first[members.start], pattern.first[members.stop])
        order, block = pattern.order[some], pattern.block_numbers[some] - members.start
        by_block = csr_array(
            (np.ones(len(block)), np.arange(len(block)), pattern.first[members.start : members.stop + 1] - some.start),
            shape=(members.stop - members.start, len(block)),
        )
        by_own, by_group, by_single = (take_columns(rows.matrix, columns, order) for columns in pattern.columns)
        by_own.swapaxes(1, 2)[(own[members][block] < 0).T] = 0.0
        by_prior = weight[members].T[..., None] * np.eye(own.shape[1])[:, None, :]
        first = _orthonormal(by_block, block, by_own, by_prior)
        blocks.triangle[members] = _orthonormal(by_block, block, by_own, by_prior) @ first
        x, y = rows.right[order].T
        reduced = by_block @ (by_own[:, 0] * x + by_own[:, 1] * y).T
        blocks.right[members] = reduced + (by_prior * prior[members]).sum(axis=2).T
        by_group, by_single = (
            by_own[:, None, 0] * by[:, 0] + by_own[:, None, 1] * by[:, 1] for by in (by_group, by_single)
        )
        blocks.parts[some] = by_group.transpose(2, 0, 1)
        place = pattern.place_in_border[..., some] - members.start * alone[0].size
        of_alone = np.bincount(place.ravel(), by_single.ravel(), alone[members].size)
        alone[members] = of_alone.reshape(alone[members].shape)
        blocks.orthonormal[..., some] = by_own
    blocks.alone[...] = alone[..., :-1]


def _orthonormal(by_block: csr_array, block: Indices, columns: Array, by_prior: Array) -> Array:
    """Orthonormalise columns (o, 2, m), with rows (o, b, o) of priors below, in place by modified Gram-Schmidt."""
    # by_block (b, m): sums over the blocks; block (m,): of each pair. Returns the triangles (b, o, o).
    count = len(columns)
    triangle = np.zeros((by_prior.shape[1], count, count))
    for i in range(count):
        along = by_block @ (columns[i, 0] * columns[i:, 0] + columns[i, 1] * columns[i:, 1]).T
        along += (by_prior[i] * by_prior[i:]).sum(axis=2).T
        length = np.sqrt(along[:, 0])
        over = 1.0 / np.where(length > 0.0, length, np.inf)
        columns[i] *= over[block]
        by_prior[i] *= over[:, None]
        triangle[:, i, i:] = along * over[:, None]
        rest = triangle[:, i, i + 1 :].T
        columns[i + 1 :] -= rest.take(block, axis=1)[:, None] * columns[i]
        by_prior[i + 1 :] -= rest[..., None] * by_prior[i]
    return triangle


@dataclass(frozen=True)
class SparseBlocks:
    """Blocks after elimination: triangle own + border shared = right, for the unscaled unknowns."""

    rows: SparseRows
    triangle: Array  # (b, o, o)
    parts: Array  # (m, o, w) border in the groups, for the pairs of rows `Pattern.order`
    alone: Array  # (b, o, t) border in the single unknowns
    right: Array  # (b, o)
    orthonormal: Array  # (o, 2, m) orthonormalised columns of the own unknowns
    scale: Array  # (n,) as in `Factor`

    @property
    def own(self) -> Indices:
        """(b, o) numbers of the own unknowns, -1 for none."""
        return self.rows.pattern.own[:-1]

    @cached_property
    def border(self) -> "Border":
        pattern = self.rows.pattern
        shape = self.right.size, pattern.members.size
        sparse = bsr_array((self.parts, pattern.groups, pattern.first), shape=shape)
        return Border(pattern, sparse, self.alone.reshape(self.right.size, len(pattern.singles)))

    def substitute(self, solution: Array) -> None:
        """Compute the own unknowns by back substitution in a scaled solution (n,) with the shared ones solved."""
        count, diagonal = self.rows.pattern.count, np.einsum("bii->bi", self.triangle)
        if not diagonal.all():
            raise np.linalg.LinAlgError("a block is singular")
        rest = self.right - self.border.times(solution[:count] / self.scale[:count]).reshape(self.right.shape)
        own = np.zeros_like(rest)
        for i in reversed(range(rest.shape[1])):
            own[:, i] = (rest[:, i] - np.einsum("bk,bk->b", self.triangle[:, i], own)) / diagonal[:, i]
        there = self.own >= 0
        solution[self.own[there]] = own[there] * self.scale[self.own[there]]

    def square_sum(self) -> float:
        """Sum of the squared right sides."""
        return float((self.right**2).sum())

    @cached_property
    def _inverse(self) -> Array:
        """Inverses (b, o, o) of the scaled triangles."""
        scaled = self.triangle / np.where(self.own >= 0, self.scale[self.own], 1.0)[:, None, :]
        inverse = np.zeros_like(scaled)
        for i in reversed(range(scaled.shape[1])):
            inverse[:, i, i] = 1.0
            inverse[:, i] -= np.einsum("bk,bkj->bj", scaled[:, i, i + 1 :], inverse[:, i + 1 :])
            inverse[:, i] /= scaled[:, i, i, None]
        return inverse

    def norm_of_inverse(self) -> float:
        if not np.einsum("bii->bi", self.triangle).all():
            return np.inf
        return float(np.sqrt((self._inverse**2).sum(axis=(1, 2)).max(initial=0.0)))

    def own_cofactors(self, triangle: Triangle) -> Iterator[tuple[Indices, Array]]:
        if compiled.kernels is None or self.own.shape[1] > COMPILED_OWN or not triangle.is_safely_squared:
            yield from self._own_cofactors_by_shape(triangle)
            return
        pattern, fronts, inner = self.rows.pattern, triangle.fronts, np.empty_like(self.triangle)
        over = 1.0 / self.scale[: pattern.count]
        squares = (
            square * over[front.columns] * over[front.columns, None]
            for front, square in zip(fronts, triangle.squares, strict=True)
        )
        home = fronts.home(pattern.left_over[0][:-1, None])
        given = (
            pattern.first, np.argsort(home, kind="stable"), home, pattern.groups, pattern.members, pattern.singles,
            self.parts, self.alone, fronts.table, fronts.later_unknowns,
            np.concatenate([square.ravel() for square in squares]),
        )  # fmt: skip
        compiled.kernels.border_cofactors(*map(np.ascontiguousarray, given), inner)
        inner += np.eye(self.own.shape[1])
        yield self.own, self._inverse @ inner @ self._inverse.swapaxes(1, 2)

    def _own_cofactors_by_shape(self, triangle: Triangle) -> Iterator[tuple[Indices, Array]]:
        """Own cofactors without kernels, for blocks of equal shape together; by roots where the condition requires."""
        pattern = self.rows.pattern
        counts, group, count = np.diff(pattern.first), pattern.groups, pattern.count
        shared_scale, inverse = np.append(self.scale[:count], 1.0), self._inverse
        for each in np.unique(counts):
            some = np.flatnonzero(counts == each)
            at = pattern.first[some][:, None] + np.arange(each)
            border = self.parts[at].swapaxes(1, 2).reshape(*self.right[some].shape, -1)
            border = np.concatenate([border, self.alone[some]], axis=2)
            members = pattern.members[group[at]].reshape(len(some), -1)
            unknowns = np.concatenate(
                [members, np.broadcast_to(pattern.singles, (len(some), len(pattern.singles)))], axis=1
            )
            border *= np.where(unknowns >= 0, 1.0 / shared_scale[unknowns], 0.0)[:, None]
            some_of_each = np.where(unknowns >= 0, unknowns, unknowns.max(axis=1, keepdims=True))
            inner = triangle.through(border, some_of_each) + np.eye(self.right.shape[1])
            yield self.own[some], inverse[some] @ inner @ inverse[some].swapaxes(1, 2)

    @cached_property
    def blocks(self) -> tuple[BlockFactors, ...]:
        """The eliminated blocks in dense form, scaled, grouped by shape."""
        pattern = self.rows.pattern
        place = np.zeros(len(pattern.block), dtype=np.intp)
        place[pattern.order] = np.arange(len(pattern.order))
        block_of = np.zeros(len(self.scale), dtype=np.intp)
        some, _ = there = np.nonzero(self.own >= 0)
        block_of[self.own[there]] = some
        present = np.argsort(self.own < 0, axis=1, kind="stable")
        found = []
        for rows, block in self.rows.arranged():
            count = block.own.shape[1]
            at = block_of[block.own.min(axis=1, initial=len(block_of) - 1)]
            columns = present[at, :count]
            turned = self.orthonormal[columns[..., None, None], np.arange(2), place[rows][:, None, :, None]]
            shared = block.matrix[..., count:] / self.scale[block.shared][:, None, :]
            border = turned.reshape(len(at), count, shared.shape[1]) @ shared
            triangle = self.triangle[at[:, None, None], columns[..., None], columns[:, None]]
            triangle = triangle / self.scale[block.own][:, None, :]
            found.append(BlockFactors(block.own, block.shared, triangle, border, self.right[at[:, None], columns]))
        return tuple(found)


def eliminate(
    blocks: Iterable[Blocks],
    count: int,
    prior_root_weight: Array,
    prior_right: Array,
    damping: float = 0.0,
    sparse: SparseRows | None = None,
    sharp: bool = True,
    fronts: Fronts | None = None,
) -> Factor:
    """Factorise the observation equations of all blocks together with the priors.

    Parameters
    ----------
    blocks : observation equations; the unknowns that no block owns are shared, and are numbered first.
    count : number of unknowns n.
    prior_root_weight, prior_right : (n,) pseudo-observations: prior_root_weight times unknown = prior_right.
    damping : added to the normal equations of the scaled unknowns (Levenberg and Marquardt).
    sparse : the same equations in sparse form.
    sharp : False: singular values below 1e-6 need not be distinguished from 1e-6.
    fronts : fronts of the shared unknowns, which are numbered in elimination order; default a single front.

    Notes
    -----
    Large problems with `sparse` equations avoid Householder QR. Their own unknowns are eliminated by Gram-Schmidt
    orthonormalisation, and the reduced normal equations of the shared unknowns are factorised (Cholesky). This squares
    the condition number: the relative error of variances is at most about 1e-16 times the squared condition, 1e-10 for
    a condition of 1e3. Worse conditioned problems are factorised by Householder QR; those too large for that are
    accepted up to a condition of 1e6.
    """
    cost = reflections_cost(fronts, *sparse.pattern.left_over) if sparse is not None and fronts is not None else 0.0
    is_large = sparse is not None and cost > (CHEAP if sharp else REFLECTED)
    blocks = blocks if is_large else list(blocks)  # laid out once
    equations = sparse.equations(fronts) if sparse is not None and fronts is not None and is_large else None
    if sparse is not None and equations is not None:
        squares = sparse.column_squares(count, equations)
    else:
        squares = np.zeros(count)
        for block in blocks:
            of_block = np.einsum("bmk,bmk->bk", block.matrix, block.matrix)
            squares += np.bincount(column_values(np.arange(count), block).ravel(), of_block.ravel(), count)
    squares += prior_root_weight**2
    scale = np.where(squares > 0.0, np.sqrt(squares), 1.0)
    # Combine prior and damping of each unknown in one row: coefficient and right side.
    together = np.hypot(prior_root_weight / scale, np.sqrt(damping))
    priors = together, prior_root_weight / scale * prior_right / np.where(together > 0.0, together, 1.0)
    if sparse is not None and equations is not None:
        factor = _eliminate_normally(sparse, scale, priors, equations, 0.0 if sharp else SAFE)
        least = SAFE if cost > REFLECTED else TEN_DIGITS
        if factor is not None and (not sharp or factor.triangle.reciprocal_condition > least):
            return factor
    return _reflect_all(blocks, scale, priors, fronts)


def _reflect_all(blocks: Iterable[Blocks], scale: Array, priors: tuple[Array, Array], fronts: Fronts | None) -> Factor:
    """Factorise by Householder QR: the triangles of the blocks, then their remaining rows in the shared unknowns."""
    factors, rests = [], []
    for block in blocks:
        (count, height, width), own_count = block.matrix.shape, block.own.shape[1]
        rows = np.zeros((count, height + own_count, width + 1))  # the right side last
        np.divide(block.matrix, column_values(scale, block)[:, None, :], out=rows[:, :height, :-1])
        rows[:, :height, -1] = block.right
        rows[:, height:, :own_count] = priors[0][block.own][..., None] * np.eye(own_count)
        rows[:, height:, -1] = priors[1][block.own]
        reduced = qr_triangle(rows)
        own = reduced[:, :own_count]
        of_own = own[..., :own_count], own[..., own_count:-1], own[..., -1]
        factors.append(BlockFactors(block.own, block.shared, *of_own))
        rests.append((block.shared, reduced[:, own_count:, own_count:]))
    fronts = fronts or Fronts.single(len(scale) - sum(block.own.size for block in factors))
    triangle, right = reflect_fronts(fronts, rests, *(prior[: fronts.count] for prior in priors))
    return Factor(DenseBlocks(tuple(factors)), triangle, right, scale)


def _eliminate_normally(
    rows: SparseRows, scale: Array, priors: tuple[Array, Array], equations: SharedEquations, lift: float
) -> Factor | None:
    """Factorise with reduced normal equations of the shared unknowns; None if these are not positive definite."""
    # lift: its square is added to the diagonal of the scaled normal equations.
    fronts, squares = equations.fronts, equations.squares
    root_weight, prior_right = (prior[: fronts.count] for prior in priors)
    blocks = eliminate_blocks(rows, *priors, scale, equations)
    over = 1.0 / scale[: fronts.count]
    for front, square in zip(fronts, squares, strict=True):
        square *= over[front.columns]
        square *= over[front.columns, None]
        square[range(front.count), range(front.count)] += root_weight[front.own] ** 2 + lift**2
    right = over * equations.right + root_weight * prior_right
    try:
        triangle, right = factorise_normal_equations(fronts, squares, right)
    except np.linalg.LinAlgError:
        return None
    return Factor(blocks, triangle, right, scale, lift)

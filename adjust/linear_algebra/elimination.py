"""Block elimination in bordered least-squares problems: each block's own unknowns are reduced onto the shared ones.

The observations of an image, or of a point, depend on its own unknowns and on some shared ones. An orthogonal
(Householder) factorisation of these rows gives a triangle for the own unknowns and fewer rows in the shared ones; the
remaining rows of all blocks are factorised together. The cost is linear in the number of blocks, and the condition
number is that of the design matrix, not its square as with normal equations (Golub and Van Loan, Matrix Computations,
section 5.3; Triggs et al., Bundle adjustment: a modern synthesis). Blocks of equal shape are factorised together.

Observations that no single block contains form blocks without own unknowns: all their unknowns must be shared.

In large networks the normal equations of the remaining rows are factorised. Of many small blocks, for example points,
whose rows involve few of the shared unknowns, the kernels eliminate the own unknowns at once (Schur complement): their
columns are orthonormalised by the Gram-Schmidt method, twice, which is as accurate as Householder reflections (Giraud,
Langou and Rozloznik 2005, The loss of orthogonality in the Gram-Schmidt orthogonalization process). No dense blocks are
formed. The reduced normal equations of the shared unknowns are N = A'A - B'B, with the rows A and the borders B.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_array

import compiled
from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import BlockFactors, Blocks, DenseBlocks, Eliminated, Factor, column_values
from adjust.linear_algebra.normal_equations import SharedEquations, SparseRows
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


def eliminate_blocks(
    rows: SparseRows, root_weight: Array, prior_right: Array, scale: Array, equations: SharedEquations
) -> "SparseBlocks":
    """Eliminate all own unknowns by the kernels, at most COMPILED_OWN of a block.

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
    assert compiled.kernels is not None
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

    def substitute(self, solution: Array) -> None:
        """Compute the own unknowns by back substitution in a scaled solution (n,) with the shared ones solved."""
        count, diagonal = self.rows.pattern.count, np.einsum("bii->bi", self.triangle)
        if not diagonal.all():
            raise np.linalg.LinAlgError("a block is singular")
        shared, pattern = solution[:count] / self.scale[:count], self.rows.pattern
        sparse = bsr_array((self.parts, pattern.groups, pattern.first), shape=(self.right.size, pattern.members.size))
        of_groups = sparse @ np.append(shared, 0.0)[pattern.members.ravel()]
        rest = self.right - of_groups.reshape(self.right.shape) - self.alone @ shared[pattern.singles]
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
        if compiled.kernels is None or not triangle.is_safely_squared:
            yield from DenseBlocks(self.blocks).own_cofactors(triangle)
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
    Large problems with `sparse` equations avoid Householder QR of the shared unknowns: their reduced normal equations
    are factorised (Cholesky). This squares the condition number: the relative error of variances is at most about 1e-16
    times the squared condition, 1e-10 for a condition of 1e3. Worse conditioned problems are factorised by Householder
    QR; those too large for that are accepted up to a condition of 1e6.
    """
    if fronts is None:
        blocks = list(blocks)
        fronts = Fronts.single(count - sum(block.own.size for block in blocks))
    cost = reflections_cost(fronts, *sparse.pattern.left_over) if sparse is not None else 0.0
    is_large = cost > (CHEAP if sharp else REFLECTED)
    equations: SharedEquations | None = None
    if sparse is not None and is_large and compiled.kernels is not None:
        equations = sparse.equations(fronts) if sparse.pattern.own.shape[1] <= COMPILED_OWN else None
    if sparse is not None and equations is not None:
        squares = sparse.column_squares(count, equations)
    else:
        blocks, squares = list(blocks), np.zeros(count)  # laid out once
        for block in blocks:
            of_block = np.einsum("bmk,bmk->bk", block.matrix, block.matrix)
            squares += np.bincount(column_values(np.arange(count), block).ravel(), of_block.ravel(), count)
    squares += prior_root_weight**2
    scale = np.where(squares > 0.0, np.sqrt(squares), 1.0)
    # Combine prior and damping of each unknown in one row: coefficient and right side.
    together = np.hypot(prior_root_weight / scale, np.sqrt(damping))
    priors = together, prior_root_weight / scale * prior_right / np.where(together > 0.0, together, 1.0)
    factor, lift = None, 0.0 if sharp else SAFE
    if sparse is not None and equations is not None:
        eliminated = eliminate_blocks(sparse, *priors, scale, equations)
        factor = _factorise(eliminated, 1.0 / scale[: fronts.count], scale, priors, equations, lift)
    elif is_large:
        dense, rests = _reduce_blocks(blocks, scale, priors)
        equations = SharedEquations.zeros(fronts)
        for shared, rest in rests:
            if shared.shape[1]:
                equations.add_rows(shared, rest[..., :-1], rest[..., -1])
        factor = _factorise(dense, np.ones(fronts.count), scale, priors, equations, lift)
    least = SAFE if cost > REFLECTED else TEN_DIGITS
    if factor is not None and (not sharp or factor.triangle.reciprocal_condition > least):
        return factor
    dense, rests = _reduce_blocks(blocks, scale, priors)
    return Factor(dense, *reflect_fronts(fronts, rests, *(prior[: fronts.count] for prior in priors)), scale)


def _reduce_blocks(
    blocks: Iterable[Blocks], scale: Array, priors: tuple[Array, Array]
) -> tuple[DenseBlocks, list[tuple[Indices, Array]]]:
    """Factorise blocks by Householder QR; returns them and their remaining rows in the scaled shared unknowns."""
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
    return DenseBlocks(tuple(factors)), rests


def _factorise(
    blocks: Eliminated, over: Array, scale: Array, priors: tuple[Array, Array], equations: SharedEquations, lift: float
) -> Factor | None:
    """Factorise reduced normal equations of the shared unknowns; None if these are not positive definite."""
    # over (s,): scaled unknowns by those of the equations; lift: its square is added to the diagonal.
    fronts, squares = equations.fronts, equations.squares
    root_weight, prior_right = (prior[: fronts.count] for prior in priors)
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

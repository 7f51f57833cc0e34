"""Schur complement for many small blocks, for example points, whose rows involve few of the shared unknowns.

The own unknowns of all blocks are eliminated at once: their columns are orthonormalised by the Gram-Schmidt method,
twice, which is as accurate as Householder reflections (Giraud, Langou and Rozloznik 2005, The loss of orthogonality in
the Gram-Schmidt orthogonalization process). No dense blocks are formed. The reduced normal equations of the shared
unknowns are N = A'A - B'B, with the rows A and the borders B: products of block-sparse matrices.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_array, coo_array, csr_array

import compiled
from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import BlockFactors, Blocks
from adjust.linear_algebra.fronts import Fronts
from adjust.linear_algebra.sparse_factor import Triangle

Arranged = Callable[[], Iterable[tuple[Indices, Blocks]]]  # pairs of rows (b, m), and their dense blocks of equal shape
COMPILED_OWN = 3  # largest number of own unknowns per block in kernels.c
ROWS_AT_ONCE = 20_000  # pairs of rows in one batch, which then fits the processor's cache


@dataclass(frozen=True)
class Pattern:
    """Sparsity pattern of n pairs of rows: unknowns of one of b blocks, of one of g groups, and single ones.

    Attributes
    ----------
    columns : own (o,), group (w,), single (c,) columns of the derivatives with respect to these unknowns.
    block, group : (n,) block and group of each pair; b and g for none.
    own, members, single : (b + 1, o), (g + 1, w), (n, c) numbers of the unknowns, -1 for none.
    count : number of shared unknowns: those of the groups, and the single ones.
    """

    columns: tuple[Indices, Indices, Indices]
    block: Indices
    group: Indices
    own: Indices
    members: Indices
    single: Indices
    count: int

    @cached_property
    def singles(self) -> Indices:
        """(t,) numbers of the single unknowns in rows with own unknowns."""
        touched = np.zeros(self.count + 1, dtype=bool)  # the last stands for none
        for numbers in self.single.T:
            touched[numbers[self.block < len(self.own) - 1]] = True
        return np.flatnonzero(touched[:-1])

    @cached_property
    def order(self) -> Indices:
        """(m,) pairs of rows with own unknowns, sorted by block, and within a block in elimination order of groups."""
        order = np.lexsort((self._lowest[self.group], self.block))
        return order[: np.count_nonzero(self.block < len(self.own) - 1)]

    @cached_property
    def groups(self) -> Indices:
        """(m,) groups of the pairs in `order`."""
        return self.group[self.order]

    @cached_property
    def block_numbers(self) -> Indices:
        """(m,) blocks of the pairs in `order`."""
        return self.block[self.order]

    @cached_property
    def first(self) -> Indices:
        """(b + 1,) index in `order` of each block's first pair; the last is m."""
        return np.searchsorted(self.block_numbers, np.arange(len(self.own)))

    @cached_property
    def cells(self) -> tuple[Indices, Indices, Indices]:
        """Cells: pairs of rows with the same shared unknowns.

        Returns the order (n,) of the pairs by cell, the first (p + 1,) of each cell, and its unknowns (p, w + c).
        """
        touched = np.column_stack([self.group, self.single])
        begins = np.append(True, (touched[1:] != touched[:-1]).any(axis=1))  # most pairs equal the one before
        kinds, kind = np.unique(touched[begins], axis=0, return_inverse=True)
        cell = kind[np.cumsum(begins) - 1]
        order = np.argsort(cell, kind="stable")
        unknowns = np.concatenate([self.members[kinds[:, 0]], kinds[:, 1:]], axis=1)
        return order, np.searchsorted(cell[order], np.arange(len(kinds) + 1)), unknowns

    @cached_property
    def place_in_border(self) -> Indices:
        """(o, c, m) flat index in borders (b, o, t + 1) to which products of own and single columns are added."""
        place = np.full(self.count + 1, len(self.singles), dtype=np.intp)
        place[self.singles] = np.arange(len(self.singles))
        rows = self.block_numbers * self.own.shape[1] + np.arange(self.own.shape[1])[:, None]
        return np.asarray(rows[:, None] * (len(self.singles) + 1) + place[self.single[self.order]].T)

    @cached_property
    def _lowest(self) -> Indices:
        """(g + 1,) smallest number of a member of each group."""
        return np.asarray(np.where(self.members >= 0, self.members, self.count).min(axis=1, initial=self.count))

    @cached_property
    def left_over(self) -> tuple[Indices, Indices]:
        """(b + 1,) first shared unknown of each block, and the number of its reduced rows; last, rows without block."""
        first = np.full(len(self.own), self.count)
        np.minimum.at(first, self.block, self._lowest[self.group])
        first = np.where(first < self.count, first, self.singles.min(initial=self.count))
        rows = 2 * np.bincount(self.block, minlength=len(self.own)) - (self.own >= 0).sum(axis=1)
        return first, np.where(first < self.count, np.maximum(rows, 0), 0)


@dataclass(frozen=True)
class Border:
    """Border of r rows in the shared unknowns: block-sparse in the groups, and dense (r, t) in the single ones."""

    pattern: Pattern
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


@dataclass(frozen=True)
class SparseRows:
    """Observation equations in pairs of rows of unit weight, with a sparsity pattern.

    Attributes
    ----------
    matrix : (n, 2, k) derivatives with respect to the unknowns in the pattern.
    right : (n, 2) right sides.
    further : additional rows in shared unknowns only.
    arranged : returns all rows as dense blocks, for rare uses.
    """

    pattern: Pattern
    matrix: Array
    right: Array
    further: tuple[Blocks, ...]
    arranged: Arranged

    def equations(self, fronts: Fronts) -> "SharedEquations":
        """Normal equations of all rows in the shared unknowns, before the own ones are eliminated."""
        pattern, equations = self.pattern, SharedEquations.zeros(fronts)
        order, first, unknowns = pattern.cells
        home = fronts.home(np.where(unknowns >= 0, unknowns, pattern.count))
        if compiled.kernels is not None:
            given = (
                self.right, np.concatenate(pattern.columns[1:]), order, first, unknowns,
                np.argsort(home, kind="stable"), home, fronts.table, fronts.later_unknowns,
            )  # fmt: skip
            compiled.kernels.square_rows(
                self.matrix, *map(np.ascontiguousarray, given), equations.values, equations.right
            )
        else:
            squares = self._cell_squares()
            np.add.at(equations.right, unknowns[unknowns >= 0], squares[:, :-1, -1][unknowns >= 0])
            equations.add_squares(unknowns, home, squares[:, :-1, :-1])
        for block in self.further:
            of_rows = block.matrix.swapaxes(1, 2)
            equations.add_squares(block.shared, fronts.home(block.shared), of_rows @ block.matrix)
            np.add.at(equations.right, block.shared, (of_rows @ block.right[..., None])[..., 0])
        return equations

    def column_squares(self, count: int, equations: "SharedEquations") -> Array:
        """(n,) sums of squares of the columns of all unknowns."""
        squares = np.zeros(count + 1)
        by_own = self.matrix[..., self.pattern.columns[0]]
        for of_rows, unknowns in zip((by_own**2).sum(axis=1).T, self.pattern.own.T, strict=True):
            squares[unknowns] = np.bincount(self.pattern.block, of_rows, len(unknowns))
        squares[: self.pattern.count] = equations.diagonal
        return squares[:-1]

    def _cell_squares(self) -> Array:
        """Normal matrices (p, w + c + 1, w + c + 1) of the cells' rows, the right side as the last column."""
        pattern, (order, first, unknowns) = self.pattern, self.pattern.cells
        width = unknowns.shape[1]
        squares = np.empty((len(unknowns), width + 1, width + 1))
        for cells in _batches(first):
            rows = order[first[cells.start] : first[cells.stop]]
            columns = np.concatenate(
                [_take_columns(self.matrix, np.concatenate(pattern.columns[1:]), rows), self.right[rows].T[None]]
            )
            starts = first[cells] - first[cells.start]
            for i, (x, y) in enumerate(columns):
                sums = np.add.reduceat(x * columns[i:, 0] + y * columns[i:, 1], starts, axis=1).T
                squares[cells, i, i:] = squares[cells, i:, i] = sums
        return squares


@dataclass(frozen=True)
class SharedEquations:
    """Normal equations of the shared unknowns.

    Attributes
    ----------
    values : normal matrices (k + a, k + a) of all fronts, one after the other; the lower triangles count.
    right : (s,) right side.
    """

    fronts: Fronts
    values: Array
    right: Array

    @staticmethod
    def zeros(fronts: Fronts) -> "SharedEquations":
        return SharedEquations(fronts, np.zeros(sum(front.width**2 for front in fronts)), np.zeros(fronts.count))

    @property
    def squares(self) -> list[Array]:
        """Normal matrices (k + a, k + a) of the fronts, as views of the values."""
        begins = self.fronts.table[:, 2].tolist()
        shapes = ((front.width, front.width) for front in self.fronts)
        return [
            self.values[begin : begin + shape[0] ** 2].reshape(shape)
            for begin, shape in zip(begins, shapes, strict=True)
        ]

    @property
    def diagonal(self) -> Array:
        """(s,) diagonal of the normal matrix."""
        diagonal = np.zeros(self.fronts.count)
        for front, square in zip(self.fronts, self.squares, strict=True):
            diagonal[front.columns] += np.diag(square)
        return diagonal

    def add_squares(self, unknowns: Indices, home: Indices, squares: Array) -> None:
        """Add normal matrices (b, s, s) of unknowns (b, s), -1 for none, to those of their fronts home (b,)."""
        of_fronts = self.squares
        for i in np.unique(home):
            of_front = spread_squares(unknowns[home == i], squares[home == i], self.fronts.count).tocoo()
            rows, columns = (self.fronts[int(i)].places(at.astype(np.intp)) for at in (of_front.row, of_front.col))
            of_fronts[i][rows, columns] += of_front.data


def _batches(first: Indices) -> Iterator[slice]:
    """Batches of consecutive sets of rows, the i-th from first[i] to first[i + 1], that fit the processor's cache."""
    start = 0
    while start < len(first) - 1:
        stop = max(start + 1, int(np.searchsorted(first, first[start] + ROWS_AT_ONCE, side="right")) - 1)
        yield slice(start, stop)
        start = stop


def _take_columns(matrix: Array, columns: Indices, order: Indices) -> Array:
    """Columns (c, 2, m) of pairs of rows (n, 2, k), taken in an order (m,)."""
    taken = np.empty((len(columns), 2, len(order)))
    for into, i in zip(taken, columns, strict=True):
        for axis in range(2):
            into[axis] = matrix[:, axis, i][order]
    return taken


def spread_squares(unknowns: Indices, squares: Array, count: int) -> csr_array:
    """Sum (n, n) of matrices (b, s, s) of unknowns (b, s), -1 for none."""
    rows, columns = (np.broadcast_to(at, squares.shape) for at in (unknowns[:, :, None], unknowns[:, None, :]))
    there = (rows >= 0) & (columns >= 0)
    return csr_array(coo_array((squares[there], (rows[there], columns[there])), shape=(count, count)))


def eliminated(
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
    for members in _batches(pattern.first):
        some = slice(pattern.first[members.start], pattern.first[members.stop])
        order, of = pattern.order[some], pattern.block_numbers[some] - members.start
        by_block = csr_array(
            (np.ones(len(of)), np.arange(len(of)), pattern.first[members.start : members.stop + 1] - some.start),
            shape=(members.stop - members.start, len(of)),
        )
        by_own, by_group, by_single = (_take_columns(rows.matrix, columns, order) for columns in pattern.columns)
        by_own.swapaxes(1, 2)[(own[members][of] < 0).T] = 0.0
        by_prior = weight[members].T[..., None] * np.eye(own.shape[1])[:, None, :]
        first = _orthonormal(by_block, of, by_own, by_prior)
        blocks.triangle[members] = _orthonormal(by_block, of, by_own, by_prior) @ first
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


def _orthonormal(by_block: csr_array, of: Indices, columns: Array, by_prior: Array) -> Array:
    """Orthonormalise columns (o, 2, m), with rows (o, b, o) of priors below, in place by modified Gram-Schmidt.

    by_block (b, m): sums over the blocks; of (m,): block of each pair. Returns the triangles (b, o, o).
    """
    count = len(columns)
    triangle = np.zeros((by_prior.shape[1], count, count))
    for i in range(count):
        along = by_block @ (columns[i, 0] * columns[i:, 0] + columns[i, 1] * columns[i:, 1]).T
        along += (by_prior[i] * by_prior[i:]).sum(axis=2).T
        length = np.sqrt(along[:, 0])
        over = 1.0 / np.where(length > 0.0, length, np.inf)
        columns[i] *= over[of]
        by_prior[i] *= over[:, None]
        triangle[:, i, i:] = along * over[:, None]
        rest = triangle[:, i, i + 1 :].T
        columns[i + 1 :] -= rest.take(of, axis=1)[:, None] * columns[i]
        by_prior[i + 1 :] -= rest[..., None] * by_prior[i]
    return triangle


@dataclass(frozen=True)
class SparseBlocks:
    """Blocks after elimination: triangle own + border shared = right, for the unscaled unknowns.

    Attributes
    ----------
    triangle : (b, o, o).
    parts : (m, o, w) border in the groups, for the pairs of rows `Pattern.order`.
    alone : (b, o, t) border in the single unknowns.
    right : (b, o).
    orthonormal : (o, 2, m) orthonormalised columns of the own unknowns.
    scale : (n,) as in `Factor`.
    """

    rows: SparseRows
    triangle: Array
    parts: Array
    alone: Array
    right: Array
    orthonormal: Array
    scale: Array

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
            own[:, i] = (rest[:, i] - (self.triangle[:, i] * own).sum(axis=1)) / diagonal[:, i]
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
            inverse[:, i] -= (scaled[:, i, i + 1 :, None] * inverse[:, i + 1 :]).sum(axis=1)
            inverse[:, i] /= scaled[:, i, i, None]
        return inverse

    def norm_of_inverse(self) -> float:
        """Largest Frobenius norm of the scaled triangles' inverses; inf if one is singular."""
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

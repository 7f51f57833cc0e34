"""Observation equations in pairs of rows with a sparsity pattern, and their normal equations in the shared unknowns."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csr_array

import compiled
from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import Blocks
from adjust.linear_algebra.sparse_factor import Fronts

Arranged = Callable[[], Iterable[tuple[Indices, Blocks]]]  # pairs of rows (b, m), and their dense blocks of equal shape
ROWS_AT_ONCE = 20_000  # pairs of rows in one batch, which then fits the processor's cache


@dataclass(frozen=True)
class SparsityPattern:
    """Sparsity pattern of n pairs of rows: unknowns of one of b blocks, of one of g groups, and single ones."""

    # own (o,), group (w,), single (c,) columns of the derivatives with respect to these unknowns
    columns: tuple[Indices, Indices, Indices]
    # block, group: (n,) block and group of each pair; b and g for none
    block: Indices
    group: Indices
    # own, members, single: (b + 1, o), (g + 1, w), (n, c) numbers of the unknowns, -1 for none
    own: Indices
    members: Indices
    single: Indices
    count: int  # number of shared unknowns: those of the groups, and the single ones

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
class SparseRows:
    """Observation equations in pairs of rows of unit weight, with a sparsity pattern."""

    pattern: SparsityPattern
    matrix: Array  # (n, 2, k) derivatives with respect to the unknowns in the pattern
    right: Array  # (n, 2) right sides
    further: tuple[Blocks, ...]  # additional rows in shared unknowns only
    arranged: Arranged  # returns all rows as dense blocks, for rare uses

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
        for column, unknowns in zip(self.pattern.columns[0], self.pattern.own.T, strict=True):
            of_rows = self.matrix[:, 0, column] ** 2 + self.matrix[:, 1, column] ** 2
            squares[unknowns] = np.bincount(self.pattern.block, of_rows, len(unknowns))
        squares[: self.pattern.count] = 0.0
        for front, square in zip(equations.fronts, equations.squares, strict=True):
            squares[front.columns] += np.diag(square)
        return squares[:-1]

    def _cell_squares(self) -> Array:
        """Normal matrices (p, w + c + 1, w + c + 1) of the cells' rows, the right side as the last column."""
        pattern, (order, first, unknowns) = self.pattern, self.pattern.cells
        width = unknowns.shape[1]
        squares = np.empty((len(unknowns), width + 1, width + 1))
        for cells in batches(first):
            rows = order[first[cells.start] : first[cells.stop]]
            columns = np.concatenate(
                [take_columns(self.matrix, np.concatenate(pattern.columns[1:]), rows), self.right[rows].T[None]]
            )
            starts = first[cells] - first[cells.start]
            for i, (x, y) in enumerate(columns):
                sums = np.add.reduceat(x * columns[i:, 0] + y * columns[i:, 1], starts, axis=1).T
                squares[cells, i, i:] = squares[cells, i:, i] = sums
        return squares


@dataclass(frozen=True)
class SharedEquations:
    """Normal equations of the shared unknowns."""

    fronts: Fronts
    values: Array  # normal matrices (k + a, k + a) of all fronts, one after the other; the lower triangles count
    right: Array  # (s,) right side

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

    def add_squares(self, unknowns: Indices, home: Indices, squares: Array) -> None:
        """Add normal matrices (b, s, s) of unknowns (b, s), -1 for none, to those of their fronts home (b,)."""
        of_fronts, shape = self.squares, (self.fronts.count, self.fronts.count)
        for i in np.unique(home):
            own, values = unknowns[home == i], squares[home == i]
            rows, columns = (np.broadcast_to(at, values.shape) for at in (own[:, :, None], own[:, None, :]))
            there = (rows >= 0) & (columns >= 0)
            summed = csr_array(coo_array((values[there], (rows[there], columns[there])), shape=shape)).tocoo()
            rows, columns = (self.fronts[int(i)].places(at.astype(np.intp)) for at in (summed.row, summed.col))
            of_fronts[i][rows, columns] += summed.data


def batches(first: Indices) -> Iterator[slice]:
    """Batches of consecutive sets of rows, the i-th from first[i] to first[i + 1], that fit the processor's cache."""
    start = 0
    while start < len(first) - 1:
        stop = max(start + 1, int(np.searchsorted(first, first[start] + ROWS_AT_ONCE, side="right")) - 1)
        yield slice(start, stop)
        start = stop


def take_columns(matrix: Array, columns: Indices, order: Indices) -> Array:
    """Columns (c, 2, m) of pairs of rows (n, 2, k), taken in an order (m,)."""
    taken = np.empty((len(columns), 2, len(order)))
    for into, i in zip(taken, columns, strict=True):
        for axis in range(2):
            into[axis] = matrix[:, axis, i][order]
    return taken

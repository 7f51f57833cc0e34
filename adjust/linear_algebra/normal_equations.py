"""Observation equations in pairs of rows with a sparsity pattern, and their normal equations in the shared unknowns."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csr_array

import compiled
from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import Blocks
from adjust.linear_algebra.sparse_factor import Fronts

Arranged = Callable[[], Iterable[tuple[Indices, Blocks]]]  # pairs of rows (b, m), and their dense blocks of equal shape


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
    def first(self) -> Indices:
        """(b + 1,) index in `order` of each block's first pair; the last is m."""
        return np.searchsorted(self.block[self.order], np.arange(len(self.own)))

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
        """Normal equations of all rows in the shared unknowns, before the own ones are eliminated, by the kernels."""
        pattern, equations = self.pattern, SharedEquations.zeros(fronts)
        order, first, unknowns = pattern.cells
        home = fronts.home(np.where(unknowns >= 0, unknowns, pattern.count))
        assert compiled.kernels is not None
        given = (
            self.right, np.concatenate(pattern.columns[1:]), order, first, unknowns,
            np.argsort(home, kind="stable"), home, fronts.table, fronts.later_unknowns,
        )  # fmt: skip
        compiled.kernels.square_rows(self.matrix, *map(np.ascontiguousarray, given), equations.values, equations.right)
        for block in self.further:
            equations.add_rows(block.shared, block.matrix, block.right)
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

    def add_rows(self, unknowns: Indices, rows: Array, right: Array) -> None:
        """Add the normal equations of rows (b, m, s) in unknowns (b, s), and of their right sides (b, m)."""
        of_fronts, shape, home = self.squares, (self.fronts.count, self.fronts.count), self.fronts.home(unknowns)
        squares = rows.swapaxes(1, 2) @ rows
        for i in np.unique(home):
            own, values = unknowns[home == i], squares[home == i]
            rows_at, columns = (np.broadcast_to(at, values.shape) for at in (own[:, :, None], own[:, None, :]))
            summed = csr_array(coo_array((values.ravel(), (rows_at.ravel(), columns.ravel())), shape=shape)).tocoo()
            into, columns = (self.fronts[int(i)].places(at.astype(np.intp)) for at in (summed.row, summed.col))
            of_fronts[i][into, columns] += summed.data
        np.add.at(self.right, unknowns, (rows.swapaxes(1, 2) @ right[..., None])[..., 0])

"""Sums of the normal equations of many blocks that share many unknowns, each block a few of them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csr_array

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Groups:
    """Shared unknowns (s,) that blocks meet together, those of an image or of a point: their group, -1 for none, and
    their place in it.
    """

    group: Indices
    place: Indices

    @property
    def count(self) -> int:
        return int(self.group.max(initial=-1)) + 1

    @property
    def width(self) -> int:
        """The unknowns of the largest group."""
        return int(self.place.max(initial=0)) + 1

    @property
    def members(self) -> Indices:
        """(count * width,) the unknowns group by group, -1 behind those of smaller ones."""
        members = np.full((self.count, self.width), -1, dtype=np.intp)
        grouped = np.flatnonzero(self.group >= 0)
        members[self.group[grouped], self.place[grouped]] = grouped
        return members.ravel()


def border_square(groups: Groups, borders: Iterable[tuple[Indices, Array]]) -> csr_array:
    """The sum (s, s) of B'B over blocks; of each shape the shared unknowns (b, s') and the borders B (b, o, s').

    As a product of sparse matrices of dense parts: a row of parts a block, a column a group. What is in no group, the
    cameras, is few.
    """
    single = np.flatnonzero(groups.group < 0)
    place_of_single = np.zeros(len(groups.group), dtype=np.intp)
    place_of_single[single] = np.arange(len(single))
    by_height: dict[int, list[tuple[_Parts, Array]]] = {}
    for shared, border in borders:
        alone = np.zeros((*border.shape[:2], len(single)))
        block, column = np.nonzero(groups.group[shared] < 0)
        alone[block, :, place_of_single[shared[block, column]]] = border[block, :, column]
        rows = _parts(groups, shared, border), alone.reshape(-1, len(single))
        by_height.setdefault(border.shape[1], []).append(rows)
    count = len(groups.group)
    square = csr_array((count, count))
    for members in by_height.values():
        parts = _joined([each for each, _ in members], groups)
        alone = np.concatenate([each for _, each in members])
        square = square + _numbered(groups.members, groups.members, bsr_array(parts.T @ parts).tocoo(), count)
        across = _numbered(groups.members, single, coo_array(parts.T @ alone), count)
        square = square + across + across.T + _numbered(single, single, coo_array(alone.T @ alone), count)
    return csr_array(square)


def _numbered(rows: Indices, columns: Indices, square: coo_array, count: int) -> csr_array:
    """A matrix whose rows and columns stand for some of all unknowns, -1 for none, as a matrix (n, n) of all."""
    row, column = rows[square.row], columns[square.col]
    there = (row >= 0) & (column >= 0)
    return csr_array(coo_array((square.data[there], (row[there], column[there])), shape=(count, count)))


def spread_squares(unknowns: Indices, squares: Array, count: int) -> csr_array:
    """The sum (n, n) of squares (b, s, s) of some unknowns (b, s) each."""
    rows, columns = (np.broadcast_to(at, squares.shape).ravel() for at in (unknowns[:, :, None], unknowns[:, None, :]))
    return csr_array(coo_array((squares.ravel(), (rows, columns)), shape=(count, count)))


@dataclass(frozen=True)
class _Parts:
    """The borders of b blocks in the groups: dense parts (p, o, w), their groups (p,), how many of each block (b,)."""

    data: Array
    group: Indices
    count: Indices


def _parts(groups: Groups, shared: Indices, border: Array) -> _Parts:
    group = groups.group[shared]
    # Shared unknowns stand in order, so that those of a group stand together.
    before = np.concatenate([np.full((len(group), 1), -1), group[:, :-1]], axis=1)
    starts = (group >= 0) & (group != before)
    part = (np.cumsum(starts) - 1).reshape(starts.shape)
    data = np.zeros((int(starts.sum()), border.shape[1], groups.width))
    block, column = np.nonzero(group >= 0)
    data[part[block, column], :, groups.place[shared[block, column]]] = border[block, :, column]
    return _Parts(data, group[starts], starts.sum(axis=1))


def _joined(parts: list[_Parts], groups: Groups) -> bsr_array:
    data = np.concatenate([each.data for each in parts])
    rows = np.concatenate([[0], np.cumsum(np.concatenate([each.count for each in parts]))])
    shape = (len(rows) - 1) * data.shape[1], groups.count * groups.width
    return bsr_array((data, np.concatenate([each.group for each in parts]), rows), shape=shape)

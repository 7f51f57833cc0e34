"""The free unknowns of a problem, numbered, and what the blocks of its observations touch of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adjust.problem import ABSENT, Problem

Indices = NDArray[np.intp]

ELEMENTS_AT_ONCE = 2_000_000  # of the matrices of blocks that are handled together


@dataclass(frozen=True)
class Touched:
    """What b blocks of equal shape touch: their own and shared free unknowns, and where every derivative goes.

    rows (b, m): the observations of every block; own (b, o), shared (b, s): numbers of unknowns. columns (b, m, k): the
    column, own unknowns first, of every derivative; one column behind the last for what is fixed or absent.
    """

    rows: Indices
    own: Indices
    shared: Indices
    columns: Indices


@dataclass(frozen=True)
class Numbering:
    """The free unknowns of a problem, numbered: those that blocks of observations share, then the blocks' own.

    A block is an image, with its orientation and transformation. Where object points have more unknowns than images
    have, a block is a point with its coordinates, and the images' unknowns are shared: whichever leaves less to share.
    What an image shows besides, its fiducials and the known points, is then a block without own unknowns. Points and
    images that further observations tie to others have no unknowns of their own: theirs are shared.
    """

    problem: Problem

    @cached_property
    def free(self) -> Indices:
        """Positions of the free unknowns."""
        free = np.flatnonzero(self.problem.unknowns.sigma > 0.0)
        is_own = np.isin(free, self._blocks.owned)
        return np.concatenate([free[~is_own], free[is_own]])

    @cached_property
    def used(self) -> Indices:
        """The derivatives, by their place in `Problem.columns`, that are by free unknowns in some observation."""
        return np.flatnonzero((self.numbers[self.problem.columns] != ABSENT).any(axis=0))

    @cached_property
    def touched(self) -> list[Touched]:
        """What every block touches, blocks of equal shape together."""
        return list(_arranged(self.numbers[self.problem.columns[:, self.used]], self._blocks, self.numbers))

    @cached_property
    def numbers(self) -> Indices:
        """By position: the number of a free unknown, ABSENT for what is fixed, and at the end for ABSENT."""
        numbers = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        numbers[self.free] = np.arange(len(self.free))
        return numbers

    @cached_property
    def _blocks(self) -> "_Blocks":
        problem, unknowns = self.problem, self.problem.unknowns
        points = np.array(list(unknowns.point.values()), dtype=np.intp).reshape(-1, 3)
        tied = np.zeros(len(unknowns) + 1, dtype=bool)  # the last stands for ABSENT
        for further in problem.further:
            tied[further.positions] = True
        points = points[(unknowns.sigma[points] > 0.0).any(axis=1) & ~tied[points].any(axis=1)]
        images = _side_by_side(
            [
                np.concatenate([unknowns.exterior[image.name], unknowns.transformation[image.name]])
                for image in problem.network.images
            ]
        )
        images[tied[images].any(axis=1)] = ABSENT
        free = np.append(unknowns.sigma > 0.0, False)
        if free[points].sum() <= free[images].sum():
            return _Blocks(images, problem.image_numbers)
        of_point = np.full(len(free), len(points), dtype=np.intp)
        of_point[points[:, 0]] = np.arange(len(points))
        block = of_point[np.where(problem.is_fiducial, ABSENT, problem.places[:, 0])]
        nothing = np.full((len(images), 3), ABSENT, dtype=np.intp)
        others = block == len(points)
        return _Blocks(np.concatenate([points, nothing]), block + np.where(others, problem.image_numbers, 0))


@dataclass(frozen=True)
class _Blocks:
    """owned (b, k): positions of the own unknowns of every block, ABSENT where it has less; of (n,): whose block every
    observation is.
    """

    owned: Indices
    of: Indices


def _side_by_side(rows: list[Indices]) -> Indices:
    """Rows of different lengths as one array, ABSENT behind the shorter."""
    array = np.full((len(rows), max(len(row) for row in rows)), ABSENT, dtype=np.intp)
    for own, row in zip(array, rows, strict=True):
        own[: len(row)] = row
    return array


def _arranged(numbers: Indices, blocks: _Blocks, number: Indices) -> Iterator[Touched]:
    """Blocks of equal shape together; numbers (n, k): those of the unknowns of every derivative."""
    touches, owned = numbers != ABSENT, number[blocks.owned]
    count, owns = int(number.max(initial=ABSENT)) + 1, owned != ABSENT
    first_own = count - int(owns.sum())
    # Every pair of a block and an unknown that it touches or owns: block by block, its own unknowns first.
    of_pair = np.concatenate([np.repeat(blocks.of, touches.sum(axis=1)), np.nonzero(owns)[0]])
    unknown = np.concatenate([numbers[touches], owned[owns]])
    pairs, place = np.unique(of_pair * count + (unknown - first_own) % count, return_inverse=True)
    unknown = (pairs % count + first_own) % count
    first = np.searchsorted(pairs, np.arange(len(owned)) * count)
    widths = np.diff(first, append=len(pairs))
    own_counts = owns.sum(axis=1)
    columns = np.full(numbers.shape, ABSENT, dtype=np.intp)
    columns[touches] = place[: int(touches.sum())] - np.repeat(first[blocks.of], touches.sum(axis=1))

    order = np.argsort(blocks.of, kind="stable")
    heights = np.bincount(blocks.of, minlength=len(owned))
    first_row = np.cumsum(heights) - heights
    shapes, kinds = np.unique(np.stack([heights, own_counts, widths], axis=1), axis=0, return_inverse=True)
    for kind, (height, own_count, width) in enumerate(shapes):
        if height + own_count == 0:
            continue
        at_once = max(1, ELEMENTS_AT_ONCE // (2 * int(height) * (int(width) + 1) + 1))
        members = np.flatnonzero(kinds == kind)
        for some in np.split(members, range(at_once, len(members), at_once)):
            rows = order[first_row[some][:, None] + np.arange(height)]
            own_and_shared = unknown[first[some][:, None] + np.arange(width)]
            of_rows = np.where(columns[rows] == ABSENT, width, columns[rows])
            yield Touched(rows, own_and_shared[:, :own_count], own_and_shared[:, own_count:], of_rows)

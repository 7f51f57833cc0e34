"""The free unknowns of a problem, numbered, and what the blocks of its observations touch of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from adjust.array_types import Indices, Mask
from adjust.linear_algebra.fronts import Fronts, band_order, make_fronts
from adjust.linear_algebra.schur_complement import Pattern
from adjust.problem.problem import ABSENT, Problem, side_by_side

ELEMENTS_AT_ONCE = 2_000_000  # of the matrices of blocks that are handled together


@dataclass(frozen=True)
class Touched:
    """What b blocks of equal shape touch: their own and shared free unknowns, and where every derivative goes.

    rows (b, m): the observations of every block; own (b, o), shared (b, s): numbers of unknowns. columns (b, m, k): the
    column, own unknowns first, of every derivative; one column behind the last for what is fixed or absent. Where all
    blocks or all observations agree, b or m is 1.
    """

    rows: Indices
    own: Indices
    shared: Indices
    columns: Indices


@dataclass(frozen=True)
class Numbering:
    """The free unknowns of a problem, numbered: those that blocks of observations share, then the blocks' own.

    A block is a frame, with its orientation and the transformations and joins of its scans. Where object points have
    more unknowns than frames have, a block is a point with its coordinates, and the frames' unknowns are shared:
    whichever leaves less to share. What a frame shows besides, its fiducials and the known points, is then a block
    without own unknowns. Points and frames that further observations tie to others have no unknowns of their own:
    theirs are shared.
    """

    problem: Problem

    @cached_property
    def free(self) -> Indices:
        """Positions of the free unknowns; the shared ones as they are eliminated."""
        free = np.flatnonzero(self.problem.unknowns.sigma > 0.0)
        return np.concatenate([self._shared_order.positions, free[np.isin(free, self._blocks.owned)]])

    @property
    def fronts(self) -> Fronts:
        """In which the shared unknowns are eliminated."""
        return self._shared_order.fronts

    @cached_property
    def touched(self) -> list[Touched]:
        """What every block touches, blocks of equal shape together."""
        return list(_arranged(self.numbers[self.problem.columns], self._blocks, self.numbers))

    @cached_property
    def numbers(self) -> Indices:
        """By position: the number of a free unknown, ABSENT for what is fixed, and at the end for ABSENT."""
        numbers = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        numbers[self.free] = np.arange(len(self.free))
        return numbers

    @cached_property
    def pattern(self) -> Pattern | None:
        """What every observation touches, without blocks being laid out; None where no images or points are shared, and
        where the frames that own unknowns are parts put together.
        """
        problem, unknowns = self.problem, self.problem.unknowns
        exterior, place, film, *_ = problem.parts
        every = np.arange(problem.parts.width)
        image_columns, place_columns = (
            np.concatenate([every[exterior.columns], every[film.columns]]),
            every[place.columns],
        )
        of_images = np.hstack([problem.exterior[:, exterior.members], problem.film_positions[:, film.members]])
        of_points = self._point_unknowns[:, place.members]
        place_of = np.full(len(unknowns) + 1, len(of_points), dtype=np.intp)  # the last stands for ABSENT
        place_of[self._point_unknowns[:, :1]] = np.arange(len(of_points))[:, None]
        images = image_columns, of_images, problem.image_numbers
        points = place_columns, of_points, place_of[np.where(problem.is_fiducial, ABSENT, problem.places[:, 0])]
        if not self._points_own and (unknowns.join or len(self._frame_unknowns) < len(of_images)):
            return None
        owning, grouped = (points, images) if self._points_own else (images, points)
        own, members = (
            np.pad(self.numbers[of], ((0, 1), (0, 0)), constant_values=ABSENT) for _, of, _ in (owning, grouped)
        )
        own[own < self._shared_count] = ABSENT
        members[members >= self._shared_count] = ABSENT
        block = np.where((own[owning[2]] >= 0).any(axis=1), owning[2], len(own) - 1)
        group = np.where((members[grouped[2]] >= 0).any(axis=1), grouped[2], len(members) - 1)
        if not (members >= 0).any() or not (own[block] >= 0).any():
            return None
        taken = dict(zip(grouped[0], members.T, strict=True)), dict(zip(owning[0], own.T, strict=True))
        single = {}
        for column in every:
            numbers = self.numbers[problem.columns[:, column]]
            for of_all, which in zip(taken, (group, block), strict=True):
                if column in of_all:
                    numbers = np.where(of_all[column][which] >= 0, ABSENT, numbers)
            if (numbers >= 0).any():
                single[column] = numbers
        used, rest = np.array(list(single), dtype=np.intp), np.array(list(single.values()), dtype=np.intp)
        columns = owning[0], grouped[0], used
        return Pattern(columns, block, group, own, members, rest.reshape(-1, len(block)).T, self._shared_count)

    @property
    def _shared_count(self) -> int:
        return len(self._shared_order.positions)

    @cached_property
    def _shared_order(self) -> "_Shared":
        """The shared unknowns: images, or points, that are neighbours one after the other, what is of none behind.

        As they are numbered where all of them are one front.
        """
        free = np.flatnonzero(self.problem.unknowns.sigma > 0.0)
        shared = free[~np.isin(free, self._blocks.owned)]
        group = self._group[shared]
        sizes = np.bincount(group[group >= 0], minlength=len(self._grouped))
        present = np.flatnonzero(sizes)
        met = self._group_meetings[:, present]
        meeting = csr_array(met.T @ met)
        order = band_order(meeting)
        fronts = make_fronts(meeting[order][:, order], sizes[present[order]], int((group < 0).sum()))
        if len(fronts) == 1:
            return _Shared(shared, fronts)
        rank = np.full(len(sizes) + 1, len(sizes), dtype=np.intp)  # the last stands for what is in no group
        rank[present[order]] = np.arange(len(order))
        return _Shared(shared[np.argsort(rank[group], kind="stable")], fronts)

    @property
    def _grouped(self) -> Indices:
        """Positions (g, k) of the unknowns of every frame, or of every point: those that blocks do not own."""
        return self._frame_unknowns if self._points_own else self._point_unknowns

    @cached_property
    def _group(self) -> Indices:
        """By position: of which image or point, of those that are grouped, it is, ABSENT for others and at the end."""
        group = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        group[self._grouped] = np.arange(len(self._grouped))[:, None]
        group[ABSENT] = ABSENT
        return group

    @property
    def _group_meetings(self) -> csr_array:
        """Which groups (b, g) every block of observations meets, and behind these every further observation."""
        groups = [self._frame_of_rows if self._points_own else self._group[self.problem.places[:, 0]]]
        blocks = [self._blocks.of]
        for i, further in enumerate(self.problem.further):
            groups.append(self._group[further.positions])
            blocks.append(np.full(len(further.positions), len(self._blocks.owned) + i))
        group, block = np.concatenate(groups), np.concatenate(blocks)
        some = group >= 0
        shape = len(self._blocks.owned) + len(self.problem.further), len(self._grouped)
        return csr_array((np.ones(int(some.sum())), (block[some], group[some])), shape=shape)

    @property
    def _blocks(self) -> "_Blocks":
        return self._point_blocks if self._points_own else self._frame_blocks

    @cached_property
    def _points_own(self) -> bool:
        free = np.append(self.problem.unknowns.sigma > 0.0, False)  # the last stands for ABSENT
        return bool(free[self._point_blocks.owned].sum() > free[self._frame_blocks.owned].sum())

    @cached_property
    def _is_tied(self) -> Mask:
        """By position: what further observations tie to other unknowns; the last stands for ABSENT."""
        tied = np.zeros(len(self.problem.unknowns) + 1, dtype=bool)
        for further in self.problem.further:
            tied[further.positions] = True
        return tied

    @cached_property
    def _frame_unknowns(self) -> Indices:
        """Positions (frames, k) of the unknowns of every frame, ABSENT behind those that have less."""
        unknowns = self.problem.unknowns
        own: dict[str, list[Indices]] = {}
        for image in self.problem.network.images:
            own.setdefault(image.frame, [unknowns.exterior[image.name]]).append(unknowns.transformation[image.name])
        for (frame, _), pair in unknowns.join.items():
            own[frame].append(pair)
        return side_by_side([np.concatenate(each) for each in own.values()])

    @cached_property
    def _frame_of_rows(self) -> Indices:
        """(n,) the frame of every observation, by its number."""
        return self.problem.network.frame_numbers[self.problem.image_numbers]

    @cached_property
    def _point_unknowns(self) -> Indices:
        """Positions (points, 3) of the unknowns of every point."""
        return np.array(list(self.problem.unknowns.point.values()), dtype=np.intp).reshape(-1, 3)

    @cached_property
    def _frame_blocks(self) -> "_Blocks":
        owned = self._frame_unknowns.copy()
        owned[self._is_tied[owned].any(axis=1)] = ABSENT
        return _Blocks(owned, self._frame_of_rows)

    @cached_property
    def _point_blocks(self) -> "_Blocks":
        problem, unknowns = self.problem, self.problem.unknowns
        points = self._point_unknowns
        points = points[(unknowns.sigma[points] > 0.0).any(axis=1) & ~self._is_tied[points].any(axis=1)]
        of_point = np.full(len(unknowns) + 1, len(points), dtype=np.intp)  # the last stands for ABSENT
        of_point[points[:, 0]] = np.arange(len(points))
        block = of_point[np.where(problem.is_fiducial, ABSENT, problem.places[:, 0])]
        nothing = np.full((len(self._frame_unknowns), 3), ABSENT, dtype=np.intp)
        others = block == len(points)
        return _Blocks(np.concatenate([points, nothing]), block + np.where(others, self._frame_of_rows, 0))


@dataclass(frozen=True)
class _Shared:
    """positions (s,) of the shared unknowns as they are eliminated, and in which fronts."""

    positions: Indices
    fronts: Fronts


@dataclass(frozen=True)
class _Blocks:
    """owned (b, k): positions of the own unknowns of every block, ABSENT where it has less; of (n,): whose block every
    observation is.
    """

    owned: Indices
    of: Indices


def _arranged(derivatives: Indices, blocks: _Blocks, numbers: Indices) -> Iterator[Touched]:
    """Blocks of equal shape together; derivatives (n, k): the numbers of their unknowns; numbers: by position."""
    owned = numbers[blocks.owned]
    count, owns = int(numbers.max(initial=ABSENT)) + 1, owned != ABSENT
    first_own = count - int(owns.sum())
    rank = (np.arange(count + 1) - first_own) % max(count, 1)  # own unknowns first; the last stands for ABSENT
    order = np.argsort(blocks.of, kind="stable")
    # Most observations of a block touch what the one before touched: such runs are looked at once.
    of, unknown = blocks.of[order], derivatives[order]
    begins = np.append(True, (of[1:] != of[:-1]) | (unknown[1:] != unknown[:-1]).any(axis=1))[: len(of)]
    run, of, unknown = np.cumsum(begins) - 1, of[begins], unknown[begins].T
    # Every pair of a block and an unknown that it touches or owns: block by block, its own unknowns first.
    pair = np.where(unknown == ABSENT, ABSENT, of * count + rank[unknown])
    new = pair != ABSENT
    new[:, 1:] &= pair[:, 1:] != pair[:, :-1]
    owned_pairs = np.nonzero(owns)[0] * count + rank[owned[owns]]
    pairs, place = np.unique(np.concatenate([pair[new], owned_pairs]), return_inverse=True)
    first = np.searchsorted(pairs, np.arange(len(owned)) * count)
    widths = np.diff(first, append=len(pairs))
    own_counts = owns.sum(axis=1)
    touched = place[np.maximum(np.cumsum(new).reshape(new.shape) - 1, 0)]
    columns = np.where(pair == ABSENT, widths[of], touched - first[of]).T  # behind the last for what is absent
    unknown = (pairs % count + first_own) % count

    heights = np.bincount(blocks.of, minlength=len(owned))
    first_row = np.cumsum(heights) - heights
    shapes, kinds = np.unique(np.stack([heights, own_counts, widths], axis=1), axis=0, return_inverse=True)
    for kind, (height, own_count, width) in enumerate(shapes):
        if height + own_count == 0:
            continue
        at_once = max(1, ELEMENTS_AT_ONCE // (2 * int(height) * (int(width) + 1) + 1))
        members = np.flatnonzero(kinds == kind)
        for some in np.split(members, range(at_once, len(members), at_once)):
            ordered = first_row[some][:, None] + np.arange(height)
            own_and_shared = unknown[first[some][:, None] + np.arange(width)]
            own, shared = own_and_shared[:, :own_count], own_and_shared[:, own_count:]
            yield Touched(order[ordered], own, shared, _agreed(columns, run[ordered]))


def _agreed(columns: Indices, run: Indices) -> Indices:
    """The columns (b, m, k) of the runs (b, m) of observations, b or m 1 where all agree."""
    if (run == run[:, :1]).all():
        run = run[:, :1]
    of_rows = columns[run]
    for axis in (0, 1):
        first = of_rows.take(range(min(1, of_rows.shape[axis])), axis=axis)
        if (of_rows == first).all():
            of_rows = first
    return of_rows

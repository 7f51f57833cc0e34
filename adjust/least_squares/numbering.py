"""Numbering of the free unknowns of a problem, and the unknowns involved in each block of observations."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from adjust.array_types import Indices, Mask
from adjust.linear_algebra.fronts import Fronts, band_order, make_fronts
from adjust.linear_algebra.sparse_rows import Pattern
from adjust.problem.problem import ABSENT, Problem, side_by_side

ELEMENTS_AT_ONCE = 2_000_000  # matrix elements of the blocks in one batch


@dataclass(frozen=True)
class Touched:
    """Unknowns of b blocks of equal shape, and the columns of their derivatives."""

    rows: Indices  # (b, m) observations of each block
    # own, shared: (b, o), (b, s) numbers of the free unknowns
    own: Indices
    shared: Indices
    # (b, m, k) column of each derivative, own unknowns first; the column after the last for fixed or absent quantities.
    # b or m is 1 where all blocks or all observations agree.
    columns: Indices


@dataclass(frozen=True)
class Numbering:
    """Numbering of the free unknowns: those shared by blocks of observations first, then the blocks' own.

    A block is a frame, which owns its exterior orientation and the film transformations and join points of its scans.
    If the object points have more unknowns than the frames, a block is a point, which owns its coordinates, and the
    unknowns of the frames are shared: so fewer unknowns are shared. The remaining observations of a frame, of fiducials
    and known points, then form a block without own unknowns. Points and frames in further observations own no unknowns:
    theirs are shared.
    """

    problem: Problem

    @cached_property
    def free(self) -> Indices:
        """Positions of the free unknowns, the shared ones in elimination order."""
        free = np.flatnonzero(self.problem.unknowns.sigma > 0.0)
        return np.concatenate([self._shared_order.positions, free[np.isin(free, self._blocks.owned)]])

    @property
    def fronts(self) -> Fronts:
        """Fronts of the shared unknowns."""
        return self._shared_order.fronts

    @cached_property
    def touched(self) -> list[Touched]:
        """Unknowns of all blocks, blocks of equal shape together."""
        return list(_arranged(self.numbers[self.problem.columns], self._blocks, self.numbers))

    @cached_property
    def numbers(self) -> Indices:
        """Number of each unknown by position; ABSENT for fixed ones, and as the last element, for ABSENT itself."""
        numbers = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        numbers[self.free] = np.arange(len(self.free))
        return numbers

    @cached_property
    def pattern(self) -> Pattern | None:
        """Sparsity pattern of the observations.

        None if no images or points are shared, or if frames own unknowns and some are scanned in parts.
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
        """Shared unknowns in elimination order: neighbouring images (or points) in sequence, the remaining ones last.

        In their original order if they form a single front.
        """
        free = np.flatnonzero(self.problem.unknowns.sigma > 0.0)
        shared = free[~np.isin(free, self._blocks.owned)]
        group = self._group[shared]
        sizes = np.bincount(group[group >= 0], minlength=len(self._grouped))
        present = np.flatnonzero(sizes)
        if not len(present):
            return _Shared(shared, Fronts.single(len(shared)))
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
        """Positions (g, k) of the unknowns of each frame, or of each point: of the kind that blocks do not own."""
        return self._frame_unknowns if self._points_own else self._point_unknowns

    @cached_property
    def _group(self) -> Indices:
        """Group (frame or point) of each unknown by position; ABSENT for others, and as the last element."""
        group = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        group[self._grouped] = np.arange(len(self._grouped))[:, None]
        group[ABSENT] = ABSENT
        return group

    @property
    def _group_meetings(self) -> csr_array:
        """Incidence matrix (b, g) of blocks and groups; further observations follow the blocks as more rows."""
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
        """Mask by position of the unknowns in further observations; the last element stands for ABSENT."""
        tied = np.zeros(len(self.problem.unknowns) + 1, dtype=bool)
        for further in self.problem.further:
            tied[further.positions] = True
        return tied

    @cached_property
    def _frame_unknowns(self) -> Indices:
        """Positions (frames, k) of the unknowns of each frame, padded with ABSENT."""
        unknowns = self.problem.unknowns
        own: dict[str, list[Indices]] = {}
        for image in self.problem.network.images:
            own.setdefault(image.frame, [unknowns.exterior[image.name]]).append(unknowns.transformation[image.name])
        for (frame, _), pair in unknowns.join.items():
            own[frame].append(pair)
        return side_by_side([np.concatenate(each) for each in own.values()])

    @cached_property
    def _frame_of_rows(self) -> Indices:
        """(n,) number of the frame of each observation."""
        return self.problem.network.frame_numbers[self.problem.image_numbers]

    @cached_property
    def _point_unknowns(self) -> Indices:
        """Positions (points, 3) of the unknowns of each point."""
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
    """Positions (s,) of the shared unknowns in elimination order, and their fronts."""

    positions: Indices
    fronts: Fronts


@dataclass(frozen=True)
class _Blocks:
    """Blocks. owned (b, k): positions of their own unknowns, padded with ABSENT; of (n,): block of each observation."""

    owned: Indices
    of: Indices


def _arranged(derivatives: Indices, blocks: _Blocks, numbers: Indices) -> Iterator[Touched]:
    """Group blocks by shape."""
    # derivatives (n, k): numbers of the unknowns of each derivative; numbers: number of each unknown by position.
    owned = numbers[blocks.owned]
    count, owns = int(numbers.max(initial=ABSENT)) + 1, owned != ABSENT
    first_own = count - int(owns.sum())
    rank = (np.arange(count + 1) - first_own) % max(count, 1)  # own unknowns first; the last stands for ABSENT
    order = np.argsort(blocks.of, kind="stable")
    # Most observations involve the same unknowns as the one before: process such runs once.
    of, unknown = blocks.of[order], derivatives[order]
    begins = np.append(True, (of[1:] != of[:-1]) | (unknown[1:] != unknown[:-1]).any(axis=1))[: len(of)]
    run, of, unknown = np.cumsum(begins) - 1, of[begins], unknown[begins].T
    # All pairs of a block and an unknown that it involves or owns: block by block, own unknowns first.
    pair = np.where(unknown == ABSENT, ABSENT, of * count + rank[unknown])
    new = pair != ABSENT
    new[:, 1:] &= pair[:, 1:] != pair[:, :-1]
    owned_pairs = np.nonzero(owns)[0] * count + rank[owned[owns]]
    pairs, place = np.unique(np.concatenate([pair[new], owned_pairs]), return_inverse=True)
    first = np.searchsorted(pairs, np.arange(len(owned)) * count)
    widths = np.diff(first, append=len(pairs))
    own_counts = owns.sum(axis=1)
    touched = place[np.maximum(np.cumsum(new).reshape(new.shape) - 1, 0)]
    columns = np.where(pair == ABSENT, widths[of], touched - first[of]).T  # after the last for absent ones
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
    """Columns (b, m, k) of the runs (b, m) of observations; b or m is 1 where all agree."""
    if (run == run[:, :1]).all():
        run = run[:, :1]
    of_rows = columns[run]
    for axis in (0, 1):
        first = of_rows.take(range(min(1, of_rows.shape[axis])), axis=axis)
        if (of_rows == first).all():
            of_rows = first
    return of_rows

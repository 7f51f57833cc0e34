"""Observation equations of an adjustment: numbering of the free unknowns, blocks of observations, weighted rows.

`linear_algebra.elimination` reduces the rows to the shared unknowns, by Householder transformations or by the normal
equations of `linear_algebra.normal_equations`.

Rows are whitened condition equations F1, F2 and F3, F4 in blocks, and priors of unknowns.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

import compiled
from adjust.array_types import Array, Indices
from adjust.linear_algebra.factor import Blocks
from adjust.linear_algebra.normal_equations import SparseRows, SparsityPattern
from adjust.linear_algebra.small_matrices import applied, inverse, lower_root, product
from adjust.linear_algebra.sparse_factor import ELEMENTS_AT_ONCE, Fronts, band_order, make_fronts
from adjust.problem.condition_equations import Derivatives
from adjust.problem.problem import ABSENT, Problem, State, side_by_side


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
        return np.concatenate([self._shared_order[0], free[np.isin(free, self._blocks.owned)]])

    @property
    def fronts(self) -> Fronts:
        """Fronts of the shared unknowns."""
        return self._shared_order[1]

    @cached_property
    def touched(self) -> list[Touched]:
        """Unknowns of all blocks, blocks of equal shape together."""
        return list(_arrange_blocks(self.numbers[self.problem.columns], self._blocks, self.numbers))

    @cached_property
    def numbers(self) -> Indices:
        """Number of each unknown by position; ABSENT for fixed ones, and as the last element, for ABSENT itself."""
        numbers = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        numbers[self.free] = np.arange(len(self.free))
        return numbers

    @cached_property
    def pattern(self) -> SparsityPattern | None:
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
        of_points = problem.point_positions[:, place.members]
        place_of = np.full(len(unknowns) + 1, len(of_points), dtype=np.intp)  # the last stands for ABSENT
        place_of[problem.point_positions[:, :1]] = np.arange(len(of_points))[:, None]
        images = image_columns, of_images, problem.image_numbers
        points = place_columns, of_points, place_of[np.where(problem.is_fiducial, ABSENT, problem.places[:, 0])]
        points_own, shared_count = self._blocks.are_points, len(self._shared_order[0])
        if not points_own and (unknowns.join or len(self._frame_unknowns) < len(of_images)):
            return None
        owning, grouped = (points, images) if points_own else (images, points)
        own, members = (
            np.pad(self.numbers[positions], ((0, 1), (0, 0)), constant_values=ABSENT)
            for _, positions, _ in (owning, grouped)
        )
        own[own < shared_count] = ABSENT
        members[members >= shared_count] = ABSENT
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
        return SparsityPattern(columns, block, group, own, members, rest.reshape(-1, len(block)).T, shared_count)

    @cached_property
    def _shared_order(self) -> tuple[Indices, Fronts]:
        """Positions (s,) of the shared unknowns in elimination order, and their fronts.

        Neighbouring images (or points) are in sequence, the remaining unknowns last. In their original order if they
        form a single front.
        """
        free = np.flatnonzero(self.problem.unknowns.sigma > 0.0)
        shared = free[~np.isin(free, self._blocks.owned)]
        # Frames or points are groups: those of the kind that blocks do not own. The last element stands for ABSENT.
        grouped = self._frame_unknowns if self._blocks.are_points else self.problem.point_positions
        group_of = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        group_of[grouped] = np.arange(len(grouped))[:, None]
        group_of[ABSENT] = ABSENT
        group = group_of[shared]
        sizes = np.bincount(group[group >= 0], minlength=len(grouped))
        present = np.flatnonzero(sizes)
        if not len(present):
            return shared, Fronts.single(len(shared))
        met = self._group_meetings(group_of, len(grouped))[:, present]
        meeting = csr_array(met.T @ met)
        order = band_order(meeting)
        fronts = make_fronts(meeting[order][:, order], sizes[present[order]], int((group < 0).sum()))
        if len(fronts) == 1:
            return shared, fronts
        rank = np.full(len(sizes) + 1, len(sizes), dtype=np.intp)  # the last stands for what is in no group
        rank[present[order]] = np.arange(len(order))
        return shared[np.argsort(rank[group], kind="stable")], fronts

    def _group_meetings(self, group_of: Indices, count: int) -> csr_array:
        """Incidence matrix (b, g) of blocks and groups; further observations follow the blocks as more rows."""
        # group_of: group of each unknown by position, ABSENT for none.
        groups = [
            self.problem.network.observed_frames if self._blocks.are_points else group_of[self.problem.places[:, 0]]
        ]
        blocks = [self._blocks.block_numbers]
        for i, further in enumerate(self.problem.further):
            groups.append(group_of[further.positions])
            blocks.append(np.full(len(further.positions), len(self._blocks.owned) + i))
        group, block = np.concatenate(groups), np.concatenate(blocks)
        some = group >= 0
        shape = len(self._blocks.owned) + len(self.problem.further), count
        return csr_array((np.ones(int(some.sum())), (block[some], group[some])), shape=shape)

    @cached_property
    def _blocks(self) -> "_Blocks":
        """Blocks of the frames, or of the points where these own more free unknowns."""
        problem, unknowns = self.problem, self.problem.unknowns
        tied = np.zeros(len(unknowns) + 1, dtype=bool)  # in further observations; the last stands for ABSENT
        for further in problem.further:
            tied[further.positions] = True
        of_frames, points = self._frame_unknowns.copy(), problem.point_positions
        of_frames[tied[of_frames].any(axis=1)] = ABSENT
        points = points[(unknowns.sigma[points] > 0.0).any(axis=1) & ~tied[points].any(axis=1)]
        free = np.append(unknowns.sigma > 0.0, False)  # the last stands for ABSENT
        if free[points].sum() <= free[of_frames].sum():
            return _Blocks(of_frames, self.problem.network.observed_frames, are_points=False)
        of_point = np.full(len(unknowns) + 1, len(points), dtype=np.intp)  # the last stands for ABSENT
        of_point[points[:, 0]] = np.arange(len(points))
        block = of_point[np.where(problem.is_fiducial, ABSENT, problem.places[:, 0])]
        nothing = np.full((len(of_frames), 3), ABSENT, dtype=np.intp)  # the frames' other observations own nothing
        block = block + np.where(block == len(points), self.problem.network.observed_frames, 0)
        return _Blocks(np.concatenate([points, nothing]), block, are_points=True)

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


@dataclass(frozen=True)
class _Blocks:
    """Blocks. owned (b, k): positions of their own unknowns, padded with ABSENT; block_numbers (n,):
    block of each observation."""

    owned: Indices
    block_numbers: Indices
    are_points: bool  # or frames


def _arrange_blocks(derivatives: Indices, blocks: _Blocks, numbers: Indices) -> Iterator[Touched]:
    """Group blocks by shape."""
    # derivatives (n, k): numbers of the unknowns of each derivative; numbers: number of each unknown by position.
    owned = numbers[blocks.owned]
    count, owns = int(numbers.max(initial=ABSENT)) + 1, owned != ABSENT
    first_own = count - int(owns.sum())
    rank = (np.arange(count + 1) - first_own) % max(count, 1)  # own unknowns first; the last stands for ABSENT
    order = np.argsort(blocks.block_numbers, kind="stable")
    # Most observations involve the same unknowns as the one before: process such runs once.
    block, unknown = blocks.block_numbers[order], derivatives[order]
    begins = np.append(True, (block[1:] != block[:-1]) | (unknown[1:] != unknown[:-1]).any(axis=1))[: len(block)]
    run, block, unknown = np.cumsum(begins) - 1, block[begins], unknown[begins].T
    # All pairs of a block and an unknown that it involves or owns: block by block, own unknowns first.
    pair = np.where(unknown == ABSENT, ABSENT, block * count + rank[unknown])
    new = pair != ABSENT
    new[:, 1:] &= pair[:, 1:] != pair[:, :-1]
    owned_pairs = np.nonzero(owns)[0] * count + rank[owned[owns]]
    pairs, place = np.unique(np.concatenate([pair[new], owned_pairs]), return_inverse=True)
    first = np.searchsorted(pairs, np.arange(len(owned)) * count)
    widths = np.diff(first, append=len(pairs))
    own_counts = owns.sum(axis=1)
    touched = place[np.maximum(np.cumsum(new).reshape(new.shape) - 1, 0)]
    columns = np.where(pair == ABSENT, widths[block], touched - first[block]).T  # after the last for absent ones
    unknown = (pairs % count + first_own) % count

    heights = np.bincount(blocks.block_numbers, minlength=len(owned))
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


@dataclass(frozen=True)
class WhitenedRows:
    """Rows of unit weight; iterates over the blocks of `Numbering.touched`, formed on demand, and of `further`."""

    numbering: Numbering
    root: Array  # (n, 2, 2) Cholesky factor L of A C A' = L L'
    matrix: Array  # (n, 2, k) derivatives with respect to the unknowns at `Problem.columns`
    right: Array  # (n, 2) right sides
    further: tuple[Blocks, ...]  # one block for each further observation

    def __iter__(self) -> Iterator[Blocks]:
        for touched in self.numbering.touched:
            yield _blocks(touched, self.matrix, self.right)
        yield from self.further

    def replace_discrepancies(self, by_observation: Array, v_mm: Array) -> "WhitenedRows":
        """Replace the right side by that of other discrepancies v (n, 2); by_observation: A (n, 2, 2)."""
        return replace(self, right=_whiten(self.root, applied(by_observation, v_mm)[..., None])[..., 0])

    def change_mm(self, by_observation: Array, step: Array) -> Array:
        """First-order change -A^-1 B dx of the computed observations (n, 2) by a step dx of the unknowns."""
        by_column = np.append(step, 0.0)[self.numbering.problem.columns]  # the last stands for ABSENT
        along = applied(self.root, np.einsum("nij,nj->ni", self.matrix, by_column))
        return -applied(inverse(by_observation), along)

    @cached_property
    def sparse(self) -> SparseRows | None:
        """Rows in sparse form; None without a `Numbering.pattern`."""
        pattern = self.numbering.pattern
        if pattern is None:
            return None
        itself = replace(self)  # a copy avoids a reference cycle, so that the memory is freed before the next step
        return SparseRows(pattern, self.matrix, self.right, self.further, itself._arrange_blocks)

    def _arrange_blocks(self) -> Iterator[tuple[Indices, Blocks]]:
        nothing = np.empty((1, 0), dtype=np.intp)
        rows = [touched.rows for touched in self.numbering.touched] + [nothing] * len(self.further)
        return zip(rows, self, strict=True)


def whitened_rows(
    numbering: Numbering, values: Array, at: Derivatives, covariance_mm2: Array, v_mm: Array
) -> WhitenedRows:
    """Whiten the rows B dx = w of all blocks: multiply each pair by L^-1, where A C A' = L L'.

    F is 0 at the computed observations, so that w = -A (l_obs - l_k) = A v, with v (n, 2) = computed minus observed.
    The derivatives B in `at` are overwritten. Further observations have the rows f'(x) dx = l - f(x); all their
    unknowns are shared.
    """
    a, matrix, further = at.by_observation, at.by_unknowns, list[Blocks]()
    for each in numbering.problem.further:
        numbers = numbering.numbers[each.positions]
        free, of_each = numbers != ABSENT, np.linalg.cholesky(each.covariance)
        by_unknowns = np.linalg.solve(of_each, each.jacobian(values)[:, free])
        difference = np.linalg.solve(of_each, each.observed - each.computed(values))
        nothing = np.empty((1, 0), dtype=np.intp)
        further.append(Blocks(nothing, numbers[None, free], by_unknowns[None], difference[None]))
    if compiled.kernels is not None:
        root, right = np.empty(a.shape), np.empty(v_mm.shape)
        compiled.kernels.whiten_rows(a, covariance_mm2, v_mm, root, matrix, right)
        return WhitenedRows(numbering, root, matrix, right, tuple(further))
    root = lower_root(product(product(a, covariance_mm2), a.transpose(0, 2, 1)))
    right = _whiten(root, applied(a, v_mm)[..., None])[..., 0]
    return WhitenedRows(numbering, root, _whiten(root, matrix), right, tuple(further))


def _whiten(root: Array, rows: Array) -> Array:
    """Multiply rows (n, 2, k) by the inverses of lower triangles (n, 2, 2), in place to save memory."""
    rows[:, 0] /= root[:, 0, :1]
    rows[:, 1] -= root[:, 1, :1] * rows[:, 0]
    rows[:, 1] /= root[:, 1, 1:]
    return rows


def _blocks(touched: Touched, matrix: Array, right: Array) -> Blocks:
    """Form dense rows of blocks of equal shape from all rows (n, 2, k), each derivative in its unknown's column."""
    (count, height), width = touched.rows.shape, touched.own.shape[1] + touched.shared.shape[1]
    of_blocks = _row_values(right, touched.rows).reshape(count, 2 * height)
    if touched.columns.shape[:2] == (1, 1) and np.array_equal(touched.columns[0, 0], np.arange(width)):
        as_they_are = _row_values(matrix, touched.rows).reshape(count, 2 * height, width)
        return Blocks(touched.own, touched.shared, as_they_are, of_blocks)
    by_column = np.zeros((count, width + 1, height, 2))  # contiguous by column, for column operations
    if touched.columns.shape[:2] == (1, 1):
        for k, column in enumerate(touched.columns[0, 0]):
            by_column[:, column] = _row_values(matrix[..., k], touched.rows)
    elif len(touched.columns) == 1 and height <= count:
        for row, columns in enumerate(touched.columns[0]):
            by_column[:, columns, row] = matrix[touched.rows[:, row]].swapaxes(1, 2)
    else:
        columns = np.broadcast_to(touched.columns[:, :, None, :], (count, height, 2, matrix.shape[2]))
        np.put_along_axis(by_column.transpose(0, 2, 3, 1), columns, matrix[touched.rows], axis=3)
    dense = by_column[:, :width].reshape(count, width, 2 * height).swapaxes(1, 2)
    return Blocks(touched.own, touched.shared, dense, of_blocks)


def _row_values(values: Array, rows: Indices) -> Array:
    """Values (b, m, ...) of rows (b, m) from all values (n, ...); a view if the rows are consecutive."""
    first, count = int(rows[0, 0]) if rows.size else 0, rows.size
    if np.array_equal(rows.ravel(), np.arange(first, first + count)):
        return values[first : first + count].reshape(*rows.shape, *values.shape[1:])
    return np.asarray(values[rows])


def prior_root_weights(numbering: Numbering) -> Array:
    """(f,) inverse prior standard deviations of the free unknowns, of pseudo-observations too; 0 without a prior."""
    return np.asarray(1.0 / numbering.problem.prior_sigma[numbering.free])


def prior_differences(problem: Problem, state: State) -> Array:
    """(n,) given minus current values of all quantities, angles reduced to half a turn; 0 where nothing is given."""
    unknowns = problem.unknowns
    differences = np.where(np.isnan(unknowns.given), 0.0, unknowns.given - state.values)
    angles = problem.exterior[:, 3:]
    differences[angles] = (differences[angles] + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(differences)

"""The weighted rows of an adjustment: whitened pairs F1, F2 and F3, F4 in blocks, and the unknowns' priors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adjust.elimination import Block
from adjust.functions import Derivatives
from adjust.further_observations import FurtherObservation
from adjust.problem import ABSENT, Problem, State

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Touched:
    """What a block's observations touch: numbers of its own and of shared free unknowns, where every derivative goes.

    rows (m,): its observations. columns (m, k): the column, own unknowns first, of every derivative; one column behind
    the last for what is fixed or absent.
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
    Points and images that further observations tie to others have no unknowns of their own: theirs are shared.
    """

    problem: Problem

    @cached_property
    def free(self) -> Indices:
        """Positions of the free unknowns."""
        free = np.flatnonzero(self.problem.unknowns.sigma > 0.0)
        own = np.concatenate([positions for _, positions in self._blocks])
        is_own = np.isin(free, own)
        return np.concatenate([free[~is_own], free[is_own]])

    @cached_property
    def numbers(self) -> Indices:
        """The number of every quantity among the free unknowns, ABSENT if it is fixed; the last stands for ABSENT."""
        numbers = np.full(len(self.problem.unknowns) + 1, ABSENT, dtype=np.intp)
        numbers[self.free] = np.arange(len(self.free))
        return numbers

    @cached_property
    def touched(self) -> list[Touched]:
        """What every block touches."""
        problem = self.problem
        numbers = self.numbers
        column_of = np.empty(len(self.free) + 1, dtype=np.intp)
        touched = []
        for rows, positions in self._blocks:
            derivatives = numbers[problem.columns[rows]]
            own, used = np.unique(numbers[positions]), np.unique(derivatives)
            own, used = own[own != ABSENT], used[used != ABSENT]
            shared = np.setdiff1d(used, own)
            columns = np.concatenate([own, shared])
            column_of[columns] = np.arange(len(columns))
            column_of[ABSENT] = len(columns)
            touched.append(Touched(rows, own, shared, column_of[derivatives]))
        return touched

    @cached_property
    def _blocks(self) -> list[tuple[Indices, Indices]]:
        """Observations and positions of the own unknowns of every block."""
        unknowns = self.problem.unknowns
        tied = np.zeros(len(unknowns), dtype=bool)
        for further in self.problem.further:
            tied[further.positions] = True
        points = [
            positions
            for positions in unknowns.point.values()
            if unknowns.sigma[positions].any() and not tied[positions].any()
        ]
        images = [
            np.concatenate([unknowns.exterior[image.name], unknowns.transformation[image.name]])
            for image in self.problem.network.images
        ]
        images = [positions[:0] if tied[positions].any() else positions for positions in images]
        if _count(unknowns.sigma, points) > _count(unknowns.sigma, images):
            return self._blocks_by_point(points)
        return list(zip(self.problem.rows_by_image, images, strict=True))

    def _blocks_by_point(self, points: list[Indices]) -> list[tuple[Indices, Indices]]:
        """One block a point with unknowns, and one without own unknowns for all else that an image shows."""
        number_of = {int(positions[0]): i for i, positions in enumerate(points)}
        first = np.where(self.problem.is_fiducial, ABSENT, self.problem.places[:, 0])
        of_point = np.array([number_of.get(int(position), len(points)) for position in first], dtype=np.intp)
        order = np.argsort(of_point, kind="stable")
        ends = np.cumsum(np.bincount(of_point, minlength=len(points) + 1))
        rows = np.split(order, ends[:-1])
        others = [np.intersect1d(rows[-1], of_image) for of_image in self.problem.rows_by_image]
        nothing = np.empty(0, dtype=np.intp)
        return [*zip(rows[:-1], points, strict=True), *((each, nothing) for each in others if len(each))]


def _count(sigma: Array, positions: list[Indices]) -> int:
    """How many of the unknowns at some positions are free."""
    return int((sigma[np.concatenate(positions)] > 0.0).sum()) if positions else 0


@dataclass(frozen=True)
class WhitenedRows:
    """Rows of unit weight: root (n, 2, 2), the factor L of A C A' = L L', and the blocks.

    The pairs of rows stand in one block each of `Numbering.touched`; a block for each further observation follows.
    """

    root: Array
    blocks: list[Block]


def whitened_rows(
    numbering: Numbering, values: Array, at: Derivatives, covariance_mm2: Array, v_mm: Array
) -> WhitenedRows:
    """The rows B dx = w of all blocks, every pair multiplied by L^-1, where A C A' = L L'.

    At computed observations F is 0, so that w = -A (l_obs - l_k) = A v, with v (n, 2) = computed less observed.
    """
    a = at.by_observation
    root = np.asarray(np.linalg.cholesky(a @ covariance_mm2 @ a.transpose(0, 2, 1)), dtype=np.float64)
    matrix = np.asarray(np.linalg.solve(root, at.by_unknowns), dtype=np.float64)
    right = np.asarray(np.linalg.solve(root, a @ v_mm[..., None])[..., 0], dtype=np.float64)
    blocks = [_block(touched, matrix[touched.rows], right[touched.rows]) for touched in numbering.touched]
    return WhitenedRows(root, blocks + [_further_block(numbering, each, values) for each in numbering.problem.further])


def _block(touched: Touched, matrix: Array, right: Array) -> Block:
    count = len(touched.own) + len(touched.shared)
    dense = np.zeros((len(matrix), 2, count + 1))
    np.put_along_axis(dense, np.repeat(touched.columns[:, None, :], 2, axis=1), matrix, axis=2)
    return Block(touched.own, touched.shared, dense[..., :count].reshape(-1, count), right.reshape(-1))


def _further_block(numbering: Numbering, further: FurtherObservation, values: Array) -> Block:
    """The rows f'(x) dx = l - f(x) of a further observation; what it touches is shared."""
    numbers = numbering.numbers[further.positions]
    free = numbers != ABSENT
    root = np.linalg.cholesky(further.covariance)
    matrix = np.linalg.solve(root, further.by_unknowns(values)[:, free])
    right = np.linalg.solve(root, further.observed - further.computed(values))
    return Block(np.empty(0, dtype=np.intp), numbers[free], matrix, right)


def prior_root_weights(numbering: Numbering) -> Array:
    """One over the standard deviation of every free unknown's prior (f,), 0 where it has none."""
    return np.asarray(1.0 / numbering.problem.unknowns.sigma[numbering.free])


def of_cameras(numbering: Numbering) -> NDArray[np.bool_]:
    """Which free unknowns (f,) are those of cameras: fiducials, interior orientation, distortion (F5 to F9)."""
    unknowns = numbering.problem.unknowns
    positions = [*unknowns.camera.values(), *unknowns.fiducial.values()]
    return np.isin(numbering.free, np.concatenate(positions))


def prior_differences(problem: Problem, state: State) -> Array:
    """Given less present values (n,) of all quantities, angles within half a turn; 0 where nothing is given."""
    unknowns = problem.unknowns
    differences = np.where(np.isnan(unknowns.given), 0.0, unknowns.given - state.values)
    angles = problem.exterior[:, 3:]
    differences[angles] = (differences[angles] + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(differences)

"""The weighted rows of an adjustment: whitened pairs F1, F2 and F3, F4 image by image, and the unknowns' priors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adjust.elimination import Block
from adjust.functions import Derivatives
from adjust.problem import ABSENT, Problem, State

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Touched:
    """What an image's rows touch: numbers of its own and of shared free unknowns, and where every derivative goes.

    columns (m, k): the column, own unknowns first, of every derivative of its m observations; one column behind the
    last for what is fixed or absent.
    """

    own: Indices
    shared: Indices
    columns: Indices


@dataclass(frozen=True)
class Numbering:
    """The free unknowns of a problem, numbered in their order; those of the images come last."""

    problem: Problem

    @cached_property
    def free(self) -> Indices:
        """Positions of the free unknowns."""
        return np.flatnonzero(self.problem.unknowns.sigma > 0.0)

    @cached_property
    def touched(self) -> list[Touched]:
        """What every image touches."""
        problem, unknowns = self.problem, self.problem.unknowns
        numbers = np.full(len(unknowns) + 1, ABSENT, dtype=np.intp)  # the last stands for ABSENT
        numbers[self.free] = np.arange(len(self.free))
        column_of = np.empty(len(self.free) + 1, dtype=np.intp)
        touched = []
        for image, rows in zip(problem.network.images, problem.rows_by_image, strict=True):
            positions = np.concatenate([unknowns.exterior[image.name], unknowns.transformation[image.name]])
            own = np.unique(numbers[positions])
            used = np.unique(numbers[problem.columns[rows]])
            own, used = own[own != ABSENT], used[used != ABSENT]
            shared = np.setdiff1d(used, own)
            columns = np.concatenate([own, shared])
            column_of[columns] = np.arange(len(columns))
            column_of[ABSENT] = len(columns)
            touched.append(Touched(own, shared, column_of[numbers[problem.columns[rows]]]))
        return touched


@dataclass(frozen=True)
class WhitenedRows:
    """Pairs of rows of unit weight: root (n, 2, 2), the factor L of A C A' = L L', and the images' blocks."""

    root: Array
    blocks: list[Block]


def whitened_rows(numbering: Numbering, at: Derivatives, covariance_mm2: Array, v_mm: Array) -> WhitenedRows:
    """The rows B dx = w of all images, every pair multiplied by L^-1, where A C A' = L L'.

    At computed observations F is 0, so that w = -A (l_obs - l_k) = A v, with v (n, 2) = computed less observed.
    """
    a = at.by_observation
    root = np.asarray(np.linalg.cholesky(a @ covariance_mm2 @ a.transpose(0, 2, 1)), dtype=np.float64)
    matrix = np.asarray(np.linalg.solve(root, at.by_unknowns), dtype=np.float64)
    right = np.asarray(np.linalg.solve(root, a @ v_mm[..., None])[..., 0], dtype=np.float64)
    blocks = [
        _block(touched, matrix[rows], right[rows])
        for touched, rows in zip(numbering.touched, numbering.problem.rows_by_image, strict=True)
    ]
    return WhitenedRows(root, blocks)


def _block(touched: Touched, matrix: Array, right: Array) -> Block:
    count = len(touched.own) + len(touched.shared)
    dense = np.zeros((len(matrix), 2, count + 1))
    np.put_along_axis(dense, np.repeat(touched.columns[:, None, :], 2, axis=1), matrix, axis=2)
    return Block(touched.own, touched.shared, dense[..., :count].reshape(-1, count), right.reshape(-1))


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

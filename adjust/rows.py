"""The weighted rows of an adjustment: whitened pairs F1, F2 and F3, F4 in blocks, and the unknowns' priors."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adjust.elimination import Blocks, Sums
from adjust.functions import Derivatives
from adjust.further_observations import FurtherObservation
from adjust.numbering import ELEMENTS_AT_ONCE, Numbering, Touched
from adjust.problem import ABSENT, Problem, State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WhitenedRows:
    """Rows of unit weight; in turn the blocks of `Numbering.touched`, of large networks put together as asked for.

    A block for each further observation follows. root (n, 2, 2): the factor L of A C A' = L L'; matrix (n, 2, k): by
    the unknowns of `Numbering.used`; right (n, 2).
    """

    numbering: Numbering
    root: Array
    matrix: Array
    right: Array
    further: tuple[Blocks, ...]

    def __iter__(self) -> Iterator[Blocks]:
        yield from self._at_hand if self.matrix.size <= ELEMENTS_AT_ONCE else self._put_together()

    @cached_property
    def _at_hand(self) -> list[Blocks]:
        return list(self._put_together())

    def _put_together(self) -> Iterator[Blocks]:
        for touched in self.numbering.touched:
            yield _blocks(touched, self.matrix[touched.rows], self.right[touched.rows])
        yield from self.further

    @property
    def sums(self) -> Sums:
        """How these rows are summed up where there are too many to be factorised."""
        return Sums(_Summed(self), self.numbering.groups)


@dataclass(frozen=True)
class _Summed:
    """The rows arranged as in `Numbering.summed`, and the further observations."""

    rows: WhitenedRows

    def __iter__(self) -> Iterator[Blocks]:
        for touched in self.rows.numbering.summed:
            yield _blocks(touched, self.rows.matrix[touched.rows], self.rows.right[touched.rows])
        yield from self.rows.further


def whitened_rows(
    numbering: Numbering, values: Array, at: Derivatives, covariance_mm2: Array, v_mm: Array
) -> WhitenedRows:
    """The rows B dx = w of all blocks, every pair multiplied by L^-1, where A C A' = L L'.

    At computed observations F is 0, so that w = -A (l_obs - l_k) = A v, with v (n, 2) = computed less observed.
    """
    a = at.by_observation
    root = np.asarray(np.linalg.cholesky(a @ covariance_mm2 @ a.transpose(0, 2, 1)), dtype=np.float64)
    rows = np.concatenate([at.by_unknowns[:, :, numbering.used], a @ v_mm[..., None]], axis=2)
    rows[:, 0] /= root[:, :1, 0]
    rows[:, 1] -= root[:, 1, :1] * rows[:, 0]
    rows[:, 1] /= root[:, 1, 1:]
    further = tuple(_further_block(numbering, each, values) for each in numbering.problem.further)
    return WhitenedRows(numbering, root, rows[..., :-1], rows[..., -1], further)


def _blocks(touched: Touched, matrix: Array, right: Array) -> Blocks:
    """The rows (b, m, 2, k) of blocks of equal shape with every derivative in its unknown's column."""
    (count, height), width = touched.rows.shape, touched.own.shape[1] + touched.shared.shape[1]
    dense = np.zeros((count, height, 2, width + 1))
    if len(touched.columns) == 1 and touched.columns.shape[1] <= count:
        for row, columns in enumerate(touched.columns[0]):
            rows = slice(None) if touched.columns.shape[1] == 1 else slice(row, row + 1)
            dense[:, rows, :, columns] = matrix[:, rows]
    else:
        columns = np.broadcast_to(touched.columns[:, :, None, :], matrix.shape)
        np.put_along_axis(dense, columns, matrix, axis=3)
    dense = dense[..., :width].reshape(count, 2 * height, width)
    return Blocks(touched.own, touched.shared, dense, right.reshape(count, 2 * height))


def _further_block(numbering: Numbering, further: FurtherObservation, values: Array) -> Blocks:
    """The rows f'(x) dx = l - f(x) of a further observation; what it touches is shared."""
    numbers = numbering.numbers[further.positions]
    free = numbers != ABSENT
    root = np.linalg.cholesky(further.covariance)
    matrix = np.linalg.solve(root, further.by_unknowns(values)[:, free])
    right = np.linalg.solve(root, further.observed - further.computed(values))
    return Blocks(np.empty((1, 0), dtype=np.intp), numbers[None, free], matrix[None], right[None])


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

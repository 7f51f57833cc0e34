"""Weighted rows of an adjustment: whitened condition equations F1, F2 and F3, F4 in blocks, and priors of unknowns."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

import compiled
from adjust.array_types import Array, Indices, Mask
from adjust.least_squares.numbering import Numbering, Touched
from adjust.linear_algebra.factor import Blocks
from adjust.linear_algebra.small_matrices import applied, inverse, lower_root, product
from adjust.linear_algebra.sparse_rows import SparseRows
from adjust.problem.condition_equations import Derivatives
from adjust.problem.further_observations import FurtherObservation
from adjust.problem.problem import ABSENT, Problem, State


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
        return replace(self, right=_whitened(self.root, applied(by_observation, v_mm)[..., None])[..., 0])

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
        return SparseRows(pattern, self.matrix, self.right, self.further, itself._arranged)

    def _arranged(self) -> Iterator[tuple[Indices, Blocks]]:
        nothing = np.empty((1, 0), dtype=np.intp)
        rows = [touched.rows for touched in self.numbering.touched] + [nothing] * len(self.further)
        return zip(rows, self, strict=True)


def whitened_rows(
    numbering: Numbering, values: Array, at: Derivatives, covariance_mm2: Array, v_mm: Array
) -> WhitenedRows:
    """Whiten the rows B dx = w of all blocks: multiply each pair by L^-1, where A C A' = L L'.

    F is 0 at the computed observations, so that w = -A (l_obs - l_k) = A v, with v (n, 2) = computed minus observed.
    The derivatives B in `at` are overwritten.
    """
    a, matrix = at.by_observation, at.by_unknowns
    further = tuple(_further_block(numbering, each, values) for each in numbering.problem.further)
    if compiled.kernels is not None:
        root, right = np.empty(a.shape), np.empty(v_mm.shape)
        compiled.kernels.whiten_rows(a, covariance_mm2, v_mm, root, matrix, right)
        return WhitenedRows(numbering, root, matrix, right, further)
    root = lower_root(product(product(a, covariance_mm2), a.transpose(0, 2, 1)))
    right = _whitened(root, applied(a, v_mm)[..., None])[..., 0]
    return WhitenedRows(numbering, root, _whitened(root, matrix), right, further)


def _whitened(root: Array, rows: Array) -> Array:
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


def _further_block(numbering: Numbering, further: FurtherObservation, values: Array) -> Blocks:
    """Rows f'(x) dx = l - f(x) of a further observation, all of whose unknowns are shared."""
    numbers = numbering.numbers[further.positions]
    free = numbers != ABSENT
    root = np.linalg.cholesky(further.covariance)
    matrix = np.linalg.solve(root, further.jacobian(values)[:, free])
    right = np.linalg.solve(root, further.observed - further.computed(values))
    return Blocks(np.empty((1, 0), dtype=np.intp), numbers[None, free], matrix[None], right[None])


def prior_root_weights(numbering: Numbering) -> Array:
    """(f,) inverse prior standard deviations of the free unknowns, of pseudo-observations too; 0 without a prior."""
    return np.asarray(1.0 / numbering.problem.prior_sigma[numbering.free])


def camera_mask(numbering: Numbering) -> Mask:
    """(f,) mask of the free unknowns of cameras (F5 to F9: fiducials, interior orientation, distortion) and
    scanners."""
    unknowns = numbering.problem.unknowns
    positions = [*unknowns.camera.values(), *unknowns.fiducial.values(), *unknowns.scanner.values()]
    return np.isin(numbering.free, np.concatenate(positions))


def prior_differences(problem: Problem, state: State) -> Array:
    """(n,) given minus current values of all quantities, angles reduced to half a turn; 0 where nothing is given."""
    unknowns = problem.unknowns
    differences = np.where(np.isnan(unknowns.given), 0.0, unknowns.given - state.values)
    angles = problem.exterior[:, 3:]
    differences[angles] = (differences[angles] + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(differences)

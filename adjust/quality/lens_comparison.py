"""Comparison of calibrations of one camera, as a field of differences over the frame.

A calibration maps every camera point to a ray and places the fiducial marks. Two calibrations are equivalent if they
differ only by changes without effect: a similarity of the fiducial frame, which the interior orientation of a scan
absorbs, and a rotation of the rays, which the exterior orientation absorbs. The pixels of a digital camera, which has
no fiducials, are no convention: its frame has no similarity. The remaining difference is a field over the frame with a
known covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.linalg import block_diag, qr

from adjust.array_types import Array
from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Lens
from adjust.functional_model.projection import ray_by_orientation
from adjust.quality.significance import f_probability

Use = Literal["space", "flat"]

_GRID = 7  # points per side of the field
_UNSEEN_UM = 0.01  # negligible in any photograph: smaller differences and standard deviations count as zero
_RANK = 1e-9
_ROTATIONS = 3  # of the rays, the first changes of an orientation


@dataclass(frozen=True)
class CameraCalibration:
    """Calibration of a camera by one adjustment.

    fiducials: camera coordinates (2,), mm, by id. covariance (3 + k + 2 f, 3 + k + 2 f): of the lens's quantities, then
    of the fiducials, x before y; zero for fixed values. redundancy: of the observations that determine sigma0; 0 if
    standard deviations are a priori.
    """

    name: str
    lens: Lens
    fiducials: dict[str, Array]
    covariance: Array
    redundancy: float


@dataclass(frozen=True)
class Test:
    """Test of a hypothesis: chi-square, degrees of freedom, p-value."""

    chi_square: float
    freedom: int
    probability: float


@dataclass(frozen=True)
class Comparison:
    """Differences of n later calibrations from the first one.

    Attributes
    ----------
    times : (n + 1,).
    places_mm : (m, 2) of the field, in the frame of the first calibration.
    field_um, field_covariance_um2 : (n, m, 2) and (n, m, 2, 2) difference at each place, on the film at the c of the
        first calibration, after removal of orientation and datum.
    fiducials : common to all calibrations.
    fiducials_um, fiducials_covariance_um2 : (n, f, 2) and (n, f, 2, 2) differences after a similarity.
    same : test of the hypothesis that all calibrations are equal.
    trend : test of a linear change with time against equality; None for two calibrations.
    trend_um, trend_covariance_um2 : (m, 2) and (m, 2, 2) linear change of the field from the first time to the last.
    """

    calibrations: tuple[CameraCalibration, ...]
    times: Array
    use: Use
    places_mm: Array
    field_um: Array
    field_covariance_um2: Array
    fiducials: tuple[str, ...]
    fiducials_um: Array
    fiducials_covariance_um2: Array
    same: Test
    trend: Test | None
    trend_um: Array
    trend_covariance_um2: Array

    @property
    def probability(self) -> float:
        """P-value for an unchanged camera; for a series, which has two tests, the Bonferroni bound."""
        if self.trend is None:
            return self.same.probability
        return min(1.0, 2.0 * min(self.same.probability, self.trend.probability))


def compare(
    calibrations: Sequence[CameraCalibration],
    corners_mm: Array,
    times: Sequence[float] | Array | None = None,
    use: Use = "space",
) -> Comparison:
    """Compare two or more calibrations of a camera, in the order of time.

    Parameters
    ----------
    corners_mm : (2, 2) lower left and upper right corner of the area in the camera frame over which the field is taken.
    times : of the calibrations, such as years; by default 0, 1, 2, ...
    use : changes that the exterior orientation absorbs. "space": rotations; "flat": also shifts, as over flat ground,
        where a change of c or of the principal point is a change of the station.

    Raises
    ------
    AdjustmentError
        For fewer than two calibrations, or times that do not match them.
    """
    if len(calibrations) < 2:
        raise AdjustmentError("a comparison needs two calibrations or more.")
    if use not in get_args(Use):
        raise AdjustmentError(f"the use of a camera is one of {', '.join(get_args(Use))}, not {use!r}.")
    when = np.arange(len(calibrations), dtype=float) if times is None else np.asarray(times, float)
    if len(when) != len(calibrations) or not (np.diff(when) > 0).all():
        raise AdjustmentError(f"{len(calibrations)} calibrations need as many times, in rising order, not {when}.")
    shared = tuple(id for id in calibrations[0].fiducials if all(id in each.fiducials for each in calibrations))
    across, along = np.linspace(corners_mm[0], corners_mm[1], _GRID).T
    places = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
    is_film = any(each.fiducials for each in calibrations)
    views = [_view(each, calibrations[0], places, shared, use, is_film) for each in calibrations]
    redundancies = [each.redundancy for each in calibrations if each.redundancy > 0.0]
    same, trend = _tests(views, when, min(redundancies, default=0.0))
    freeing, count = _freeing(views[0], len(shared)), len(places)
    one = np.eye(len(views))
    field, covariance = map(
        np.array, zip(*(_free_view(views, freeing, each - one[0]) for each in one[1:]), strict=True)
    )
    # the linear change from the first time to the last, by weighted regression
    variances = np.array([np.square(freeing @ view.root).sum(axis=1).mean() for view in views])
    weights = 1.0 / (variances + _UNSEEN_UM**2)
    along = when - np.average(when, weights=weights)
    change, change_covariance = _free_view(views, freeing, weights * along * np.ptp(when) / np.sum(weights * along**2))
    return Comparison(
        calibrations=tuple(calibrations),
        times=when,
        use=use,
        places_mm=places,
        field_um=field[:, :count],
        field_covariance_um2=covariance[:, :count],
        fiducials=shared,
        fiducials_um=field[:, count:],
        fiducials_covariance_um2=covariance[:, count:],
        same=same,
        trend=trend if len(calibrations) > 2 else None,
        trend_um=change[:count],
        trend_covariance_um2=change_covariance[:count],
    )


def sigmas(covariance: Array) -> Array:
    """Standard deviations (..., 2) of covariances (..., 2, 2)."""
    return np.asarray(np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)))


class _View(NamedTuple):
    """Rays of the places and positions of the shared fiducials by one calibration, in the axes of the first one.

    value (2 (m + f),), µm; root (2 (m + f), n): square root of its covariance. Its changes without effect: of_frame
    (2 (m + f), 4), with the similarity of the frame, none for a digital camera; of_orientation (2 (m + f), q).
    """

    value: Array
    root: Array
    of_frame: Array
    of_orientation: Array

    @property
    def unseen(self) -> Array:
        return np.hstack([self.of_frame, self.of_orientation])


def _view(
    own: CameraCalibration, first: CameraCalibration, places_mm: Array, shared: Sequence[str], use: Use, is_film: bool
) -> _View:
    c_um = 1e3 * first.lens.interior[0]
    marks, there = (np.array([each.fiducials[id] for id in shared]).reshape(-1, 2) for each in (own, first))
    frame, shift = _similarity(there, marks)
    points_mm = places_mm @ frame.T + shift
    ray, found = own.lens.ray_from_observed(points_mm)
    if not found.all():
        raise AdjustmentError(
            f"the distortion of {own.name} folds the image over within the frame: it is not known there. "
            "Compare over a smaller frame."
        )
    equations, turn = own.lens.equations(points_mm, ray), frame / np.sqrt(np.linalg.det(frame))
    ray = ray @ turn  # the small remaining rotation is removed with the orientation

    def field_change(by: Array) -> Array:
        """(m, 2, n) changes of the field, µm, from changes of the equations (m, 2, n)."""
        return np.asarray(-c_um * turn.T @ np.linalg.solve(equations.ray_jacobian, by))

    names, by = list(own.fiducials), equations.quantity_jacobian
    rows = [2 * names.index(id) + axis for id in shared for axis in (0, 1)]
    of_marks = 1e3 * np.eye(2 * len(names))[rows].reshape(len(rows), 2 * len(names))
    jacobian = block_diag(field_change(by).reshape(-1, by.shape[2]), of_marks)
    sigmas = np.sqrt(np.diag(own.covariance))
    divisors = np.where(sigmas > 0.0, sigmas, 1.0)  # scale: k5 is in mm**-4, c in mm
    values, vectors = np.linalg.eigh(own.covariance / np.outer(divisors, divisors))
    root = jacobian @ (sigmas[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))

    points, count = np.concatenate([points_mm, marks]), len(ray)
    x, y = points.T
    ones, zeros = np.ones(len(points)), np.zeros(len(points))
    moves = np.array([(ones, zeros), (zeros, ones), (-y, x), (x, y)]).transpose(2, 1, 0)
    of_frame = np.concatenate([field_change(equations.xy_jacobian @ moves[:count]), -1e3 * moves[count:]])
    bundle = c_um * ray_by_orientation(ray, np.ones(count))[:, :, : 6 if use == "flat" else 3]  # rotations, shifts
    orientation = np.concatenate([bundle, np.zeros((len(marks), *bundle.shape[1:]))])
    of_frame, of_orientation = (each.reshape(2 * len(points), -1) for each in (of_frame, orientation))
    value = np.concatenate([c_um * ray, 1e3 * (marks - shift) @ np.linalg.inv(frame).T])
    return _View(value.ravel(), root, of_frame if is_film else of_frame[:, :0], of_orientation)


def _similarity(first: Array, second: Array) -> tuple[Array, Array]:
    """Similarity (2, 2), (2,) from points of the first frame to those of the second; the identity for one point."""
    if len(first) < 2:
        return np.eye(2), np.zeros(2)
    middle, there = first.mean(axis=0), second.mean(axis=0)
    a, b = (first - middle) @ np.array([1.0, 1.0j]), (second - there) @ np.array([1.0, 1.0j])
    factor = np.vdot(a, b) / np.vdot(a, a)
    turn = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return turn, there - turn @ middle


def _freeing(view: _View, marks: int) -> Array:
    """(2 (m + f), 2 (m + f)) projector that removes the similarity fitted to the marks, then the orientation fitted to
    the field, both by unweighted least squares: the remaining field is the smallest possible."""
    of_marks, everything = np.arange(len(view.value)) >= len(view.value) - 2 * marks, np.eye(len(view.value))
    by_marks, rest = everything, view.unseen
    if marks > 1:
        frame, rest = view.of_frame, view.of_orientation
        by_marks = everything - frame @ np.linalg.pinv(frame * of_marks[:, None], rcond=_RANK)
    by_field = everything - rest @ np.linalg.pinv(rest * ~of_marks[:, None], rcond=_RANK)
    return np.asarray(by_field @ by_marks)


def _free_view(views: Sequence[_View], freeing: Array, factors: Array) -> tuple[Array, Array]:
    """Linear combination (m + f, 2) of the views without the changes without effect, and its covariance by place."""
    change = np.sum([k * (view.value - views[0].value) for k, view in zip(factors, views, strict=True)], axis=0)
    root = np.hstack([k * (freeing @ view.root) for k, view in zip(factors, views, strict=True)])
    by_place = root.reshape(-1, 2, root.shape[1])
    return (freeing @ change).reshape(-1, 2), by_place @ by_place.swapaxes(1, 2)


def _tests(views: Sequence[_View], times: Array, redundancy: float) -> tuple[Test, Test]:
    """Test equality, and a linear change with time against it.

    Linear model of all views, whitened, in the directions with uncertainty: y = a (+ b t) + changes without effect,
    those of the first view, in whose axes all views are given.
    """
    left, sizes, _ = np.linalg.svd(np.concatenate([view.root for view in views], axis=1), full_matrices=False)
    known = sizes > _UNSEEN_UM * np.sqrt(len(left))
    if not known.any():
        raise AdjustmentError("none of the calibrations has standard deviations: there is nothing to compare with.")
    basis, unseen = left[:, known], views[0].unseen
    # What a rotation changes outside these directions tells it from a shift of the principal point.
    rotations = views[0].of_orientation[:, :_ROTATIONS]
    rotations = rotations / np.linalg.norm(rotations, axis=0)
    outside, lengths, _ = np.linalg.svd(rotations - basis @ (basis.T @ rotations), full_matrices=False)
    basis = np.hstack([basis, outside[:, lengths > _RANK]])
    inside = basis.T @ unseen
    right, steady, moving, unseen_rows = list[Array](), list[Array](), list[Array](), list[Array]()
    for view, time in zip(views, times - times[0], strict=True):
        covariance = basis.T @ view.root @ view.root.T @ basis + _UNSEEN_UM**2 * np.eye(basis.shape[1])
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        right.append(whitening @ basis.T @ (view.value - views[0].value))
        steady.append(whitening)
        moving.append(whitening * time)
        unseen_rows.append(whitening @ inside)
    # The frame and attitude of the first view are the reference.
    free = np.vstack([np.zeros((len(right[0]), inside.shape[1] * (len(views) - 1))), block_diag(*unseen_rows[1:])])
    y = np.concatenate(right)

    def left_over(*columns: Sequence[Array]) -> tuple[float, int]:
        """v'Pv with some columns, and the rank of the design matrix."""
        design = np.hstack([*map(np.vstack, columns), free])
        sizes = np.linalg.norm(design, axis=0)
        vectors, triangle, _ = qr(design / np.where(sizes > 0, sizes, 1.0), mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(triangle))
        explained = np.asarray(vectors[:, diagonal > _RANK * diagonal.max(initial=0.0)])
        rest = y - explained @ (explained.T @ y)
        return float(rest @ rest), explained.shape[1]

    def test(chi: float, freedom: int) -> Test:
        """F-test where sigma0 of a calibration comes from observations, perhaps few; chi-square where it is given."""
        probability = f_probability(chi / freedom, freedom, redundancy) if freedom else 1.0
        return Test(chi, freedom, probability)

    (still, fewer), (less, more) = left_over(steady), left_over(steady, moving)
    return test(still, len(y) - fewer), test(still - less, more - fewer)

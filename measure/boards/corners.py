"""Where two straight edges meet, to the noise of the picture: the crossings of a chessboard, the corners of a marker.

The picture of two crossing edges under a Gaussian blur is known in closed form. With s1, s2 the signs of a point's
distances from the edges it is the mean of s1 s2 over the blur, a bivariate normal integral: by Owen's T function exact
for any angle between the edges; a single dark or light quarter is the same integral. Unknown are the point, both
directions, the blur, and the grey values: contrast, offset, gradient and, of a crossing, the bend of the tone curve,
which widens light squares at the cost of dark ones. A crossing looks the same after a half turn whatever the tone
curve, so its place does not depend on it; a quarter's does, by as much as the edges are moved.

Beside it stands the junction: the place that the lines along the grey values' gradients miss least (Förstner and Gülch,
1987, A fast operator for detection and precise location of distinct points, corners and centres of circular features).
A lens with coma blurs edges to one side, and then a crossing has no one place: match and junction differ by tenths of a
pixel, growing towards the picture's corners. There the junction, found by `cv2.cornerSubPix`, is what most published
calibrations measure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import erf, ndtr, owens_t

from measure.flags import NO_REASON, Code, Reason
from measure.matching.gauss_newton import gauss_newton
from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.matching.window import ScanWindow
from measure.noise.noise_model import correlated, noise_model, products
from measure.noise.robust_estimation import gauss_newton_step, robust_scale, tukey_weights
from measure.results import Covariance, MarkMeasurement

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Surface = Callable[[Array, Array, float], tuple[Array, Array, Array, Array]]

_SCALE_FLOOR = 0.05  # of the contrast, under Tukey's scale: sharpening and tone curves are no damage
_MAX_ITERATIONS = 30  # of a stage
_UNDAMAGED = 0.05  # the robust weight below which a pixel shows something else
# Plain, then thrice robust: the scale of the residuals is taken once before each, so that it settles.
_STAGES_TOLERANCE_PX = (0.05, 0.05, 0.01, 0.001)
_SHAPE_UNKNOWNS = 5  # point (2), directions (2), blur
_MOST_SHIFT = 0.6  # of the reach: farther off, another corner's edges are nearer
_MOST_TURN_RAD = 0.35  # of an edge: twenty degrees, which no approximate place is wrong by
_START_BLUR_PX, _LEAST_BLUR_PX = 0.8, 0.3  # the pixel's share included
_DAMPING = 1e-9  # of a step: what hardly shows does not run away
_LONGEST_TURN_RAD = 0.15  # of an edge in a step: its picture is no longer linear in more
_LARGEST_HALF_WINDOW_PX = 6  # about a junction: more shows what the lens does to longer edges
_HALF_WINDOW = 0.85  # of the reach: the weight is 0.37 in the middle of the window's sides and 0.14 in its corners
_SMOOTHING_PX = 1.0  # pixel noise has gone, the edges are still apart
_SUBPIX_BORDER_PX = 5  # what OpenCV wants of a picture beyond twice half a window
_SUBPIX_END = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-4)  # iterations, px of the last step
_NEIGHBOURS = 4  # crossings: the next ones along the rows and columns
_FEWEST_CROSSINGS = 30  # with fewer nobody can tell coma from noise


@dataclass(frozen=True, eq=False)
class Corner:
    """A corner as fitted; where reason is not empty the fit failed, and the numbers are its last.

    center_px (2,), covariance_px2 (2, 2): as matched; contrast_dn: the grey value between the two steps less that
    beside them, negative where it is dark between them; blur_px: the standard deviation; moved_px: from where the fit
    began. junction_px (2,): where the
    gradients' lines meet (`junction`); None where they do not, and for a corner that is no crossing.
    """

    center_px: Array
    covariance_px2: Array
    contrast_dn: float
    noise_dn: float
    blur_px: float
    damaged_fraction: float
    moved_px: float
    reason: Reason = NO_REASON
    junction_px: Array | None = None


def fit_corner(window: ScanWindow, start_px: Array, steps_px: Array, reach_px: Array, surface: Surface) -> Corner:
    """Fit the corner near start_px (2,), in a window of the scan.

    steps_px (2, 2): its columns run along the two edges; reach_px (2,): how far along either of them, forth and back,
    grey values are used. surface: `crossing` or `quarter`.
    """
    return _CornerFit(window, np.asarray(start_px, float), np.asarray(steps_px, float), reach_px, surface).run()


def crossing(u: Array, v: Array, correlation: float) -> tuple[Array, Array, Array, Array]:
    """The mean of sign(u + z1) sign(v + z2) over standard normal z1, z2 of the given correlation, and its derivatives
    by u, v and the correlation.

    Owen (1956), Tables for computing bivariate normal probabilities, Annals of Mathematical Statistics 27.
    """
    root = np.sqrt(max(1 - correlation**2, 1e-12))
    u, v = (np.where(np.abs(place) < 1e-9, 1e-9, place) for place in (u, v))
    across_u, across_v = (v - correlation * u) / root, (u - correlation * v) / root
    value = np.sign(u) * np.sign(v) - 4 * (owens_t(u, across_u / u) + owens_t(v, across_v / v))
    by_u = 2 * _density(u) * erf(across_u / np.sqrt(2))
    by_v = 2 * _density(v) * erf(across_v / np.sqrt(2))
    return value, by_u, by_v, 4 * _density(u) * _density(across_u) / root


def quarter(u: Array, v: Array, correlation: float) -> tuple[Array, Array, Array, Array]:
    """Twice the probability that u + z1 and v + z2 are both positive, less one, and its derivatives: as `crossing`, for
    a corner that is alone."""
    value, by_u, by_v, by_correlation = crossing(u, v, correlation)
    return (
        0.5 * (value - 1) + ndtr(u) + ndtr(v) - 1,
        0.5 * by_u + _density(u),
        0.5 * by_v + _density(v),
        0.5 * by_correlation,
    )


def _density(place: Array) -> Array:
    return np.asarray(np.exp(-0.5 * place**2) / np.sqrt(2 * np.pi))


class _CornerFit:
    """One corner's adjustment in progress."""

    def __init__(self, window: ScanWindow, start_px: Array, steps_px: Array, reach_px: Array, surface: Surface) -> None:
        self.grey, self.valid = np.asarray(window.grey, float), window.usable
        self.origin = np.asarray(window.origin_px, float)
        self.start, self.surface, self.reach = start_px - self.origin, surface, reach_px
        self.row, self.col = np.mgrid[: self.grey.shape[0], : self.grey.shape[1]].astype(float)
        self.along_from_pixel = np.linalg.inv(steps_px / np.hypot(*steps_px))
        self.center = self.start.copy()
        # An edge along a step has its normal a quarter turn on; the signs make the corner between the steps positive.
        mirrored = np.linalg.det(steps_px) < 0
        self.edges = np.arctan2(steps_px[1], steps_px[0]) + np.pi / 2 + np.pi * np.array([mirrored, not mirrored])
        self.start_edges = self.edges.copy()
        self.max_shift_px = _MOST_SHIFT * float(reach_px.min())
        self.variance = _START_BLUR_PX**2
        self.max_variance = (float(reach_px.min()) / 2) ** 2 + PIXEL_VARIANCE_PX2
        self.bends = surface is crossing
        self.linear = np.zeros(5 if self.bends else 4)  # half the contrast, offset, gradient (2), bend
        self.unknowns = _SHAPE_UNKNOWNS + len(self.linear)
        self.scale_dn = 0.0
        self.weights = self._area()
        outside = Reason("too little of it is inside of the scan", Code.OUTSIDE)
        self.reason = NO_REASON if self.weights.sum() > 2 * self.unknowns else outside

    def run(self) -> Corner:
        """Plain, then robust, until the corner stands still; or a reason why it does not."""
        for stage, tolerance_px in enumerate(_STAGES_TOLERANCE_PX):
            if not self.reason:
                self.scale_dn = self._residual_scale() if stage else np.inf
                self.reason = gauss_newton(self, tolerance_px, _MAX_ITERATIONS).reason
        design, residuals = self._linearised()
        covariance, noise, area = np.full((2, 2), np.inf), float("nan"), self._area()
        used, junction_px = self.weights > _UNDAMAGED, None
        if used.sum() > self.unknowns and not self.reason:
            # The covariance that the residuals' own autocovariance gives.
            model = noise_model(residuals, used, self.unknowns)
            noise = float(np.sqrt(model.variance_dn2))
            weighted = design * self.weights
            inverse = np.linalg.pinv(products(weighted, design), hermitian=True)
            covariance = (inverse @ products(weighted, correlated(weighted, model)) @ inverse)[:2, :2]
            if not 2 * abs(self.linear[0]) > 4 * noise:
                self.reason = Reason("no edges stand out from the noise", Code.CONTRAST)
            elif self.bends:
                # Damage is painted over with what was fitted.
                undamaged = self.grey - np.where(self.weights < _UNDAMAGED * area, residuals, 0.0)
                reach_px = float(self.reach.min())
                place = junction(undamaged, self.center, reach_px)
                junction_px = place + self.origin if np.hypot(*(place - self.center)) < reach_px / 2 else None
        return Corner(
            center_px=self.center + self.origin,
            covariance_px2=(covariance + covariance.T) / 2,
            contrast_dn=2 * float(self.linear[0]),
            noise_dn=noise,
            blur_px=float(np.sqrt(max(self.variance - PIXEL_VARIANCE_PX2, 0.0))),
            damaged_fraction=float(1 - self.weights.sum() / max(area.sum(), 1e-9)),
            moved_px=float(np.hypot(*(self.center - self.start))),
            reason=self.reason,
            junction_px=junction_px,
        )

    def _area(self) -> Array:
        """Weights 0 to 1 of a parallelogram about the corner; its border is smooth, and it moves with the corner: a
        window that is not centred would prefer one half of an edge."""
        offset = np.stack([self.col - self.center[0], self.row - self.center[1]])
        along = np.abs(np.tensordot(self.along_from_pixel, offset, axes=1))
        inside = np.clip(self.reach[:, None, None] + 0.5 - along, 0.0, 1.0)
        return np.asarray(self.valid * inside[0] * inside[1])

    def _residual_scale(self) -> float:
        _, residuals = self._linearised()
        return max(robust_scale(residuals[self.weights > 0]), _SCALE_FLOOR * 2 * abs(float(self.linear[0])), 1e-9)

    def _linearised(self) -> tuple[Array, Array]:
        """(unknowns, height, width) derivatives and (height, width) residuals, at the best grey-value parameters."""
        dx, dy = self.col - self.center[0], self.row - self.center[1]
        sigma = np.sqrt(self.variance)
        normals = np.stack([np.cos(self.edges), np.sin(self.edges)], axis=-1)
        tangents = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
        u, v = ((normal[0] * dx + normal[1] * dy) / sigma for normal in normals)
        value, by_u, by_v, by_correlation = self.surface(u, v, float(normals[0] @ normals[1]))
        grey = np.stack([value, np.ones_like(dx), dx, dy, *([value**2 - 1] if self.bends else [])])
        weighted = grey * self.weights
        right = np.tensordot(weighted, self.grey, axes=2)
        self.linear = np.asarray(np.linalg.lstsq(products(weighted, grey), right, rcond=1e-12)[0])
        turning = [
            by * (tangent[0] * dx + tangent[1] * dy) / sigma + by_correlation * (tangent @ other)
            for by, tangent, other in zip((by_u, by_v), tangents, normals[::-1], strict=True)
        ]
        shape = [
            -(by_u * normals[0, 0] + by_v * normals[1, 0]) / sigma,
            -(by_u * normals[0, 1] + by_v * normals[1, 1]) / sigma,
            *turning,
            -(by_u * u + by_v * v) / (2 * self.variance),
        ]
        slope = self.linear[0] + (2 * self.linear[4] * value if self.bends else 0.0)
        return np.concatenate([slope * np.stack(shape), grey]), self.grey - np.tensordot(self.linear, grey, axes=1)

    def solve(self) -> Array | None:
        """A Gauss-Newton step, shortened to what a linearisation can bear; None where an unknown shows nowhere."""
        design, residuals = self._linearised()
        self.weights = self._area() * tukey_weights(residuals, self.scale_dn)
        used = self.weights > 0
        if not np.all((design[:, used] != 0).any(axis=1)):
            return None
        step = gauss_newton_step(design[:, used], residuals[used], self.weights[used], _DAMPING)
        return np.asarray(step / max(np.hypot(*step[:2]), np.abs(step[2:4]).max() / _LONGEST_TURN_RAD, 1.0))

    def step(self, step: Array) -> float:
        """Take a step; its length in px."""
        self.center += step[:2]
        self.edges += step[2:4]
        variance = np.clip(self.variance + step[4], self.variance / 2, self.variance * 2)
        self.variance = float(np.clip(variance, _LEAST_BLUR_PX**2, self.max_variance))
        return float(np.hypot(*step[:2]))

    def failure(self) -> Reason:
        """Why the corner is none that was expected here, empty where it may be one."""
        if np.hypot(*(self.center - self.start)) > self.max_shift_px:
            return Reason("the fit ran away to something else", Code.NO_FIT)
        if np.abs(self.edges - self.start_edges).max() > _MOST_TURN_RAD:
            return Reason("the edges here run otherwise than they should", Code.SIZE)
        return NO_REASON


def junction(grey: Array, start_px: Array, reach_px: float) -> Array:
    """Refine the junction near a place by `cv2.cornerSubPix`.

    OpenCV's equations are Förstner's: sum of w g g' (x - x0) = 0 over a window, with the gradients g and the weight w =
    exp(-(dx² + dy²) / half²), where half is half the window's size. There is no zero zone. OpenCV takes differences of
    neighbouring pixels for gradients; smoothed before, they have half the noise.

    Parameters
    ----------
    grey
        Grey values (height, width).
    start_px
        (2,) column and row.
    reach_px
        How far about the place the picture shows its edges and nothing else.

    Returns
    -------
    Array
        (2,) column and row; not a number where OpenCV finds no place within its window.
    """
    half = min(_LARGEST_HALF_WINDOW_PX, round(_HALF_WINDOW * reach_px), (min(grey.shape) - _SUBPIX_BORDER_PX) // 2)
    if half < 1:
        return np.full(2, np.nan)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SMOOTHING_PX)
    start = np.asarray(start_px, np.float32)
    found = cv2.cornerSubPix(smooth, start.reshape(1, 1, 2).copy(), (half, half), (-1, -1), _SUBPIX_END)
    place = np.asarray(found, float).ravel()
    return np.full(2, np.nan) if np.array_equal(place, start) else place


def one_definition(pictures: Sequence[Sequence[MarkMeasurement]]) -> tuple[tuple[MarkMeasurement, ...], ...]:
    """The marks of a camera's pictures as they are, or all its crossings at their junctions where the lens has coma.

    Where a symmetric blur describes the edges, match and junction differ by noise alone, of which the match has less.
    Coma blurs edges to one side, the more so the farther from the axis. It moves match and junction apart alike in
    neighbouring crossings, so that the mean product of neighbours' differences is its share of their mean square.
    Beyond one half it is larger than what the junction's noise adds. Then the junctions are taken, which most published
    calibrations measure too. Their error is made by the lens and not by noise: all have the standard deviation of a
    place known to within the rms distance of match and junction, over the root of three (JCGM 100:2008, Guide to the
    expression of uncertainty in measurement, 4.3.7).

    Parameters
    ----------
    pictures
        The marks of each picture of one camera.

    Returns
    -------
    tuple of tuples
        The same marks; those with a junction moved there, with its covariance, where the lens has coma.
    """
    unmoved = tuple(tuple(marks) for marks in pictures)
    apart, alike = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for marks in pictures:
        crossings = [mark for mark in marks if _has_junction(mark)]
        if len(crossings) > _NEIGHBOURS:
            centers = np.array([mark.center_px for mark in crossings])
            differences = np.array([_junction_px(mark) for mark in crossings]) - centers
            near = np.asarray(KDTree(centers).query(centers, _NEIGHBOURS + 1)[1])[:, 1:]
            apart.append(differences)
            alike.append((differences[:, None, :] * differences[near]).mean(axis=1))
    squares_px2 = np.concatenate(apart) ** 2
    if len(squares_px2) < _FEWEST_CROSSINGS or np.concatenate(alike).mean() <= squares_px2.mean() / 2:
        return unmoved
    covariance = Covariance.from_noise(squares_px2.mean() / 3 * np.eye(2))
    return tuple(
        tuple(
            replace(mark, center_px=_junction_px(mark), covariance=covariance) if _has_junction(mark) else mark
            for mark in marks
        )
        for marks in pictures
    )


def _has_junction(mark: MarkMeasurement) -> bool:
    return mark.status.is_observation and "junction_col_px" in mark.quality


def _junction_px(mark: MarkMeasurement) -> Array:
    return np.array([mark.quality["junction_col_px"], mark.quality["junction_row_px"]])

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
pixel, growing towards the picture's corners. There the junction is the place that `cv2.cornerSubPix`, and with it most
published calibrations, measure.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf, ndtr, owens_t

from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.matching.window import ScanWindow
from measure.noise.noise_model import correlated, noise_model, products
from measure.noise.robust_estimation import gauss_newton_step, robust_scale, tukey_weights
from measure.reason import NO_REASON, Code, Reason

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Surface = Callable[[Array, Array, float], tuple[Array, Array, Array, Array]]

_SCALE_FLOOR = 0.05  # of the contrast, under Tukey's scale: sharpening and tone curves are no damage
_MAX_ITERATIONS = 30  # of a stage, or of the junction
_LARGEST_WINDOW_PX = 3.5  # the standard deviation of the gradients' window about a crossing
_UNDAMAGED = 0.05  # the robust weight below which a pixel shows something else
# Plain, then thrice robust: the scale of the residuals is taken once before each, so that it settles.
_STAGES_TOLERANCE_PX = (0.05, 0.05, 0.01, 0.001)
_SHAPE_UNKNOWNS = 5  # point (2), directions (2), blur
_MOST_SHIFT = 0.6  # of the reach: farther off, another corner's edges are nearer
_MOST_TURN_RAD = 0.35  # of an edge: twenty degrees, which no approximate place is wrong by
_START_BLUR_PX, _LEAST_BLUR_PX = 0.8, 0.3  # the pixel's share included
_DAMPING = 1e-9  # of a step: what hardly shows does not run away
_LONGEST_TURN_RAD = 0.15  # of an edge in a step: its picture is no longer linear in more
_GRADIENT_PX = 1.0  # the Gaussian under the derivatives: pixel noise has gone, the edges are still apart
_REACH_SIGMAS = 4.0  # of that Gaussian's filter
_TOLERANCE_PX = 1e-4  # of the last step
_WORST_CONDITION = 1e6  # of the normal matrix: beyond it the gradients have one direction only


@dataclass(frozen=True, eq=False)
class Corner:
    """A corner as fitted; where reason is not empty the fit failed, and the numbers are its last.

    center_px (2,), covariance_px2 (2, 2): as matched; contrast_dn: the grey value between the two steps less that
    beside them, negative where it is dark between them; blur_px: the standard deviation. junction_px (2,): where the
    gradients' lines meet (`junction`); None where they do not, and for a corner that is no crossing.
    """

    center_px: Array
    covariance_px2: Array
    contrast_dn: float
    noise_dn: float
    blur_px: float
    damaged_fraction: float
    reason: Reason = NO_REASON
    junction_px: Array | None = None


def fit_corner(window: ScanWindow, start_px: Array, steps_px: Array, reach_px: Array, surface: Surface) -> Corner:
    """Fit the corner near start_px (2,), in a window of the scan.

    steps_px (2, 2): its columns run along the two edges; reach_px (2,): how far along either of them, forth and back,
    grey values are used. surface: `crossing` or `quarter`.
    """
    fit = _CornerFit(window, np.asarray(start_px, float), np.asarray(steps_px, float), reach_px, surface)
    fit.run()
    return fit.result()


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

    def run(self) -> None:
        """Plain, then robust, until the corner stands still; or a reason why it does not."""
        for stage, tolerance_px in enumerate(_STAGES_TOLERANCE_PX):
            if not self.reason:
                self.scale_dn = self._residual_scale() if stage else np.inf
                self._adjust(tolerance_px)

    def result(self) -> Corner:
        """The corner in the scan, with the covariance that the residuals' own autocovariance gives."""
        design, residuals = self._linearised()
        used = self.weights > 0.05
        covariance, noise = np.full((2, 2), np.inf), float("nan")
        meeting = None
        if used.sum() > self.unknowns and not self.reason:
            model = noise_model(residuals, used, self.unknowns)
            noise = float(np.sqrt(model.variance_dn2))
            weighted = design * self.weights
            inverse = np.linalg.pinv(products(weighted, design), hermitian=True)
            covariance = (inverse @ products(weighted, correlated(weighted, model)) @ inverse)[:2, :2]
            if not 2 * abs(self.linear[0]) > 4 * noise:
                self.reason = Reason("no edges stand out from the noise", Code.CONTRAST)
            elif self.bends:
                meeting = self._junction(residuals)
        return Corner(
            center_px=self.center + self.origin,
            covariance_px2=(covariance + covariance.T) / 2,
            contrast_dn=2 * float(self.linear[0]),
            noise_dn=noise,
            blur_px=float(np.sqrt(max(self.variance - PIXEL_VARIANCE_PX2, 0.0))),
            damaged_fraction=float(1 - self.weights.sum() / max(self._area().sum(), 1e-9)),
            reason=self.reason,
            junction_px=None if meeting is None else meeting + self.origin,
        )

    def _junction(self, residuals: Array) -> Array | None:
        """Where the gradients' lines meet. Damage is painted over with what was fitted."""
        area = self._area()
        damaged = self.weights < _UNDAMAGED * area
        window_px = min(_LARGEST_WINDOW_PX, float(self.reach.min()) / 2)
        meeting = junction(self.grey - np.where(damaged, residuals, 0.0), self.center, window_px, area)
        return meeting if np.hypot(*(meeting - self.center)) < window_px else None

    def _adjust(self, tolerance_px: float) -> None:
        for _ in range(_MAX_ITERATIONS):
            if self.reason:
                return
            design, residuals = self._linearised()
            self.weights = self._area() * tukey_weights(residuals, self.scale_dn)
            if self._step(design, residuals) < tolerance_px:
                return
        self.reason = self.reason or Reason("the fit does not settle", Code.NO_FIT)

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
        self.linear = self._best_linear(grey)
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

    def _best_linear(self, grey: Array) -> Array:
        normal = products(grey * self.weights, grey)
        right = np.tensordot(grey * self.weights, self.grey, axes=2)
        return np.asarray(np.linalg.lstsq(normal, right, rcond=1e-12)[0])

    def _step(self, design: Array, residuals: Array) -> float:
        """A Gauss-Newton step, shortened to what a linearisation can bear; its length in px."""
        used = self.weights > 0
        if not np.all((design[:, used] != 0).any(axis=1)):
            self.reason = Reason("nothing here shows where the edges meet", Code.NO_FIT)
            return 0.0
        step = gauss_newton_step(design[:, used], residuals[used], self.weights[used], _DAMPING)
        step /= max(np.hypot(*step[:2]), np.abs(step[2:4]).max() / _LONGEST_TURN_RAD, 1.0)
        self.center += step[:2]
        self.edges += step[2:4]
        variance = np.clip(self.variance + step[4], self.variance / 2, self.variance * 2)
        self.variance = float(np.clip(variance, _LEAST_BLUR_PX**2, self.max_variance))
        if np.hypot(*(self.center - self.start)) > self.max_shift_px:
            self.reason = Reason("the fit ran away to something else", Code.NO_FIT)
        elif np.abs(self.edges - self.start_edges).max() > _MOST_TURN_RAD:
            self.reason = Reason("the edges here run otherwise than they should", Code.SIZE)
        return float(np.hypot(*step[:2]))


def junction(grey: Array, start_px: Array, window_px: float, area: Array) -> Array:
    """The junction (2,) as col, row near start_px in grey values (height, width).

    window_px: the standard deviation of the Gaussian window about the junction; area (height, width): 0 where a
    gradient has no part. Not a number where the gradients have one direction only.
    """
    along_x, along_y = _derivative(grey, 0), _derivative(grey, 1)
    row, col = np.mgrid[: grey.shape[0], : grey.shape[1]].astype(float)
    center = np.array(start_px, float)
    for _ in range(_MAX_ITERATIONS):
        dx, dy = col - center[0], row - center[1]
        weights = area * np.exp(-(dx**2 + dy**2) / (2 * window_px**2))
        normal = _normal(along_x, along_y, weights)
        if np.linalg.cond(normal) > _WORST_CONDITION:
            return np.full(2, np.nan)
        distance = along_x * dx + along_y * dy
        step = np.linalg.solve(normal, [(weights * along * distance).sum() for along in (along_x, along_y)])
        center += step
        if np.hypot(*step) < _TOLERANCE_PX:
            break
    return center


def _normal(along_x: Array, along_y: Array, weights: Array) -> Array:
    mixed = (weights * along_x * along_y).sum()
    return np.array([[(weights * along_x**2).sum(), mixed], [mixed, (weights * along_y**2).sum()]])


def _derivative(image: Array, axis: int) -> Array:
    """The derivative of the image smoothed by a Gaussian, along columns (0) or rows (1)."""
    reach = int(np.ceil(_REACH_SIGMAS * _GRADIENT_PX))
    place = np.arange(-reach, reach + 1.0)
    smooth = np.exp(-(place**2) / (2 * _GRADIENT_PX**2))
    smooth /= smooth.sum()
    slope = place * smooth / (place**2 * smooth).sum()
    along, down = (slope, smooth) if axis == 0 else (smooth, slope)
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, along, down, borderType=cv2.BORDER_REPLICATE))

"""Least-squares matching of two intersecting straight edges: crossings of a chessboard, corners of markers.

The image of two intersecting edges under a Gaussian blur has a closed form: with s1, s2 the signs of a point's
distances from the edges, it is the mean of s1 s2 over the blur, a bivariate normal integral, for any angle between the
edges. A single dark or light quarter is the same integral. All corners of a board are fitted at once. The unknowns are
the point, both directions, the blur, and the grey values: contrast, offset, gradient and, for a crossing, the curvature
of the tone curve, which widens light squares at the expense of dark ones. A crossing is symmetric under a half turn for
any tone curve, so its place does not depend on the curve. The place of a quarter does: it shifts with the edges.

A lens bends the edges. Their curvature is taken from the other corners after the plain fit, and they are fitted as
parabolas from then on. Junctions stay those of straight edges, whose noise is larger than this shifts them.

The junction is determined in addition: the point closest to the edge lines, which run perpendicular to the grey-value
gradients (Förstner and Gülch, 1987, A fast operator for detection and precise location of distinct points, corners and
centres of circular features). A lens with coma blurs edges to one side; a crossing then has no unique place. Match and
junction differ by tenths of a pixel, increasing towards the image corners. In this case the junction, found by
`cv2.cornerSubPix`, is what most published calibrations measure.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from measure.array_types import Array, Indices, Integers, Mask, Single
from measure.flags import NO_REASON, Cause, Code, Reason
from measure.matching.gauss_newton import FitModel, gauss_newton
from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.matching.window import ScanWindow
from measure.noise.noise_model import covariance_along, influence_covariances
from measure.noise.robust_estimation import gauss_newton_step, place_influences, robust_scale, tukey_weights
from measure.results import Covariance
from measure.scans.jpeg import covariances_of_rounding

Surface = Callable[[Single, Single, Single], tuple[Single, Single, Single, Single]]

_FAR = np.float32(9.0)  # standard deviations beyond which nothing changes; denormal numbers would be slow
_NODES, _MOST_NODES = ((0.3, 2), (0.55, 3), (0.8, 5)), 10  # nodes of the quadrature by correlation, single precision
_ERF_SCALE = 0.3275911
_ERF_FACTORS = (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592)
_SCALE_FLOOR = 0.05  # fraction of the contrast, floor of Tukey's scale: sharpening and tone curves are not damage
_MAX_ITERATIONS = 100  # per stage; moiré and sharpening make some approach by a few per cent a step
_UNDAMAGED = 0.05  # robust weight below which a pixel counts as an outlier
# One plain and two robust stages. The residual scale is fixed at the start of each, so that the iteration converges.
_STAGES_TOLERANCE_PX = (0.05, 0.01, 0.001)
_SHAPE_UNKNOWNS, _BLUR = 5, 4  # point (2), directions (2), blur
_MOST_SHIFT = 0.6  # fraction of the reach; beyond it the edges of a different corner are nearer
_MOST_TURN_RAD = 0.35  # rad (20°), largest turn of an edge; approximate directions are better
_START_BLUR_PX, _LEAST_BLUR_PX = 0.8, 0.3  # px, pixel included
_DAMPING = 1e-9  # of a step, stabilises poorly determined unknowns
_GREY_DAMPING = 1e-12  # for grey values, which are never singular
_SPARE_PX = 2  # px margin around the area, so that a corner can move
_LONGEST_TURN_RAD = 0.15  # rad, largest turn of an edge in one step for which the linearisation holds
_LARGEST_HALF_WINDOW_PX = 6  # px around a junction; larger windows include the distortion of longer edges
_HALF_WINDOW = 0.85  # fraction of the reach; the weight is 0.37 at the middle of the window's sides, 0.14 at corners
_SMOOTHING_PX = 1.0  # px, suppresses pixel noise while edges stay separate
_BORDER_PX = 4  # px, reflected border of each window, the reach of the smoothing
_SUBPIX_BORDER_PX = 5  # px that OpenCV requires in addition to twice the half window
_SUBPIX_END = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-4)  # iterations, px of the last step
_POINTS = 6  # nearest points of a line of the board, through which a cubic is fitted
_FEWEST = 4  # points; a parabola through three has no residuals, which would show a gross error
_SAME_LINE = 1e-6  # of the board's extent: points closer to a line than this lie on it
_LARGEST_RESIDUAL_PX = 0.5  # rms from the curve, beyond which a point is not where its name says


def crossing(u: Single, v: Single, correlation: Single) -> tuple[Single, Single, Single, Single]:
    """Mean of sign(u + z1) sign(v + z2) over standard normal z1, z2 of the given correlation, and its derivatives with
    respect to u, v and the correlation. Exact to single precision.

    Notes
    -----
    The derivative with respect to the correlation is four times the normal density (Plackett 1954). It is integrated
    over the arc sine of the correlation by Gauss's rule (Genz 2004, Numerical computation of rectangular bivariate and
    trivariate normal and t probabilities, Statistics and Computing 14).
    """
    u, v = np.clip(u, -_FAR, _FAR), np.clip(v, -_FAR, _FAR)
    inverse_root = np.asarray(1 / np.sqrt(np.maximum(1 - correlation**2, np.float32(1e-6))), np.float32)
    density_u, across_u = _density(u), np.clip((v - correlation * u) * inverse_root, -_FAR, _FAR)
    density_v, across_v = _density(v), np.clip((u - correlation * v) * inverse_root, -_FAR, _FAR)
    density_across_u = _density(across_u)
    value = _erf(u, density_u) * _erf(v, density_v)
    by_u = 2 * density_u * _erf(across_u, density_across_u)
    by_v = 2 * density_v * _erf(across_v, _density(across_v))
    by_correlation = (4 * inverse_root) * (density_u * density_across_u)
    squares, product, angle = u * u + v * v, u * v, np.arcsin(np.clip(correlation, -1, 1))
    largest = float(np.abs(correlation).max(initial=0.0))
    nodes = next((count for limit, count in _NODES if largest < limit), _MOST_NODES)
    for place, weight in _gauss_legendre(nodes):
        sine = np.sin(angle * np.float32((1 + place) / 2))
        inverse = 1 / (sine * sine - 1)
        exponent = squares * (inverse / 2)
        exponent -= product * (sine * inverse)
        np.maximum(exponent, -_FAR * _FAR, out=exponent)
        np.exp(exponent, out=exponent)
        exponent *= angle * np.float32(weight / np.pi)
        value += exponent
    return value, by_u, by_v, by_correlation


def quarter(u: Single, v: Single, correlation: Single) -> tuple[Single, Single, Single, Single]:
    """Twice the probability that u + z1 and v + z2 are both positive, minus one, and its derivatives: the counterpart
    of `crossing` for a single corner."""
    value, by_u, by_v, by_correlation = crossing(u, v, correlation)
    u, v = np.clip(u, -_FAR, _FAR), np.clip(v, -_FAR, _FAR)
    density_u, density_v, half = _density(u), _density(v), np.float32(0.5)
    value = half * (value - 1 + _erf(u, density_u) + _erf(v, density_v))
    return value, half * by_u + density_u, half * by_v + density_v, half * by_correlation


def _erf(place: Single, density: Single) -> Single:
    """erf(place / sqrt(2)) to 2e-7 (Abramowitz and Stegun 1964, 7.1.26), with the normal density there."""
    t = 1 / (1 + np.float32(_ERF_SCALE / np.sqrt(2)) * np.abs(place))
    tail = np.zeros_like(t)
    for factor in _ERF_FACTORS:
        tail += np.float32(factor)
        tail *= t
    tail *= density
    return np.asarray(np.copysign(1 - np.float32(np.sqrt(2 * np.pi)) * tail, place), np.float32)


def _density(place: Single) -> Single:
    density = place * place
    density *= np.float32(-0.5)
    np.exp(density, out=density)
    density *= np.float32(1 / np.sqrt(2 * np.pi))
    return density


@cache
def _gauss_legendre(nodes: int) -> list[tuple[float, float]]:
    """Nodes and weights of Gauss-Legendre quadrature."""
    return list(zip(*(each.tolist() for each in np.polynomial.legendre.leggauss(nodes)), strict=True))


@dataclass(frozen=True, eq=False)
class Corner:
    """Fitted corner. If reason is not empty the fit failed, and the values are those of its last iteration.

    Attributes
    ----------
    center_px, covariance : (2,) and of it, by least-squares matching.
    contrast_dn : grey value between the two steps minus that outside, negative if dark between them.
    noise_dn : standard deviation of one pixel's noise.
    blur_px : standard deviation of the blur.
    damaged_fraction : fraction of the area rejected as outliers.
    misfit : root of the covariance of neighbouring residuals over the contrast, outliers included: noise has none. Of a
        crossing only what a half turn changes counts, which sharpening, tone curve and motion do not.
    moved_px : distance from the start of the fit.
    junction_px : (2,) from `junctions`; None where not found, and for corners other than crossings.
    """

    center_px: Array
    covariance: Covariance
    contrast_dn: float
    noise_dn: float
    blur_px: float
    damaged_fraction: float
    misfit: float
    moved_px: float
    reason: Reason = NO_REASON
    junction_px: Array | None = None


@dataclass(frozen=True, eq=False)
class CornerStart:
    """Initial values of a corner. center_px (2,); steps_px (2, 2): columns along the two edges; reach_px (2,): half
    size of the window along each edge; board (2,): its place on the board, whose edges are parallel to its axes."""

    center_px: Array
    steps_px: Array
    reach_px: Array
    board: Array

    @property
    def half_px(self) -> int:
        """Half size (px) of a square window that contains all grey values used, plus a margin."""
        along = np.abs(self.steps_px / np.hypot(*self.steps_px)) @ self.reach_px
        return int(np.ceil(along).max()) + _SPARE_PX


def _half_turned(picture: NDArray[Any], shift: Integers) -> NDArray[Any]:
    """A window turned by a half about its middle, then shifted by rows and columns."""
    return np.roll(picture[::-1, ::-1], shift, axis=(0, 1))


def fit_corners(
    read: Callable[[int, int, int], ScanWindow],
    starts: Sequence[CornerStart],
    surface: Surface,
    quantisation_step_dn: float,
    first_block_px: tuple[int, int],
) -> list[Corner]:
    """Fit all corners of a board at once. read: returns the square window with the given first column, first row and
    side, px; surface: `crossing` or `quarter`; quantisation_step_dn, first_block_px: of the scan."""
    if not starts:
        return []
    half = max(start.half_px for start in starts)
    firsts = [np.round(start.center_px).astype(int) - half for start in starts]
    windows = [read(int(col), int(row), 2 * half + 1) for col, row in firsts]
    return _CornerFits(windows, starts, surface).run(quantisation_step_dn, first_block_px)


class _CornerFits(FitModel):
    """Adjustments of n corners in progress. Arrays over pixels are (n, p): p candidate pixels of each corner."""

    damping = _DAMPING

    def __init__(self, windows: Sequence[ScanWindow], starts: Sequence[CornerStart], surface: Surface) -> None:
        super().__init__(len(starts))
        self.windows, self.surface = windows, surface
        self.origin = np.array([window.origin_px for window in windows], float)
        self.start = np.array([start.center_px for start in starts], float) - self.origin
        self.reach = np.array([start.reach_px for start in starts], float)
        steps = np.array([start.steps_px for start in starts], float)
        self.along_from_pixel = np.linalg.inv(steps / np.linalg.norm(steps, axis=1, keepdims=True))
        self.center = self.start.copy()
        self.last_px, self.share = np.zeros_like(self.start), np.ones(len(starts))  # last step; fraction of it taken
        # The normal of an edge is its step turned by a quarter; the signs make the quadrant between the steps positive.
        mirrored = np.linalg.det(steps) < 0
        turn = np.pi * np.stack([mirrored, ~mirrored], axis=1)
        self.edges = np.arctan2(steps[:, 1], steps[:, 0]) + np.pi / 2 + turn
        self.start_edges = self.edges.copy()
        self.board = np.array([start.board for start in starts])
        self.curvatures = np.zeros((len(starts), 2))  # 1/px, of the edges towards their normals
        self.max_shift_px = _MOST_SHIFT * self.reach.min(axis=1)
        self.variance = np.full(len(starts), _START_BLUR_PX**2)
        self.max_variance = (self.reach.min(axis=1) / 2) ** 2 + PIXEL_VARIANCE_PX2
        self.bends = surface is crossing
        self.linear = np.zeros((len(starts), 5 if self.bends else 4))  # contrast / 2, offset, gradient (2), curvature
        self.unknowns = _SHAPE_UNKNOWNS + self.linear.shape[1]
        self._choose_pixels()
        self.residuals = np.zeros(self.grey.shape, np.float32)
        self.design = np.zeros((len(starts), self.unknowns, self.grey.shape[1]), np.float32)
        self.weights, self.scale = self._area(self.every), np.full(len(starts), np.inf)
        outside = Reason("too little of it is inside of the scan", Code.OUTSIDE)
        self.reasons = [NO_REASON if each.sum() > 2 * self.unknowns else outside for each in self.weights]

    def _choose_pixels(self) -> None:
        """Select the pixels of each corner's area plus a margin for its movement; the lists are padded to one
        length."""
        self.shape = self.windows[0].grey.shape
        self.grey_size = self.windows[0].grey.size
        row, col = np.indices(self.shape, np.float32).reshape(2, -1)
        offset = np.stack([col, row]) - self.start[:, :, None].astype(np.float32)
        along = np.abs(self.along_from_pixel.astype(np.float32) @ offset)
        near = along <= (self.reach + 0.5 + _SPARE_PX)[:, :, None]
        lists = [np.flatnonzero(each) for each in near.all(axis=1)]
        self.counts = [len(each) for each in lists]
        self.pixels = np.zeros((len(lists), max(self.counts)), np.intp)
        self.valid, self.grey, self.ends = (np.zeros(self.pixels.shape, np.float32) for _ in range(3))
        for number, (chosen, window) in enumerate(zip(lists, self.windows, strict=True)):
            here, usable = (number, slice(len(chosen))), window.usable.ravel()[chosen]
            self.pixels[here], self.valid[here] = chosen, usable
            self.grey[here] = np.where(usable, window.grey.ravel()[chosen], 0.0)
            self.ends[here] = window.ends.ravel()[chosen]
        self.places = np.stack([axis[self.pixels] for axis in (col, row)], axis=1)

    def run(self, quantisation_step_dn: float, first_block_px: tuple[int, int]) -> list[Corner]:
        """Adjust by plain, then robust least squares until the corners converge; sets a reason for those that do
        not."""
        self._linearise(self.every, is_first=True)
        for stage, tolerance_px in enumerate(_STAGES_TOLERANCE_PX):
            moving = np.array([number for number, reason in enumerate(self.reasons) if not reason], np.intp)
            if stage == 1:  # take the curvature of the edges from the corners as they are fitted so far
                fits = np.array([not reason for reason in self.reasons])
                centers_px = np.where(fits[:, None], self.center + self.origin, np.nan)
                self.curvatures = edge_curvatures(centers_px, self.board, self._normals(self.every))
            if stage:
                floor = _SCALE_FLOOR * 2 * np.abs(self.linear[moving, 0])
                robust = [robust_scale(self.residuals[number, self.weights[number] > 0]) for number in moving]
                self.scale[moving] = np.maximum(np.maximum(robust, floor), 1e-9)
            gauss_newton(self, moving, tolerance_px, _MAX_ITERATIONS)
        return self._corners(quantisation_step_dn, first_block_px)

    def _corners(self, quantisation_step_dn: float, first_block_px: tuple[int, int]) -> list[Corner]:
        """Assemble the corners, with covariances from the autocovariance of the residuals, and junctions."""
        design, residuals = self.design, self.residuals
        area, used = self._area(self.every), self.weights > _UNDAMAGED
        used &= design[:, _SHAPE_UNKNOWNS + 1] != 0  # the offset's derivative is 0 for clipped pixels only
        influence = self._pictures(place_influences(design, self.weights))
        covariances, variances = influence_covariances(
            influence, self._pictures(residuals), self._pictures(used), self.unknowns
        )
        covariances = (covariances + covariances.swapaxes(1, 2)) / 2
        shared_dn2 = self._structure_dn2(self._pictures(area > 0))
        fails = np.array([bool(reason) for reason in self.reasons]) | (used.sum(axis=1) <= self.unknowns)
        losses = np.zeros_like(covariances)
        if quantisation_step_dn:
            fitted = self._pictures(self.grey - residuals)
            losses = covariances_of_rounding(influence, fitted, self.origin - first_block_px, quantisation_step_dn)
        covariances[fails], noise_dn = np.inf, np.where(fails, np.nan, np.sqrt(variances))
        rounding_dn = np.finfo(np.float32).eps * np.abs(self.linear[:, 1])  # for a uniform window without noise
        faint = ~fails & ~(np.abs(self.linear[:, 0]) > 2 * np.maximum(noise_dn, rounding_dn))
        self.refuse(np.flatnonzero(faint), Reason("no edges stand out from the noise", Code.CONTRAST))
        junctions_px = np.full((len(self.windows), 2), np.nan)
        if self.bends:  # damaged pixels are replaced by the model
            damage = self._pictures(np.where(self.weights < _UNDAMAGED * area, residuals, np.float32(0.0)))
            greys = np.array([window.grey for window in self.windows]) - damage
            reach_px = self.reach.min(axis=1)
            junctions_px = junctions(greys, self.center, float(reach_px.min()))
            far = ~(np.hypot(*(junctions_px - self.center).T) < reach_px / 2)
            junctions_px[far | fails | faint] = np.nan
        return [
            Corner(
                center_px=self.center[number] + self.origin[number],
                covariance=Covariance.from_noise(covariances[number]).plus(Cause.COMPRESSION, losses[number]),
                contrast_dn=2 * float(self.linear[number, 0]),
                noise_dn=float(noise_dn[number]),
                blur_px=float(np.sqrt(max(self.variance[number] - PIXEL_VARIANCE_PX2, 0.0))),
                damaged_fraction=float(1 - self.weights[number].sum() / max(area[number].sum(), 1e-9)),
                misfit=float(np.sqrt(max(shared_dn2[number], 0.0)) / max(2 * abs(self.linear[number, 0]), 1e-9)),
                moved_px=float(np.hypot(*(self.center[number] - self.start[number]))),
                reason=self.reasons[number],
                junction_px=None if np.isnan(junction[0]) else junction + self.origin[number],
            )
            for number, junction in enumerate(junctions_px)
        ]

    def _structure_dn2(self, inside: Mask) -> Array:
        """(n,) covariance of neighbouring residuals in (n, height, width)."""
        left = self._pictures(self.residuals) * inside
        if self.bends:
            half = (np.array(self.shape) - 1) / 2
            shifts = np.rint(2 * (self.center[:, ::-1] - half)).astype(int)
            inside &= np.stack([_half_turned(*each) for each in zip(inside, shifts, strict=True)])
            turned = np.stack([_half_turned(*each) for each in zip(left, shifts, strict=True)])
            left = (left - turned) / np.sqrt(2) * inside  # noise stays as large
        return covariance_along(left, inside, 1)

    def _pictures(self, values: NDArray[Any]) -> NDArray[Any]:
        """Scatter values (n, ..., p) of the corners' pixels to windows (n, ..., height, width), 0 elsewhere."""
        pictures = np.zeros((*values.shape[:-1], self.grey_size), values.dtype)
        for picture, value, pixels, count in zip(pictures, values, self.pixels, self.counts, strict=True):
            picture[..., pixels[:count]] = value[..., :count]
        return pictures.reshape(*values.shape[:-1], *self.shape)

    def _area(self, numbers: Indices) -> Single:
        """Weights, 0 to 1, of a parallelogram around each corner. Its border is smooth, and it moves with the corner,
        since an off-centre window would favour one half of an edge."""
        offset = self.places[numbers] - self.center[numbers, :, None].astype(np.float32)
        along = self.along_from_pixel[numbers].astype(np.float32) @ offset
        inside = (self.reach[numbers] + 0.5).astype(np.float32)[..., None] - np.abs(along, out=along)
        return np.asarray(self.valid[numbers] * np.clip(inside, 0.0, 1.0, out=inside).prod(axis=1))

    def _normals(self, numbers: Indices) -> Array:
        """(m, 2 edges, 2) unit normals of the edges."""
        return np.stack([np.cos(self.edges[numbers]), np.sin(self.edges[numbers])], axis=-1)

    def _linearise(self, numbers: Indices, is_first: bool = False) -> None:
        """Compute derivatives and residuals of some corners. The first call estimates the grey values."""
        sigma = np.sqrt(self.variance[numbers, None])
        normals = self._normals(numbers)
        tangents = np.stack([-normals[..., 1], normals[..., 0]], axis=-1)
        offset = self.places[numbers] - self.center[numbers, :, None].astype(np.float32)
        directions = np.concatenate([normals, tangents], axis=1) / sigma[..., None]
        u, v, *along = np.moveaxis(directions.astype(np.float32) @ offset, 1, 0)
        # Edges are parabolas, which a lens makes of lines. Their derivatives are those of the lines, to a hundredth.
        bend = (self.curvatures[numbers] * sigma / 2).astype(np.float32)
        u, v = u - bend[:, :1] * along[0] ** 2, v - bend[:, 1:] * along[1] ** 2
        correlation = (normals[:, 0] * normals[:, 1]).sum(axis=1).astype(np.float32)[:, None]
        value, by_u, by_v, by_correlation = self.surface(u, v, correlation)
        design = np.empty((len(numbers), self.unknowns, u.shape[1]), np.float32)
        grey = design[:, _SHAPE_UNKNOWNS:]
        grey[:, 0], grey[:, 1], grey[:, 2:4] = value, 1.0, offset
        if self.bends:
            grey[:, 4] = value**2 - 1
        if is_first:
            self.linear[:] = np.nan_to_num(gauss_newton_step(grey, self.grey, self.weights, _GREY_DAMPING))
        linear = self.linear[numbers].astype(np.float32)
        slope = linear[:, :1] + (2 * linear[:, 4:] * value if self.bends else np.float32(0.0))
        by_u, by_v, by_correlation = by_u * slope, by_v * slope, by_correlation * slope
        scaled = directions.astype(np.float32)[..., None]
        turned = np.einsum("nei,nei->en", tangents, normals[:, ::-1]).astype(np.float32)[..., None]
        design[:, 0] = -(by_u * scaled[:, 0, 0] + by_v * scaled[:, 1, 0])
        design[:, 1] = -(by_u * scaled[:, 0, 1] + by_v * scaled[:, 1, 1])
        for edge, by in enumerate((by_u, by_v)):
            design[:, 2 + edge] = by * along[edge] + by_correlation * turned[edge]
        design[:, 4] = (by_u * u + by_v * v) * (-0.5 / sigma**2).astype(np.float32)
        residuals = self.grey[numbers] - (linear[:, None] @ grey)[:, 0]
        # A clipped grey value says nothing where the model lies beyond the end of the range as well.
        informative = self.ends[numbers] * residuals >= 0
        self.design[numbers], self.residuals[numbers] = design * informative[:, None], residuals * informative

    def pixel_weights(self, fits: Indices) -> Single:
        """Tukey's weights in the area around each corner."""
        relative = np.asarray(self.residuals[fits] / self.scale[fits, None], np.float32)
        self.weights[fits] = np.asarray(self._area(fits) * tukey_weights(relative, 1.0), np.float32)
        return np.asarray(self.weights[fits])

    def solve(self, fits: Indices) -> Array:
        """Solve the normal equations. A blur at its limit is held there: sharpened edges have less than none."""
        steps, before = super().solve(fits), self.variance[fits]
        is_low = (before <= _LEAST_BLUR_PX**2) & (steps[:, _BLUR] < 0)
        held = is_low | ((before >= self.max_variance[fits]) & (steps[:, _BLUR] > 0))
        if held.any():
            others, some = np.delete(np.arange(self.unknowns), _BLUR), fits[held]
            weights = self.pixel_weights(some)
            steps[held, _BLUR] = 0.0
            steps[np.ix_(held, others)] = gauss_newton_step(
                self.design[some][:, others], self.residuals[some], weights, self.damping
            )
        return steps

    def step(self, fits: Indices, steps: Array) -> Array:
        """Apply steps, shortened to the range of the linearisation, and ever more where they turn back: at a sharp edge
        they overshoot. Returns (m,) lengths in px."""
        turn = np.abs(steps[:, 2:4]).max(axis=1) / _LONGEST_TURN_RAD
        steps = steps / np.maximum(np.maximum(np.hypot(steps[:, 0], steps[:, 1]), turn), 1.0)[:, None]
        turns_back = (steps[:, :2] * self.last_px[fits]).sum(axis=1) < 0
        self.share[fits] = np.minimum(self.share[fits] * np.where(turns_back, 0.5, 2.0), 1.0)
        steps = steps * self.share[fits, None]
        self.last_px[fits] = steps[:, :2]
        self.center[fits] += steps[:, :2]
        self.edges[fits] += steps[:, 2:4]
        self.linear[fits] += steps[:, _SHAPE_UNKNOWNS:]
        before = self.variance[fits]
        variance = np.clip(before + steps[:, _BLUR], before / 2, before * 2)
        self.variance[fits] = np.clip(variance, _LEAST_BLUR_PX**2, self.max_variance[fits])
        away = np.linalg.norm(self.center - self.start, axis=1) > self.max_shift_px
        turned = np.abs(self.edges - self.start_edges).max(axis=1) > _MOST_TURN_RAD
        self.refuse(fits[away[fits]], Reason("the fit did not stay at this corner", Code.NO_FIT))
        self.refuse(
            fits[turned[fits]], Reason("the edges here have other directions than those of the board", Code.SIZE)
        )
        self._linearise(fits)
        return np.hypot(steps[:, 0], steps[:, 1])


def junctions(greys: NDArray[np.floating], starts_px: Array, reach_px: float) -> Array:
    """Refine junctions near given places by `cv2.cornerSubPix`.

    Parameters
    ----------
    greys : (n, height, width) grey values around each place.
    starts_px : (n, 2) column and row in these windows.
    reach_px : distance up to which the windows show only the edges of the junction.

    Returns
    -------
    (n, 2) column and row; nan where OpenCV finds no place within its window.

    Notes
    -----
    OpenCV solves Förstner's equations: sum of w g g' (x - x0) = 0 over a window, with the gradients g and the weight w
    = exp(-(dx² + dy²) / half²), where half is half the window's size. There is no zero zone. OpenCV's gradients are
    differences of neighbouring pixels; smoothing beforehand halves their noise.
    """
    number, *shape = greys.shape
    half = min(_LARGEST_HALF_WINDOW_PX, round(_HALF_WINDOW * reach_px), (min(shape) - _SUBPIX_BORDER_PX) // 2)
    if half < 1:
        return np.full((number, 2), np.nan)
    border = (_BORDER_PX, _BORDER_PX)
    column = np.pad(greys.astype(np.float32), ((0, 0), border, border), mode="reflect")  # windows stacked vertically
    smooth = cv2.GaussianBlur(column.reshape(-1, column.shape[2]), (0, 0), _SMOOTHING_PX)
    offsets = np.stack([np.full(number, 0.0), np.arange(number) * column.shape[1]], axis=1) + _BORDER_PX
    starts = (starts_px + offsets).astype(np.float32)
    found = cv2.cornerSubPix(smooth, starts[:, None].copy(), (half, half), (-1, -1), _SUBPIX_END)[:, 0]
    return np.where((found == starts).all(axis=1, keepdims=True), np.nan, found - offsets)


def edge_curvatures(centers_px: Array, board: Array, normals: Array) -> Array:
    """Curvature of the two edges at each corner of a board.

    An edge lies on a line of the board, as the next corners do. Every perspective keeps lines straight, so the
    curve that the corners of a line show comes from the lens.

    Parameters
    ----------
    centers_px : (n, 2) corners in the image, to about a tenth of a pixel; nan where not known.
    board : (n, 2) their places on the board, whose edges are parallel to its axes.
    normals : (n, 2, 2) unit normals of the two edges (rows) at each corner in the image.

    Returns
    -------
    (n, 2) curvatures, 1/px, positive where the edge bends towards its normal; 0 where a line shows fewer than four
    corners, or where these do not lie on a smooth curve.
    """
    curvatures = np.zeros((len(board), 2))
    known = np.flatnonzero(np.isfinite(centers_px).all(axis=1))
    if len(known) < _FEWEST:
        return curvatures
    rows, centers = np.arange(len(known)), centers_px[known]
    for axis in range(2):
        apart = board[known] / float(np.ptp(board, axis=0).max())
        apart[:, 1 - axis] /= _SAME_LINE
        distances, near = KDTree(apart).query(apart, range(1, _POINTS + 1), distance_upper_bound=2.0)
        on_line = np.isfinite(distances)
        offsets = (centers[np.where(on_line, near, 0)] - centers[:, None]) * on_line[..., None]
        farthest = offsets[rows, np.argmax(np.abs(offsets).sum(axis=2), axis=1)]
        across = np.einsum("nei,ni->ne", normals[known], farthest)
        edge = np.argmin(np.abs(across), axis=1)
        normal = normals[known, edge]
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        along, height = (np.einsum("npi,ni->np", offsets, direction) for direction in (tangent, normal))
        length = np.abs(along).max(axis=1, keepdims=True) + 1e-9
        along /= length
        count = on_line.sum(axis=1)
        is_cubic = count > _FEWEST
        design = np.stack([on_line, along, along**2 / 2, along**3 * is_cubic[:, None]], axis=-1)
        terms = np.linalg.pinv(design) @ height[..., None]
        spare = count - np.where(is_cubic, 4, 3)
        squares_px2 = ((height - (design @ terms)[..., 0]) ** 2).sum(axis=1)
        lies_on_it = (spare > 0) & (squares_px2 <= _LARGEST_RESIDUAL_PX**2 * spare)
        # A corner alone on its line does not show which edge that is: the other edge's curvature stays.
        curved = terms[:, 2, 0] / length[:, 0] ** 2
        curvatures[known, edge] = np.where(lies_on_it, curved, curvatures[known, edge])
    return curvatures

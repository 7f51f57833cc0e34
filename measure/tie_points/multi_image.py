"""Multi-image least-squares matching: one natural point in all frames that show it, none of them a perfect original.

The same small piece of ground is resampled from every frame onto one grid. All frames' pieces are one unknown common
patch, each with an offset and a gain of its own and with an affine geometry; the grid of one frame, the reference, says
which point is meant. The patch being unknown too, its best estimate is the pieces' mean, and a frame's geometry follows
from the difference of its piece and the reference's (the object-based matching of Gruen and Baltsavias 1988 and of
Rosenholm 1987, the patch eliminated).

Covariance: a frame's own noise alone moves its own point, the reference's as much as another's. The definition of the
point is free of error, for the unknown object point takes it up: so frames are uncorrelated, each with the covariance
of its own noise, and what separates two frames has the sum of both."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import chdtrc

from measure.flags import NO_REASON, Code, Reason
from measure.matching.gauss_newton import UNSETTLED, gauss_newton
from measure.noise.noise_model import NoiseModel, correlated, noise_model

Array = NDArray[np.float64]

# Of the coefficients of u², uv and v² of a surface whose curvature has no preferred direction, but for their scale.
_ISOTROPIC = np.array([[0.75, 0.0, 0.25], [0.0, 1.0, 0.0], [0.25, 0.0, 0.75]])
_DIRECTIONS = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])
_ROUNDS = 8  # of scoring
_LEAST_NOISE_EIGENVALUE = 1e-9  # of a covariance, over its largest
_FEWEST = 20  # patches whose bendings have a variance worth the name
Mask = NDArray[np.bool_]

RADIUS_PX = 15  # of a round patch: texture enough nearly everywhere, and small enough for the ground to be plane
SPARE_PX = 12  # about the patch in a window: room to move, to be stretched and to be smoothed
_UNKNOWNS = 8  # of a frame: six of the affine geometry, gain and offset
_SMOOTHING_PX = (2.0, 1.0, 0.0)  # first a smoothed picture, which draws from farther, at last the picture itself
_FINEST_START_PX = 1.0  # where grain is strong, a little smoothing leaves the smaller errors
_EVEN = 1e-6  # of the grey values: what rounding makes of an even picture
_LEAST_EIGENVALUE = 1e-4  # of the normal equations scaled to unit diagonal
_ITERATIONS = 30  # under each smoothing, at most
_STILL_PX = 0.005  # a last step well below the precision
_FARTHEST_STEP_PX = 3.0  # beyond it the matching has run away


@dataclass(frozen=True, eq=False)
class Bending:
    """What a piece shows of its bending q (6,) against the reference's: coefficients of u², uv and v² in units of the
    usual patch's radius, whatever the size of this one, of the columns' shift and then of the rows', px of the patch.

    observed (6,) is response (6, 6) @ q and noise of covariance noise (6, 6); on_place (2, 6) @ q is its effect on the
    place, px of the patch.
    """

    observed: Array
    response: Array
    noise: Array
    on_place: Array

    @property
    def has_noise(self) -> bool:
        """Whether the noise is a covariance that can be weighed by: pictures copied from one another have none."""
        values = np.linalg.eigvalsh(self.noise)
        return bool(values[0] > _LEAST_NOISE_EIGENVALUE * values[-1])

    def estimated(self, variance: Array) -> tuple[Array, Array]:
        """The shift (2,) of the place, px of the patch, and the covariance (2, 2) that stays, where bendings have that
        covariance (6, 6)."""
        gain = variance @ self.response.T @ np.linalg.inv(self.response @ variance @ self.response.T + self.noise)
        left = variance - gain @ self.response @ variance
        return self.on_place @ gain @ self.observed, self.on_place @ left @ self.on_place.T


def bending_variance(bendings: Sequence[Bending]) -> Array:
    """The covariance (6, 6) of the bendings of one scan's patches against another's; zero where too few are known.

    Relief bends along the epipolar lines, and curves in all directions alike: unknown are the variances of a shift's
    two components and their covariance.
    """
    if len(bendings) < _FEWEST:
        return np.zeros((6, 6))
    observed, noise = np.array([each.observed for each in bendings]), np.array([each.noise for each in bendings])
    response = np.array([each.response for each in bendings])
    shapes = np.array([np.kron(direction, _ISOTROPIC) for direction in _DIRECTIONS])
    parts = np.einsum("nij,kjl,nml->knim", response, shapes, response)
    components = np.zeros(3)
    for _ in range(_ROUNDS):
        inverse = np.linalg.inv(noise + np.tensordot(components, parts, 1))
        weighted = np.einsum("nij,knjl->knil", inverse, parts)
        free = np.einsum("nij,nj->ni", inverse, observed)
        normal = np.einsum("knij,lnji->kl", weighted, weighted)
        squares = np.einsum("ni,knij,nj->k", free, parts, free)
        expected = np.einsum("knij,nji->k", weighted, np.einsum("nij,njl->nil", inverse, noise))
        components = _valid(np.linalg.solve(normal, squares - expected))
    return np.asarray(np.tensordot(components, shapes, 1))


def _valid(components: Array) -> Array:
    """The nearest components that some shift can have."""
    values, vectors = np.linalg.eigh(np.tensordot(components, _DIRECTIONS, 1))
    matrix = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.array([matrix[0, 0], matrix[0, 1], matrix[1, 1]])


@dataclass(frozen=True, eq=False)
class Piece:
    """What a frame shows about a point: grey values (height, width) whose top-left pixel is origin_px (col, row) of the
    scan, and the approximate affine map (2, 3) from the grid of the patch to the scan."""

    grey: NDArray[np.floating]
    origin_px: tuple[int, int]
    scan_from_patch: Array


@dataclass(frozen=True, eq=False)
class Matched:
    """A piece as matched. center_px (2,), covariance_px2 (2, 2), scan_from_patch (2, 3) in the scan.

    correlation: of the piece with the mean of the others; gain: its contrast over the mean one; variance: of its noise,
    in units of its own contrast; unevenness: the probability that quarters of the patch differ as much in their shifts
    by chance. bending: of the ground within the patch, None for the reference, which has none against itself, and
    where nothing but the ground differs, so that it cannot be weighed.
    reason: why the point could not be matched, and then its pieces have no covariance.
    """

    center_px: Array
    covariance_px2: Array
    scan_from_patch: Array
    correlation: float
    gain: float
    variance: float
    unevenness: float
    bending: Bending | None = None
    reason: Reason = NO_REASON


def match_pieces(pieces: Sequence[Piece], reference: int, radius_px: int = RADIUS_PX) -> tuple[Matched, ...]:
    """Match the pieces of one point jointly.

    Parameters
    ----------
    pieces : what each frame shows of the point.
    reference : the number of the piece whose point stays where it is.
    radius_px : of the patch.

    Returns
    -------
    The pieces as matched, in their order; with reasons where they could not be.
    """
    fit = _Fit(pieces, reference, radius_px)
    best: tuple[Matched, ...] = ()
    for smoothing_px in _SMOOTHING_PX:
        fit.run(smoothing_px)
        if any(fit.reasons):
            return best or fit.unmatched()
        if smoothing_px <= _FINEST_START_PX:
            result = fit.result()
            best = result if not best or _area(result) < _area(best) else best
    return best


def _area(matched: Sequence[Matched]) -> float:
    """Mean variance of the points, by which results of one point are compared."""
    return float(np.mean([np.trace(each.covariance_px2) for each in matched]))


class _Fit:
    """The pieces' geometries in progress."""

    def __init__(self, pieces: Sequence[Piece], reference: int, radius_px: int) -> None:
        self.pieces, self.reference = pieces, reference
        self.maps = [np.array(piece.scan_from_patch, dtype=float) for piece in pieces]
        self.reasons = [NO_REASON] * len(pieces)
        edge = np.arange(-radius_px - 1, radius_px + 2)
        self.grid = np.stack(np.meshgrid(edge, edge), axis=-1).astype(float)
        self.used: Mask = np.hypot(self.grid[..., 0], self.grid[..., 1]) <= radius_px
        self.splines: list[Array] = []
        self.values = np.zeros((len(pieces), *self.used.shape))
        self.gains = np.ones(len(pieces))
        self.design = np.zeros((6, *self.used.shape))
        self.normal = np.eye(6)

    def run(self, smoothing_px: float) -> None:
        """Gauss-Newton steps until no point moves any more."""
        self.splines = [_spline(piece.grey, smoothing_px) for piece in self.pieces]
        if gauss_newton(self, _STILL_PX, _ITERATIONS).reason == UNSETTLED:
            self.reasons = [Reason("the matching does not come to rest", Code.NO_FIT)] * len(self.pieces)

    def solve(self) -> Array | None:
        """(frames, 6) how the grid is to be bent for each piece to lie on the reference's; None with reasons."""
        self._resample()
        if any(self.reasons) or not self._linearise():
            return None
        differences = (self.values - self.values[self.reference])[:, self.used]
        return np.asarray(np.linalg.solve(self.normal, self.design[:, self.used] @ differences.T).T)

    def step(self, step: Array) -> float:
        """Bend the grid by (frames, 6); how far the farthest point moved, px."""
        for index, of_piece in enumerate(step):
            self._move(index, of_piece)
        return float(np.abs(step[:, :2]).max())

    def failure(self) -> Reason:
        """The first piece's that failed, empty where none did."""
        return next((reason for reason in self.reasons if reason), NO_REASON)

    def _resample(self) -> None:
        """All pieces on the grid of the patch, less their means, in units of their own contrast."""
        for index, (piece, spline) in enumerate(zip(self.pieces, self.splines, strict=True)):
            places = self.grid @ self.maps[index][:, :2].T + self.maps[index][:, 2] - piece.origin_px
            if places.min() < 0.0 or (places.max(axis=(0, 1)) > np.array(spline.shape)[::-1] - 1).any():
                self.reasons[index] = Reason("the matching leaves the window about the approximate place", Code.NO_FIT)
                continue
            grey = ndimage.map_coordinates(spline, places[..., ::-1].transpose(2, 0, 1), order=3, prefilter=False)
            self.gains[index] = float(np.std(grey[self.used]))
            if not self.gains[index] > _EVEN * np.abs(grey).max():
                self.reasons[index] = Reason("the picture is even there", Code.CONTRAST)
                continue
            self.values[index] = (grey - grey[self.used].mean()) / self.gains[index]

    def _linearise(self) -> bool:
        """Derivatives of the common patch by shift, and by the four of the linear part; freed of gain and offset.

        The normal equations come from products of different pieces: in those of a piece with itself its noise would
        count as texture, which slows the steps and makes the covariance too small.
        """
        single = self._derivatives(self.values)
        self.normal = _products(single, single)
        self.design[:, self.used] = single.mean(axis=0).T
        size = np.sqrt(np.abs(np.diag(self.normal)))
        if not (size > 0.0).all() or np.linalg.eigvalsh(self.normal / np.outer(size, size))[0] < _LEAST_EIGENVALUE:
            self.reasons = [Reason("the texture does not fix the place in both directions", Code.IMPRECISE)] * len(
                self.pieces
            )
            return False
        return True

    def _derivatives(self, patches: Array) -> Array:
        """(frames, pixels used, 6) of each patch, less what a gain and an offset would explain."""
        by_col, by_row = (_slope(patches, axis)[:, self.used] for axis in (2, 1))
        u, v = self.grid[self.used].T
        columns = [by_col, by_row, by_col * u, by_col * v, by_row * u, by_row * v]
        return self._freed(np.stack(columns, axis=2), patches)

    def _bent(self, patches: Array) -> Array:
        """The same by the six coefficients of a bending."""
        u, v = self.grid[self.used].T / RADIUS_PX
        slopes = [_slope(patches, axis)[:, self.used] for axis in (2, 1)]
        return self._freed(np.stack([slope * form for slope in slopes for form in (u * u, u * v, v * v)], 2), patches)

    def _freed(self, design: Array, patches: Array) -> Array:
        """Columns less what a gain and an offset would explain."""
        patch = patches.mean(axis=0)[self.used]
        grey = np.linalg.qr(np.stack([np.ones_like(patch), patch], axis=1))[0]
        return np.asarray(design - grey @ (grey.T @ design))

    def _move(self, index: int, step: Array) -> None:
        """Where a piece looks as the patch does at u + d(u), the patch at u is found at u - d(u)."""
        if not np.isfinite(step).all() or np.hypot(*step[:2]) > _FARTHEST_STEP_PX or np.abs(step[2:]).max() > 0.5:
            self.reasons[index] = Reason("the matching runs away from the approximate place", Code.NO_FIT)
            return
        linear, shift = np.eye(2) - step[2:].reshape(2, 2), -step[:2]
        before = self.maps[index]
        self.maps[index] = np.column_stack([before[:, :2] @ linear, before[:, :2] @ shift + before[:, 2]])

    def unmatched(self) -> tuple[Matched, ...]:
        """The pieces with the reasons why they could not be matched, which is a reason against the others too."""
        nothing = np.full((2, 2), np.inf)
        return tuple(
            Matched(matrix[:, 2].copy(), nothing, matrix, 0.0, 0.0, np.inf, 0.0, reason=reason)
            for matrix, reason in zip(self.maps, self.reasons, strict=True)
        )

    def result(self) -> tuple[Matched, ...]:
        """The pieces with covariances from the noise that is left between them."""
        count = len(self.pieces)
        residuals = (self.values - self.values.mean(axis=0)) * self.used
        # Of a piece's own noise the mean has taken its share.
        residuals *= np.sqrt(count / (count - 1))
        noises = [self._noise(each) for each in residuals]
        bendings = self._bendings(noises)
        matched = []
        for index, noise in enumerate(noises):
            linear = self.maps[index][:, :2]
            own = self._covariance(noise)[:2, :2]
            others = (self.values.sum(axis=0) - self.values[index])[self.used]
            matched.append(
                Matched(
                    center_px=self.maps[index][:, 2].copy(),
                    covariance_px2=linear @ own @ linear.T,
                    scan_from_patch=self.maps[index],
                    correlation=float(np.corrcoef(self.values[index][self.used], others)[0, 1]),
                    gain=float(self.gains[index] / self.gains.mean()),
                    variance=noise.variance_dn2,
                    unevenness=self._unevenness(residuals[index], noise),
                    bending=bendings[index],
                )
            )
        return tuple(matched)

    def _noise(self, residuals: Array) -> NoiseModel:
        """The noise behind residuals, of which the unknowns have taken most where it is smoothest: tr(P C), P being the
        projection on what they explain, and not one pixel's variance for each."""
        noise = noise_model(residuals, self.used, _UNKNOWNS)
        explained = np.zeros((_UNKNOWNS, *self.used.shape))
        columns = [self.used[self.used], self.values.mean(axis=0)[self.used], *self.design[:, self.used]]
        explained[:, self.used] = np.linalg.qr(np.stack(columns, axis=1))[0].T
        taken = float(np.sum(explained * correlated(explained, noise))) / max(noise.variance_dn2, 1e-300)
        pixels = int(self.used.sum())
        factor = (pixels - _UNKNOWNS) / max(pixels - taken, 0.5 * pixels)
        return NoiseModel(factor * noise.variance_dn2, factor * noise.autocovariance_dn2, noise.neighbour_correlation)

    def _covariance(self, noise: NoiseModel) -> Array:
        """(6, 6) of the geometry, for noise of that autocovariance."""
        inverse = np.linalg.inv(self.normal)
        spread = np.tensordot(correlated(self.design, noise), self.design, axes=([1, 2], [1, 2]))
        return np.asarray(inverse @ spread @ inverse)

    def _bendings(self, noises: Sequence[NoiseModel]) -> list[Bending | None]:
        """What the differences from the reference's piece show, the affine geometry taken off."""
        single, bent = self._derivatives(self.values), self._bent(self.values)
        through = np.asarray(np.linalg.solve(self.normal, _products(single, bent)), np.float64)
        response = _products(bent, bent) - _products(single, bent).T @ through
        columns = np.zeros((bent.shape[2], *self.used.shape))
        columns[:, self.used] = (bent.mean(axis=0) - single.mean(axis=0) @ through).T
        spreads = [np.tensordot(correlated(columns, each), columns, axes=([1, 2], [1, 2])) for each in noises]
        bendings: list[Bending | None] = []
        for values, spread in zip(self.values, spreads, strict=True):
            observed = np.tensordot(columns, values - self.values[self.reference], axes=2)
            bending = Bending(observed, response, spread + spreads[self.reference], np.negative(through[:2]))
            bendings.append(bending if bending.has_noise else None)
        bendings[self.reference] = None
        return bendings

    def _unevenness(self, residuals: Array, noise: NoiseModel) -> float:
        """Each quarter of the patch has a shift of its own: chi-squared of the four, which sum to nothing."""
        u, v = self.grid[..., 0], self.grid[..., 1]
        quarters = [(u > 0) & (v >= 0), (u <= 0) & (v > 0), (u < 0) & (v <= 0), (u >= 0) & (v < 0)]
        moves = np.concatenate([self.design[:2] * quarter for quarter in quarters])
        # What the six unknowns of the whole patch have taken is taken off the quarters, too.
        flat, whole = moves[:, self.used].T, self.design[:, self.used].T
        free = flat - whole @ np.linalg.solve(self.normal, whole.T @ flat)
        moves = np.zeros_like(moves)
        moves[:, self.used] = free.T
        observed = np.einsum("kij,ij->k", moves, residuals)
        spread = np.tensordot(correlated(moves, noise), moves, axes=([1, 2], [1, 2]))
        values, vectors = np.linalg.eigh(spread)
        real = values > 1e-9 * values[-1]
        return (
            float(chdtrc(real.sum(), np.sum((vectors.T @ observed)[real] ** 2 / values[real]))) if real.any() else 1.0
        )


def _products(first: Array, second: Array) -> Array:
    """Mean products (j, k) of derivatives (frames, pixels, j) and (frames, pixels, k) of different frames."""
    count = len(first)
    own = np.einsum("nij,nik->jk", first, second)
    return np.asarray((first.sum(axis=0).T @ second.sum(axis=0) - own) / (count * (count - 1)))


def _spline(grey: NDArray[np.floating], smoothing_px: float) -> Array:
    """Coefficients of the cubic spline through the grey values."""
    picture = np.asarray(grey, dtype=float)
    if smoothing_px > 0.0:
        picture = cv2.GaussianBlur(picture, (0, 0), smoothing_px)
    return np.asarray(ndimage.spline_filter(picture, order=3, mode="mirror"))


def _slope(patches: Array, axis: int) -> Array:
    """The derivative of the cubic spline through the patches along an axis."""
    coefficients = ndimage.spline_filter1d(patches, order=3, axis=axis, mode="mirror")
    return np.asarray(ndimage.correlate1d(coefficients, [-0.5, 0.0, 0.5], axis=axis, mode="mirror"))

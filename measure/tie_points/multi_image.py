"""Multi-image least-squares matching of one natural point in all frames that show it.

The same small patch of ground is resampled from every frame onto one grid. Each frame's piece is the unknown common
patch with its own offset, gain and affine geometry; the reference frame defines the point. The best estimate of the
patch is the mean of the pieces, and a frame's geometry follows from the difference between its piece and the
reference's (object-based matching of Gruen and Baltsavias 1988 and Rosenholm 1987, with the patch eliminated).

Covariance: each frame's point depends only on its own noise. The definition of the point is free of error, since the
unknown object point absorbs it. Frames are therefore uncorrelated, and the difference between two frames has the sum of
their covariances."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import chdtrc

from measure.array_types import Array, Indices, Mask
from measure.flags import NO_REASON, Code, Reason
from measure.matching.gauss_newton import FitModel, gauss_newton
from measure.noise.noise_model import NoiseModel, correlate, noise_model

# Covariance, up to scale, of the coefficients of u², uv and v² of a surface with isotropic curvature.
_ISOTROPIC = np.array([[0.75, 0.0, 0.25], [0.0, 1.0, 0.0], [0.25, 0.0, 0.75]])
_DIRECTIONS = np.array([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]])
_ROUNDS = 8  # of Fisher scoring
_LEAST_NOISE_EIGENVALUE = 1e-9  # of a covariance, relative to its largest
_FEWEST = 20  # patches needed to estimate the variance of their bendings

RADIUS_PX = 15  # of a round patch: enough texture nearly everywhere, and small enough for plane ground
SPARE_PX = 12  # border of the window: room for shifts, deformation and smoothing
_UNKNOWNS = 8  # per frame: six affine parameters, gain and offset
_SMOOTHING_PX = (2.0, 1.0, 0.0)  # from coarse, with a large radius of convergence, to the image itself
_FINEST_START_PX = 1.0  # with strong grain, a little smoothing gives the smaller errors
_EVEN = 1e-6  # relative contrast of rounding errors in a uniform image
_LEAST_EIGENVALUE = 1e-4  # of the normal equations scaled to unit diagonal
_ITERATIONS = 30  # at most, per smoothing
_STILL_PX = 0.005  # last step, well below the precision
_FARTHEST_STEP_PX = 3.0  # a longer step means divergence


@dataclass(frozen=True, eq=False)
class Bending:
    """Estimate of a piece's second-order deformation q (6,) relative to the reference: coefficients of u², uv and v² of
    the column shift, then of the row shift, px of the patch, with u and v in units of RADIUS_PX.

    observed (6,) = response (6, 6) @ q + noise, with covariance noise (6, 6); on_place (2, 6) @ q is the effect on the
    position, px of the patch.
    """

    observed: Array
    response: Array
    noise: Array
    on_place: Array

    def estimated(self, variance: Array) -> tuple[Array, Array]:
        """Predicted shift (2,) of the position, px of the patch, and its remaining covariance (2, 2), given the
        covariance (6, 6) of bendings."""
        gain = variance @ self.response.T @ np.linalg.inv(self.response @ variance @ self.response.T + self.noise)
        left = variance - gain @ self.response @ variance
        return self.on_place @ gain @ self.observed, self.on_place @ left @ self.on_place.T


def bending_variance(bendings: Sequence[Bending]) -> Array:
    """Covariance (6, 6) of the bendings between the patches of two scans; zero where too few are known.

    Relief shifts along the epipolar lines and is isotropic in curvature: the unknown variance components are those of
    the two components of a shift and their covariance.
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
        # Projected onto positive semidefinite covariances.
        solved = np.linalg.solve(normal, squares - expected)
        values, vectors = np.linalg.eigh(np.tensordot(solved, _DIRECTIONS, 1))
        matrix = (vectors * np.maximum(values, 0.0)) @ vectors.T
        components = np.array([matrix[0, 0], matrix[0, 1], matrix[1, 1]])
    return np.asarray(np.tensordot(components, shapes, 1))


@dataclass(frozen=True, eq=False)
class Piece:
    """Image of a point in one frame. grey (height, width), with its top-left pixel at origin_px (col, row) of the scan;
    scan_from_patch (2, 3): approximate affine map from the patch grid to the scan."""

    grey: NDArray[np.floating]
    origin_px: tuple[int, int]
    scan_from_patch: Array


@dataclass(frozen=True, eq=False)
class Matched:
    """A matched piece.

    Attributes
    ----------
    center_px, covariance_px2, scan_from_patch : (2,), (2, 2) and (2, 3), in the scan.
    correlation : with the mean of the other pieces.
    gain : contrast relative to the mean.
    variance : of its noise, in units of its own contrast.
    unevenness : p-value of the shifts of the quarters of the patch being equal.
    bending : second-order deformation; None for the reference, and where its noise covariance is singular.
    reason : why the point could not be matched; there is then no covariance.
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
    """Match the pieces of one point jointly. reference: index of the piece that defines the point; radius_px: of the
    patch. Returns the matched pieces in their order, with reasons where matching failed."""
    fit = _JointMatch(pieces, reference, radius_px)
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
    """Mean position variance over the frames, the criterion between results of one point."""
    return float(np.mean([np.trace(each.covariance_px2) for each in matched]))


class _JointMatch(FitModel):
    """State of the joint matching: the geometry of every piece."""

    def __init__(self, pieces: Sequence[Piece], reference: int, radius_px: int) -> None:
        super().__init__(len(pieces))
        self.pieces, self.reference = pieces, reference
        self.maps = [np.array(piece.scan_from_patch, dtype=float) for piece in pieces]
        edge = np.arange(-radius_px - 1, radius_px + 2)
        self.grid = np.stack(np.meshgrid(edge, edge), axis=-1).astype(float)
        self.used: Mask = np.hypot(self.grid[..., 0], self.grid[..., 1]) <= radius_px
        self.splines: list[Array] = []
        self.values = np.zeros((len(pieces), *self.used.shape))
        self.gains = np.ones(len(pieces))
        self.design = np.zeros((6, *self.used.shape))
        self.normal = np.eye(6)

    def run(self, smoothing_px: float) -> None:
        """Iterate Gauss-Newton steps to convergence, on interpolating cubic splines of the smoothed grey values."""
        self.splines = []
        for piece in self.pieces:
            picture = np.asarray(piece.grey, dtype=float)
            if smoothing_px > 0.0:
                picture = cv2.GaussianBlur(picture, (0, 0), smoothing_px)
            self.splines.append(np.asarray(ndimage.spline_filter(picture, order=3, mode="mirror")))
        gauss_newton(self, self.every, _STILL_PX, _ITERATIONS)

    def solve(self, _: Indices) -> Array:
        """(frames, 6) affine corrections that align each piece with the reference; 0 where one fails, with reasons."""
        self._resample()
        if any(self.reasons) or not self._linearise():
            return np.zeros((len(self.pieces), 6))
        differences = (self.values - self.values[self.reference])[:, self.used]
        return np.asarray(np.linalg.solve(self.normal, self.design[:, self.used] @ differences.T).T)

    def step(self, _: Indices, steps: Array) -> Array:
        """Apply affine corrections d(u) (frames, 6): patch coordinate u then maps to u - d(u). All pieces share the
        patch and go on together: returns their largest shift, px, for each."""
        for index, own in enumerate(steps):
            if not np.isfinite(own).all() or np.hypot(*own[:2]) > _FARTHEST_STEP_PX or np.abs(own[2:]).max() > 0.5:
                self.reasons[index] = Reason("the matching runs away from the approximate place", Code.NO_FIT)
                continue
            linear, shift = np.eye(2) - own[2:].reshape(2, 2), -own[:2]
            before = self.maps[index]
            self.maps[index] = np.column_stack([before[:, :2] @ linear, before[:, :2] @ shift + before[:, 2]])
        largest_px = 0.0 if any(self.reasons) else float(np.abs(steps[:, :2]).max())
        return np.full(len(steps), largest_px)

    def _resample(self) -> None:
        """Resample all pieces onto the grid of the patch, centred and scaled to unit contrast."""
        for index, (piece, spline) in enumerate(zip(self.pieces, self.splines, strict=True)):
            places = self.grid @ self.maps[index][:, :2].T + self.maps[index][:, 2] - piece.origin_px
            if places.min() < 0.0 or (places.max(axis=(0, 1)) > np.array(spline.shape)[::-1] - 1).any():
                self.reasons[index] = Reason("the matching leaves the window about the approximate place", Code.NO_FIT)
                continue
            grey = ndimage.map_coordinates(spline, places[..., ::-1].transpose(2, 0, 1), order=3, prefilter=False)
            self.gains[index] = float(np.std(grey[self.used]))
            if not self.gains[index] > _EVEN * np.abs(grey).max():
                self.reasons[index] = Reason("the image is uniform there", Code.CONTRAST)
                continue
            self.values[index] = (grey - grey[self.used].mean()) / self.gains[index]

    def _linearise(self) -> bool:
        """Set the derivatives of the common patch by shift and linear part, orthogonal to gain and offset.

        The normal equations use products of different pieces: products of a piece with itself would count noise as
        texture, which slows convergence and makes the covariance too small.
        """
        single = self._affine_derivatives()
        self.normal = _products(single, single)
        self.design[:, self.used] = single.mean(axis=0).T
        size = np.sqrt(np.abs(np.diag(self.normal)))
        if not (size > 0.0).all() or np.linalg.eigvalsh(self.normal / np.outer(size, size))[0] < _LEAST_EIGENVALUE:
            self.reasons = [Reason("the texture does not fix the place in both directions", Code.IMPRECISE)] * len(
                self.pieces
            )
            return False
        return True

    def _slopes(self) -> list[Array]:
        """(frames, pixels used) derivatives of the interpolating cubic splines of the pieces by column and by row."""
        slopes = []
        for axis in (2, 1):
            coefficients = ndimage.spline_filter1d(self.values, order=3, axis=axis, mode="mirror")
            slope = ndimage.correlate1d(coefficients, [-0.5, 0.0, 0.5], axis=axis, mode="mirror")
            slopes.append(np.asarray(slope)[:, self.used])
        return slopes

    def _affine_derivatives(self) -> Array:
        """(frames, pixels used, 6) derivatives of each piece by shift and linear part, orthogonal to gain and
        offset."""
        by_col, by_row = self._slopes()
        u, v = self.grid[self.used].T
        columns = [by_col, by_row, by_col * u, by_col * v, by_row * u, by_row * v]
        return self._eliminate_gain_and_offset(np.stack(columns, axis=2))

    def _eliminate_gain_and_offset(self, design: Array) -> Array:
        """Remove the components that a gain and an offset explain."""
        patch = self.values.mean(axis=0)[self.used]
        grey = np.linalg.qr(np.stack([np.ones_like(patch), patch], axis=1))[0]
        return np.asarray(design - grey @ (grey.T @ design))

    def unmatched(self) -> tuple[Matched, ...]:
        """Results without covariance, with the reasons of the pieces that failed."""
        nothing = np.full((2, 2), np.inf)
        return tuple(
            Matched(matrix[:, 2].copy(), nothing, matrix, 0.0, 0.0, np.inf, 0.0, reason=reason)
            for matrix, reason in zip(self.maps, self.reasons, strict=True)
        )

    def result(self) -> tuple[Matched, ...]:
        """Results with covariances from the residuals between the pieces."""
        count = len(self.pieces)
        residuals = (self.values - self.values.mean(axis=0)) * self.used
        # The mean contains 1 / count of a piece's own noise.
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
        """Noise model of a piece from its residuals. The unknowns absorb tr(P C) of the noise, with P the projection on
        their columns: more than one pixel's variance each, since they absorb smooth noise most."""
        noise = noise_model(residuals, self.used, _UNKNOWNS)
        explained = np.zeros((_UNKNOWNS, *self.used.shape))
        columns = [self.used[self.used], self.values.mean(axis=0)[self.used], *self.design[:, self.used]]
        explained[:, self.used] = np.linalg.qr(np.stack(columns, axis=1))[0].T
        taken = float(np.sum(explained * correlate(explained, noise))) / max(noise.variance_dn2, 1e-300)
        pixels = int(self.used.sum())
        factor = (pixels - _UNKNOWNS) / max(pixels - taken, 0.5 * pixels)
        return NoiseModel(factor * noise.variance_dn2, factor * noise.autocovariance_dn2, noise.neighbour_correlation)

    def _covariance(self, noise: NoiseModel) -> Array:
        """(6, 6) covariance of the affine parameters for correlated noise."""
        inverse = np.linalg.inv(self.normal)
        spread = np.tensordot(correlate(self.design, noise), self.design, axes=([1, 2], [1, 2]))
        return np.asarray(inverse @ spread @ inverse)

    def _bendings(self, noises: Sequence[NoiseModel]) -> list[Bending | None]:
        """Bending of each piece relative to the reference, after elimination of the affine parameters; None where its
        noise covariance is singular, as for images copied from each other."""
        u, v = self.grid[self.used].T / RADIUS_PX
        columns_of_forms = [slope * form for slope in self._slopes() for form in (u * u, u * v, v * v)]
        single, bent = self._affine_derivatives(), self._eliminate_gain_and_offset(np.stack(columns_of_forms, axis=2))
        through = np.asarray(np.linalg.solve(self.normal, _products(single, bent)), np.float64)
        response = _products(bent, bent) - _products(single, bent).T @ through
        columns = np.zeros((bent.shape[2], *self.used.shape))
        columns[:, self.used] = (bent.mean(axis=0) - single.mean(axis=0) @ through).T
        spreads = [np.tensordot(correlate(columns, each), columns, axes=([1, 2], [1, 2])) for each in noises]
        bendings: list[Bending | None] = []
        for values, spread in zip(self.values, spreads, strict=True):
            observed = np.tensordot(columns, values - self.values[self.reference], axes=2)
            noise = spread + spreads[self.reference]
            eigenvalues = np.linalg.eigvalsh(noise)
            is_regular = eigenvalues[0] > _LEAST_NOISE_EIGENVALUE * eigenvalues[-1]
            bendings.append(Bending(observed, response, noise, np.negative(through[:2])) if is_regular else None)
        bendings[self.reference] = None
        return bendings

    def _unevenness(self, residuals: Array, noise: NoiseModel) -> float:
        """P-value (chi-square) of four separate shifts of the quarters of the patch."""
        u, v = self.grid[..., 0], self.grid[..., 1]
        quarters = [(u > 0) & (v >= 0), (u <= 0) & (v > 0), (u < 0) & (v <= 0), (u >= 0) & (v < 0)]
        moves = np.concatenate([self.design[:2] * quarter for quarter in quarters])
        # Remove what the six affine parameters of the whole patch absorb.
        flat, whole = moves[:, self.used].T, self.design[:, self.used].T
        free = flat - whole @ np.linalg.solve(self.normal, whole.T @ flat)
        moves = np.zeros_like(moves)
        moves[:, self.used] = free.T
        observed = np.einsum("kij,ij->k", moves, residuals)
        spread = np.tensordot(correlate(moves, noise), moves, axes=([1, 2], [1, 2]))
        values, vectors = np.linalg.eigh(spread)
        real = values > 1e-9 * values[-1]
        return (
            float(chdtrc(real.sum(), np.sum((vectors.T @ observed)[real] ** 2 / values[real]))) if real.any() else 1.0
        )


def _products(first: Array, second: Array) -> Array:
    """(j, k) mean products of derivatives (frames, pixels, j) and (frames, pixels, k) over pairs of different
    frames."""
    count = len(first)
    own = np.einsum("nij,nik->jk", first, second)
    return np.asarray((first.sum(axis=0).T @ second.sum(axis=0) - own) / (count * (count - 1)))

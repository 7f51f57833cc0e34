"""Noise model of the residuals of a fit: variance, autocovariance, and the weights that follow from them.

The noise is white scanner noise plus film grain of several sizes. Isotropic noise whose correlation falls with distance
is well described by a sum of grains with Gaussian correlation: film needs one or two sizes, image texture, with detail
of all sizes, many.

The autocovariance of the residuals is biased: each unknown absorbs noise, mostly at the low frequencies where it is
strongest, and in a small window the covariance comes out too small. The model therefore predicts the autocovariance
after the same fit and is fitted to the observed one, lag by lag, in the mark's window and, where there are any, in
patches of blank film beside it, which show grain and noise alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import nnls

from measure.array_types import Array, Mask, Single
from measure.noise.robust_estimation import Real, robust_scale

WHITE = 0.02  # least fraction of white noise: grain is not known better at the highest frequencies
REACH_PX = 5  # reach of the coarsest grain that matters at scanning pitch, correlated over 1.5 px

_ODDS = 13.8  # chi-square of two coordinates at p = 0.001
_TEXTURE = 0.25  # correlation at REACH_PX that grain never has
_POWER, _POWER_SIGMA, _MOST = 0.4, 0.25, 1 - 1 / 2.2  # exponent of noise over light: prior, its sigma, upper bound
_OTHER, _SAME = 0.5, 0.15  # fractions of the largest change of log light: above, noise differs; below, it does not
_GREATEST = 0.98  # quantile that counts as the largest change
_FEWEST = 12  # pixels needed to estimate their noise
SCALE_VARIANCE = 1.36  # variance of the logarithm of a robust scale, times the number of values
_LEAST = 0.1  # change of log light below which noise is constant
_DARKEST = 5e-4  # of full scale: below it noise does not decrease further
_ROUNDS = 8  # of conjugate gradients at most
_CLOSE = 0.03  # relative residual of a derivative that costs 0.001 of the standard deviation
_MISFIT = 0.003  # model error from pixel to pixel, in contrasts
PATCH_PX = 15  # side of a patch: three times the reach of film grain
BESIDE_PX = 2 * PATCH_PX + 4.0  # width of the surroundings of a mark that are searched for blank film
# Standard deviations of the Gaussians that turn white noise into grain, and the coarsest that is still film grain.
GRAIN_PX = (0.4, 0.5, 0.6, 0.7, 0.8, 0.95, 1.1, 1.3, 1.5, 1.8, 2.2)
_COARSEST_PX = 1.8
_AS_NOISY = 3.0  # largest ratio of a patch's variance and that of the residuals; beyond: image, text or dust
_FEWEST_PATCHES = 6  # patches needed to improve on the mark's own window
_LARGEST_LAG_PX = 8  # lag at which grain of 1.5 px has a correlation of 0.001
_FARTHEST_PX = 3.0  # largest lag compared; beyond it the residuals show the fit rather than the noise
_FARTHEST_BLANK_PX = 5.0  # the same for blank film
_ALIKE = 1e-10  # relative eigenvalue below which images are linearly dependent
_INDEX = np.arange(-_LARGEST_LAG_PX, _LARGEST_LAG_PX + 1)
_SQUARED_LAGS = _INDEX[:, None] ** 2 + _INDEX**2
# (1 + grains, lags, lags) autocorrelations of white noise and of white noise under Gaussians.
_KERNELS: Array = np.stack(
    [_SQUARED_LAGS == 0.0, *(np.exp(-_SQUARED_LAGS / (4.0 * grain_px**2)) for grain_px in GRAIN_PX)]
)
_ROW, _COL = np.mgrid[:PATCH_PX, :PATCH_PX].reshape(2, -1) - (PATCH_PX - 1) / 2
# (pixels, 3) orthonormal basis of planes over a patch.
PLANE: Array = np.linalg.qr(np.stack([np.ones(PATCH_PX**2), _COL, _ROW], axis=1))[0]


def combine(factors: Array, images: Array) -> Array:
    """Linear combination of images (n, height, width) with factors (n,) to one image, or (m, n) to m images."""
    sums = factors @ images.reshape(len(images), prod(images.shape[1:]))
    return np.asarray(sums.reshape(*factors.shape[:-1], *images.shape[1:]))


def inner_products(first: Array, second: Array) -> Array:
    """(n, m) inner products of images (n, height, width) and (m, height, width)."""
    return np.asarray(first.reshape(len(first), -1) @ second.reshape(len(second), -1).T)


def least_squares_factors(images: Array, image: Array) -> Array:
    """(n,) least-squares factors of images (n, height, width), 0 where not used, that approximate an image."""
    inverse = np.linalg.pinv(inner_products(images, images), hermitian=True)
    return np.asarray(inverse @ inner_products(images, image[None])[:, 0])


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Stationary noise.

    Attributes
    ----------
    variance_dn2 : of one pixel.
    autocovariance_dn2 : (2 reach + 1, 2 reach + 1) by lag; (1, 1) for white noise.
    neighbour_correlation : mean correlation of pixels that touch along an edge.
    is_grain : whether blank film confirms it; residuals of a fit alone may be image texture.
    """

    variance_dn2: float
    autocovariance_dn2: Array
    neighbour_correlation: float
    is_grain: bool = False

    @property
    def is_white(self) -> bool:
        return self.autocovariance_dn2.size == 1

    def raise_variance(self, variance_dn2: float) -> "NoiseModel":
        """Scale the noise to at least this variance."""
        if not self.variance_dn2:  # no noise at all: nothing to scale
            return NoiseModel(variance_dn2, np.full((1, 1), variance_dn2), 0.0, self.is_grain)
        larger = max(variance_dn2 / self.variance_dn2, 1.0)
        return replace(
            self, variance_dn2=self.variance_dn2 * larger, autocovariance_dn2=self.autocovariance_dn2 * larger
        )


def noise_model(residuals: Array, used: Mask, unknowns: int) -> NoiseModel:
    """Estimate the noise model from residuals (height, width), where used, of a fit with the given number of unknowns.

    Noise counts as white if the correlation of neighbours is within three standard errors of zero.
    """
    noise, is_white = white_noise_model(residuals, used, unknowns)
    if is_white:
        return noise
    lags = taper(autocovariance(np.where(used, residuals, 0.0), used, REACH_PX))
    return replace(noise, autocovariance_dn2=lags * (noise.variance_dn2 / lags[REACH_PX, REACH_PX]))


def influence_covariances(
    influences: NDArray[Real], residuals: NDArray[Real], used: Mask, unknowns: int
) -> tuple[Array, Array]:
    """Covariances of linear estimates under their own correlated noise.

    Parameters
    ----------
    influences : (n, k, height, width) derivatives of n estimates by their pixels.
    residuals, used : (n, height, width), from which the noise is estimated.

    Returns
    -------
    Covariances (n, k, k), and variances (n,) of a pixel.
    """
    kept, count = np.where(used, residuals, 0.0), np.maximum(used.sum(axis=(1, 2)), 1)
    squares = (kept**2).sum(axis=(1, 2))
    variances = squares / np.maximum(count - unknowns, 1)
    correlation = covariance_along(kept, used, 1) / np.maximum(squares / count, 1e-300)
    flat = influences.astype(np.float32).reshape(*influences.shape[:2], -1)
    covariances = variances[:, None, None] * (flat @ flat.swapaxes(1, 2))
    coloured = np.abs(correlation) >= 3 / np.sqrt(2 * count)
    if coloured.any():
        own = _coloured_covariances(influences[coloured], kept[coloured], used[coloured], variances[coloured])
        # Lags of few pixels are noisy: where they are no autocovariance of any noise, it is white.
        is_definite = np.linalg.eigvalsh(np.nan_to_num(own + own.swapaxes(1, 2)))[:, 0] > 0.0
        covariances[np.flatnonzero(coloured)[is_definite]] = own[is_definite]
    return covariances, variances


def _coloured_covariances(influences: NDArray[Real], kept: NDArray[Any], used: Mask, variances: Array) -> Array:
    """Covariances (n, k, k) as of `influence_covariances`, with the autocovariance of the residuals kept."""
    index = np.arange(-REACH_PX, REACH_PX + 1)
    lags = taper(autocovariance(kept, used, REACH_PX))
    lags *= (variances / np.maximum(lags[:, REACH_PX, REACH_PX], 1e-300))[:, None, None]
    size: list[int] = transform_size(tuple(kept.shape[1:]), REACH_PX)
    kernels = np.zeros((len(kept), *size), np.float32)
    kernels[:, index[:, None], index] = lags
    weights = np.full(size[1] // 2 + 1, 2.0)  # columns of a real transform also stand for their conjugates
    weights[[0, *([-1] if size[1] % 2 == 0 else [])]] = 1.0
    weights = fft.rfft2(kernels).real * (weights / np.prod(size)).astype(np.float32)
    waves = fft.rfft2(influences.astype(np.float32), s=size)
    parts = [waves.real.reshape(*waves.shape[:2], -1), waves.imag.reshape(*waves.shape[:2], -1)]
    flat = weights.reshape(len(weights), 1, -1)
    real, imaginary = ((part * flat) @ part.swapaxes(1, 2) for part in parts)
    return np.asarray(real + imaginary, float)


def taper(lags: Array) -> Array:
    """Taper the far lags of autocovariances (..., lags, lags), which are dominated by noise."""
    reach = lags.shape[-1] // 2
    index = np.arange(-reach, reach + 1)
    return np.asarray(lags * np.clip(reach + 1 - np.hypot(index[:, None], index), 0.0, 1.0))


def white_noise_model(
    residuals: Array, used: Mask, unknowns: int, information: float | None = None
) -> tuple[NoiseModel, bool]:
    """White-noise model, and whether the residuals are white. information: equivalent number of ordinary pixels, where
    some are clipped and residuals are their scores."""
    count, kept = max(int(used.sum()), 1), np.where(used, residuals, 0.0)
    squares = float((kept**2).sum())
    variance = squares / max((count if information is None else information) - unknowns, 1)
    correlation = float(covariance_along(kept, used, 1)) / (squares / count) if squares else 0.0
    return NoiseModel(variance, np.array([[variance]]), correlation), abs(correlation) < 3 / np.sqrt(2 * count)


def is_textured(residuals: Array, used: Mask, floor_dn: float) -> bool:
    """Whether residuals show image texture rather than grain: they are correlated beyond the reach of grain. floor_dn:
    model error, which does not count."""
    kept = np.where(used, residuals, 0.0)
    if not kept.any():
        return False
    return bool(covariance_along(kept, used, REACH_PX) > _TEXTURE * max((kept**2).sum() / used.sum(), floor_dn**2))


def may_be_noise(off: Array, covariance: Array) -> bool:
    """Whether an offset (2,) is compatible with noise of covariance (2, 2), at p = 0.001."""
    return bool(off @ np.linalg.solve(covariance, off) < _ODDS)


def correlate(columns: Array, noise: NoiseModel, power: float = 1.0) -> Array:
    """Product of the noise's covariance matrix and images (n, height, width), by FFT in single precision; powers other
    than 1 ignore the image border."""
    spectrum, shape = _spectrum(noise, columns.shape[1:])
    if power != 1.0:
        spectrum = np.maximum(spectrum, WHITE * noise.variance_dn2) ** power
    return np.asarray(_filtered(columns.astype(np.float32), spectrum.astype(np.float32), shape), float)


def _spectrum(noise: NoiseModel, size: tuple[int, ...]) -> tuple[Array, list[int]]:
    """Power spectrum of the noise for images of a size, and the size of the transform."""
    reach = len(noise.autocovariance_dn2) // 2
    shape, index = transform_size(size, reach), np.arange(-reach, reach + 1)
    kernel = np.zeros(shape)
    kernel[np.ix_(index, index)] = noise.autocovariance_dn2
    return np.asarray(fft.rfft2(kernel).real), shape


def _filtered(images: NDArray[Real], spectrum: NDArray[Real], shape: list[int]) -> NDArray[Real]:
    """Filter images (n, height, width) with a spectrum of the given transform size."""
    height, width = images.shape[1:]
    smeared = fft.irfft2(fft.rfft2(images, s=shape) * spectrum, s=shape)
    return np.asarray(smeared[:, :height, :width], images.dtype)


def autocovariance(kept: Array, used: Mask, reach: int) -> Array:
    """(..., lags, lags) autocovariance of images (..., height, width) up to reach, averaged over mirrored lags, since
    grain is isotropic."""
    shape = transform_size(kept.shape[-2:], reach)
    spectra = np.abs(fft.rfft2(np.stack([kept, used]), s=shape)) ** 2
    sums, pairs = fft.irfft2(spectra, s=shape)
    index = np.arange(-reach, reach + 1)
    lags = (sums / np.maximum(pairs, 1.0))[..., index[:, None], index]
    lags = (lags + lags[..., ::-1]) / 2
    return np.asarray((lags + lags.swapaxes(-1, -2)) / 2)


def transform_size(shape: tuple[int, ...], reach: int) -> list[int]:
    """Transform size that avoids wrap-around up to the reach."""
    return [fft.next_fast_len(size + reach, real=True) for size in shape]


def covariance_along(kept: Array, used: Mask, lag: int) -> Array:
    """(...) mean product of images (..., height, width) at a lag along rows and columns."""
    neighbours = kept[..., lag:] * kept[..., :-lag], kept[..., lag:, :] * kept[..., :-lag, :]
    pairs = used[..., lag:] & used[..., :-lag], used[..., lag:, :] & used[..., :-lag, :]
    sums = [
        each.sum(axis=(-2, -1)) / np.maximum(both.sum(axis=(-2, -1)), 1)
        for each, both in zip(neighbours, pairs, strict=True)
    ]
    return np.asarray(sum(sums) / 2)


# Weights of pixels: noise that grows with light, and generalised least squares for grain.
#
# Sensor noise is constant in light. Noise added to grey values that are a power of light, by rounding or compression,
# is constant in grey values and grows with light; grain lies between. The standard deviation is therefore modelled as
# a power of light with an exponent from 0 (constant in light) to 1 - 1 / 2.2 (constant in grey values of gamma 2.2).
# A faster growth is not noise but a misfit of the mark, and must not be down-weighted.
#
# Generalised least squares solves `B r = 0`, with B the derivatives times the inverse of the noise's covariance
# matrix. Conjugate gradients give B to some per cent in a few rounds without forming a matrix. B need not be exact:
# the estimate is unbiased for any B, and its covariance is computed with the B that was used.


def steadiness(residuals: Array, light: Array, ground: Mask, used: Mask) -> Array:
    """(height, width) standard deviation of the background's noise over that of each pixel.

    Parameters
    ----------
    residuals, light : (height, width) residuals and model of a fit, in light; the latter as a fraction of full scale.
    ground, used : (height, width) background pixels, and pixels used. Robust scales limit the effect of damage.
    """
    at_ground = ground & used
    if not at_ground.any():
        return np.ones_like(residuals)
    light = np.maximum(light, _DARKEST)
    change = np.log(light / np.median(light[at_ground]))
    size = np.abs(change)
    greatest = float(np.quantile(size[used], _GREATEST))
    if greatest < _LEAST:
        return np.ones_like(residuals)
    same, other = at_ground & (size < _SAME * greatest), used & (size > _OTHER * greatest)
    power, weight = _POWER, _POWER_SIGMA**-2
    if same.sum() >= _FEWEST and other.sum() >= _FEWEST:
        scales = [max(robust_scale(residuals[group]), 1e-9) for group in (other, same)]
        apart = float(np.mean(change[other]) - np.mean(change[same]))
        precision = apart**2 / (SCALE_VARIANCE * (1 / same.sum() + 1 / other.sum()))
        power = (weight * power + precision * float(np.log(scales[0] / scales[1])) / apart) / (weight + precision)
    return np.asarray(np.exp(-np.clip(power, 0.0, _MOST) * change))


def gls_weights(design: Array, used: Mask, noise: NoiseModel, contrast_dn: float) -> tuple[Array, Array]:
    """Weighted derivatives B and C B', each (unknowns, height, width) and 0 where not used; C: covariance of the
    noise."""
    scale_dn2, (spectrum_dn2, shape) = noise.variance_dn2, _spectrum(noise, used.shape)
    least = max(WHITE * scale_dn2, (_MISFIT * contrast_dn) ** 2) / scale_dn2
    spectrum: Single = np.maximum(spectrum_dn2 / scale_dn2, least).astype(np.float32)
    counts = used.astype(np.float32)
    inverse: Single = np.asarray(1 / spectrum, np.float32)  # preconditioner: ignores the border
    # Scale the columns for single precision; all are solved together.
    right = (design * used).astype(np.float32)
    size = np.sqrt(_dots(right, right))
    right /= size
    # Converged columns leave the iteration: those of a mark's edges first, those of the background later.
    solution, left, rests = np.zeros_like(right), np.arange(len(right)), right.copy()
    direction = ahead = _filtered(right, inverse, shape) * counts
    strength = _dots(right, ahead)
    for _ in range(_ROUNDS):
        image = _filtered(direction, spectrum, shape) * counts
        length = strength / np.maximum(_dots(direction, image), 1e-30)
        solution[left] += length * direction
        rests[left] -= np.multiply(length, image, out=image)
        rest = rests[left]
        far = _dots(rest, rest)[:, 0, 0] >= _CLOSE**2  # of columns of unit length
        if not far.any():
            break
        left, rest, direction, before = left[far], rest[far], direction[far], strength[far]
        ahead = _filtered(rest, inverse, shape) * counts
        strength = _dots(rest, ahead)
        direction *= strength / np.maximum(before, 1e-30)
        direction += ahead
    return solution * (size / scale_dn2).astype(float), (right - rests) * size.astype(float)


def _dots(first: Single, second: Single) -> Single:
    return np.asarray(np.einsum("nij,nij->n", first, second)[:, None, None], np.float32)


Lags = NDArray[np.intp]  # (n, 2) rows and columns between pixels, all of one length


def blank_patches(window: Array, free: Mask, variance_dn2: float) -> Array:
    """(n, PATCH_PX, PATCH_PX) grey values minus a plane in the blank patches of a window (height, width): wholly free,
    with a variance near the given one. Empty if there are too few."""
    patches = _squares(window)[_squares(free).all(axis=(1, 2))].reshape(-1, PATCH_PX**2)
    rest = patches - patches @ PLANE @ PLANE.T
    variances = (rest**2).sum(axis=1) / (PATCH_PX**2 - PLANE.shape[1])
    alike = (variances > variance_dn2 / _AS_NOISY) & (variances < variance_dn2 * _AS_NOISY)
    return np.asarray(rest[alike & (alike.sum() >= _FEWEST_PATCHES)].reshape(-1, PATCH_PX, PATCH_PX))


def is_coloured(patches: Array) -> bool:
    """Whether neighbouring pixels of the patches are correlated, at three standard errors."""
    if not len(patches):
        return False
    sums = (patches[:, :, 1:] * patches[:, :, :-1]).sum() + (patches[:, 1:] * patches[:, :-1]).sum()
    # The plane absorbs three degrees of freedom of a patch, which biases the correlation.
    correlation = sums / (2 * (patches**2).sum()) + PLANE.shape[1] / PATCH_PX**2
    return bool(abs(correlation) > 3 / np.sqrt(2 * patches.size))


def _squares(image: Array | Mask) -> Array:
    """(n, PATCH_PX, PATCH_PX) squares of an image."""
    rows, cols = (size // PATCH_PX for size in image.shape)
    inner = image[: rows * PATCH_PX, : cols * PATCH_PX].reshape(rows, PATCH_PX, cols, PATCH_PX)
    return np.asarray(inner.swapaxes(1, 2).reshape(-1, PATCH_PX, PATCH_PX), float)


def grain_model(residuals: Array, used: Mask, design: Array, neighbour_correlation: float, blank: Array) -> NoiseModel:
    """Fit a sum of white noise and grains to the residuals, allowing for what the fit absorbs.

    Parameters
    ----------
    residuals, used : (height, width) residuals of the fit, and the pixels used.
    design : (unknowns, height, width) derivatives of the fitted model with respect to its unknowns.
    neighbour_correlation : of the residuals.
    blank : (n, PATCH_PX, PATCH_PX) patches of blank film minus a plane, as of `blank_patches`. Where they hold more
        pixels than the window, they alone are used.
    """
    parts = []
    if len(blank):
        pairs, expected = _patch()
        left = _pixel_products(blank, _rings(_FARTHEST_BLANK_PX))
        parts.append((len(blank) * pairs, left, len(blank) * expected))
    if blank.size < used.sum():
        rings = _rings(_FARTHEST_PX)
        pairs, left = (_pixel_products(image[None], rings) for image in (used, np.where(used, residuals, 0.0)))
        parts.append((pairs, left, pairs * _ring_kernels(rings) + taken_out(used, design)))
    pairs, left, expected = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    weights = 1.0 / np.sqrt(np.maximum(pairs, 1.0))
    lags = np.tensordot(nnls((expected * weights).T, left * weights)[0], _KERNELS, axes=1)
    variance, neighbours = lags[_LARGEST_LAG_PX, _LARGEST_LAG_PX], lags[_LARGEST_LAG_PX, _LARGEST_LAG_PX + 1]
    # A fit lowers the correlation of residuals. If it is still above that of the coarsest grain, in the residuals or in
    # the model, image texture was taken for grain.
    alike, most = max(neighbour_correlation, neighbours / max(variance, 1e-300)), np.exp(-1 / (4.0 * _COARSEST_PX**2))
    return NoiseModel(float(variance), lags, neighbour_correlation, bool(len(blank) and alike < most))


def taken_out(used: Mask, design: Array, farthest_px: float = _FARTHEST_PX) -> Array:
    """Part of the sums of products of pixels at each distance, up to farthest_px, that a fit absorbs.

    The residuals have the covariance matrix M C M, with M = I - Q Q'. Summed over pixels at one distance, by D, this is
    tr(D C) - 2 tr(Q' C D Q) + tr(Q' D Q Q' C Q). The last two terms are sums of products of the columns of Q, lag by
    lag, times the autocorrelation at that lag.

    Parameters
    ----------
    used, design : (height, width), (unknowns, height, width) pixels used, and derivatives of the model by its unknowns.

    Returns
    -------
    (1 + grains, distances), for white noise and each grain at unit variance.
    """
    border, used_design = int(farthest_px), design[:, used]
    within = np.pad(used, border)
    base = np.zeros((len(design), *within.shape), np.float32)
    # An orthonormal basis of the span of the derivatives.
    normal = used_design @ used_design.T
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    significant = values > _ALIKE * values[-1]
    orthonormal = (vectors[:, significant] / np.sqrt(values[significant])).T / size
    base[: len(orthonormal), within] = orthonormal @ used_design
    shape = transform_size(within.shape, _LARGEST_LAG_PX)
    spectra = np.conj(fft.rfft2(base, s=shape))
    flat, counted = base.reshape(len(base), -1), within.ravel().astype(np.float32)
    taken = []
    for ring in _rings(farthest_px):
        sums = _ring_sums(flat, ring, within.shape[1]) * counted
        sums = (flat @ sums.T) @ flat - 2 * sums
        lags = fft.irfft2((spectra * fft.rfft2(sums.reshape(base.shape), s=shape)).sum(axis=0), s=shape)
        taken.append(_KERNELS.reshape(len(_KERNELS), -1) @ lags[np.ix_(_INDEX, _INDEX)].ravel())
    return np.stack(taken, axis=1)


def _pixel_products(images: Array | Mask, rings: Sequence[Lags]) -> Array:
    """(distances,) sums over images (n, height, width) of products of pixels at each distance."""
    shape = transform_size(images.shape[1:], _LARGEST_LAG_PX)
    lags = fft.irfft2((np.abs(fft.rfft2(images.astype(np.float32), s=shape)) ** 2).sum(axis=0), s=shape)
    return np.array([lags[*ring.T].sum() for ring in rings])


def _ring_kernels(rings: Sequence[Lags]) -> Array:
    """(1 + grains, distances) autocorrelations at each distance."""
    return np.asarray(_KERNELS[:, *np.array([ring[0] for ring in rings]).T + _LARGEST_LAG_PX])


def _ring_sums(images: Single, ring: Lags, width: int) -> Single:
    """(n, pixels) sums of the pixels at the lags of a ring from each pixel of images (n, pixels), stored row by row
    with a border of zeros as wide as the lags."""
    total, most = np.zeros_like(images), int(np.abs(ring).max()) * (width + 1)
    for lag in (ring @ (width, 1)).tolist():
        total[:, most : total.shape[1] - most] += images[:, most + lag : total.shape[1] - most + lag]
    return total


@cache
def _rings(farthest_px: float) -> tuple[Lags, ...]:
    """Lags grouped by length, up to the farthest, the shortest first."""
    lags = np.argwhere(np.ones((2 * int(farthest_px) + 1,) * 2)) - int(farthest_px)
    squares = (lags**2).sum(axis=1)
    return tuple(lags[squares == square] for square in np.unique(squares[squares <= farthest_px**2]))


@cache
def _patch() -> tuple[Array, Array]:
    """For a patch of blank film, by distance: number of pixel pairs, and expected sums of products after removal of a
    plane."""
    whole, rings = np.ones((PATCH_PX, PATCH_PX), dtype=bool), _rings(_FARTHEST_BLANK_PX)
    pairs = _pixel_products(whole[None], rings)
    taken = taken_out(whole, PLANE.T.reshape(-1, PATCH_PX, PATCH_PX), _FARTHEST_BLANK_PX)
    return pairs, pairs * _ring_kernels(rings) + taken

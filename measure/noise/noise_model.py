"""The noise of film and scanner behind the residuals of a fit: variance, autocovariance, and weights that follow."""

from dataclasses import dataclass, replace
from math import prod

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from measure.array_types import Array, Mask, Single
from measure.noise.robust_estimation import Real, robust_scale

WHITE = 0.02  # of the variance at least is taken as white: no film's grain is known better at the finest frequencies
REACH_PX = 5  # the coarsest grain that matters at scanning pitch: correlated over 1.5 px, gone beyond 5

_ALIKE = 1e-10  # of the largest eigenvalue: what images differ by in less is no direction of its own
_ODDS = 13.8  # chi-square of two coordinates: one in a thousand
_TEXTURE = 0.25  # correlation at REACH_PX that grain never has
_POWER, _POWER_SIGMA, _MOST = 0.4, 0.25, 1 - 1 / 2.2  # of light: what is believed of any scan
_OTHER, _SAME = 0.5, 0.15  # of light's greatest change: from where noise differs, up to where it does not
_GREATEST = 0.98  # of the pixels change less than what is called the greatest change
_FEWEST = 12  # pixels that tell how noisy they are
_SCALE_VARIANCE = 1.36  # of the logarithm of a robust scale, times the number of values it is of
_LEAST = 0.1  # of light's logarithm: noise hardly changes with less
_DARKEST = 5e-4  # of full scale: nearer to black no scanner's noise is less
_ROUNDS = 8  # of conjugate gradients, at most
_CLOSE = 0.03  # of a derivative: so little left costs a thousandth of the standard deviation
_MISFIT = 0.003  # of the contrast: what the drawing itself gets wrong from pixel to pixel


def combined(factors: Array, images: Array) -> Array:
    """Images (n, height, width) times factors (n,), summed to one image, or (m, n), to m images."""
    sums = factors @ images.reshape(len(images), prod(images.shape[1:]))
    return np.asarray(sums.reshape(*factors.shape[:-1], *images.shape[1:]))


def products(first: Array, second: Array) -> Array:
    """(n, m) the sums over all pixels of the products of images (n, height, width) and (m, height, width)."""
    return np.asarray(first.reshape(len(first), -1) @ second.reshape(len(second), -1).T)


def to_orthonormal(normal: Array) -> Array:
    """(k, n) the factors by which images become an orthonormal base of the space they span, of k dimensions; normal
    (n, n): the sums of their products."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    significant = values > _ALIKE * values[-1]
    return np.asarray((vectors[:, significant] / np.sqrt(values[significant])).T / size)


def factors(images: Array, image: Array) -> Array:
    """(n,) the factors by which images (n, height, width), 0 where they do not count, come closest to an image in least
    squares."""
    inverse = np.linalg.pinv(products(images, images), hermitian=True)
    return np.asarray(inverse @ products(images, image[None])[:, 0])


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """variance_dn2 of one pixel, and the (2 * reach + 1) square of autocovariances about it, a lone value for white
    noise. neighbour_correlation: the mean correlation of pixels that touch along an edge. is_grain: whether blank film
    shows it, and not a fit's residuals alone, which may be a landscape's."""

    variance_dn2: float
    autocovariance_dn2: Array
    neighbour_correlation: float
    is_grain: bool = False

    @property
    def is_white(self) -> bool:
        return self.autocovariance_dn2.size == 1

    def floored(self, variance_dn2: float) -> "NoiseModel":
        """The same, of a variance that is not smaller."""
        if not self.variance_dn2:  # a picture without any noise: there is nothing to enlarge
            return NoiseModel(variance_dn2, np.full((1, 1), variance_dn2), 0.0, self.is_grain)
        larger = max(variance_dn2 / self.variance_dn2, 1.0)
        return replace(
            self, variance_dn2=self.variance_dn2 * larger, autocovariance_dn2=self.autocovariance_dn2 * larger
        )


def noise_model(residuals: Array, used: Mask, unknowns: int) -> NoiseModel:
    """The noise model of residuals (height, width), where used, after a fit of so many unknowns.

    Noise counts as white where the correlation of neighbours is within three standard errors of nothing.
    """
    noise, is_white = as_if_white(residuals, used, unknowns)
    if is_white:
        return noise
    lags = _faded(autocovariance(np.where(used, residuals, 0.0), used, REACH_PX))
    return replace(noise, autocovariance_dn2=lags * (noise.variance_dn2 / lags[REACH_PX, REACH_PX]))


def influence_covariances(influences: Array, residuals: Array, used: Mask, unknowns: int) -> tuple[Array, Array]:
    """The covariances (n, k, k) of n estimates that depend on their pixels by influences (n, k, height, width), and the
    variances (n,) of a pixel, as the noise models of the residuals (n, height, width), where used, have them."""
    kept, count = np.where(used, residuals, 0.0), np.maximum(used.sum(axis=(1, 2)), 1)
    squares = (kept**2).sum(axis=(1, 2))
    variances = squares / np.maximum(count - unknowns, 1)
    correlation = _covariance_along(kept, used, 1) / np.maximum(squares / count, 1e-300)
    index = np.arange(-REACH_PX, REACH_PX + 1)
    is_white = np.abs(correlation) < 3 / np.sqrt(2 * count)
    lags = _faded(autocovariance(kept, used, REACH_PX))
    lags *= (variances / np.maximum(lags[:, REACH_PX, REACH_PX], 1e-300))[:, None, None]
    lags[is_white] = np.where(np.add.outer(abs(index), abs(index)) == 0, variances[is_white, None, None], 0.0)
    shape = padded(residuals.shape[1:], REACH_PX)
    kernels = np.zeros((len(residuals), *shape), np.float32)
    kernels[:, index[:, None], index] = lags
    weights = np.full(shape[1] // 2 + 1, 2.0)  # of a real transform's columns, which stand for their opposites, too
    weights[[0, *([-1] if shape[1] % 2 == 0 else [])]] = 1.0
    weights = fft.rfft2(kernels).real * (weights / np.prod(shape)).astype(np.float32)
    waves = fft.rfft2(influences.astype(np.float32), s=shape)
    parts = [waves.real.reshape(*waves.shape[:2], -1), waves.imag.reshape(*waves.shape[:2], -1)]
    flat = weights.reshape(len(weights), 1, -1)
    real, imaginary = ((part * flat) @ part.swapaxes(1, 2) for part in parts)
    return np.asarray(real + imaginary, float), variances


def _faded(lags: Array) -> Array:
    """The far lags are noise themselves: they fade out."""
    index = np.arange(-REACH_PX, REACH_PX + 1)
    return np.asarray(lags * np.clip(REACH_PX + 1 - np.hypot(index[:, None], index), 0.0, 1.0))


def as_if_white(
    residuals: Array, used: Mask, unknowns: int, information: float | None = None
) -> tuple[NoiseModel, bool]:
    """The same without correlations, and whether it has none. information: of how many ordinary pixels they have the
    information, where some are clipped and residuals are their scores."""
    count, kept = max(int(used.sum()), 1), np.where(used, residuals, 0.0)
    squares = float((kept**2).sum())
    variance = squares / max((count if information is None else information) - unknowns, 1)
    correlation = float(_covariance_along(kept, used, 1)) / (squares / count) if squares else 0.0
    return NoiseModel(variance, np.array([[variance]]), correlation), abs(correlation) < 3 / np.sqrt(2 * count)


def is_textured(residuals: Array, used: Mask, floor_dn: float) -> bool:
    """Whether what a fit leaves is a landscape rather than grain: still alike beyond the reach of any grain. Residuals
    below floor_dn are the drawing's own."""
    kept = np.where(used, residuals, 0.0)
    if not kept.any():
        return False
    return bool(_covariance_along(kept, used, REACH_PX) > _TEXTURE * max((kept**2).sum() / used.sum(), floor_dn**2))


def may_be_noise(off: Array, covariance: Array) -> bool:
    """Whether noise of that covariance (2, 2) may have moved a place by off (2,)."""
    return bool(off @ np.linalg.solve(covariance, off) < _ODDS)


def correlated(columns: Array, noise: NoiseModel, power: float = 1.0) -> Array:
    """The noise's covariance matrix, or a power of it as if the picture had no border, times images (n, height, width):
    without ever forming it."""
    spectrum, shape = _spectrum(noise, columns.shape[1:])
    if power != 1.0:
        spectrum = np.maximum(spectrum, WHITE * noise.variance_dn2) ** power
    return np.asarray(_filtered(columns, spectrum, shape))


def _spectrum(noise: NoiseModel, size: tuple[int, ...]) -> tuple[Array, list[int]]:
    """Of the noise, in a transform of images of a size, and the transform's own size."""
    reach = len(noise.autocovariance_dn2) // 2
    shape, index = padded(size, reach), np.arange(-reach, reach + 1)
    kernel = np.zeros(shape)
    kernel[np.ix_(index, index)] = noise.autocovariance_dn2
    return np.asarray(fft.rfft2(kernel).real), shape


def _filtered(images: NDArray[Real], spectrum: NDArray[Real], shape: list[int]) -> NDArray[Real]:
    """Images (n, height, width) by a spectrum in a transform of a size."""
    height, width = images.shape[1:]
    smeared = fft.irfft2(fft.rfft2(images, s=shape) * spectrum, s=shape)
    return np.asarray(smeared[:, :height, :width], images.dtype)


def autocovariance(kept: Array, used: Mask, reach: int) -> Array:
    """Mean products (..., lags, lags) of images (..., height, width) at all lags up to reach, averaged over opposite
    and mirrored lags: grain has no direction."""
    shape = padded(kept.shape[-2:], reach)
    spectra = np.abs(fft.rfft2(np.stack([kept, used]), s=shape)) ** 2
    products, pairs = fft.irfft2(spectra, s=shape)
    index = np.arange(-reach, reach + 1)
    lags = (products / np.maximum(pairs, 1.0))[..., index[:, None], index]
    lags = (lags + lags[..., ::-1]) / 2
    return np.asarray((lags + lags.swapaxes(-1, -2)) / 2)


def padded(shape: tuple[int, ...], reach: int) -> list[int]:
    """The size of a transform in which lags up to the reach do not run into one another."""
    return [fft.next_fast_len(size + reach, real=True) for size in shape]


def _covariance_along(kept: Array, used: Mask, lag: int) -> Array:
    """(...) the mean product of images (..., height, width) at a lag along a row or a column."""
    products = kept[..., lag:] * kept[..., :-lag], kept[..., lag:, :] * kept[..., :-lag, :]
    pairs = used[..., lag:] & used[..., :-lag], used[..., lag:, :] & used[..., :-lag, :]
    sums = [
        each.sum(axis=(-2, -1)) / np.maximum(both.sum(axis=(-2, -1)), 1)
        for each, both in zip(products, pairs, strict=True)
    ]
    return np.asarray(sum(sums) / 2)


# Weights of pixels: by noise that grows with light, and for grain by what the inverse of the noise's covariance matrix
# makes of a fit's derivatives.
#
# A sensor's own noise is alike in light. What is added to grey values that are a power of light, or rounded or
# compressed away of them, is alike in these, and in light the larger the more light there is; grain lies between. So
# the standard deviation of noise is taken to grow as a power of light, from 0, alike in light, to that of noise alike
# in grey values of a gamma of 2.2: the same however a file codes light. What seems to grow faster is no noise: it is a
# mark that is not as drawn, and to weigh it down would fit less and less of it.
#
# Generalised least squares solves `B r = 0`, B being the derivatives times that inverse. Conjugate gradients give B to
# some per cent in a few rounds without forming a matrix. B need not be exact: the estimate is unbiased with any, and
# its covariance follows from the very B that was used.


def steadiness(residuals: Array, light: Array, ground: Mask, used: Mask) -> Array:
    """(height, width): the standard deviation of the ground's noise over that of each pixel.

    residuals (height, width): light that a fit left; light, alike: what it draws, of full scale; ground, used,
    alike: the ordinary pixels, and those that count. Damage hardly does: scales are medians.
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
        precision = apart**2 / (_SCALE_VARIANCE * (1 / same.sum() + 1 / other.sum()))
        power = (weight * power + precision * float(np.log(scales[0] / scales[1])) / apart) / (weight + precision)
    return np.asarray(np.exp(-np.clip(power, 0.0, _MOST) * change))


def weighted(design: Array, used: Mask, noise: NoiseModel, contrast_dn: float) -> tuple[Array, Array]:
    """B and C B', each (unknowns, height, width) and 0 where not used: weighted derivatives, and the covariance matrix
    of the noise times them."""
    scale_dn2, (spectrum_dn2, shape) = noise.variance_dn2, _spectrum(noise, used.shape)
    least = max(WHITE * scale_dn2, (_MISFIT * contrast_dn) ** 2) / scale_dn2
    spectrum: Single = np.maximum(spectrum_dn2 / scale_dn2, least).astype(np.float32)
    counts = used.astype(np.float32)
    inverse: Single = np.asarray(1 / spectrum, np.float32)  # as if the pixels used had no border
    # The columns are scaled for single precision, and all are solved at once.
    right = (design * used).astype(np.float32)
    size = np.sqrt(_dots(right, right))
    right /= size
    # Columns that are close leave the rounds: those of a mark's edges are so at once, the ground's later.
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

"""What the residuals of a fit say about the noise of the film: its scale, and how far grain reaches."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ODDS = 13.8  # chi-square of two coordinates: one in a thousand
_TEXTURE = 0.25  # correlation at REACH_PX that grain never has
SIGMA_OF_DEVIATION = 1.4826  # the standard deviation of normal values over their median absolute deviation

WHITE = 0.02  # of the variance at least is taken as white: no film's grain is known better at the finest frequencies
REACH_PX = 5  # the coarsest grain that matters at scanning pitch: correlated over 1.5 px, gone beyond 5


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

    def at_least(self, variance_dn2: float) -> "NoiseModel":
        """The same, of a variance that is not smaller."""
        if not self.variance_dn2:  # a picture without any noise: there is nothing to enlarge
            return NoiseModel(variance_dn2, np.full((1, 1), variance_dn2), 0.0, self.is_grain)
        larger = max(variance_dn2 / self.variance_dn2, 1.0)
        return replace(
            self, variance_dn2=self.variance_dn2 * larger, autocovariance_dn2=self.autocovariance_dn2 * larger
        )


def noise_model(residuals: Array, used: Mask, unknowns: int, told: float | None = None) -> NoiseModel:
    """The noise model of residuals (height, width), where used, after a fit of so many unknowns. told: of how many
    ordinary pixels they have the information, where some are clipped and residuals are their scores.

    Noise counts as white where the correlation of neighbours is within three standard errors of nothing.
    """
    noise, is_white = as_if_white(residuals, used, unknowns, told)
    if is_white:
        return noise
    lags = autocovariance(np.where(used, residuals, 0.0), used, REACH_PX) * _taper(REACH_PX)
    return replace(noise, autocovariance_dn2=lags * (noise.variance_dn2 / lags[REACH_PX, REACH_PX]))


def as_if_white(residuals: Array, used: Mask, unknowns: int, told: float | None = None) -> tuple[NoiseModel, bool]:
    """The same without correlations, and whether it has none."""
    count = max(int(used.sum()), 1)
    kept = np.where(used, residuals, 0.0)
    squares = float((kept**2).sum())
    variance = squares / max((count if told is None else told) - unknowns, 1)
    correlation = _covariance_along(kept, used, 1) / (squares / count) if squares else 0.0
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


def robust_scale(values: Array) -> float:
    """The standard deviation of normal values, from their median absolute deviation."""
    if values.size == 0:
        return 0.0
    return SIGMA_OF_DEVIATION * _median(np.abs(values - _median(values)))


def robust_scales(values: NDArray[np.floating]) -> Array:
    """(n,) that of each row of many values (n, many), at once."""
    middle = values.shape[1] // 2
    off = np.abs(values - np.partition(values, middle, axis=1)[:, middle, None])
    return np.asarray(SIGMA_OF_DEVIATION * np.partition(off, middle, axis=1)[:, middle], float)


def _median(values: Array) -> float:
    middle = values.size // 2  # numpy's own takes many times as long for a small window
    parted = np.partition(values, middle, axis=None)
    return float(parted[middle] if values.size % 2 else (parted[:middle].max() + parted[middle]) / 2)


def correlated(columns: Array, noise: NoiseModel) -> Array:
    """The noise's covariance matrix times images (n, height, width), without ever forming it."""
    return coloured(columns, noise, 1.0)


def coloured(columns: Array, noise: NoiseModel, power: float) -> Array:
    """A power of the noise's covariance matrix, as if the picture had no border, times images (n, height, width)."""
    height, width = columns.shape[1:]
    reach = len(noise.autocovariance_dn2) // 2
    shape = padded((height, width), reach)
    kernel, index = np.zeros(shape), np.arange(-reach, reach + 1)
    kernel[np.ix_(index, index)] = noise.autocovariance_dn2
    spectrum = fft.rfft2(kernel).real
    if power != 1.0:
        spectrum = np.maximum(spectrum, WHITE * noise.variance_dn2) ** power
    smeared = fft.irfft2(fft.rfft2(columns, s=shape) * spectrum, s=shape)
    return np.asarray(smeared[:, :height, :width])


def autocovariance(kept: Array, used: Mask, reach: int) -> Array:
    """Mean products at all lags up to reach, averaged over opposite and mirrored lags: grain has no direction."""
    shape = padded(kept.shape, reach)
    spectra = np.abs(fft.rfft2(np.stack([kept, used]), s=shape)) ** 2
    products, pairs = fft.irfft2(spectra, s=shape)
    index = np.arange(-reach, reach + 1)
    lags = (products / np.maximum(pairs, 1.0))[np.ix_(index, index)]
    lags = (lags + lags[:, ::-1]) / 2
    return np.asarray((lags + lags.T) / 2)


def padded(shape: tuple[int, ...], reach: int) -> list[int]:
    """The size of a transform in which lags up to the reach do not run into one another."""
    return [fft.next_fast_len(size + reach, real=True) for size in shape]


def _covariance_along(kept: Array, used: Mask, lag: int) -> float:
    """The mean product at a lag along a row or a column."""
    products = (kept[:, lag:] * kept[:, :-lag]).sum(), (kept[lag:] * kept[:-lag]).sum()
    pairs = (used[:, lag:] & used[:, :-lag]).sum(), (used[lag:] & used[:-lag]).sum()
    return float(sum(product / max(count, 1) for product, count in zip(products, pairs, strict=True)) / 2)


def _taper(reach: int) -> Array:
    """Fades out the far lags, which are noise themselves."""
    index = np.arange(-reach, reach + 1)
    distance = np.hypot(index[:, None], index[None, :])
    return np.asarray(np.clip(reach + 1 - distance, 0.0, 1.0))

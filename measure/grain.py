"""Film grain behind the residuals of a fit: white scanner noise and grain of Gaussian correlation, by their shares.

The residuals alone mislead. Each unknown takes noise out of them, most of it where noise is strongest, at low
frequencies; in a small window little of that is left, and a covariance from the residuals' own autocovariance comes out
too small. So what a model of noise would leave after the very same fit is compared with what is left, lag by lag.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from measure.noise import REACH_PX, NoiseModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Standard deviations of the Gaussian that smears white noise into grain; beyond 1.5 px it is no grain any more.
GRAIN_PX = (0.4, 0.5, 0.6, 0.7, 0.8, 0.95, 1.1, 1.3, 1.5)
_FARTHEST_PX = 3.0  # lags that are compared: beyond it the residuals hold the fit's marks rather than the noise's


def grain_model(residuals: Array, used: Mask, design: Array, neighbour_correlation: float) -> NoiseModel:
    """The noise model whose residuals after the fit are most like the ones there are.

    residuals (height, width), where used; design (unknowns, height, width): derivatives by the unknowns of the fit.
    """
    window = _Window(used, design)
    observed = window.by_distance(window.products(np.where(used, residuals, 0.0)[None]))
    white = window.expected(np.ones((1, 1)))
    kernels = [_kernel(grain_px) for grain_px in GRAIN_PX]
    candidates = [np.stack([white, window.expected(kernel)], axis=1) for kernel in kernels]
    fits = [nnls(each * window.weights[:, None], observed * window.weights) for each in candidates]
    best = min(range(len(fits)), key=lambda index: float(fits[index][1]))
    white_share, grain_share = fits[best][0]
    lags = grain_share * kernels[best]
    lags[REACH_PX, REACH_PX] += white_share
    return NoiseModel(float(lags[REACH_PX, REACH_PX]), lags, neighbour_correlation)


def _kernel(grain_px: float) -> Array:
    """Autocorrelation of white noise smeared by a Gaussian, at all lags up to the reach."""
    index = np.arange(-REACH_PX, REACH_PX + 1)
    squared = index[:, None] ** 2 + index[None, :] ** 2
    return np.asarray(np.exp(-squared / (4.0 * grain_px**2)))


class _Window:
    """The pixels of a fit and what it takes out of the noise there; sums over all pairs of pixels, by their lag."""

    def __init__(self, used: Mask, design: Array) -> None:
        self.used = used
        self.shape = (used.shape[0] + 2 * REACH_PX, used.shape[1] + 2 * REACH_PX)
        directions, _ = np.linalg.qr(design[:, used].T)
        taken = np.zeros((directions.shape[1], *used.shape))
        taken[:, used] = directions.T
        self.taken = taken
        self.spectra = np.fft.rfft2(taken, s=self.shape)
        self.pairs = self.products(used.astype(float)[None])
        distance = np.hypot(*np.meshgrid(np.arange(-REACH_PX, REACH_PX + 1), np.arange(-REACH_PX, REACH_PX + 1)))
        near = distance <= _FARTHEST_PX
        self.group = np.unique(np.round(distance[near], 6), return_inverse=True)[1]
        self.near = near
        # A sum's variance grows with its pairs.
        self.weights = 1.0 / np.sqrt(np.maximum(self.by_distance(self.pairs), 1.0))

    def products(self, images: Array) -> Array:
        """Sum over the images of their own products at every lag."""
        return self._at_lags((np.abs(np.fft.rfft2(images, s=self.shape)) ** 2).sum(axis=0))

    def by_distance(self, lags: Array) -> Array:
        """Summed over the lags of the same length."""
        return np.bincount(self.group, weights=lags[self.near]).astype(np.float64)

    def expected(self, kernel: Array) -> Array:
        """What noise of that autocovariance leaves: the trace of each lag with M C M, M taking the fit out."""
        half = kernel.shape[0] // 2
        padded = np.zeros(self.shape)
        index = np.arange(-half, half + 1)
        padded[np.ix_(index, index)] = kernel
        smeared = np.fft.irfft2(self.spectra * np.fft.rfft2(padded), s=self.shape)
        smeared = smeared[:, : self.used.shape[0], : self.used.shape[1]] * self.used
        crossed = np.fft.rfft2(smeared, s=self.shape)
        among = np.tensordot(self.taken[:, self.used], smeared[:, self.used], axes=(1, 1))
        once = self._at_lags((np.conj(self.spectra) * crossed).sum(axis=0))
        twice = self._at_lags((np.conj(self.spectra) * np.tensordot(among, self.spectra, axes=(1, 0))).sum(axis=0))
        whole = self.pairs * _placed(kernel)
        return self.by_distance(whole - once - once[::-1, ::-1] + twice)

    def _at_lags(self, spectrum: Array) -> Array:
        values = np.fft.irfft2(spectrum, s=self.shape)
        index = np.arange(-REACH_PX, REACH_PX + 1)
        return np.asarray(values[np.ix_(index, index)])


def _placed(kernel: Array) -> Array:
    """The kernel in the middle of the square of all lags."""
    whole = np.zeros((2 * REACH_PX + 1, 2 * REACH_PX + 1))
    half = kernel.shape[0] // 2
    middle = slice(REACH_PX - half, REACH_PX + half + 1)
    whole[middle, middle] = kernel
    return whole

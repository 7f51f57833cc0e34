"""Film grain behind the residuals of a fit: white scanner noise and grain of Gaussian correlation, by their shares.

The residuals alone mislead. Each unknown takes noise out of them, most of it where noise is strongest, at low
frequencies; in a small window little of that is left, and a covariance from the residuals' own autocovariance comes out
too small. So what a model of noise would leave after the very same fit is compared with what is left, lag by lag; in
the mark's own window, and in patches of blank film beside it, where there are any.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from measure.blank_film import PATCH_PX, PLANE
from measure.noise import NoiseModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Standard deviations of the Gaussian that smears white noise into grain, and the coarsest that is still film's.
GRAIN_PX = (0.4, 0.5, 0.6, 0.7, 0.8, 0.95, 1.1, 1.3, 1.5, 1.8, 2.2)
_COARSEST_PX = 1.8
REACH_PX = 8  # grain of 1.5 px is correlated by one in a thousand there
_FARTHEST_PX = 3.0  # lags that are compared: beyond it the residuals hold the fit's marks rather than the noise's
_FARTHEST_BLANK_PX = 5.0


def grain_model(
    residuals: Array, used: Mask, design: Array, neighbour_correlation: float, blank: Array | None = None
) -> NoiseModel:
    """The noise model whose residuals after the fit are most like the ones there are.

    residuals (height, width), where used; design (unknowns, height, width): derivatives by the unknowns of the fit.
    blank (n, PATCH_PX, PATCH_PX): patches of blank film less a plane.
    """
    window = _Window(used, design, _FARTHEST_PX)
    left = window.by_distance(window.products(np.where(used, residuals, 0.0)[None])) * window.weights
    expected = np.stack([window.expected(grain_px) * window.weights for grain_px in (None, *GRAIN_PX)])
    beside_it = blank is not None and len(blank) > 0
    if blank is not None and beside_it:
        patch, count = _patch(), len(blank)
        weights = patch.weights / np.sqrt(count)
        left = np.concatenate([left, patch.by_distance(patch.products(blank)) * weights])
        beside = np.stack([_expected_blank(grain_px) * weights * count for grain_px in (None, *GRAIN_PX)])
        expected = np.concatenate([expected, beside], axis=1)
    fits = [nnls(np.stack([expected[0], each], axis=1), left) for each in expected[1:]]
    best = min(range(len(fits)), key=lambda index: float(fits[index][1]))
    white_share, grain_share = fits[best][0]
    lags = grain_share * _kernel(GRAIN_PX[best])
    lags[REACH_PX, REACH_PX] += white_share
    is_grain = beside_it and GRAIN_PX[best] <= _COARSEST_PX
    return NoiseModel(float(lags[REACH_PX, REACH_PX]), lags, neighbour_correlation, is_grain)


def _kernel(grain_px: float | None) -> Array:
    """Autocorrelation of white noise, smeared by a Gaussian or not, at all lags up to the reach."""
    index = np.arange(-REACH_PX, REACH_PX + 1)
    squared = index[:, None] ** 2 + index[None, :] ** 2
    return np.asarray(squared == 0, float) if grain_px is None else np.exp(-squared / (4.0 * grain_px**2))


class _Window:
    """The pixels of a fit and what it takes out of the noise there; sums over all pairs of pixels, by their lag."""

    def __init__(self, used: Mask, design: Array, farthest_px: float) -> None:
        self.used = used
        self.shape = (used.shape[0] + 2 * REACH_PX, used.shape[1] + 2 * REACH_PX)
        directions, _ = np.linalg.qr(design[:, used].T)
        taken = np.zeros((directions.shape[1], *used.shape))
        taken[:, used] = directions.T
        self.taken = taken
        self.spectra = np.fft.rfft2(taken, s=self.shape)
        self.pairs = self.products(used.astype(float)[None])
        distance = np.hypot(*np.meshgrid(np.arange(-REACH_PX, REACH_PX + 1), np.arange(-REACH_PX, REACH_PX + 1)))
        self.near = distance <= farthest_px
        self.group = np.unique(np.round(distance[self.near], 6), return_inverse=True)[1]
        self.weights = 1.0 / np.sqrt(np.maximum(self.by_distance(self.pairs), 1.0))

    def products(self, images: Array) -> Array:
        """Sum over the images of their own products at every lag."""
        return self._at_lags((np.abs(np.fft.rfft2(images, s=self.shape)) ** 2).sum(axis=0))

    def by_distance(self, lags: Array) -> Array:
        """Summed over the lags of the same length."""
        return np.bincount(self.group, weights=lags[self.near]).astype(np.float64)

    def expected(self, grain_px: float | None) -> Array:
        """What noise of that grain leaves: the trace of each lag with M C M, M taking the fit out."""
        kernel = _kernel(grain_px)
        padded = np.zeros(self.shape)
        index = np.arange(-REACH_PX, REACH_PX + 1)
        padded[np.ix_(index, index)] = kernel
        smeared = np.fft.irfft2(self.spectra * np.fft.rfft2(padded), s=self.shape)
        smeared = smeared[:, : self.used.shape[0], : self.used.shape[1]] * self.used
        crossed = np.fft.rfft2(smeared, s=self.shape)
        among = np.tensordot(self.taken[:, self.used], smeared[:, self.used], axes=(1, 1))
        once = self._at_lags((np.conj(self.spectra) * crossed).sum(axis=0))
        twice = self._at_lags((np.conj(self.spectra) * np.tensordot(among, self.spectra, axes=(1, 0))).sum(axis=0))
        return self.by_distance(self.pairs * kernel - once - once[::-1, ::-1] + twice)

    def _at_lags(self, spectrum: Array) -> Array:
        values = np.fft.irfft2(spectrum, s=self.shape)
        index = np.arange(-REACH_PX, REACH_PX + 1)
        return np.asarray(values[np.ix_(index, index)])


@cache
def _expected_blank(grain_px: float | None) -> Array:
    """What noise of that grain leaves in a patch of blank film."""
    return _patch().expected(grain_px)


@cache
def _patch() -> _Window:
    whole = np.ones((PATCH_PX, PATCH_PX), dtype=bool)
    return _Window(whole, PLANE.T.reshape(-1, PATCH_PX, PATCH_PX), _FARTHEST_BLANK_PX)

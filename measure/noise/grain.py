"""Noise model of the residuals of a fit: white scanner noise plus film grain of several sizes.

Isotropic noise whose correlation falls with distance is well described by a sum of grains with Gaussian correlation:
film needs one or two sizes, image texture, with detail of all sizes, many.

The autocovariance of the residuals is biased: each unknown absorbs noise, mostly at the low frequencies where it is
strongest, and in a small window the covariance comes out too small. The model therefore predicts the autocovariance
after the same fit and is fitted to the observed one, lag by lag, in the mark's window and, where there are any, in
patches of blank film beside it, which show grain and noise alone.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import nnls

from measure.array_types import Array, Mask, Single
from measure.noise.noise_model import NoiseModel, transform_size

Lags = NDArray[np.intp]  # (n, 2) rows and columns between pixels, all of one length

PATCH_PX = 15  # side of a patch: three times the reach of film grain
BESIDE_PX = 2 * PATCH_PX + 4.0  # width of the surroundings of a mark that are searched for blank film
# Standard deviations of the Gaussians that turn white noise into grain, and the coarsest that is still film grain.
GRAIN_PX = (0.4, 0.5, 0.6, 0.7, 0.8, 0.95, 1.1, 1.3, 1.5, 1.8, 2.2)
_COARSEST_PX = 1.8
_AS_NOISY = 3.0  # largest ratio of a patch's variance and that of the residuals; beyond: image, text or dust
_FEWEST = 6  # patches needed to improve on the mark's own window
_REACH_PX = 8  # lag at which grain of 1.5 px has a correlation of 0.001
_FARTHEST_PX = 3.0  # largest lag compared; beyond it the residuals show the fit rather than the noise
_FARTHEST_BLANK_PX = 5.0  # the same for blank film
_ALIKE = 1e-10  # relative eigenvalue below which images are linearly dependent


_INDEX = np.arange(-_REACH_PX, _REACH_PX + 1)
_SQUARED_LAGS = _INDEX[:, None] ** 2 + _INDEX**2
# (1 + grains, lags, lags) autocorrelations of white noise and of white noise under Gaussians.
_KERNELS: Array = np.stack(
    [_SQUARED_LAGS == 0.0, *(np.exp(-_SQUARED_LAGS / (4.0 * grain_px**2)) for grain_px in GRAIN_PX)]
)
_ROW, _COL = np.mgrid[:PATCH_PX, :PATCH_PX].reshape(2, -1) - (PATCH_PX - 1) / 2
# (pixels, 3) orthonormal basis of planes over a patch.
PLANE: Array = np.linalg.qr(np.stack([np.ones(PATCH_PX**2), _COL, _ROW], axis=1))[0]


def blank_patches(window: Array, free: Mask, variance_dn2: float) -> Array:
    """(n, PATCH_PX, PATCH_PX) grey values minus a plane in the blank patches of a window (height, width): wholly free,
    with a variance near the given one. Empty if there are too few."""
    patches = _squares(window)[_squares(free).all(axis=(1, 2))].reshape(-1, PATCH_PX**2)
    rest = patches - patches @ PLANE @ PLANE.T
    variances = (rest**2).sum(axis=1) / (PATCH_PX**2 - PLANE.shape[1])
    alike = (variances > variance_dn2 / _AS_NOISY) & (variances < variance_dn2 * _AS_NOISY)
    return np.asarray(rest[alike & (alike.sum() >= _FEWEST)].reshape(-1, PATCH_PX, PATCH_PX))


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
    variance, neighbours = lags[_REACH_PX, _REACH_PX], lags[_REACH_PX, _REACH_PX + 1]
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
    shape = transform_size(within.shape, _REACH_PX)
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
    shape = transform_size(images.shape[1:], _REACH_PX)
    lags = fft.irfft2((np.abs(fft.rfft2(images.astype(np.float32), s=shape)) ** 2).sum(axis=0), s=shape)
    return np.array([lags[*ring.T].sum() for ring in rings])


def _ring_kernels(rings: Sequence[Lags]) -> Array:
    """(1 + grains, distances) autocorrelations at each distance."""
    return np.asarray(_KERNELS[:, *np.array([ring[0] for ring in rings]).T + _REACH_PX])


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

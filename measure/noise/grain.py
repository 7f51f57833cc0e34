"""Film grain behind the residuals of a fit: white scanner noise and grain of several sizes, by their shares.

Any noise that is alike in all directions, and the more the nearer, is about a sum of grains of Gaussian correlation: a
film's needs one or two sizes, a landscape, which has detail of every size, many.

The residuals alone mislead. Each unknown takes noise out of them, most of it where noise is strongest, at low
frequencies; in a small window little of that is left, and a covariance from the residuals' own autocovariance comes out
too small. So what a model of noise would leave after the very same fit is compared with what is left, lag by lag; in
the mark's own window, and in patches of blank film beside it, where there are any: what these show is grain and noise
alone, and more of it than the window holds.
"""

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import nnls

from measure.noise.noise_model import NoiseModel, padded, to_orthonormal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Single = NDArray[np.float32]

PATCH_PX = 15  # a side: thrice as far as film's grain reaches
BESIDE_PX = 2 * PATCH_PX + 4.0  # how much of the film beside a mark is asked
_AS_NOISY = 3.0  # times the variance of the mark's own residuals, or a part of it: beyond it is a picture, text or dust
_FEWEST = 6  # patches that tell more than the mark's own window
# Standard deviations of the Gaussian that smears white noise into grain, and the coarsest that is still film's.
GRAIN_PX = (0.4, 0.5, 0.6, 0.7, 0.8, 0.95, 1.1, 1.3, 1.5, 1.8, 2.2)
_COARSEST_PX = 1.8
REACH_PX = 8  # grain of 1.5 px is correlated by one in a thousand there
_HERE = REACH_PX  # index of no lag at all
_FARTHEST_PX = 3.0  # lags that are compared: beyond it the residuals hold the fit's marks rather than the noise's
_FARTHEST_BLANK_PX = 5.0  # the same of blank film, which has no marks in it


def blank_patches(window: Array, free: Mask, variance_dn2: float) -> Array:
    """(n, PATCH_PX, PATCH_PX) grey values less a plane, of patches of the window (height, width) that are wholly free
    and vary about as much as the noise of that variance; none where there are too few."""
    patches = _squares(window)[_squares(free).all(axis=(1, 2))].reshape(-1, PATCH_PX**2)
    rest = patches - patches @ PLANE @ PLANE.T
    variances = (rest**2).sum(axis=1) / (PATCH_PX**2 - PLANE.shape[1])
    alike = (variances > variance_dn2 / _AS_NOISY) & (variances < variance_dn2 * _AS_NOISY)
    if alike.sum() < _FEWEST:
        return np.zeros((0, PATCH_PX, PATCH_PX))
    return np.asarray(rest[alike].reshape(-1, PATCH_PX, PATCH_PX))


def is_coloured(patches: Array) -> bool:
    """Whether neighbouring pixels of the patches are alike, by more than three standard errors of chance."""
    if not len(patches):
        return False
    sums = (patches[:, :, 1:] * patches[:, :, :-1]).sum() + (patches[:, 1:] * patches[:, :-1]).sum()
    # A plane takes three pixels' worth out of a patch, and as much out of the products.
    correlation = sums / (2 * (patches**2).sum()) + PLANE.shape[1] / PATCH_PX**2
    return bool(abs(correlation) > 3 / np.sqrt(2 * patches.size))


def _plane() -> Array:
    """(pixels, 3) an orthonormal base of the planes over a patch."""
    row, col = np.mgrid[:PATCH_PX, :PATCH_PX].reshape(2, -1) - (PATCH_PX - 1) / 2
    base, _ = np.linalg.qr(np.stack([np.ones(PATCH_PX**2), col, row], axis=1))
    return np.asarray(base, dtype=np.float64)


PLANE = _plane()


def _squares(image: Array | Mask) -> Array:
    """(n, PATCH_PX, PATCH_PX) the squares that an image divides into."""
    rows, cols = (size // PATCH_PX for size in image.shape)
    inner = image[: rows * PATCH_PX, : cols * PATCH_PX].reshape(rows, PATCH_PX, cols, PATCH_PX)
    return np.asarray(inner.swapaxes(1, 2).reshape(-1, PATCH_PX, PATCH_PX), float)


def grain_model(
    residuals: Array, used: Mask, taken: Array, neighbour_correlation: float, blank: Array | None = None
) -> NoiseModel:
    """The noise model, a sum of white noise and grains, whose residuals after the fit are most like the ones there are.

    residuals (height, width), where used; taken: what the fit takes out of the noise, as `taken_out` gives it.
    blank (n, PATCH_PX, PATCH_PX): patches of blank film less a plane.
    """
    window = _Pixels(used, _FARTHEST_PX)
    left = window.products(np.where(used, residuals, 0.0)[None]) * window.weights
    expected = window.expected(taken) * window.weights
    if blank is not None and len(blank) > 0:
        (patch, of_patch), count = _patch(), len(blank)
        weights = patch.weights / np.sqrt(count)
        left = np.concatenate([left, patch.products(blank) * weights])
        expected = np.concatenate([expected, of_patch * weights * count], axis=1)
    shares, _ = nnls(expected.T, left)
    lags = np.tensordot(shares, _KERNELS, axes=1)
    variance = float(lags[_HERE, _HERE])
    # A fit makes residuals less alike than the noise is. If they still are more alike than the coarsest grain, or the
    # model is, a landscape was taken for grain.
    alike = max(neighbour_correlation, lags[_HERE, _HERE + 1] / max(variance, 1e-300))
    is_grain = blank is not None and len(blank) > 0 and bool(alike < _kernel(_COARSEST_PX)[_HERE, _HERE + 1])
    return NoiseModel(variance, lags, neighbour_correlation, is_grain)


def _kernel(grain_px: float | None) -> Array:
    """Autocorrelation of white noise, smeared by a Gaussian or not, at all lags up to the reach."""
    index = np.arange(-REACH_PX, REACH_PX + 1)
    squared = index[:, None] ** 2 + index[None, :] ** 2
    return np.asarray(squared == 0, float) if grain_px is None else np.exp(-squared / (4.0 * grain_px**2))


def taken_out(used: Mask, design: Array, farthest_px: float = _FARTHEST_PX) -> Array:
    """(1 + grains, distances) what a fit takes out of the sums of products of pixels so far apart, up to farthest_px,
    that white noise and noise of each grain make at unit variance. used (height, width); design (unknowns, height,
    width): derivatives by its unknowns.

    The fit leaves M C M of a covariance matrix C, with M = I - Q Q'. Summed over pixels so far apart, by D, that
    is tr(D C) - 2 tr(Q' C D Q) + tr(Q' D Q Q' C Q): the last two are sums of products of Q's columns, lag by lag,
    times the autocorrelation at that lag, whatever it is.
    """
    rings, border, used_design = _rings(farthest_px), int(farthest_px), design[:, used]
    within = np.pad(used, border)
    base = np.zeros((len(design), *within.shape), np.float32)
    orthonormal = to_orthonormal(used_design @ used_design.T)
    base[: len(orthonormal), within] = orthonormal @ used_design
    shape, index = padded(within.shape, REACH_PX), np.arange(-REACH_PX, REACH_PX + 1)
    spectra = np.conj(fft.rfft2(base, s=shape))
    flat, counted = base.reshape(len(base), -1), within.ravel().astype(np.float32)
    taken = []
    for ring in rings:
        sums = ring.sums(flat, within.shape[1]) * counted
        sums = (flat @ sums.T) @ flat - 2 * sums
        lags = fft.irfft2((spectra * fft.rfft2(sums.reshape(base.shape), s=shape)).sum(axis=0), s=shape)
        taken.append(_KERNELS.reshape(len(_KERNELS), -1) @ lags[np.ix_(index, index)].ravel())
    return np.stack(taken, axis=1)


class _Pixels:
    """The pixels of a fit (height, width), and sums over all pairs of them so far apart."""

    def __init__(self, used: Mask, farthest_px: float) -> None:
        self.rings = _rings(farthest_px)
        self.pairs = self.products(used[None])
        self.weights = 1.0 / np.sqrt(np.maximum(self.pairs, 1.0))

    def products(self, images: Array | Mask) -> Array:
        """(distances,) sums over the images of the products of their pixels so far apart."""
        shape = padded(images.shape[1:], REACH_PX)
        lags = fft.irfft2((np.abs(fft.rfft2(images.astype(np.float32), s=shape)) ** 2).sum(axis=0), s=shape)
        return np.array([lags[ring.index].sum() for ring in self.rings])

    def expected(self, taken: Array) -> Array:
        """(1 + grains, distances) what white noise and noise of each grain make of these sums, at unit variance, less
        what a fit takes out."""
        lags = np.array([ring.lags[0] for ring in self.rings]).T + _HERE
        return np.asarray(self.pairs * _KERNELS[:, *lags] + taken)


@dataclass(frozen=True)
class _Ring:
    """All lags (rows, columns) of one length."""

    lags: tuple[tuple[int, int], ...]

    @property
    def index(self) -> tuple[list[int], list[int]]:
        """Of these lags in a picture of all of them that begins with none, negative ones at its end."""
        return [down for down, _ in self.lags], [right for _, right in self.lags]

    def sums(self, images: Single, width: int) -> Single:
        """Of the pixels at these lags from each pixel of images (n, pixels), row after row of that width, which are 0
        in a border as wide as the lags."""
        total = np.zeros_like(images)
        most = max(max(abs(down), abs(right)) for down, right in self.lags) * (width + 1)
        for down, right in self.lags:
            lag = down * width + right
            total[:, most : total.shape[1] - most] += images[:, most + lag : total.shape[1] - most + lag]
        return total


def _rings(farthest_px: float) -> list[_Ring]:
    reach = range(-int(farthest_px), int(farthest_px) + 1)
    by_square: dict[int, list[tuple[int, int]]] = {}
    for down, right in product(reach, repeat=2):
        if down**2 + right**2 <= farthest_px**2:
            by_square.setdefault(down**2 + right**2, []).append((down, right))
    return [_Ring(tuple(lags)) for _, lags in sorted(by_square.items())]


@cache
def _patch() -> tuple[_Pixels, Array]:
    """A patch of blank film, and what noise leaves there less a plane."""
    whole = np.ones((PATCH_PX, PATCH_PX), dtype=bool)
    pixels = _Pixels(whole, _FARTHEST_BLANK_PX)
    return pixels, pixels.expected(taken_out(whole, PLANE.T.reshape(-1, PATCH_PX, PATCH_PX), _FARTHEST_BLANK_PX))


_KERNELS = np.stack([_kernel(grain_px) for grain_px in (None, *GRAIN_PX)])

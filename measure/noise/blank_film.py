"""Blank film beside a mark: what it shows is grain and noise alone, and more of it than the mark's own window holds."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PATCH_PX = 15  # a side: thrice as far as film's grain reaches
BESIDE_PX = 2 * PATCH_PX + 4.0  # how much of the film beside a mark is asked
_ALIKE = 3.0  # times the variance of the mark's own residuals, or a part of it: beyond it is a picture, text or dust
_FEWEST = 6  # patches that tell more than the mark's own window


def blank_patches(window: Array, free: Mask, variance_dn2: float) -> Array:
    """(n, PATCH_PX, PATCH_PX) grey values less a plane, of patches of the window (height, width) that are wholly free
    and vary about as much as the noise of that variance; none where there are too few."""
    patches = _squares(window)[_squares(free).all(axis=(1, 2))].reshape(-1, PATCH_PX**2)
    rest = patches - patches @ PLANE @ PLANE.T
    variances = (rest**2).sum(axis=1) / (PATCH_PX**2 - PLANE.shape[1])
    alike = (variances > variance_dn2 / _ALIKE) & (variances < variance_dn2 * _ALIKE)
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

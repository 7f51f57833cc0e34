"""Pictures for the tests of measure, drawn by brute force: supersampling and scipy's Gaussian filter."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from measure.picture_scan import WholePicture
from measure.resolution import NO_TAGS
from measure.scan import Scan

Array = NDArray[np.float64]


def scan_of(grey: Array) -> Scan:
    """A scan of 16 bits in memory."""
    stored = np.clip(np.round(grey), 0, 65535).astype(np.uint16)
    return Scan(Path("drawn.tif"), WholePicture(stored[..., None]), NO_TAGS)


def drawn(
    inside: Callable[[Array, Array], Array], width: int, height: int, blur_px: float, fineness: int = 16
) -> Array:
    """(height, width) means over the pixels of a function of column and row, after a Gaussian blur."""
    pad = int(np.ceil(5 * blur_px)) + 1
    fine = [(np.arange((size + 2 * pad) * fineness) + 0.5) / fineness - 0.5 - pad for size in (width, height)]
    sharp = inside(*np.meshgrid(*fine)).astype(float)
    blurred = gaussian_filter(sharp, blur_px * fineness, truncate=5) if blur_px > 0 else sharp
    rows, cols = height + 2 * pad, width + 2 * pad
    pixels = blurred.reshape(rows, fineness, cols, fineness).mean(axis=(1, 3))
    return np.asarray(pixels[pad:-pad, pad:-pad])


def ellipse(center_px: Array, pixel_from_disk: Array) -> Callable[[Array, Array], Array]:
    """1 inside of an ellipse."""
    disk_from_pixel = np.linalg.inv(pixel_from_disk)

    def inside(col: Array, row: Array) -> Array:
        offset = np.stack([col - center_px[0], row - center_px[1]])
        x, y = np.tensordot(disk_from_pixel, offset, axes=1)
        return np.asarray(x**2 + y**2 < 1)

    return inside


def whitened(error: Array, covariance: Array) -> Array:
    """The error in units of its standard deviations: two independent standard normal numbers where all is right."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), error))

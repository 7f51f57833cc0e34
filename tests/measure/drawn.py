"""Pictures for the tests of measure, drawn by brute force: supersampling and a sampled Gaussian."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from measure.scans.picture_scan import WholePicture
from measure.scans.radiometry import Samples
from measure.scans.resolution import NO_TAGS
from measure.scans.scan import Scan

Array = NDArray[np.float64]


def scan_of(grey: Array, full_scale: int = 65535, rounding_step_dn: float = 0.0) -> Scan:
    """Grey values (height, width), rounded and cut off, as a scan of 16 or 8 bits in memory."""
    rounded = np.clip(np.rint(grey), 0, full_scale)[..., None]
    stored: Samples = rounded.astype(np.uint16) if full_scale > 255 else rounded.astype(np.uint8)
    return Scan(Path("drawn.tif"), WholePicture(stored, rounding_step_dn), NO_TAGS)


def drawn(
    inside: Callable[[Array, Array], Array], width: int, height: int, blur_px: float, fineness: int = 16
) -> Array:
    """(height, width) means over the pixels of a function of column and row, after a Gaussian blur."""
    pad = int(np.ceil(5 * blur_px)) + 1
    fine = [(np.arange((size + 2 * pad) * fineness) + 0.5) / fineness - 0.5 - pad for size in (width, height)]
    sharp = inside(*np.meshgrid(*fine)).astype(float)
    return pixel_means(sharp, blur_px, fineness, pad)


def pixel_means(sharp: Array, blur_px: float, fineness: int, pad: int) -> Array:
    """Means over the pixels after a Gaussian blur cut off at five sigmas; of samples `fineness` to a pixel along each
    axis, with a border of `pad` pixels, of more than five sigmas, that the result has not."""
    rows, columns = (_means_of_samples(size, blur_px * fineness, fineness, pad) for size in sharp.shape)
    return np.asarray(rows @ sharp @ columns.T)


def _means_of_samples(samples: int, sigma: float, fineness: int, pad: int) -> Array:
    """(pixels, samples) what each sample counts in a pixel's mean: all blurred samples of the pixel, summed up."""
    reach = int(5 * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2) if sigma > 0 else np.ones(1)
    of_pixel = np.convolve(np.ones(fineness), kernel / kernel.sum()) / fineness
    means = np.zeros((samples // fineness - 2 * pad, samples))
    for pixel, row in enumerate(means):
        first = (pixel + pad) * fineness - reach
        row[first : first + len(of_pixel)] = of_pixel
    return means


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

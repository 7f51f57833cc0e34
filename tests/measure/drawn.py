"""Pictures for the tests of measure, drawn by brute force: supersampling and a sampled Gaussian."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS, Samples
from measure.scans.scan import Scan

Array = NDArray[np.float64]
STRIP = 10_000  # samples that are asked together


def scan_of(grey: Array, full_scale: int = 65535, rounding_step_dn: float = 0.0) -> Scan:
    """Grey values (height, width), rounded and cut off, as a scan of 16 or 8 bits in memory."""
    rounded = np.clip(np.rint(grey), 0, full_scale)[..., None]
    stored: Samples = rounded.astype(np.uint16) if full_scale > 255 else rounded.astype(np.uint8)
    return Scan(Path("drawn.tif"), WholePicture(stored, rounding_step_dn), NO_TAGS)


def drawn(
    inside: Callable[[Array, Array], Array], width: int, height: int, blur_px: float, fineness: int = 16
) -> Array:
    """(height, width) means over the pixels of a function of columns (1, n) and rows (m, 1), after a Gaussian blur."""
    pad = int(np.ceil(5 * blur_px)) + 1
    fine = [(np.arange((size + 2 * pad) * fineness) + 0.5) / fineness - 0.5 - pad for size in (width, height)]
    columns, rows = np.meshgrid(*fine, sparse=True)
    sharp = np.concatenate([inside(columns, strip) for strip in encode_strips(rows, columns.size)]).astype(float)
    return pixel_means(sharp, blur_px, fineness, pad)


def encode_strips(rows: NDArray[Any], columns: int) -> list[NDArray[Any]]:
    """Rows in strips of so few samples that all that is made of them stays in a processor's cache."""
    return np.array_split(rows, max(len(rows) * columns // STRIP, 1))


def pixel_means(sharp: Array, blur_px: float, fineness: int, pad: int) -> Array:
    """Means over the pixels after a Gaussian blur cut off at five sigmas; of samples `fineness` to a pixel along each
    axis, with a border of `pad` pixels, of more than five sigmas, that the result has not."""
    rows, columns = (_means_of_samples(size, blur_px * fineness, fineness, pad) for size in sharp.shape)
    return np.asarray((columns @ (rows @ sharp).T).T)


def _means_of_samples(samples: int, sigma: float, fineness: int, pad: int) -> csr_array:
    """(pixels, samples) what each sample counts in a pixel's mean: all blurred samples of the pixel, summed up."""
    reach = int(5 * sigma + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2) if sigma > 0 else np.ones(1)
    of_pixel = np.convolve(np.ones(fineness), kernel / kernel.sum()) / fineness
    pixels, each = samples // fineness - 2 * pad, len(of_pixel)
    first = (np.arange(pixels) + pad) * fineness - reach
    entries = np.tile(of_pixel, pixels), (first[:, None] + np.arange(each)).ravel(), each * np.arange(pixels + 1)
    return csr_array(entries, shape=(pixels, samples))


def transformed(matrix: NDArray[np.floating], col: Array, row: Array) -> tuple[Array, Array]:
    """The x and the y of a matrix (2, 2) by (column, row), for columns (1, n) and rows (m, 1)."""
    x, y = (line[0] * col + line[1] * row for line in matrix)
    return x, y


def ellipse(center_px: Array, pixel_from_disk: Array) -> Callable[[Array, Array], Array]:
    """1 inside of an ellipse."""
    disk_from_pixel = np.linalg.inv(pixel_from_disk)

    def inside(col: Array, row: Array) -> Array:
        x, y = transformed(disk_from_pixel, col - center_px[0], row - center_px[1])
        return np.asarray(x**2 + y**2 < 1)

    return inside


def whitened(error: Array, covariance: Array) -> Array:
    """The error in units of its standard deviations: two independent standard normal numbers where all is right."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), error))

"""Film grain and scanner noise, independent of the division of the image into strips."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]

BLOCK_ROWS = 256
REACH = 4.0  # half width of the grain's Gaussian kernel, in sigmas


def white_noise(seed: tuple[int, ...], row0: int, height: int, width: int) -> Picture:
    """Rows row0 to row0 + height of an unbounded image of white noise of unit RMS, determined by the seed."""
    first, last = row0 // BLOCK_ROWS, (row0 + height - 1) // BLOCK_ROWS
    rows = np.concatenate([_block(seed, block, width) for block in range(first, last + 1)])
    start = row0 - first * BLOCK_ROWS
    return rows[start : start + height]


def grain(seed: tuple[int, ...], row0: int, height: int, width: int, sigma_px: float) -> Picture:
    """Rows of grain of unit RMS: white noise filtered by a Gaussian of sigma_px; 0: white."""
    if sigma_px == 0.0:
        return white_noise(seed, row0, height, width)
    reach = int(np.ceil(REACH * sigma_px))
    gaussian = np.asarray(cv2.getGaussianKernel(2 * reach + 1, sigma_px, cv2.CV_64F), np.float64)
    kernel = gaussian / np.sqrt((gaussian**2).sum())
    noise = white_noise(seed, row0 - reach, height + 2 * reach, width)
    smooth = cv2.sepFilter2D(noise, cv2.CV_32F, kernel, kernel)
    return np.asarray(smooth[reach : reach + height], np.float32)


@lru_cache(maxsize=3)
def _block(seed: tuple[int, ...], block: int, width: int) -> Picture:
    """Block of noise, cached since adjacent strips share blocks. Block -1 serves the margin of the first strip."""
    return np.random.default_rng([*seed, block + 1]).standard_normal((BLOCK_ROWS, width), np.float32)

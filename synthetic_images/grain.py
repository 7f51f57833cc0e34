"""Film grain and the scanner's noise, the same for every division of the picture into strips."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]

BLOCK_ROWS = 256
REACH = 4.0  # sigmas of the grain's Gaussian


def white_noise(seed: tuple[int, ...], row0: int, height: int, width: int) -> Picture:
    """Rows row0 to row0 + height of an endless picture of white noise of unit rms, which the seed decides."""
    first, last = row0 // BLOCK_ROWS, (row0 + height - 1) // BLOCK_ROWS
    rows = np.concatenate([_block(seed, block, width) for block in range(first, last + 1)])
    start = row0 - first * BLOCK_ROWS
    return rows[start : start + height]


def grain(seed: tuple[int, ...], row0: int, height: int, width: int, sigma_px: float) -> Picture:
    """Rows of grain of unit rms: white noise after a Gaussian of sigma_px; 0: white."""
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
    """One block; strips that follow each other need their neighbours' blocks too. The halo of the first lies in -1."""
    return np.random.default_rng([*seed, block + 1]).standard_normal((BLOCK_ROWS, width), np.float32)

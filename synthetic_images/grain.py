"""Film grain and the scanner's noise, the same for every division of the picture into strips."""

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]

BLOCK_ROWS = 256
REACH = 4.0  # sigmas of the grain's Gaussian


def white_noise(seed: list[int], row0: int, height: int, width: int) -> Picture:
    """Rows row0 to row0 + height of an endless picture of white noise of unit rms, which the seed decides."""
    blocks = []
    for block in range(row0 // BLOCK_ROWS, (row0 + height - 1) // BLOCK_ROWS + 1):
        generator = np.random.default_rng([*seed, block + 1])  # the halo of the first strip lies in block -1
        blocks.append(generator.standard_normal((BLOCK_ROWS, width), np.float32))
    rows = np.concatenate(blocks) if len(blocks) > 1 else blocks[0]
    first = row0 % BLOCK_ROWS
    return rows[first : first + height]


def grain(seed: list[int], row0: int, height: int, width: int, sigma_px: float) -> Picture:
    """Rows of grain of unit rms: white noise after a Gaussian of sigma_px; 0: white."""
    if sigma_px == 0.0:
        return white_noise(seed, row0, height, width)
    reach = int(np.ceil(REACH * sigma_px))
    gaussian = np.asarray(cv2.getGaussianKernel(2 * reach + 1, sigma_px, cv2.CV_64F), np.float64)
    kernel = gaussian / np.sqrt((gaussian**2).sum())
    noise = white_noise(seed, row0 - reach, height + 2 * reach, width)
    smooth = cv2.sepFilter2D(noise, cv2.CV_32F, kernel, kernel)
    return np.asarray(smooth[reach : reach + height], np.float32)

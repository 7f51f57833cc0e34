"""Imaging of areas by a scanner: blur by the optics, then averaging over the area of each pixel.

Blurring after the averaging would not be equivalent: sharp edges would be aliased, and the centre of a fine line would
be wrong by up to 0.005 px. Edges are therefore rendered in finer pixels.
"""

import cv2
import numpy as np

from synthetic_images.areas import Area, Cover, coverage

FOLD = 4  # fine pixels per pixel; centres are accurate to 0.0007 px for a dot of 1 px, 0.0001 px for a target of 5 px
REACH = 5.0  # extent of the blur, in sigmas
BLOCK_PX = 64


def reach_px(blur_px: float) -> int:
    """Extent of the blur of an edge, px."""
    return int(np.ceil(REACH * blur_px))


def blurred_coverage(
    areas: tuple[Area, ...], col0: int, row0: int, width: int, height: int, blur_px: float, fold: int = FOLD
) -> Cover:
    """(height, width) coverage of the pixels of a window by the union of areas, after a Gaussian blur.

    fold: each pixel crossed by an edge is divided into fold x fold.
    """
    reach = reach_px(blur_px)
    plain = coverage(areas, col0 - reach, row0 - reach, width + 2 * reach, height + 2 * reach)
    blurred = plain[reach : reach + height, reach : reach + width].copy()
    for top in range(0, height, BLOCK_PX):
        for left in range(0, width, BLOCK_PX):
            tall, wide = min(BLOCK_PX, height - top), min(BLOCK_PX, width - left)
            around = plain[top : top + tall + 2 * reach, left : left + wide + 2 * reach]
            if around.min() < around.max():
                block = _fine(areas, col0 + left, row0 + top, wide, tall, blur_px, fold)
                blurred[top : top + tall, left : left + wide] = block
    return blurred


def _fine(areas: tuple[Area, ...], col0: int, row0: int, width: int, height: int, blur_px: float, fold: int) -> Cover:
    """Coverage of a window crossed by edges, computed in finer pixels."""
    reach = reach_px(blur_px)
    fine = coverage(areas, col0 - reach, row0 - reach, width + 2 * reach, height + 2 * reach, fold)
    if reach > 0:
        size = 2 * reach * fold + 1
        fine = np.asarray(cv2.GaussianBlur(fine, (size, size), blur_px * fold), np.float32)
        fine = fine[reach * fold : (reach + height) * fold, reach * fold : (reach + width) * fold]
    return np.asarray(fine.reshape(height, fold, width, fold).mean(axis=(1, 3)), np.float32)

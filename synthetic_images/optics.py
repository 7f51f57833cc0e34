"""Areas as a scanner sees them: blurred by its optics, then averaged over every pixel's own area.

The optics come before the pixels. To blur what pixels have averaged already is not the same: sharp edges would be
aliased, and the centre of a fine line would be off by up to 0.005 px. So edges are drawn in finer pixels.
"""

import cv2
import numpy as np

from synthetic_images.areas import Area, Cover, coverage

FOLD = 4  # a centre is then true to 0.0007 px for a dot of 1 px, 0.0001 px for a target of 5 px
REACH = 5.0  # sigmas
BLOCK_PX = 64


def reach_px(blur_px: float) -> int:
    """How far the optics spread an edge."""
    return int(np.ceil(REACH * blur_px))


def seen_coverage(
    areas: tuple[Area, ...], col0: int, row0: int, width: int, height: int, blur_px: float, fold: int = FOLD
) -> Cover:
    """(height, width) the share of every pixel of a window that the union of the areas takes, after a Gaussian blur.

    fold: every pixel is divided into fold x fold.
    """
    reach = reach_px(blur_px)
    plain = coverage(areas, col0 - reach, row0 - reach, width + 2 * reach, height + 2 * reach)
    seen = plain[reach : reach + height, reach : reach + width].copy()
    for top in range(0, height, BLOCK_PX):
        for left in range(0, width, BLOCK_PX):
            tall, wide = min(BLOCK_PX, height - top), min(BLOCK_PX, width - left)
            around = plain[top : top + tall + 2 * reach, left : left + wide + 2 * reach]
            if around.min() < around.max():
                block = _fine(areas, col0 + left, row0 + top, wide, tall, blur_px, fold)
                seen[top : top + tall, left : left + wide] = block
    return seen


def _fine(areas: tuple[Area, ...], col0: int, row0: int, width: int, height: int, blur_px: float, fold: int) -> Cover:
    """The same for a window that edges cross, by way of finer pixels."""
    reach = reach_px(blur_px)
    fine = coverage(areas, col0 - reach, row0 - reach, width + 2 * reach, height + 2 * reach, fold)
    if reach > 0:
        size = 2 * reach * fold + 1
        fine = np.asarray(cv2.GaussianBlur(fine, (size, size), blur_px * fold), np.float32)
        fine = fine[reach * fold : (reach + height) * fold, reach * fold : (reach + width) * fold]
    return np.asarray(fine.reshape(height, fold, width, fold).mean(axis=(1, 3)), np.float32)

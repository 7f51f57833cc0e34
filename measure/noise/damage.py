"""Detection of film damage (dust, hairs, scratches) in the residuals of a fit."""

import cv2
import numpy as np

from measure.array_types import Array, Mask
from measure.noise.robust_estimation import robust_scale

_SMOOTHING_PX = 0.8  # of the residuals: little more than a pixel, for the finest specks


def damage(residuals: Array, area: Mask, sigmas: float, floor_dn: float, is_lossy: bool = False) -> Mask:
    """Find pixels of dust and scratches: regions of large smoothed residuals that are wider than a pixel somewhere.

    The smoothing reaches as far beyond a speck as its blurred edge. Growing the regions by another pixel would cost
    more of a small mark's edge than the rest of the specks disturbs.

    Parameters
    ----------
    residuals, area : (height, width)
        Residuals of a fit, and the pixels used.
    sigmas, floor_dn : float
        Threshold in standard deviations; lower bound of the standard deviation, for data without noise.
    is_lossy : bool
        Whether the image was compressed with loss. The residuals then have long tails, which are not faint dust, thin
        patterns that may touch a speck, and ringing in the pixels beside it.

    Returns
    -------
    (height, width) mask.
    """
    weight = cv2.GaussianBlur(area.astype(float), (0, 0), _SMOOTHING_PX)
    smooth = cv2.GaussianBlur(np.where(area, residuals, 0.0), (0, 0), _SMOOTHING_PX) / np.maximum(weight, 0.1)
    smooth = np.where(area, smooth, 0.0)
    limit = sigmas * max(robust_scale(smooth[area]), floor_dn)
    if is_lossy:
        return grown(_opened(np.abs(smooth) > limit))
    # Much dust inflates even the robust scale and hides fainter specks: estimate it again without the obvious ones.
    limit = sigmas * max(robust_scale(smooth[area & (np.abs(smooth) <= limit)]), floor_dn)
    large = np.abs(smooth) > limit
    count, regions = cv2.connectedComponents(large.astype(np.uint8), connectivity=4)
    is_damage = np.zeros(count, dtype=bool)
    is_damage[regions[_opened(large)]] = True
    return np.asarray(is_damage[regions])


def _opened(mask: Mask) -> Mask:
    """Morphological opening: keep what is wider than a pixel."""
    # An even structuring element is off-centre: the anchors of erosion and dilation must be opposite.
    speck = np.ones((2, 2), np.uint8)
    eroded = cv2.erode(mask.astype(np.uint8), speck, anchor=(0, 0))
    return np.asarray(cv2.dilate(eroded, speck, anchor=(1, 1)) > 0)


def grown(mask: Mask) -> Mask:
    """Dilate a mask by the pixels that touch it along an edge."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), cross) > 0)

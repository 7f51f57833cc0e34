"""Damage of the film in what a fit leaves: dust, hairs and scratches, as regions of the picture."""

import cv2
import numpy as np

from measure.array_types import Array, Mask
from measure.noise.robust_estimation import robust_scale

_SMOOTHING_PX = 0.8  # of residuals: hardly more than a pixel, so that the finest specks stand out too


def damage(residuals: Array, area: Mask, sigmas: float, floor_dn: float, is_lossy: bool = False) -> Mask:
    """Find pixels of dust and scratches: regions where smoothed residuals stand out, wider than a pixel somewhere.

    The smoothing already reaches as far beyond a speck as its blurred edge does. To grow the regions by another pixel
    costs more of a small mark's edge than what is left of the specks spoils.

    Parameters
    ----------
    residuals, area : (height, width)
        What a fit leaves, and where it counts.
    sigmas, floor_dn : float
        How many standard deviations stand out; under these, for clean data have none.
    is_lossy : bool
        Whether lossy compression rounded the picture. It gives residuals long tails, which are no fainter dust, and
        thin patterns of its own, which hang together with a speck but are none; and beside a speck it rings, in the
        pixels next to it.

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
    # Much dust widens even that scale, and hides the fainter specks: what it shows at once is left out of it.
    limit = sigmas * max(robust_scale(smooth[area & (np.abs(smooth) <= limit)]), floor_dn)
    large = np.abs(smooth) > limit
    count, regions = cv2.connectedComponents(large.astype(np.uint8), connectivity=4)
    is_damage = np.zeros(count, dtype=bool)
    is_damage[regions[_opened(large)]] = True
    return np.asarray(is_damage[regions])


def _opened(mask: Mask) -> Mask:
    """What of the mask is wider than a pixel."""
    # An even square lies off its middle: where it erodes to the left it has to dilate to the right.
    speck = np.ones((2, 2), np.uint8)
    eroded = cv2.erode(mask.astype(np.uint8), speck, anchor=(0, 0))
    return np.asarray(cv2.dilate(eroded, speck, anchor=(1, 1)) > 0)


def grown(mask: Mask) -> Mask:
    """The mask and the pixels that touch it along an edge."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), cross) > 0)

"""Damage of the film in what a fit leaves: dust, hairs and scratches, as regions of the picture."""

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.noise.robust_estimation import robust_scale

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SMOOTHING_PX = 0.8  # of residuals: hardly more than a pixel, so that the finest specks stand out too


def damage(residuals: Array, area: Mask, sigmas: float, floor_dn: float) -> Mask:
    """Pixels of dust and scratches: regions where smoothed residuals exceed so many of their standard deviations, and
    that are wider than a pixel somewhere. floor_dn: under that standard deviation, for clean data have none.

    The smoothing already reaches as far beyond a speck as its blurred edge does. To grow the regions by another pixel
    costs more of a small mark's edge than what is left of the specks spoils."""
    smooth = _smoothed(residuals, area)
    limit = sigmas * max(robust_scale(smooth[area]), floor_dn)
    # Much dust widens even that scale, and hides the fainter specks: what it shows at once is left out of it.
    limit = sigmas * max(robust_scale(smooth[area & (np.abs(smooth) <= limit)]), floor_dn)
    large = np.abs(smooth) > limit
    wide = _opened(large)
    count, regions = cv2.connectedComponents(large.astype(np.uint8), connectivity=4)
    is_damage = np.zeros(count, dtype=bool)
    is_damage[regions[wide]] = True
    return np.asarray(is_damage[regions])


def damage_where_lossy(residuals: Array, area: Mask, sigmas: float, floor_dn: float) -> Mask:
    """The same where lossy compression rounded the picture. It gives residuals long tails, which are no fainter dust,
    and thin patterns of its own, which hang together with a speck but are none; and beside a speck it rings, in the
    pixels next to it."""
    smooth = _smoothed(residuals, area)
    return grown(_opened(np.abs(smooth) > sigmas * max(robust_scale(smooth[area]), floor_dn)))


def _smoothed(residuals: Array, area: Mask) -> Array:
    weight = cv2.GaussianBlur(area.astype(float), (0, 0), _SMOOTHING_PX)
    smooth = cv2.GaussianBlur(np.where(area, residuals, 0.0), (0, 0), _SMOOTHING_PX) / np.maximum(weight, 0.1)
    return np.where(area, smooth, 0.0)


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

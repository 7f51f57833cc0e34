"""Least squares that hold against dust: Tukey's biweight, the search for damage, and a guarded solution."""

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.noise.noise import robust_scale

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Real = TypeVar("Real", np.float32, np.float64)

MEDIAN_EFFICIENCY = 0.37  # of a variance from the median, against one from the mean of squares
STUDENT_FREEDOM = 4.0  # of Student's t: a fifth of false observations moves little
_TUKEY = 4.685  # in standard deviations: 95 % efficient in normal noise
_SMOOTHING_PX = 0.8  # of residuals: hardly more than a pixel, so that the finest specks stand out too


def tukey_weights(residuals: NDArray[Real], scale_dn: float) -> NDArray[Real]:
    """Weights between 0 and 1, all 1 where the scale is infinite."""
    if not np.isfinite(scale_dn):
        return np.ones_like(residuals)
    return np.asarray((1 - np.clip(np.abs(residuals) / (_TUKEY * scale_dn), 0.0, 1.0) ** 2) ** 2)


def tukey_loss(residuals: Array, scale_dn: float) -> float:
    """Tukey's loss, in units of squares; the sum of squares itself where the scale is infinite."""
    if not np.isfinite(scale_dn):
        return float(np.sum(residuals**2))
    limit = _TUKEY * scale_dn
    return float(np.sum(1 - np.clip(1 - (residuals / limit) ** 2, 0.0, None) ** 3) * limit**2 / 3)


def student_weights(squares: Array, dimensions: float) -> Array:
    """Of observations of so many dimensions that lie so many standard deviations off, squared, in Student's t
    distribution (Lange, Little and Taylor 1989)."""
    return np.asarray((STUDENT_FREEDOM + dimensions) / (STUDENT_FREEDOM + squares))


def solution(normal: Array, right: Array, free: Mask) -> Array | None:
    """The solution for the free unknowns, 0 for the others; None where the equations are singular."""
    size = np.sqrt(np.diag(normal))[free]
    if not np.all(size > 0) or not np.all(np.isfinite(size)):
        return None
    values, vectors = np.linalg.eigh(normal[np.ix_(free, free)] / np.outer(size, size))
    if not values[-1] < 1e10 * values[0]:
        return None
    result = np.zeros(len(right))
    result[free] = vectors @ (right[free] / size @ vectors / values) / size
    return result


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

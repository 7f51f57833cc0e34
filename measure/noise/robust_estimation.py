"""Robust estimation: M-estimator weights and losses, robust scales, Gauss-Newton steps; damage in residuals."""

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask, Single

Real = TypeVar("Real", np.float32, np.float64)

MEDIAN_EFFICIENCY = 0.37  # of a variance from the median, relative to one from the mean of squares
STUDENT_FREEDOM = 4.0  # degrees of freedom of Student's t: robust against a fifth of outliers
_TUKEY = 4.685  # in standard deviations: 95 % efficient in normal noise
SIGMA_OF_DEVIATION = 1.4826  # ratio of standard deviation and median absolute deviation of normal values
_WORST_CONDITION = 1e10  # of regular normal equations
_SMOOTHING_PX = 0.8  # of the residuals: little more than a pixel, for the finest specks


def tukey_weights(residuals: NDArray[Real], scale: float) -> NDArray[Real]:
    """Tukey's biweight, between 0 and 1; 1 where the scale is infinite."""
    if not np.isfinite(scale):
        return np.ones_like(residuals)
    return np.asarray((1 - np.clip(np.abs(residuals) / (_TUKEY * scale), 0.0, 1.0) ** 2) ** 2)


def tukey_loss(residuals: Array, scale: float) -> float:
    """Tukey's loss, scaled like a sum of squares; the sum of squares where the scale is infinite."""
    if not np.isfinite(scale):
        return float(np.sum(residuals**2))
    limit = _TUKEY * scale
    return float(np.sum(1 - np.clip(1 - (residuals / limit) ** 2, 0.0, None) ** 3) * limit**2 / 3)


def student_weights(squares: Array, dimensions: float) -> Array:
    """Weights of Student's t distribution from squared Mahalanobis distances of observations with the given dimension
    (Lange, Little and Taylor 1989)."""
    return np.asarray((STUDENT_FREEDOM + dimensions) / (STUDENT_FREEDOM + squares))


def gauss_newton_step(design: NDArray[Real], residuals: NDArray[Real], weights: NDArray[Real], damping: float) -> Array:
    """(..., unknowns) Gauss-Newton step for derivatives (..., unknowns, observations), residuals and weights (...,
    observations); all nan where an unknown changes no observation. damping: added to the diagonal of the normal
    equations scaled to unit diagonal (Levenberg)."""
    weighted = design * weights[..., None, :]
    normal = (weighted @ design.swapaxes(-1, -2)).astype(float)
    right = (weighted @ residuals[..., None]).astype(float)
    squares = np.einsum("...uu->...u", normal)
    size = np.sqrt(np.maximum(squares, 1e-12))
    scaled = normal / (size[..., :, None] * size[..., None, :]) + damping * np.eye(normal.shape[-1])
    steps = np.linalg.solve(scaled, right / size[..., None])[..., 0] / size
    return np.asarray(np.where((squares > 0).all(axis=-1, keepdims=True), steps, np.nan))


def place_influences(design: NDArray[Real], weights: NDArray[Real]) -> Single:
    """(n, 2, observations) derivatives of the first two unknowns of n fits by their observations. design (n, unknowns,
    observations), weights (n, observations)."""
    weighted = design * weights[:, None]
    inverse = np.linalg.pinv((weighted @ design.swapaxes(1, 2)).astype(float), hermitian=True)
    return np.asarray(inverse[:, :2].astype(np.float32) @ weighted, np.float32)


def solution(normal: Array, right: Array, free: Mask) -> Array:
    """Solve normal equations (unknowns, unknowns) for the free unknowns, 0 for the others; all nan if singular."""
    squares, singular = np.diag(normal)[free], np.full(len(right), np.nan)
    if not np.all(squares > 0) or not np.all(np.isfinite(squares)):
        return singular
    size = np.sqrt(squares)
    scaled = normal[np.ix_(free, free)] / np.outer(size, size)
    values = np.linalg.eigvalsh(scaled)
    if not values[-1] < _WORST_CONDITION * values[0]:
        return singular
    result = np.zeros(len(right))
    result[free] = np.linalg.solve(scaled, right[free] / size) / size
    return result


@dataclass(frozen=True, eq=False)
class TukeyFit:
    """values = factors (unknowns,) @ design + residuals (observations,); weights (observations,)."""

    factors: Array
    residuals: Array
    weights: Array


def tukey_fit(design: Array, values: Array, rounds: int, least_scale: float) -> TukeyFit:
    """Fit design (unknowns, observations) to values by iteratively reweighted least squares with Tukey's weights.

    The first round is unweighted; the scale is that of the residuals, at least least_scale.
    """
    weights = np.ones_like(values)
    for _ in range(rounds):
        weighted = design * weights
        factors = np.asarray(np.linalg.lstsq(weighted @ design.T, weighted @ values, rcond=None)[0], dtype=float)
        residuals = values - factors @ design
        weights = tukey_weights(residuals, max(robust_scale(residuals), least_scale))
    return TukeyFit(factors, residuals, weights)


def least_distances(
    design: Array, places: Array, least: float, rounds: int, prior: Array | None = None, usual: Array | None = None
) -> Array:
    """(..., unknowns, 2) maps from design (..., n, unknowns) to places (..., n, 2) by the least sum of distances.

    Robust against false places; distances below least have equal weight. prior (unknowns, unknowns): weight matrix of
    the prior map usual (unknowns, 2), where the weight of a place is at most 1.
    """
    weights, unknowns = np.ones(design.shape[:-1]), design.shape[-1]
    prior = np.zeros((unknowns, unknowns)) if prior is None else prior
    usual = np.zeros((unknowns, 2)) if usual is None else usual
    for _ in range(rounds):
        weighted = np.swapaxes(design * weights[..., None], -1, -2)
        maps = np.linalg.solve(weighted @ design + prior, weighted @ places + prior @ usual)
        off = places - design @ maps
        weights = least / np.maximum(np.hypot(off[..., 0], off[..., 1]), least)
    return np.asarray(maps)


def robust_scale(values: Array) -> float:
    """Robust standard deviation from the median absolute deviation."""
    if values.size == 0:
        return 0.0
    return SIGMA_OF_DEVIATION * _median(np.abs(values - _median(values)))


def _median(values: Array) -> float:
    middle = values.size // 2  # np.median is many times slower for a small window
    parted = np.partition(values, middle, axis=None)
    return float(parted[middle] if values.size % 2 else (parted[:middle].max() + parted[middle]) / 2)


def damage(residuals: Array, area: Mask, sigmas: float, floor_dn: float, is_lossy: bool = False) -> Mask:
    """Find pixels of dust and scratches: regions of large smoothed residuals that are wider than a pixel somewhere.

    The smoothing reaches as far beyond a speck as its blurred edge. Growing the regions by another pixel would cost
    more of a small mark's edge than the rest of the specks disturbs.

    Parameters
    ----------
    residuals, area : (height, width) residuals of a fit, and the pixels used.
    sigmas, floor_dn : threshold in standard deviations; lower bound of the standard deviation, for data without noise.
    is_lossy : whether the image was compressed with loss. The residuals then have long tails, which are not faint dust,
        thin patterns that may touch a speck, and ringing in the pixels beside it.

    Returns
    -------
    (height, width) mask.
    """
    weight = cv2.GaussianBlur(area.astype(float), (0, 0), _SMOOTHING_PX)
    smooth = cv2.GaussianBlur(np.where(area, residuals, 0.0), (0, 0), _SMOOTHING_PX) / np.maximum(weight, 0.1)
    smooth = np.where(area, smooth, 0.0)
    limit = sigmas * max(robust_scale(smooth[area]), floor_dn)
    if is_lossy:
        return dilate_mask(_open_mask(np.abs(smooth) > limit))
    # Much dust inflates even the robust scale and hides fainter specks: estimate it again without the obvious ones.
    limit = sigmas * max(robust_scale(smooth[area & (np.abs(smooth) <= limit)]), floor_dn)
    large = np.abs(smooth) > limit
    count, regions = cv2.connectedComponents(large.astype(np.uint8), connectivity=4)
    is_damage = np.zeros(count, dtype=bool)
    is_damage[regions[_open_mask(large)]] = True
    return np.asarray(is_damage[regions])


def _open_mask(mask: Mask) -> Mask:
    """Morphological opening: keep what is wider than a pixel."""
    # An even structuring element is off-centre: the anchors of erosion and dilation must be opposite.
    speck = np.ones((2, 2), np.uint8)
    eroded = cv2.erode(mask.astype(np.uint8), speck, anchor=(0, 0))
    return np.asarray(cv2.dilate(eroded, speck, anchor=(1, 1)) > 0)


def dilate_mask(mask: Mask) -> Mask:
    """Dilate a mask by the pixels that touch it along an edge."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), cross) > 0)

"""Geometric verification of point pairs: by the epipolar geometry of two frames and by neighbouring points."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from measure.flags import POINT_OFF_ITS_NEIGHBOURS, POINT_OFF_ITS_RAY
from measure.noise.robust_estimation import least_distances, robust_scale

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

FEWEST_PAIRS = 16  # twice the minimal number for a fundamental matrix
_CONFIDENCE, _TRIALS = 0.9999, 10000  # of MAGSAC: probability of success, and largest number of trials
_NEIGHBOURS = 8  # their median distance estimates lens distortion and film deformation
_MAP_NEIGHBOURS = 12  # used for a local map: four times its parameters, since some may be false
_ROUNDS = 2  # a false point may distort its neighbours' maps; in the second round it is left out of them
_REWEIGHTINGS = 10  # of the least absolute deviations
_LEAST_PX = 0.1  # lower bound of distances in the weights, and of the neighbours' scatter


def epipolar_inliers(first: Array, second: Array, tolerance: float) -> Mask:
    """Mask of the pairs of points (n, 2) that satisfy one epipolar geometry within a tolerance, in the points' unit. No
    pair passes where there are too few inliers."""
    if len(first) < FEWEST_PAIRS:
        return np.zeros(len(first), dtype=bool)
    _, inside = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, tolerance, _CONFIDENCE, _TRIALS)
    agree = np.zeros(len(first), dtype=bool) if inside is None else inside.ravel() > 0
    return agree if agree.sum() >= FEWEST_PAIRS else np.zeros(len(first), dtype=bool)


def epipolar_outliers(first: Array, second: Array, tolerance: float) -> Mask:
    """Mask of the pairs (n, 2) that deviate from the epipolar geometry unlike their neighbours.

    Lens distortion and film deformation shift neighbouring pairs alike: the test uses the distance of a pair minus the
    median of its neighbours.
    """
    if len(first) < FEWEST_PAIRS:
        return np.zeros(len(first), dtype=bool)
    matrix, _ = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, tolerance, _CONFIDENCE, _TRIALS)
    if matrix is None:
        return np.zeros(len(first), dtype=bool)
    distance = _sampson(np.asarray(matrix, np.float64)[:3], first, second)
    near = np.asarray(cKDTree(first).query(first, _NEIGHBOURS + 1)[1])[:, 1:]
    alone = distance - np.median(distance[near], axis=1)
    limit = -float(ndtri(POINT_OFF_ITS_RAY / 2)) * robust_scale(alone)
    return np.asarray(np.abs(alone) > limit)


def _sampson(matrix: Array, first: Array, second: Array) -> Array:
    """(n,) signed first-order distance of pairs from the epipolar geometry (Sampson 1982)."""
    a = np.column_stack([first, np.ones(len(first))])
    b = np.column_stack([second, np.ones(len(second))])
    there, back = a @ matrix.T, b @ matrix
    slope = np.sqrt(there[:, 0] ** 2 + there[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2)
    return np.asarray(np.sum(b * there, axis=1) / np.maximum(slope, 1e-300))


def neighbour_outliers(first: Array, second: Array) -> Mask:
    """Mask of the points (n, 2), px, that deviate in the second frame from the map of their neighbours.

    The deviation is taken in units of the neighbours' scatter. Above their median these ratios are modelled as
    lognormal, since relief makes their tail longer than that of normal errors. None deviates where points are too few.
    """
    off = np.zeros(len(first), dtype=bool)
    for _ in range(_ROUNDS):
        if np.count_nonzero(~off) <= 2 * _MAP_NEIGHBOURS:
            return np.zeros(len(first), dtype=bool)
        ratios = _ratios(first, second, np.flatnonzero(~off))
        usual, large = np.quantile(ratios, (0.5, float(ndtr(1.0))))
        off = np.asarray(ratios > usual - float(ndtri(POINT_OFF_ITS_NEIGHBOURS)) * (large - usual))
    return off


def _ratios(first: Array, second: Array, trusted: Indices) -> Array:
    """(n,) logarithm of each point's deviation from the map of its trusted neighbours, in units of their scatter."""
    near = trusted[cKDTree(first[trusted]).query(first, _MAP_NEIGHBOURS + 1)[1]]
    # Drop the point itself where it is trusted, else the farthest neighbour.
    itself = near == np.arange(len(first))[:, None]
    itself[~itself.any(axis=1), -1] = True
    near = near[~itself].reshape(len(first), _MAP_NEIGHBOURS)
    design = np.concatenate([np.ones((*near.shape, 1)), first[near] - first[:, None]], axis=2)
    maps = least_distances(design, second[near], _LEAST_PX, _REWEIGHTINGS)
    scatter = np.median(_lengths(second[near] - design @ maps), axis=1)
    # A few neighbours may agree by chance: add the median scatter. Extrapolated maps are less certain: the factor.
    spread = 1.0 + np.linalg.inv(np.swapaxes(design, 1, 2) @ design)[:, 0, 0]
    variance = (scatter**2 + np.median(scatter) ** 2 + _LEAST_PX**2) * spread
    return np.asarray(np.log(np.maximum(_lengths(second - maps[:, 0]), 1e-9)) - np.log(variance) / 2)


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))

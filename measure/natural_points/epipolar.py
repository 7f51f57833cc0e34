"""Whether points of two frames can be the same points of the object: the epipolar geometry of a pair."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtri

from measure.noise.noise import robust_scale
from measure.probabilities import POINT_OFF_ITS_RAY

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST_PAIRS = 16  # twice what the geometry is computed from
_CONFIDENCE, _TRIALS = 0.9999, 10000  # of MAGSAC: that it finds the geometry, and how often it tries at most
_NEIGHBOURS = 8  # whose median distance is what lens and film bend


def agreeing(first: Array, second: Array, tolerance: float) -> Mask:
    """Which pairs of points (n, 2) in two frames one epipolar geometry explains within a tolerance; none, where it
    explains too few to be believed. Units as the points'.
    """
    if len(first) < FEWEST_PAIRS:
        return np.zeros(len(first), dtype=bool)
    _, inside = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, tolerance, _CONFIDENCE, _TRIALS)
    agree = np.zeros(len(first), dtype=bool) if inside is None else inside.ravel() > 0
    return agree if agree.sum() >= FEWEST_PAIRS else np.zeros(len(first), dtype=bool)


def contradicting(first: Array, second: Array, tolerance: float) -> Mask:
    """Which pairs (n, 2) lie off the epipolar geometry unlike the pairs about them.

    A lens and a film bend the geometry, but alike in a neighbourhood: what counts is a pair's distance less the median
    of its neighbours'.
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
    """(n,) signed distance of pairs from the geometry, to first order (Sampson 1982)."""
    a = np.column_stack([first, np.ones(len(first))])
    b = np.column_stack([second, np.ones(len(second))])
    there, back = a @ matrix.T, b @ matrix
    slope = np.sqrt(there[:, 0] ** 2 + there[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2)
    return np.asarray(np.sum(b * there, axis=1) / np.maximum(slope, 1e-300))

"""Geometric verification of point pairs: the epipolar geometry of two frames, and the neighbours of each point."""

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

FEWEST_PAIRS = 16  # twice what the geometry is computed from
_CONFIDENCE, _TRIALS = 0.9999, 10000  # of MAGSAC: that it finds the geometry, and how often it tries at most
_NEIGHBOURS = 8  # whose median distance is what lens and film bend
_MAP_NEIGHBOURS = 12  # that tell the map about a point: four times its unknowns, for some of them may be false
_ROUNDS = 2  # a false point may draw its neighbours' maps: in the second it is none of theirs
_REWEIGHTINGS = 10  # of least distances
_LEAST_PX = 0.1  # distances below it weigh alike, and what neighbours scatter at least


def epipolar_inliers(first: Array, second: Array, tolerance: float) -> Mask:
    """Which pairs of points (n, 2) in two frames one epipolar geometry explains within a tolerance; none, where it
    explains too few to be believed. Units as the points'.
    """
    if len(first) < FEWEST_PAIRS:
        return np.zeros(len(first), dtype=bool)
    _, inside = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, tolerance, _CONFIDENCE, _TRIALS)
    agree = np.zeros(len(first), dtype=bool) if inside is None else inside.ravel() > 0
    return agree if agree.sum() >= FEWEST_PAIRS else np.zeros(len(first), dtype=bool)


def epipolar_outliers(first: Array, second: Array, tolerance: float) -> Mask:
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


def neighbour_outliers(first: Array, second: Array) -> Mask:
    """Which points (n, 2) of two frames, in px, lie elsewhere in the second than their neighbours in the first put
    them, farther in units of the neighbours' scatter than relief does it to any others; none where points are too few.

    Above their median these ratios are taken as lognormal: relief makes their tail longer than that of normal errors.
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
    """(n,) logarithms of how far each point lies from where its neighbours among the trusted put it, in units of their
    scatter."""
    near = trusted[cKDTree(first[trusted]).query(first, _MAP_NEIGHBOURS + 1)[1]]
    # Itself, where it is trusted, is the first of them; else the farthest is one too many.
    itself = near == np.arange(len(first))[:, None]
    itself[~itself.any(axis=1), -1] = True
    near = near[~itself].reshape(len(first), _MAP_NEIGHBOURS)
    design = np.concatenate([np.ones((*near.shape, 1)), first[near] - first[:, None]], axis=2)
    maps = least_distances(design, second[near], _LEAST_PX, _REWEIGHTINGS)
    scatter = np.median(_lengths(second[near] - design @ maps), axis=1)
    # Few neighbours may lie well by chance: what is usual counts beside them. Outside of them a map is known worse.
    spread = 1.0 + np.linalg.inv(np.swapaxes(design, 1, 2) @ design)[:, 0, 0]
    variance = (scatter**2 + np.median(scatter) ** 2 + _LEAST_PX**2) * spread
    return np.asarray(np.log(np.maximum(_lengths(second - maps[:, 0]), 1e-9)) - np.log(variance) / 2)


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))

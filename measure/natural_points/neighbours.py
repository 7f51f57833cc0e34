"""Whether points move from frame to frame as the points about them do.

Ground that repeats itself, an orchard or rows of roofs, gives points that lie on their epipolar lines and are another
tree or roof. But the ground about a point maps nearly as one piece: an affine map, but for its relief.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from measure.noise.least_squares import least_distances
from measure.probabilities import POINT_OFF_ITS_NEIGHBOURS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_NEIGHBOURS = 12  # that tell the map about a point: four times its unknowns, for some of them may be false
_ROUNDS = 2  # a false point may draw its neighbours' maps: in the second it is none of theirs
_REWEIGHTINGS = 10  # of least distances
_LEAST_PX = 0.1  # distances below it weigh alike, and what neighbours scatter at least


def outliers(first: Array, second: Array) -> Mask:
    """Which points (n, 2) of two frames, in px, lie elsewhere in the second than their neighbours in the first put
    them, farther in units of the neighbours' scatter than relief does it to any others; none where points are too few.

    Above their median these ratios are taken as lognormal: relief makes their tail longer than that of normal errors.
    """
    off = np.zeros(len(first), dtype=bool)
    for _ in range(_ROUNDS):
        if np.count_nonzero(~off) <= 2 * _NEIGHBOURS:
            return np.zeros(len(first), dtype=bool)
        ratios = _ratios(first, second, np.flatnonzero(~off))
        usual, large = np.quantile(ratios, (0.5, float(ndtr(1.0))))
        off = np.asarray(ratios > usual - float(ndtri(POINT_OFF_ITS_NEIGHBOURS)) * (large - usual))
    return off


def _ratios(first: Array, second: Array, trusted: Indices) -> Array:
    """(n,) logarithms of how far each point lies from where its neighbours among the trusted put it, in units of their
    scatter."""
    near = trusted[cKDTree(first[trusted]).query(first, _NEIGHBOURS + 1)[1]]
    # Itself, where it is trusted, is the first of them; else the farthest is one too many.
    itself = near == np.arange(len(first))[:, None]
    itself[~itself.any(axis=1), -1] = True
    near = near[~itself].reshape(len(first), _NEIGHBOURS)
    design = np.concatenate([np.ones((*near.shape, 1)), first[near] - first[:, None]], axis=2)
    maps = least_distances(design, second[near], _LEAST_PX, _REWEIGHTINGS)
    scatter = np.median(_lengths(second[near] - design @ maps), axis=1)
    # Few neighbours may lie well by chance: what is usual counts beside them. Outside of them a map is known worse.
    spread = 1.0 + np.linalg.inv(np.swapaxes(design, 1, 2) @ design)[:, 0, 0]
    variance = (scatter**2 + np.median(scatter) ** 2 + _LEAST_PX**2) * spread
    return np.asarray(np.log(np.maximum(_lengths(second - maps[:, 0]), 1e-9)) - np.log(variance) / 2)


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))

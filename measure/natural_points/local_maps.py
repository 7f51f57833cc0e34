"""How the ground about a place maps from frame to frame, as the points about it say, and which points move otherwise.

Ground that repeats itself, an orchard or rows of roofs, gives points that lie on their epipolar lines and are another
tree or roof. But the ground about a point maps nearly as one piece: an affine map, but for its relief.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from measure.natural_points.features import Features
from measure.noise.least_squares import least_distances
from measure.probabilities import POINT_OFF_ITS_NEIGHBOURS

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

_PLACE_PX, _LOCAL = 5.0, 0.1  # how far places depart from an affine map, and that from the whole pair's
_REWEIGHTINGS, _OF_NEIGHBOURS = 6, 10  # of least distances
_STRETCH = 2.0  # the most by which a small piece of ground can differ in scale between photographs to be matched
_NEIGHBOURS = 12  # that tell the map about a point: four times its unknowns, for some of them may be false
_ROUNDS = 2  # a false point may draw its neighbours' maps: in the second it is none of theirs
_LEAST_PX = 0.1  # distances below it weigh alike, and what neighbours scatter at least


class LocalMaps:
    """Affine maps about a place from one scan to another."""

    def __init__(self, features: Sequence[Features], shared: Mapping[tuple[int, int], Indices]) -> None:
        self._places: dict[tuple[int, int], tuple[Array, Array]] = {}
        for (i, j), pairs in shared.items():
            if len(pairs):
                first, second = features[i].places_px[pairs[:, 0]], features[j].places_px[pairs[:, 1]]
                self._places[i, j], self._places[j, i] = (first, second), (second, first)
        self._trees = {pair: cKDTree(here) for pair, (here, _) in self._places.items()}
        self._whole = {pair: _affine_map(*places, np.zeros((2, 2)), 0.0) for pair, places in self._places.items()}

    def reached(self, start: int) -> list[int]:
        """The scans that share features with this one."""
        return sorted(end for begin, end in self._places if begin == start)

    def map(self, start: int, end: int, place_px: Array) -> Array | None:
        """(2, 3) map of offsets from a place (2,) of one scan to places of another; None where the scans differ too
        much in scale there.

        It is that of the nearest matches, held by those of the whole pair where they lie close together.
        """
        here, there = self._places[start, end]
        near = np.atleast_1d(self._trees[start, end].query(place_px, min(_NEIGHBOURS, len(here)))[1])
        whole = self._whole[start, end][:, :2]
        local = _affine_map(here[near] - place_px, there[near], whole, (_PLACE_PX / _LOCAL) ** 2)
        scales = np.linalg.svd(local[:, :2], compute_uv=False)
        return local if 1 / _STRETCH < scales[1] <= scales[0] < _STRETCH else None


def _affine_map(here: Array, there: Array, usual: Array, weight: float) -> Array:
    """(2, 3) from places (n, 2) to places, a few of which may be false; with a weight on what its linear part is
    usually."""
    middle = here.mean(axis=0)
    design = np.column_stack([np.ones(len(here)), here - middle])
    prior, of_usual = weight * np.diag([0.0, 1.0, 1.0]), np.vstack([np.zeros(2), usual.T])
    target, *linear = least_distances(design, there, _PLACE_PX, _REWEIGHTINGS, prior, of_usual)
    matrix = np.transpose(linear)
    return np.column_stack([matrix, target - matrix @ middle])


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
    maps = least_distances(design, second[near], _LEAST_PX, _OF_NEIGHBOURS)
    scatter = np.median(_lengths(second[near] - design @ maps), axis=1)
    # Few neighbours may lie well by chance: what is usual counts beside them. Outside of them a map is known worse.
    spread = 1.0 + np.linalg.inv(np.swapaxes(design, 1, 2) @ design)[:, 0, 0]
    variance = (scatter**2 + np.median(scatter) ** 2 + _LEAST_PX**2) * spread
    return np.asarray(np.log(np.maximum(_lengths(second - maps[:, 0]), 1e-9)) - np.log(variance) / 2)


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))

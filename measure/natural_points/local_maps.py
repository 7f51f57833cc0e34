"""How the ground about a place maps from scan to scan, as the matches about it say."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.natural_points.features import Features
from measure.noise.least_squares import least_distances

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_PLACE_PX, _LOCAL = 5.0, 0.1  # how far places depart from an affine map, and that from the whole pair's
_REWEIGHTINGS = 6  # of least distances
_STRETCH = 2.0  # the most by which a small piece of ground can differ in scale between photographs to be matched
_NEIGHBOURS = 12  # matches whose places give the local map


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

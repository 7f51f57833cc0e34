"""Which natural points are worth measuring: features that three scans or more share, and how the ground about them
maps from scan to scan.

Features of all scans are compared in pairs; what one epipolar geometry explains is joined to tracks, and the tracks are
ordered so that the first of them, however many, spread evenly over the frames."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from measure.noise.robust_estimation import least_distances
from measure.scans.parallel import map_or_replace
from measure.tie_points.features import Features, TieFrame, interleave_groups, shared_features
from measure.tie_points.multi_image import RADIUS_PX
from measure.tie_points.verification import epipolar_inliers

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]

_PLACE_PX, _LOCAL = 5.0, 0.1  # how far places depart from an affine map, and that from the whole pair's
_REWEIGHTINGS = 6  # of least distances
_STRETCH = 2.0  # the most by which a small piece of ground can differ in scale between photographs to be matched
_NEIGHBOURS = 12  # that tell the map about a point: four times its unknowns, for some of them may be false
Shared = Mapping[tuple[int, int], Indices]
Track = dict[int, int]  # the feature in every frame

_AGREE_PX = 2.0  # in the reduced scan: what a feature's place and a lens leave
_CELLS = 8  # a side of a frame, over which points are spread


class LocalMaps:
    """Affine maps about a place from one scan to another."""

    def __init__(self, features: Sequence[Features], shared: Shared) -> None:
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


@dataclass(frozen=True, eq=False)
class TieCandidate:
    """A track: the approximate affine maps (2, 3) from its patch, of radius_px, to the scans, by frame; which frame
    defines it."""

    reference: int
    maps: dict[int, Array]
    radius_px: int = RADIUS_PX


def verify_pairs(
    frames: Sequence[TieFrame], features: Sequence[Features], workers: Executor | None
) -> dict[tuple[int, int], Indices]:
    """By pair of frames the features that they share, as far as one epipolar geometry explains them; none of a pair
    over which its process was ended. Two scans of one exposed frame have no such geometry, and are no pair."""
    shared = {}
    both = [(i, j) for i, j in combinations(range(len(frames)), 2) if frames[i].frame != frames[j].frame]
    pairs_of = [(features[i], features[j]) for i, j in both]
    found = map_or_replace(workers, _match_pair, pairs_of, lambda *_: np.zeros((0, 2), np.intp))
    for (i, j), pairs in zip(both, found, strict=True):
        first, second = (
            frames[k].camera_px(features[k].places_px[own]) for k, own in zip((i, j), pairs.T, strict=True)
        )
        shared[i, j] = pairs[epipolar_inliers(first, second, _AGREE_PX * features[i].reduction)]
    return shared


def _match_pair(pair: tuple[Features, Features]) -> Indices:
    return shared_features(*pair)


def find_candidates(
    frames: Sequence[TieFrame], features: Sequence[Features], shared: Shared, fewest: int
) -> list[TieCandidate]:
    """The tracks that at least `fewest` frames may show, the best textured of every part of a frame before its others.

    Where a track has no feature in a frame, but the matches about it put it there, it is sought there too: grain hides
    many a feature that the matching of the whole patch still finds.
    """
    maps = LocalMaps(features, shared)
    found, cells, textures = [], [], []
    for track in tracks_of_pairs(shared):
        reference = _most_central(frames, features, track)
        reached = _maps(frames, features, maps, track, reference)
        candidate = TieCandidate(reference, _one_an_exposure(frames, features, reached, reference))
        if len(candidate.maps) < fewest:
            continue
        place = frames[reference].camera_px(candidate.maps[reference][None, :, 2])[0]
        col, row = np.floor(place * _CELLS / _width_px(frames[reference], features[reference].size_px)).astype(int)
        found.append(candidate)
        cells.append((reference * 1000 + col) * 1000 + row)
        textures.append(min(features[frame].textures[feature] for frame, feature in track.items()))
    return [found[k] for k in interleave_groups(np.array(cells, np.intp), np.array(textures))] if found else []


def candidates_with_radius(
    candidates: Sequence[TieCandidate],
    radius_px: int,
    frames: Sequence[TieFrame],
    sizes_px: Sequence[tuple[int, int]],
    fewest: int,
) -> list[TieCandidate]:
    """The candidates with patches of that radius, as far as at least `fewest` frames, the defining one among them, show
    these whole."""
    shown: list[dict[int, Array]] = [{} for _ in candidates]
    for i, frame in enumerate(frames):
        own = [k for k, candidate in enumerate(candidates) if i in candidate.maps]
        places = np.array([candidates[k].maps[i][:, 2] for k in own]).reshape(-1, 2)
        for k in np.array(own, int)[frame.usable(places, sizes_px[i], radius_px)]:
            shown[k][i] = candidates[k].maps[i]
    return [
        TieCandidate(candidate.reference, maps, radius_px)
        for candidate, maps in zip(candidates, shown, strict=True)
        if len(maps) >= fewest and candidate.reference in maps
    ]


def _maps(
    frames: Sequence[TieFrame],
    features: Sequence[Features],
    maps: LocalMaps,
    track: Track,
    reference: int,
) -> dict[int, Array]:
    """Maps (2, 3) by frame from a grid about the reference's feature to the feature there, or to where it should be."""
    middle = features[reference].places_px[track[reference]]
    found = {reference: np.column_stack([np.eye(2), middle])}
    for frame in maps.reached(reference):
        local = maps.map(reference, frame, middle)
        if local is None:
            continue
        if frame in track:
            local[:, 2] = features[frame].places_px[track[frame]]
        if frame in track or frames[frame].usable(local[None, :, 2], features[frame].size_px)[0]:
            found[frame] = local
    return found


def _one_an_exposure(
    frames: Sequence[TieFrame], features: Sequence[Features], maps: dict[int, Array], reference: int
) -> dict[int, Array]:
    """The maps to one scan of every exposed frame: the defining one, or that which shows the place farthest inside."""
    inside = {
        i: (i == reference, float(np.minimum(maps[i][:, 2], np.array(features[i].size_px) - 1 - maps[i][:, 2]).min()))
        for i in maps
    }
    best: dict[str, int] = {}
    for i in maps:
        best[frames[i].frame] = max(best.get(frames[i].frame, i), i, key=inside.__getitem__)
    return {i: places for i, places in maps.items() if best[frames[i].frame] == i}


def _width_px(frame: TieFrame, size_px: tuple[int, int]) -> float:
    return float(max(size_px)) if frame.frame_mm is None else max(frame.frame_mm) * frame.px_per_mm


def _most_central(frames: Sequence[TieFrame], features: Sequence[Features], track: Track) -> int:
    """The frame that sees the point most nearly along its axis: from there the others' views are least distorted."""
    off = {i: np.linalg.norm(frames[i].camera_px(features[i].places_px[k][None])) for i, k in track.items()}
    return min(off, key=lambda i: (off[i], i))


def tracks_of_pairs(shared: Shared) -> list[Track]:
    """Join features that pairs of frames share to tracks.

    Parameters
    ----------
    shared : by pair of frames, (n, 2) features that they share.

    Returns
    -------
    The tracks in the order of their features. A track that has two features in a frame is none; and a feature stays in
    one of three frames or more only where two others share it. What one pair alone has is a track of two.
    """
    links = [np.zeros((0, 4), np.intp)]
    links += [np.column_stack([np.full_like(own, pair), own])[:, [0, 2, 1, 3]] for pair, own in shared.items()]
    places, ends = np.unique(np.concatenate(links).reshape(-1, 2), axis=0, return_inverse=True)
    ends = ends.reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), ends.T), (len(places), len(places)))
    group = connected_components(graph, directed=False)[1]
    is_alone = np.bincount(group[ends[:, 0]], minlength=len(places))[group[ends[:, 0]]] == 1
    kept = np.ones(len(ends), bool)
    while True:
        links_of = np.bincount(ends[kept].ravel(), minlength=len(places))
        held = kept & (is_alone | (links_of[ends].min(axis=1) >= 2))
        if held.sum() == kept.sum():
            break
        kept = held
    members: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for place in np.unique(ends[kept]).tolist():
        frame, feature = places[place].tolist()
        members[int(group[place])].append((frame, feature))
    tracks = (dict(own) for own in members.values() if len({frame for frame, _ in own}) == len(own))
    return sorted(tracks, key=lambda track: sorted(track.items()))

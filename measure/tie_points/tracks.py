"""SIFT features of scans, matched between two of them, and their tracks over three or more: candidates for tie points.

Features are matched pair by pair, verified by the epipolar geometry and linked to tracks, with local affine maps
between the scans. The tracks are ordered so that any number of the first ones is spread evenly over the frames. Point
pairs are tested by the epipolar geometry of two frames and by neighbouring points.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import ndtr, ndtri

from measure.array_types import Array, Indices, Mask
from measure.errors import MeasurementError
from measure.flags import POINT_OFF_ITS_NEIGHBOURS, POINT_OFF_ITS_RAY, Code, Reason
from measure.geometry import linear_scale, scan_px
from measure.noise.robust_estimation import least_distances, robust_scale
from measure.scans.opening import open_scan
from measure.scans.parallel import map_or_replace
from measure.scans.scan import Scan
from measure.tie_points.multi_image import RADIUS_PX, SPARE_PX, Piece

Shared = Mapping[tuple[int, int], Indices]
Track = dict[int, int]  # feature by frame

_PLACE_PX, _LOCAL = 5.0, 0.1  # deviation of places from a local affine map, and of that from the pair's global one
_REWEIGHTINGS = 6  # of the least absolute deviations
_STRETCH = 2.0  # largest ratio of local scales between photographs that can be matched
_NEIGHBOURS = 12  # used for a local map: four times its parameters, since some may be false
_AGREE_PX = 2.0  # epipolar tolerance in the reduced scan, for localisation and lens distortion
_CELLS = 8  # per side of a frame, over which points are spread
FEWEST_PAIRS = 16  # twice the minimal number for a fundamental matrix
_CONFIDENCE, _TRIALS = 0.9999, 10000  # of MAGSAC: probability of success, and largest number of trials
_MEDIAN_NEIGHBOURS = 8  # their median distance estimates lens distortion and film deformation
_ROUNDS = 2  # a false point may distort its neighbours' maps; in the second round it is left out of them
_SCATTER_REWEIGHTINGS = 10  # of the least absolute deviations
_LEAST_PX = 0.1  # lower bound of distances in the weights, and of the neighbours' scatter
_LONGEST_PX = 3000  # longer side of the reduced scan
_TILE_PX, _OVERLAP_PX = 1024, 96  # SIFT needs some 130 bytes per pixel: one tile at a time
_CONTRAST = 0.02  # half of OpenCV's default: fields and water have weak texture
_RATIO = 0.8  # ratio test of Lowe: rejects nine false matches in ten, and one right match in twenty
_FEATURE_CELLS = 12  # per side, over which the kept features are spread
_SURPLUS = 3  # detected features per wanted one: some are unusable, and the strongest are clustered
_BLACK_AND_WHITE = (0.5, 99.5)  # percentiles of the grey values that are mapped to black and white


@dataclass(frozen=True, eq=False)
class TieFrame:
    """A scan for tie points.

    Attributes
    ----------
    image, scan : name and file.
    pixel_from_camera : (2, 3) from camera coordinates (x', y', 1), mm, to column and row.
    frame_mm : width and height of the exposed frame about the origin; None if the whole scan is exposed.
    taken_px : (n, 3) column, row and radius of marks, which are excluded.
    max_pixels : limit for the scan, if the user states one.
    part_of : name of the exposed frame if this scan is one part of it.
    """

    image: str
    scan: Path
    pixel_from_camera: Array
    frame_mm: tuple[float, float] | None
    taken_px: Array
    max_pixels: int | None = None
    part_of: str = ""

    @property
    def frame(self) -> str:
        """Name of the exposed frame."""
        return self.part_of or self.image

    def open(self) -> Scan:
        """Open the scan; raises MeasurementError where it cannot be read."""
        return open_scan(self.scan, self.max_pixels)

    @property
    def px_per_mm(self) -> float:
        return linear_scale(self.pixel_from_camera)

    @property
    def mirrored(self) -> bool:
        """Whether the scan is mirrored. Rows count downward and y' upward: an ordinary scan has a negative
        determinant."""
        return bool(np.linalg.det(self.pixel_from_camera[:, :2]) > 0.0)

    def camera_px(self, places_px: Array) -> Array:
        """(n, 2) camera coordinates of places, in pixels."""
        linear, shift = self.pixel_from_camera[:, :2], self.pixel_from_camera[:, 2]
        return np.asarray((places_px - shift) @ np.linalg.inv(linear).T * self.px_per_mm)

    def usable(self, places_px: Array, size_px: tuple[int, int], radius_px: int = RADIUS_PX) -> Mask:
        """Mask of the places whose whole patch lies within the exposed frame and clear of marks."""
        rim = radius_px + SPARE_PX
        inside = np.all((places_px >= rim) & (places_px <= np.array(size_px) - 1 - rim), axis=1)
        if self.frame_mm is not None:
            half = np.array(self.frame_mm) / 2 * self.px_per_mm - rim
            inside &= np.all(np.abs(self.camera_px(places_px)) <= half, axis=1)
        if len(self.taken_px) and len(places_px):
            for col, row, radius in self.taken_px:
                inside &= np.hypot(*(places_px - (col, row)).T) > radius + radius_px
        return np.asarray(inside)


@dataclass(frozen=True, eq=False)
class Features:
    """SIFT features of a scan. places_px (n, 2): column and row; descriptors (n, 128); strengths (n,): contrast;
    textures (n,): smaller eigenvalue of the gradient matrix over a patch; size_px: width and height of the scan;
    reduction: factor by which it was reduced."""

    places_px: Array
    descriptors: NDArray[np.float32]
    strengths: Array
    textures: Array
    size_px: tuple[int, int] = (0, 0)
    reduction: int = 1

    def part(self, rows: Indices) -> "Features":
        arrays = ("places_px", "descriptors", "strengths", "textures")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})


def find_all_features(
    frames: Sequence[TieFrame], count: int, are_alike: bool, what_fails: str, workers: Executor | None
) -> Iterator[Features | Reason]:
    """Detect at most count features in every scan.

    are_alike: the scans show one film, so that none is mirrored against another; what_fails: start of the reason that
    an unreadable scan gets.
    """
    find = partial(_features, count, are_alike, what_fails)
    return map_or_replace(workers, find, frames, lambda _, why: unreachable(what_fails, why))


def unreachable(what_fails: str, why: str) -> Reason:
    """Reason of a scan that cannot be read."""
    return Reason(f"{what_fails}: {why}", Code.UNREACHABLE)


def _features(count: int, are_alike: bool, what_fails: str, frame: TieFrame) -> Features | Reason:
    """Features spread evenly over the scan, the strongest of each cell first."""
    try:
        with frame.open() as scan:
            size_px = scan.width_px, scan.height_px
            factor = -(-max(size_px) // _LONGEST_PX)
            grey = scan.reduced(factor)
    except MeasurementError as error:
        return unreachable(what_fails, str(error))
    # In the mirror image of a mirrored scan: SIFT descriptors are invariant to rotation, not to reflection.
    mirrored = frame.mirrored and not are_alike
    black, white = np.percentile(grey[::4, ::4], _BLACK_AND_WHITE)
    picture = np.clip((grey - black) * (255.0 / max(white - black, 1e-9)), 0.0, 255.0).astype(np.uint8)
    if mirrored:
        picture = np.ascontiguousarray(picture[:, ::-1])
    found = _detect_in_tiles(picture, _SURPLUS * count, 2 * (RADIUS_PX // factor) + 1)
    places = found.places_px
    if mirrored:
        places = np.array([picture.shape[1] - 1, 0]) + places * np.array([-1, 1])
    found = replace(found, places_px=scan_px(places, factor), size_px=size_px, reduction=factor)
    found = found.part(np.flatnonzero(frame.usable(found.places_px, size_px)))
    cell = np.floor(found.places_px / size_px * _FEATURE_CELLS).astype(np.intp) @ np.array([1, _FEATURE_CELLS])
    return found.part(interleave_groups(cell, found.strengths)[:count])


def read_pieces(frame: TieFrame, patches: Sequence[tuple[Array, int]]) -> list[Piece]:
    """Read the windows of patches, given as map (2, 3) and radius, from top to bottom of a scan. Raises
    MeasurementError where it cannot be read."""
    pieces: dict[int, Piece] = {}
    with frame.open() as scan:
        for k, (matrix, radius_px) in sorted(enumerate(patches), key=lambda patch: float(patch[1][0][1, 2])):
            half = int(np.ceil(radius_px * np.linalg.norm(matrix[:, :2], 2))) + SPARE_PX
            col0, row0 = (int(value) - half for value in np.round(matrix[:, 2]))
            pieces[k] = Piece(scan.window(col0, row0, 2 * half + 1, 2 * half + 1), (col0, row0), matrix)
    return [pieces[k] for k in range(len(patches))]


def shared_features(pair: tuple[Features, Features]) -> Indices:
    """(n, 2) indices of mutual nearest neighbours that pass the ratio test."""
    first, second = pair
    if min(len(first.places_px), len(second.places_px)) < 2:
        return np.zeros((0, 2), np.intp)
    there, back = _nearest_features(first, second), _nearest_features(second, first)
    mutual = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(there))))
    return np.column_stack([mutual, there[mutual]])


def _nearest_features(first: Features, second: Features) -> Indices:
    """Nearest feature of the second scan for each of the first; -1 where the ratio test fails."""
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    return np.array(
        [best.trainIdx if best.distance < _RATIO * other.distance else -1 for best, other in pairs], np.intp
    )


def _detect_in_tiles(picture: NDArray[np.uint8], count: int, patch_px: int) -> Features:
    """Detect about `count` features tile by tile; features at one place with two directions count once.

    Texture is the smaller eigenvalue of the gradient matrix over a patch (Förstner and Gülch 1987).
    """
    tiles = [(np.empty((0, 2)), np.empty((0, 128), np.float32), np.empty(0), np.empty(0))]
    for row0, col0 in product(*(range(0, side, _TILE_PX) for side in picture.shape)):
        corner = np.array([col0, row0])
        first, last = np.maximum(corner - _OVERLAP_PX, 0), corner + _TILE_PX + _OVERLAP_PX
        tile = picture[first[1] : last[1], first[0] : last[0]]
        sift = cv2.SIFT.create(int(np.ceil(count * tile.size / picture.size)), contrastThreshold=_CONTRAST)
        points, described = sift.detectAndCompute(tile, None)
        if not points:
            continue
        found = np.array([point.pt for point in points]) + first
        once = np.zeros(len(found), bool)
        once[np.unique(np.round(found, 2), axis=0, return_index=True)[1]] = True
        within = found - corner + 0.5
        own = once & np.all((within >= 0) & (within < _TILE_PX), axis=1)
        col, row = np.round(found[own] - first).astype(np.intp).T
        textures = cv2.cornerMinEigenVal(tile, patch_px)[row, col].astype(np.float64)
        strengths = np.array([point.response for point in points])[own]
        tiles.append((found[own], np.asarray(described, np.float32)[own], strengths, textures))
    places, descriptors, strengths, textures = (np.concatenate(parts) for parts in zip(*tiles, strict=True))
    return Features(places, descriptors, strengths, textures)


def interleave_groups(group: Indices, strengths: Array) -> Indices:
    """Order that takes the strongest of every group first, then the second of every group, and so on."""
    order = np.lexsort((-strengths, group))
    _, starts = np.unique(group[order], return_index=True)
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.asarray(order[np.lexsort((-strengths[order], rank))], np.intp)


class LocalMaps:
    """Local affine maps from one scan to another."""

    def __init__(self, features: Sequence[Features], shared: Shared) -> None:
        self._places: dict[tuple[int, int], tuple[Array, Array]] = {}
        for (i, j), pairs in shared.items():
            if len(pairs):
                first, second = features[i].places_px[pairs[:, 0]], features[j].places_px[pairs[:, 1]]
                self._places[i, j], self._places[j, i] = (first, second), (second, first)
        self._trees = {pair: cKDTree(here) for pair, (here, _) in self._places.items()}
        self._whole = {pair: _affine_map(*places, np.zeros((2, 2)), 0.0) for pair, places in self._places.items()}

    def map(self, start: int, end: int, place_px: Array) -> Array | None:
        """(2, 3) map of offsets from a place (2,) in one scan to places in another; None where they share no features,
        or the scales differ too much.

        Fitted to the nearest matches, with the pair's global map as a prior.
        """
        if (start, end) not in self._places:
            return None
        here, there = self._places[start, end]
        near = np.atleast_1d(self._trees[start, end].query(place_px, min(_NEIGHBOURS, len(here)))[1])
        whole = self._whole[start, end][:, :2]
        local = _affine_map(here[near] - place_px, there[near], whole, (_PLACE_PX / _LOCAL) ** 2)
        scales = np.linalg.svd(local[:, :2], compute_uv=False)
        return local if 1 / _STRETCH < scales[1] <= scales[0] < _STRETCH else None


def _affine_map(here: Array, there: Array, usual: Array, weight: float) -> Array:
    """(2, 3) robust affine map between places (n, 2). usual (2, 2): prior of its linear part, with a weight."""
    middle = here.mean(axis=0)
    design = np.column_stack([np.ones(len(here)), here - middle])
    prior, of_usual = weight * np.diag([0.0, 1.0, 1.0]), np.vstack([np.zeros(2), usual.T])
    target, *linear = least_distances(design, there, _PLACE_PX, _REWEIGHTINGS, prior, of_usual)
    matrix = np.transpose(linear)
    return np.column_stack([matrix, target - matrix @ middle])


@dataclass(frozen=True, eq=False)
class TieCandidate:
    """Candidate for a tie point. reference: frame that defines the point; maps: approximate affine maps (2, 3) from the
    patch to the scan, by frame; radius_px: of the patch."""

    reference: int
    maps: dict[int, Array]
    radius_px: int = RADIUS_PX


def verify_pairs(
    frames: Sequence[TieFrame], features: Sequence[Features], workers: Executor | None
) -> dict[tuple[int, int], Indices]:
    """Matched features of each pair of frames that satisfy one epipolar geometry; none where a worker was killed. Two
    scans of one exposed frame have no epipolar geometry and are not paired."""
    shared = {}
    both = [(i, j) for i, j in combinations(range(len(frames)), 2) if frames[i].frame != frames[j].frame]
    pairs_of = [(features[i], features[j]) for i, j in both]
    found = map_or_replace(workers, shared_features, pairs_of, lambda *_: np.zeros((0, 2), np.intp))
    for (i, j), pairs in zip(both, found, strict=True):
        first, second = (
            frames[k].camera_px(features[k].places_px[own]) for k, own in zip((i, j), pairs.T, strict=True)
        )
        _, inliers = _epipolar_geometry(first, second, _AGREE_PX * features[i].reduction)
        shared[i, j] = pairs[inliers] if np.count_nonzero(inliers) >= FEWEST_PAIRS else pairs[:0]
    return shared


def find_candidates(
    frames: Sequence[TieFrame], features: Sequence[Features], shared: Shared, fewest: int
) -> list[TieCandidate]:
    """Candidates in at least `fewest` frames, the best textured one of each part of a frame first.

    A frame without a feature of the track is included if neighbouring matches predict the point in it: matching the
    whole patch often succeeds where grain hides the feature.
    """
    maps = LocalMaps(features, shared)
    found, cells, textures = [], [], []
    for track in tracks_of_pairs(shared):
        # The reference has the point nearest to its axis: relative to it, the other views are least distorted.
        _, reference = min(
            (float(np.linalg.norm(frames[i].camera_px(features[i].places_px[k][None]))), i) for i, k in track.items()
        )
        reached = _maps(frames, features, maps, track, reference)
        candidate = TieCandidate(reference, _one_per_exposure(frames, features, reached, reference))
        if len(candidate.maps) < fewest:
            continue
        frame = frames[reference]
        place = frame.camera_px(candidate.maps[reference][None, :, 2])[0]
        size_px = max(features[reference].size_px) if frame.frame_mm is None else max(frame.frame_mm) * frame.px_per_mm
        col, row = np.floor(place * _CELLS / size_px).astype(int)
        found.append(candidate)
        cells.append((reference * 1000 + col) * 1000 + row)
        textures.append(min(features[i].textures[feature] for i, feature in track.items()))
    return [found[k] for k in interleave_groups(np.array(cells, np.intp), np.array(textures))] if found else []


def candidates_with_radius(
    candidates: Sequence[TieCandidate],
    radius_px: int,
    frames: Sequence[TieFrame],
    sizes_px: Sequence[tuple[int, int]],
    fewest: int,
) -> list[TieCandidate]:
    """Candidates whose patch of that radius is complete in at least `fewest` frames, the reference among them."""
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
    """Maps (2, 3) by frame from the patch around the reference's feature to the feature, measured or predicted."""
    middle = features[reference].places_px[track[reference]]
    found = {reference: np.column_stack([np.eye(2), middle])}
    for frame in range(len(frames)):
        local = maps.map(reference, frame, middle)
        if local is None:
            continue
        if frame in track:
            local[:, 2] = features[frame].places_px[track[frame]]
        if frame in track or frames[frame].usable(local[None, :, 2], features[frame].size_px)[0]:
            found[frame] = local
    return found


def _one_per_exposure(
    frames: Sequence[TieFrame], features: Sequence[Features], maps: dict[int, Array], reference: int
) -> dict[int, Array]:
    """Keep one scan of each exposed frame: the reference, or the one that shows the place farthest from its edges."""
    inside = {
        i: (i == reference, float(np.minimum(maps[i][:, 2], np.array(features[i].size_px) - 1 - maps[i][:, 2]).min()))
        for i in maps
    }
    best: dict[str, int] = {}
    for i in maps:
        best[frames[i].frame] = max(best.get(frames[i].frame, i), i, key=inside.__getitem__)
    return {i: places for i, places in maps.items() if best[frames[i].frame] == i}


def tracks_of_pairs(shared: Shared) -> list[Track]:
    """Link matched features to tracks.

    Parameters
    ----------
    shared : (n, 2) matched features of each pair of frames.

    Returns
    -------
    The tracks, sorted by their features. Tracks with two features in one frame are dropped. In a track of three or more
    frames, a feature needs matches in two others; a match of a single pair makes a track of two.
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


def epipolar_outliers(first: Array, second: Array, tolerance: float) -> Mask:
    """Mask of the pairs (n, 2) that deviate from the epipolar geometry unlike their neighbours.

    Lens distortion and film deformation shift neighbouring pairs alike: the test uses the distance of a pair minus the
    median of its neighbours.
    """
    matrix, _ = _epipolar_geometry(first, second, tolerance)
    if matrix is None:
        return np.zeros(len(first), dtype=bool)
    distance = _sampson(matrix, first, second)
    near = np.asarray(cKDTree(first).query(first, _MEDIAN_NEIGHBOURS + 1)[1])[:, 1:]
    alone = distance - np.median(distance[near], axis=1)
    limit = -float(ndtri(POINT_OFF_ITS_RAY / 2)) * robust_scale(alone)
    return np.asarray(np.abs(alone) > limit)


def _epipolar_geometry(first: Array, second: Array, tolerance: float) -> tuple[Array | None, Mask]:
    """Fundamental matrix (3, 3) of pairs (n, 2) by MAGSAC, None if there is none, and the mask of its inliers."""
    matrix = inside = None
    if len(first) >= FEWEST_PAIRS:
        matrix, inside = cv2.findFundamentalMat(first, second, cv2.USAC_MAGSAC, tolerance, _CONFIDENCE, _TRIALS)
    if matrix is None:
        return None, np.zeros(len(first), dtype=bool)
    return np.asarray(matrix, np.float64)[:3], np.asarray(inside).ravel() > 0


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
        if np.count_nonzero(~off) <= 2 * _NEIGHBOURS:
            return np.zeros(len(first), dtype=bool)
        ratios = _ratios(first, second, np.flatnonzero(~off))
        usual, large = np.quantile(ratios, (0.5, float(ndtr(1.0))))
        off = np.asarray(ratios > usual - float(ndtri(POINT_OFF_ITS_NEIGHBOURS)) * (large - usual))
    return off


def _ratios(first: Array, second: Array, trusted: Indices) -> Array:
    """(n,) logarithm of each point's deviation from the map of its trusted neighbours, in units of their scatter."""
    near = trusted[cKDTree(first[trusted]).query(first, _NEIGHBOURS + 1)[1]]
    # Drop the point itself where it is trusted, else the farthest neighbour.
    itself = near == np.arange(len(first))[:, None]
    itself[~itself.any(axis=1), -1] = True
    near = near[~itself].reshape(len(first), _NEIGHBOURS)
    design = np.concatenate([np.ones((*near.shape, 1)), first[near] - first[:, None]], axis=2)
    maps = least_distances(design, second[near], _LEAST_PX, _SCATTER_REWEIGHTINGS)
    scatter = np.median(_lengths(second[near] - design @ maps), axis=1)
    # A few neighbours may agree by chance: add the median scatter. Extrapolated maps are less certain: the factor.
    spread = 1.0 + np.linalg.inv(np.swapaxes(design, 1, 2) @ design)[:, 0, 0]
    variance = (scatter**2 + np.median(scatter) ** 2 + _LEAST_PX**2) * spread
    return np.asarray(np.log(np.maximum(_lengths(second - maps[:, 0]), 1e-9)) - np.log(variance) / 2)


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))

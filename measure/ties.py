"""Natural points: the same points of the terrain in three frames or more, without any target.

Features of all scans are compared in pairs; what one epipolar geometry explains is joined to tracks; of these, spread
evenly, the points are measured by multi-image least-squares matching in the scans themselves.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import norm

from measure.epipolar import FEWEST_PAIRS, agreeing, contradicting
from measure.features import Features, find_features, in_turn, reduction, shared_features
from measure.multi_image import RADIUS_PX, SPARE_PX, Matched, Piece, match_pieces
from measure.noise import robust_scale
from measure.results import MarkMeasurement
from measure.scan import open_scan
from measure.status import Status
from measure.tracks import Track, join_tracks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Progress = Callable[[str, int, int], None]
Windows = dict[int, tuple[NDArray[np.float32], tuple[int, int]]]
Item = TypeVar("Item")
Made = TypeVar("Made")

FEWEST_IMAGES = 3  # two frames cannot contradict each other along the line of sight
_FEATURES = 25  # a scan, for every point wanted; one in five or so has a partner in all frames
_LEAST_FEATURES = 3000
_AGREE_PX = 2.0  # in the reduced scan: what a feature's place and a lens leave
_FINE_PX = 1.0  # the same for points that are measured
_PLACE_PX, _LOCAL = 5.0, 0.1  # how far places depart from an affine map, and that from the whole pair's
_REWEIGHTINGS = 6
_STRETCH = 2.0  # the most by which a small piece of ground can differ in scale between photographs to be matched
_CHUNK = 16  # points that a worker gets at a time
_NEIGHBOURS = 12  # matches whose places give the local affine map
_CELLS = 8  # a side of a frame, over which points are spread
_WRONG_PX = 0.5  # a point is measured only where an error larger than that ...
_CHANCE = 1e-4  # ... is less probable than this, which is also the chance that a test refuses a right point


@dataclass(frozen=True)
class TieOptions:
    """wanted: how many points. images: the fewest that must show a point."""

    wanted: int = 300
    images: int = FEWEST_IMAGES

    def __post_init__(self) -> None:
        if self.wanted < 1:
            raise ValueError(f"wanted is {self.wanted}; at least 1 is right")
        if self.images < FEWEST_IMAGES:
            raise ValueError(f"images is {self.images}; at least {FEWEST_IMAGES} is right: two prove nothing")


@dataclass(frozen=True, eq=False)
class TieFrame:
    """A scan in which natural points are sought.

    pixel_from_camera: (2, 3), camera mm (x', y', 1) to column and row. frame_mm: width and height of the exposed frame
    about the camera frame's origin, None where the whole scan is one. taken_px (n, 3): column, row and radius of the
    marks in it, which are no natural points.
    """

    image: str
    scan: Path
    pixel_from_camera: Array
    frame_mm: tuple[float, float] | None
    taken_px: Array

    @property
    def px_per_mm(self) -> float:
        return float(np.sqrt(abs(np.linalg.det(self.pixel_from_camera[:, :2]))))

    @property
    def mirrored(self) -> bool:
        """Rows count downwards, y' upwards: a scan that is not mirrored changes the sense of rotation."""
        return bool(np.linalg.det(self.pixel_from_camera[:, :2]) > 0.0)

    def camera_px(self, places_px: Array) -> Array:
        """(n, 2) places in the camera frame, in units of a pixel."""
        linear, shift = self.pixel_from_camera[:, :2], self.pixel_from_camera[:, 2]
        return np.asarray((places_px - shift) @ np.linalg.inv(linear).T * self.px_per_mm)

    def usable(self, places_px: Array, size_px: tuple[int, int]) -> Mask:
        """Where a whole patch lies in the exposed frame and beside the marks."""
        rim = RADIUS_PX + SPARE_PX
        inside = np.all((places_px >= rim) & (places_px <= np.array(size_px) - 1 - rim), axis=1)
        if self.frame_mm is not None:
            half = np.array(self.frame_mm) / 2 * self.px_per_mm - rim
            inside &= np.all(np.abs(self.camera_px(places_px)) <= half, axis=1)
        if len(self.taken_px) and len(places_px):
            for col, row, radius in self.taken_px:
                inside &= np.hypot(*(places_px - (col, row)).T) > radius + RADIUS_PX
        return np.asarray(inside)


@dataclass(frozen=True, eq=False)
class Ties:
    """The natural points by image, and what the user should know, a sentence each."""

    marks: Mapping[str, tuple[MarkMeasurement, ...]]
    problems: tuple[str, ...] = ()


def measure_ties(
    frames: Sequence[TieFrame],
    options: TieOptions | None = None,
    progress: Progress | None = None,
    workers: Executor | None = None,
) -> Ties:
    """Find and measure natural points. Never raises for what the pictures show; raises MeasurementError for scans that
    cannot be read.

    progress: called with what has been done, the steps done and their number. workers: processes that share the work;
    the result does not depend on their number.
    """
    options, tell = options or TieOptions(), progress or (lambda *_: None)
    steps = len(frames) + 2
    features = []
    for frame, found in zip(frames, _mapped(workers, partial(_features, options), frames, 1), strict=True):
        features.append(found)
        tell(frame.image, len(features), steps)
    shared = _verified(frames, features, workers)
    tell("pairs of scans", len(frames) + 1, steps)
    candidates = _candidates(frames, features, shared, options)
    points = _measured(frames, candidates, options, workers)
    tell("all scans together", steps, steps)
    return _result(frames, points, candidates, shared, options)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A track: the approximate affine maps (2, 3) from its patch to the scans, by frame; which frame defines it."""

    reference: int
    maps: dict[int, Array]


@dataclass(eq=False)
class _Point:
    """A candidate as measured: what was matched, by frame, and what speaks against it."""

    candidate: _Candidate
    matched: dict[int, Matched]
    unmatched: dict[int, str]
    refused: dict[int, str] = field(default_factory=dict)

    def separation(self, frame: int) -> Array:
        """(2, 2) covariance of the point in a frame if it is the reference's point exactly, px."""
        linear = self.matched[frame].scan_from_patch[:, :2]
        own, reference = self.matched[frame].covariance_px2, self.matched[self.candidate.reference].covariance_px2
        return np.asarray(own + linear @ reference @ linear.T)

    @property
    def standing(self) -> list[int]:
        """The frames in which nothing speaks against it."""
        return [frame for frame in self.matched if frame not in self.refused and frame not in self.unmatched]


def _mapped(
    workers: Executor | None, function: Callable[[Item], Made], items: Sequence[Item], chunk: int
) -> Iterator[Made]:
    return map(function, items) if workers is None else workers.map(function, items, chunksize=chunk)


def _features(options: TieOptions, frame: TieFrame) -> Features:
    count = max(_FEATURES * options.wanted, _LEAST_FEATURES)
    with open_scan(frame.scan) as scan:
        size = (scan.width_px, scan.height_px)
        return find_features(scan, lambda places: frame.usable(places, size), frame.mirrored, count)


def _verified(
    frames: Sequence[TieFrame], features: Sequence[Features], workers: Executor | None
) -> dict[tuple[int, int], Indices]:
    """By pair of frames the features that they share, as far as one epipolar geometry explains them."""
    shared = {}
    both = list(combinations(range(len(frames)), 2))
    found = _mapped(workers, _shared, [(features[i], features[j]) for i, j in both], 1)
    for (i, j), pairs in zip(both, found, strict=True):
        first = frames[i].camera_px(features[i].places_px[pairs[:, 0]])
        second = frames[j].camera_px(features[j].places_px[pairs[:, 1]])
        shared[i, j] = pairs[agreeing(first, second, _AGREE_PX * _reduction(frames[i]))]
    return shared


def _shared(pair: tuple[Features, Features]) -> Indices:
    return shared_features(*pair)


def _reduction(frame: TieFrame) -> int:
    with open_scan(frame.scan) as scan:
        return reduction(scan)


def _candidates(
    frames: Sequence[TieFrame],
    features: Sequence[Features],
    shared: Mapping[tuple[int, int], Indices],
    options: TieOptions,
) -> list[_Candidate]:
    """The tracks, those first that spread best over the frames, the strongest of every part before its others."""
    tracks = join_tracks(shared, options.images)
    if not tracks:
        return []
    references = [_most_central(frames, features, track) for track in tracks]
    cells, strengths = [], []
    for track, reference in zip(tracks, references, strict=True):
        place = frames[reference].camera_px(features[reference].places_px[track[reference]][None])[0]
        size = _CELLS / (_width_px(frames[reference]))
        col, row = np.floor(place * size).astype(int)
        cells.append((reference * 1000 + col) * 1000 + row)
        strengths.append(min(features[frame].strengths[feature] for frame, feature in track.items()))
    maps = _LocalMaps(features, shared)
    order = in_turn(np.array(cells), np.array(strengths))
    candidates = [_Candidate(references[k], maps.of(tracks[k], references[k])) for k in order]
    return [candidate for candidate in candidates if len(candidate.maps) >= options.images]


def _width_px(frame: TieFrame) -> float:
    if frame.frame_mm is not None:
        return max(frame.frame_mm) * frame.px_per_mm
    with open_scan(frame.scan) as scan:
        return float(max(scan.width_px, scan.height_px))


def _most_central(frames: Sequence[TieFrame], features: Sequence[Features], track: Track) -> int:
    """The frame that sees the point most nearly along its axis: from there the others' views are least distorted."""
    off = {i: np.linalg.norm(frames[i].camera_px(features[i].places_px[k][None])) for i, k in track.items()}
    return min(off, key=lambda i: (off[i], i))


class _LocalMaps:
    """Affine maps about a feature from one frame to another, as the matches about it say."""

    def __init__(self, features: Sequence[Features], shared: Mapping[tuple[int, int], Indices]) -> None:
        self.features = features
        self.places: dict[tuple[int, int], tuple[Array, Array]] = {}
        for (i, j), pairs in shared.items():
            first, second = features[i].places_px[pairs[:, 0]], features[j].places_px[pairs[:, 1]]
            self.places[i, j], self.places[j, i] = (first, second), (second, first)
        self.trees = {pair: cKDTree(places[0]) for pair, places in self.places.items() if len(places[0])}

    def of(self, track: Track, reference: int) -> dict[int, Array]:
        """Maps (2, 3) by frame from a grid about the reference's feature."""
        middle = self.features[reference].places_px[track[reference]]
        maps = {reference: np.column_stack([np.eye(2), middle])}
        for frame, feature in sorted(track.items()):
            if frame != reference:
                linear = self._linear((reference, frame), middle)
                scales = np.linalg.svd(linear, compute_uv=False)
                if 1 / _STRETCH < scales[1] <= scales[0] < _STRETCH:
                    maps[frame] = np.column_stack([linear, self.features[frame].places_px[feature]])
        return maps

    def _linear(self, pair: tuple[int, int], place: Array) -> Array:
        """(2, 2) from the matches nearest to a place, held by those of the whole pair where they lie close together."""
        here, there = self.places[pair]
        near = np.atleast_1d(self.trees[pair].query(place, min(_NEIGHBOURS, len(here)))[1])
        whole = _affinity(here, there, np.zeros((2, 2)), 0.0)
        return _affinity(here[near], there[near], whole, (_PLACE_PX / _LOCAL) ** 2)


def _affinity(here: Array, there: Array, usual: Array, weight: float) -> Array:
    """(2, 2) affine part from places (n, 2) to places by least distances, a few of which may be false; with a weight
    on what it is usually."""
    weights = np.ones(len(here))
    for _ in range(_REWEIGHTINGS):
        a, b = (places - np.average(places, axis=0, weights=weights) for places in (here, there))
        normal = (a.T * weights) @ a + weight * np.eye(2)
        matrix = np.linalg.solve(normal, (a.T * weights) @ b + weight * usual.T).T
        weights = 1.0 / np.maximum(np.hypot(*(b - a @ matrix.T).T) / _PLACE_PX, 1.0)
    return np.asarray(matrix)


def _measured(
    frames: Sequence[TieFrame], candidates: Sequence[_Candidate], options: TieOptions, workers: Executor | None
) -> list[_Point]:
    """Candidates measured, batch by batch, until enough have come out well; none behind the last one wanted."""
    points: list[_Point] = []
    for first in range(0, len(candidates), options.wanted):
        chosen = candidates[first : first + options.wanted]
        windows = _windows(frames, chosen)
        points += _mapped(workers, partial(_point, options), list(zip(chosen, windows, strict=True)), _CHUNK)
        _judge(frames, points)
        good = np.cumsum([sum(map(_is_sharp, _sigmas(point))) >= options.images for point in points])
        if good[-1] >= options.wanted:
            return points[: int(np.searchsorted(good, options.wanted)) + 1]
    return points


def _windows(frames: Sequence[TieFrame], candidates: Sequence[_Candidate]) -> list[Windows]:
    """The windows of every candidate by frame, one scan after the other: no more than one is open at a time."""
    windows: list[Windows] = [{} for _ in candidates]
    for i, frame in enumerate(frames):
        with open_scan(frame.scan) as scan:
            own = [k for k, candidate in enumerate(candidates) if i in candidate.maps]
            for k in sorted(own, key=lambda k: candidates[k].maps[i][1, 2]):
                matrix = candidates[k].maps[i]
                half = int(np.ceil(RADIUS_PX * np.linalg.norm(matrix[:, :2], 2))) + SPARE_PX
                col0, row0 = (int(value) - half for value in np.round(matrix[:, 2]))
                windows[k][i] = (scan.window(col0, row0, 2 * half + 1, 2 * half + 1), (col0, row0))
    return windows


def _point(options: TieOptions, sought: tuple[_Candidate, Windows]) -> _Point:
    """The candidate measured; a frame that cannot be matched is left out where enough others remain."""
    candidate, windows = sought
    members, unmatched = sorted(candidate.maps), dict[int, str]()
    while True:
        pieces = [Piece(*windows[i], candidate.maps[i]) for i in members]
        matched = dict(zip(members, match_pieces(pieces, members.index(candidate.reference)), strict=True))
        failed = {i: piece.reason for i, piece in matched.items() if piece.reason}
        if not failed:
            return _Point(candidate, matched, unmatched)
        unmatched |= failed
        left = [i for i in members if i not in failed]
        if candidate.reference in failed or len(left) < options.images:
            alike = f"cannot be matched: {next(iter(failed.values()))} in another scan"
            return _Point(candidate, {}, {i: unmatched.get(i, alike) for i in candidate.maps})
        members = left


def _judge(frames: Sequence[TieFrame], points: Sequence[_Point]) -> None:
    """What speaks against the points, each compared with all others."""
    for point in points:
        point.refused = {
            frame: "parts of the picture about the point move unlike each other: it is no plane piece of ground"
            for frame in point.standing
            if point.matched[frame].unevenness < _CHANCE
        }
    _refuse_strange_pictures(points)
    _refuse_contradictions(frames, points)


def _refuse_strange_pictures(points: Sequence[_Point]) -> None:
    """Where a frame differs from the others' common picture as it does in hardly any other point of it."""
    strangeness: dict[int, list[tuple[_Point, float]]] = defaultdict(list)
    for point in points:
        for frame in point.standing:
            others = [point.matched[other].variance for other in point.standing if other != frame]
            if others:
                strangeness[frame].append((point, float(np.log(point.matched[frame].variance / np.mean(others)))))
    for frame, rows in strangeness.items():
        values = np.array([value for _, value in rows])
        limit = np.median(values) + float(norm.isf(_CHANCE)) * robust_scale(values)
        for point, value in rows:
            if value > limit:
                point.refused[frame] = "the picture about the point is unlike that in the other scans: something else"


def _refuse_contradictions(frames: Sequence[TieFrame], points: Sequence[_Point]) -> None:
    """Where a point lies off the epipolar geometry of two frames, unlike the points about it. It is then wrong in the
    frame that all its contradictions have in common, or, where it cannot be told, in all."""
    against: dict[int, list[set[int]]] = defaultdict(list)
    for i, j in combinations(range(len(frames)), 2):
        both = [k for k, point in enumerate(points) if i in point.standing and j in point.standing]
        first, second = (
            frames[frame].camera_px(np.array([points[k].matched[frame].center_px for k in both]).reshape(-1, 2))
            for frame in (i, j)
        )
        for k in np.array(both, dtype=int)[contradicting(first, second, _FINE_PX)]:
            against[int(k)].append({i, j})
    for k, pairs in against.items():
        common = set.intersection(*pairs)
        wrong = common if len(pairs) > 1 and len(common) == 1 else set(points[k].standing)
        for frame in wrong:
            points[k].refused[frame] = "the point lies off the epipolar lines of the other scans, unlike its neighbours"


def _sigmas(point: _Point) -> list[float]:
    """The largest standard deviation of each standing frame's point against the reference's, px."""
    return [float(np.sqrt(np.linalg.eigvalsh(point.separation(frame))[-1])) for frame in point.standing]


def _is_sharp(sigma_px: float) -> bool:
    """Whether the texture rules out an error that is no measurement any more."""
    return sigma_px * float(norm.isf(_CHANCE / 2)) <= _WRONG_PX


def _result(
    frames: Sequence[TieFrame],
    points: Sequence[_Point],
    candidates: Sequence[_Candidate],
    shared: Mapping[tuple[int, int], Indices],
    options: TieOptions,
) -> Ties:
    marks: dict[str, list[MarkMeasurement]] = {frame.image: [] for frame in frames}
    for number, point in enumerate(points, 1):
        for frame in point.candidate.maps:
            marks[frames[frame].image].append(_mark(f"tie{number:04d}", point, frame, options))
    found = sum(len(point.standing) >= options.images for point in points)
    return Ties(
        {image: tuple(own) for image, own in marks.items()}, _problems(frames, found, candidates, shared, options)
    )


def _mark(name: str, point: _Point, frame: int, options: TieOptions) -> MarkMeasurement:
    place = point.candidate.maps[frame][:, 2]
    if frame in point.unmatched:
        return MarkMeasurement(name, "tie", place, None, Status.REJECTED, point.unmatched[frame])
    piece = point.matched[frame]
    sigma = float(np.sqrt(np.linalg.eigvalsh(point.separation(frame))[-1]))
    quality = {
        "correlation": piece.correlation,
        "gain": piece.gain,
        "unevenness": piece.unevenness,
        "sigma_to_reference_px": sigma,
        "reference": float(frame == point.candidate.reference),
        "images": float(len(point.standing)),
        "size_px": 2.0 * RADIUS_PX + 1.0,
    }
    status, reason = Status.MEASURED, ""
    if frame in point.refused:
        status, reason = Status.REJECTED, point.refused[frame]
    elif len(point.standing) < options.images:
        status, reason = (
            Status.REJECTED,
            f"only {len(point.standing)} scans agree on the point, {options.images} are to",
        )
    elif not _is_sharp(sigma):
        status, reason = Status.WEAK, f"the texture fixes it to {sigma:.2f} px only"
    return MarkMeasurement(name, "tie", piece.center_px, piece.covariance_px2, status, reason, quality)


def _problems(
    frames: Sequence[TieFrame],
    found: int,
    candidates: Sequence[_Candidate],
    shared: Mapping[tuple[int, int], Indices],
    options: TieOptions,
) -> tuple[str, ...]:
    """A sentence where fewer points than wanted were found, with the reason."""
    if found >= options.wanted:
        return ()
    if not candidates:
        counts = ", ".join(
            f"{frames[i].image} and {frames[j].image} {len(pairs)}" for (i, j), pairs in sorted(shared.items())
        )
        return (
            f"No natural point was found: none is in {options.images} scans. Features that pairs of scans share, of "
            f"{FEWEST_PAIRS} at least: {counts or 'none'}. Overlapping photographs of one season would have some.",
        )
    return (
        f"Of {options.wanted} natural points wanted, {found} were found: {len(candidates)} features are in "
        f"{options.images} scans or more.",
    )

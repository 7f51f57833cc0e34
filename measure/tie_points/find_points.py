"""Tie points: natural points measured by multi-image matching and tested against each other.

Candidates are measured in batches of patches that do not overlap, until enough are precise. Each point is tested by its
own images and by comparison with all other points.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, combinations, compress

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri

from measure.array_types import Array, Mask
from measure.errors import MeasurementError
from measure.flags import NO_REASON, POINT_REFUSED, Code, Reason, Status
from measure.noise.robust_estimation import robust_scale
from measure.results import Covariance, MarkMeasurement, largest_sigma_px
from measure.scans.parallel import map_or_replace
from measure.tie_points.multi_image import RADIUS_PX, Bending, Matched, Piece, bending_variance, match_pieces
from measure.tie_points.tracks import (
    FEWEST_PAIRS,
    Features,
    Shared,
    TieCandidate,
    TieFrame,
    candidates_with_radius,
    epipolar_outliers,
    find_all_features,
    find_candidates,
    neighbour_outliers,
    read_pieces,
    unreachable,
    verify_pairs,
)

Pieces = dict[int, Piece | Reason]  # by frame; a reason where there is none

_RADII_PX = (RADIUS_PX, 21, 30)  # of patches: the next one, of twice the area, where the texture is too weak
Progress = Callable[[str, int, int], None]

_FEATURES = 25  # per scan and point wanted; about one in five is shared by all frames
_LEAST_FEATURES = 3000  # per scan: enough to verify the pairs of a small project
_NONE_HERE = "No natural points are sought here"
_LEAST_BATCH = 4  # smallest batch, one part in so many of the points wanted: each batch reads all scans
_FINE_PX = 1.0  # tolerance to the epipolar line, for lens distortion
_CHUNK = 16  # points per task of a worker
_OFF_LINES = Reason(
    "the point lies off the epipolar lines of the other scans, and its neighbours do not", Code.OTHER_SCANS
)
_UNLIKE_NEIGHBOURS = Reason(
    "the points about it map elsewhere from scan to scan: ground that repeats itself may have been mistaken",
    Code.OTHER_SCANS,
)
_UNEVEN = Reason("parts of the picture about the point move differently: its surface is not plane", Code.OTHER_SCANS)
_OTHER_PICTURE = Reason("the picture about the point differs from that in the other scans", Code.OTHER_SCANS)
_PRECISE_PX = 0.125  # largest rms position error of a `measured` point
_FEWEST_IMAGES = 3  # two frames cannot contradict each other along the line of sight


@dataclass(eq=False)
class TiePoint:
    """A measured candidate. matched, unmatched, refused: by frame, the fit or the reason against it."""

    candidate: TieCandidate
    matched: dict[int, Matched]
    unmatched: dict[int, Reason]
    refused: dict[int, Reason] = field(default_factory=dict)

    def separation(self, frame: int) -> Array:
        """(2, 2) covariance of the point in a frame relative to the reference frame, px²."""
        linear = self.matched[frame].scan_from_patch[:, :2]
        own, reference = self.matched[frame].covariance_px2, self.matched[self.candidate.reference].covariance_px2
        return np.asarray(own + linear @ reference @ linear.T)

    def error_px(self, frame: int) -> float:
        """Rms position error in a frame, relative to the reference frame."""
        return float(np.sqrt(np.trace(self.separation(frame))))

    def is_sharp(self, frame: int) -> bool:
        """Whether it is precise enough for the status `measured`."""
        return self.error_px(frame) <= _PRECISE_PX

    @property
    def accepted_frames(self) -> list[int]:
        """Frames in which it passed all tests."""
        return [frame for frame in self.matched if frame not in self.refused and frame not in self.unmatched]


def measure_points(
    frames: Sequence[TieFrame],
    sizes_px: Sequence[tuple[int, int]],
    candidates: Sequence[TieCandidate],
    wanted: int,
    fewest: int,
    workers: Executor | None,
) -> list[TiePoint]:
    """Measure candidates in their order until enough are precise in at least `fewest` scans.

    Patches never overlap, since the adjustment assumes uncorrelated errors. Where too few points are precise, the
    imprecise ones are measured again with larger patches. A candidate that overlaps an unmatched one is still tried;
    one that overlaps a point refused by comparison is not, since that point may pass once more points are known.

    Parameters
    ----------
    sizes_px : width and height of each scan.
    wanted : number of points.
    fewest : scans in which each must be precise.

    Returns
    -------
    The points, up to the last one wanted.
    """
    points, matched, sharp = list[TiePoint](), list[TiePoint](), np.zeros(0, dtype=bool)
    for radius_px in _RADII_PX:
        left = candidates_with_radius(candidates, radius_px, frames, sizes_px, fewest)
        if not left or sharp.sum() >= wanted:
            break
        settled = [bool(own or point.refused) and bool(point.matched) for own, point in zip(sharp, points, strict=True)]
        matched, points, sharp = list(compress(matched, settled)), list(compress(points, settled)), sharp[settled]
        while left and sharp.sum() < wanted:
            missing = max(wanted - int(sharp.sum()), wanted // _LEAST_BATCH)
            chosen, left = _select_disjoint(left, [point.candidate for point in matched if point.matched], missing)
            pieces_by_frame = _all_pieces(frames, chosen, workers)
            with_pieces = list(zip(chosen, pieces_by_frame, strict=True))
            matched += map_or_replace(workers, partial(_match_candidate, fewest), with_pieces, _lost_point, _CHUNK)
            points = _correct_bending(matched)
            _test_points(frames, points)
            sharp = np.array(
                [sum(map(point.is_sharp, point.accepted_frames)) >= fewest for point in points], dtype=bool
            )
    return points[: int(np.searchsorted(np.cumsum(sharp), wanted)) + 1]


def _select_disjoint(
    candidates: Sequence[TieCandidate], measured: Sequence[TieCandidate], most: int
) -> tuple[list[TieCandidate], list[TieCandidate]]:
    """Split candidates: the first ones whose patches overlap neither each other nor measured ones in any frame, and
    those that may be tried later."""
    overlapping = _overlapping([*measured, *candidates])
    taken, chosen = set(range(len(measured))), set[int]()
    near, left = list[TieCandidate](), list[TieCandidate]()
    for number, candidate in enumerate(candidates, len(measured)):
        if overlapping[number] & taken:
            continue
        if len(chosen) == most or overlapping[number] & chosen:
            left.append(candidate)
        else:
            chosen.add(number)
            near.append(candidate)
    return near, left


def _overlapping(candidates: Sequence[TieCandidate]) -> list[set[int]]:
    """Indices of the candidates that each one overlaps in some frame."""
    overlapping = [set[int]() for _ in candidates]
    for frame in set(chain.from_iterable(candidate.maps for candidate in candidates)):
        own = np.array([k for k, candidate in enumerate(candidates) if frame in candidate.maps])
        places = np.array([candidates[k].maps[frame][:, 2] for k in own])
        radii = np.array([candidates[k].radius_px for k in own])
        pairs = cKDTree(places).query_pairs(2.0 * radii.max(), output_type="ndarray")
        touching = np.hypot(*(places[pairs[:, 0]] - places[pairs[:, 1]]).T) < radii[pairs].sum(axis=1)
        for one, other in own[pairs[touching]].tolist():
            overlapping[one].add(other)
            overlapping[other].add(one)
    return overlapping


def _all_pieces(
    frames: Sequence[TieFrame], candidates: Sequence[TieCandidate], workers: Executor | None
) -> list[Pieces]:
    """Image pieces of every candidate by frame; each scan is opened once, by one worker."""
    pieces_by_frame: list[Pieces] = [{} for _ in candidates]
    shown = [[k for k, candidate in enumerate(candidates) if i in candidate.maps] for i in range(len(frames))]
    task = [
        (frame, [(candidates[k].maps[i], candidates[k].radius_px) for k in own])
        for i, (frame, own) in enumerate(zip(frames, shown, strict=True))
    ]
    for i, found in enumerate(map_or_replace(workers, _read_pieces, task, lambda _, why: unreachable(_NONE_HERE, why))):
        for number, k in enumerate(shown[i]):
            pieces_by_frame[k][i] = found if isinstance(found, Reason) else found[number]
    return pieces_by_frame


def _read_pieces(task: tuple[TieFrame, Sequence[tuple[Array, int]]]) -> list[Piece] | Reason:
    try:
        return read_pieces(*task)
    except MeasurementError as error:
        return unreachable(_NONE_HERE, str(error))


def _lost_point(task: tuple[TieCandidate, Pieces], why: str) -> TiePoint:
    return TiePoint(task[0], {}, {i: unreachable(_NONE_HERE, why) for i in task[0].maps})


def _match_candidate(fewest: int, task: tuple[TieCandidate, Pieces]) -> TiePoint:
    """Match a candidate; frames that cannot be matched are left out as long as enough others remain."""
    candidate, pieces_by_frame = task
    failed = {i: piece for i, piece in pieces_by_frame.items() if isinstance(piece, Reason)}
    shown = {i: piece for i, piece in pieces_by_frame.items() if not isinstance(piece, Reason)}
    members, unmatched = sorted(candidate.maps), dict[int, Reason]()
    while True:
        if not failed:
            pieces, reference = [shown[i] for i in members], members.index(candidate.reference)
            matched = dict(zip(members, match_pieces(pieces, reference, candidate.radius_px), strict=True))
            failed = {i: piece.reason for i, piece in matched.items() if piece.reason}
            if not failed:
                return TiePoint(candidate, matched, unmatched)
        unmatched |= failed
        left = [i for i in members if i not in failed]
        if candidate.reference in failed or len(left) < fewest:
            first = next(iter(failed.values()))
            alike = first.reword(f"cannot be matched: {first} in another scan")
            return TiePoint(candidate, {}, {i: unmatched.get(i, alike) for i in candidate.maps})
        members, failed = left, {}


def _correct_bending(points: Sequence[TiePoint]) -> list[TiePoint]:
    """Correct the points for the curvature of the ground, whose variance is estimated from all points."""
    known: dict[tuple[int, int], list[Bending]] = defaultdict(list)
    for point in points:
        for frame, piece in point.matched.items():
            if piece.bending is not None and piece.unevenness >= POINT_REFUSED:
                known[point.candidate.reference, frame].append(piece.bending)
    variances = {pair: bending_variance(bendings) for pair, bendings in known.items()}
    corrected = []
    for point in points:
        matched = dict(point.matched)
        for frame, piece in point.matched.items():
            if piece.bending is None:
                continue
            variance = variances.get((point.candidate.reference, frame), np.zeros((6, 6)))
            shift, covariance = piece.bending.estimated(variance)
            linear = piece.scan_from_patch[:, :2]
            matched[frame] = replace(
                piece,
                center_px=piece.center_px - linear @ shift,
                covariance_px2=piece.covariance_px2 + linear @ covariance @ linear.T,
            )
        corrected.append(replace(point, matched=matched, refused={}))
    return corrected


def _test_points(frames: Sequence[TieFrame], points: Sequence[TiePoint]) -> None:
    """Test each point against all others and note the reasons for refusal: uneven, of a picture that differs from the
    others unusually much for that frame, or contradicted by other frames."""
    strangeness: dict[int, list[tuple[TiePoint, float]]] = defaultdict(list)
    for point in points:
        point.refused = {
            frame: _UNEVEN for frame in point.accepted_frames if point.matched[frame].unevenness < POINT_REFUSED
        }
        for frame in point.accepted_frames:
            others = [point.matched[other].variance for other in point.accepted_frames if other != frame]
            if others:
                strangeness[frame].append((point, float(np.log(point.matched[frame].variance / np.mean(others)))))
    for frame, rows in strangeness.items():
        values = np.array([value for _, value in rows])
        limit = np.median(values) - float(ndtri(POINT_REFUSED)) * robust_scale(values)
        for point, value in rows:
            if value > limit:
                point.refused[frame] = _OTHER_PICTURE
    _refuse_contradictions(frames, points, partial(epipolar_outliers, tolerance=_FINE_PX), _OFF_LINES)
    _refuse_contradictions(frames, points, neighbour_outliers, _UNLIKE_NEIGHBOURS)


def _refuse_contradictions(
    frames: Sequence[TieFrame], points: Sequence[TiePoint], differ: Callable[[Array, Array], Mask], reason: Reason
) -> None:
    """Refuse points in which two frames contradict each other, unlike their neighbours.

    differ: returns the contradictory ones of points (n, 2) in two frames. The point is refused in the frame that all
    its contradictions share, or in all frames where there is none.
    """
    against: dict[int, list[set[int]]] = defaultdict(list)
    for i, j in combinations(range(len(frames)), 2):
        both = [k for k, point in enumerate(points) if i in point.accepted_frames and j in point.accepted_frames]
        first, second = (
            frames[frame].camera_px(np.array([points[k].matched[frame].center_px for k in both]).reshape(-1, 2))
            for frame in (i, j)
        )
        for k in np.array(both, dtype=int)[differ(first, second)]:
            against[int(k)].append({i, j})
    for k, pairs in against.items():
        common = set.intersection(*pairs)
        wrong = common if len(pairs) > 1 and len(common) == 1 else set(points[k].accepted_frames)
        for frame in wrong:
            points[k].refused[frame] = reason


@dataclass(frozen=True)
class TieOptions:
    """wanted: number of points; images: least number of scans that show each."""

    wanted: int = 300
    images: int = _FEWEST_IMAGES

    def __post_init__(self) -> None:
        if self.wanted < 1:
            raise ValueError(f"wanted is {self.wanted}; at least 1 is right")
        if self.images < _FEWEST_IMAGES:
            raise ValueError(f"images is {self.images}; at least {_FEWEST_IMAGES} is right: two prove nothing")


@dataclass(frozen=True, eq=False)
class Ties:
    """Tie points, or joins, by image, and problems by image, a sentence each; those of all scans stand with the first
    one."""

    marks: Mapping[str, tuple[MarkMeasurement, ...]]
    problems: Mapping[str, tuple[Reason, ...]]


def measure_ties(
    frames: Sequence[TieFrame],
    options: TieOptions | None = None,
    progress: Progress | None = None,
    workers: Executor | None = None,
) -> Ties:
    """Find and measure tie points.

    An unreadable scan, or one whose worker was killed, has no points and a problem that says why; image content never
    raises an error.

    Parameters
    ----------
    progress : called with the name of the step, the steps done and their number.
    workers : processes that share the work; the result does not depend on their number.
    """
    options, tell = options or TieOptions(), progress or (lambda *_: None)
    steps = len(frames) + 2
    readable, problems = list[tuple[TieFrame, Features]](), dict[str, tuple[Reason, ...]]()
    count = max(_FEATURES * options.wanted, _LEAST_FEATURES)
    found_all = find_all_features(frames, count, False, _NONE_HERE, workers)
    for done, (frame, features_or_reason) in enumerate(zip(frames, found_all, strict=True), 1):
        if isinstance(features_or_reason, Reason):
            problems[frame.image] = (features_or_reason,)
        else:
            readable.append((frame, features_or_reason))
        tell(frame.image, done, steps)
    frames, features = [frame for frame, _ in readable], [each for _, each in readable]
    shared = verify_pairs(frames, features, workers)
    tell("pairs of scans", steps - 1, steps)
    candidates = find_candidates(frames, features, shared, options.images)
    sizes_px = [each.size_px for each in features]
    points = measure_points(frames, sizes_px, candidates, options.wanted, options.images, workers)
    tell("all scans together", steps, steps)
    marks: dict[str, list[MarkMeasurement]] = {frame.image: [] for frame in frames}
    for number, point in enumerate(points, 1):
        for i in point.candidate.maps:
            marks[frames[i].image].append(_mark(f"tie{number:04d}", point, i, options))
    found = sum(len(point.accepted_frames) >= options.images for point in points)
    if frames and found < options.wanted:
        problems[frames[0].image] = (_few_points(frames, found, len(candidates), shared, options),)
    return Ties({image: tuple(own) for image, own in marks.items()}, problems)


def _mark(name: str, point: TiePoint, frame: int, options: TieOptions) -> MarkMeasurement:
    place = point.candidate.maps[frame][:, 2]
    if frame in point.unmatched:
        return MarkMeasurement(name, "tie", place, None, Status.REJECTED, point.unmatched[frame])
    piece = point.matched[frame]
    sigma = largest_sigma_px(point.separation(frame))
    quality = {
        "correlation": piece.correlation,
        "gain": piece.gain,
        "unevenness": piece.unevenness,
        "sigma_to_reference_px": sigma,
        "reference": float(frame == point.candidate.reference),
        "images": float(len(point.accepted_frames)),
        "size_px": 2.0 * point.candidate.radius_px + 1.0,
    }
    status, reason = Status.MEASURED, NO_REASON
    if frame in point.refused:
        status, reason = Status.REJECTED, point.refused[frame]
    elif len(point.accepted_frames) < options.images:
        message = f"only {len(point.accepted_frames)} scans agree on the point, {options.images} have to"
        status, reason = Status.REJECTED, Reason(message, Code.FEW_SCANS)
    elif not point.is_sharp(frame):
        message = f"the texture fixes it to {point.error_px(frame):.2f} px only"
        status, reason = Status.WEAK, Reason(message, Code.IMPRECISE)
    covariance = Covariance.from_noise(piece.covariance_px2)
    return MarkMeasurement(name, "tie", piece.center_px, covariance, status, reason, quality)


def _few_points(
    frames: Sequence[TieFrame], found: int, candidate_count: int, shared: Shared, options: TieOptions
) -> Reason:
    """Problem: fewer points than wanted were found."""
    message = (
        f"Of {options.wanted} natural points wanted, {found} were found: {candidate_count} features are in "
        f"{options.images} scans or more."
    )
    if not candidate_count:
        pairs = sorted(shared.items())
        counts = ", ".join(f"{frames[i].image} and {frames[j].image} {len(own)}" for (i, j), own in pairs)
        message = (
            f"No natural point was found: none is in {options.images} scans. Features that pairs of scans share, of "
            f"{FEWEST_PAIRS} at least: {counts or 'none'}. Overlapping photographs of one season would have some."
        )
    return Reason(message, Code.FEW_TIES)

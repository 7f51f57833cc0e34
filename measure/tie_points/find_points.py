"""Natural points: the same points of the terrain in three frames or more, without any target."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from measure.flags import NO_REASON, Code, Reason, Status
from measure.results import Covariance, MarkMeasurement
from measure.tie_points.features import Features, TieFrame
from measure.tie_points.measurement import TiePoint, measure_points
from measure.tie_points.tracks import Shared, find_all_features, find_candidates, verify_pairs
from measure.tie_points.verification import FEWEST_PAIRS

Progress = Callable[[str, int, int], None]

_FEWEST_IMAGES = 3  # two frames cannot contradict each other along the line of sight


@dataclass(frozen=True)
class TieOptions:
    """wanted: how many points. images: the fewest that must show a point."""

    wanted: int = 300
    images: int = _FEWEST_IMAGES

    def __post_init__(self) -> None:
        if self.wanted < 1:
            raise ValueError(f"wanted is {self.wanted}; at least 1 is right")
        if self.images < _FEWEST_IMAGES:
            raise ValueError(f"images is {self.images}; at least {_FEWEST_IMAGES} is right: two prove nothing")


@dataclass(frozen=True, eq=False)
class Ties:
    """The natural points by image, and by image what the user should know, a sentence each: of all scans together with
    the first of them."""

    marks: Mapping[str, tuple[MarkMeasurement, ...]]
    problems: Mapping[str, tuple[Reason, ...]]


def measure_ties(
    frames: Sequence[TieFrame],
    options: TieOptions | None = None,
    progress: Progress | None = None,
    workers: Executor | None = None,
) -> Ties:
    """Find and measure natural points. Raises nothing for what the pictures show, nor for a scan that cannot be read or
    whose worker is ended: that one has none, and a problem says why.

    progress: called with what has been done, the steps done and their number. workers: processes that share the work;
    the result does not depend on their number.
    """
    options, tell = options or TieOptions(), progress or (lambda *_: None)
    steps = len(frames) + 2
    readable, unreadable = list[tuple[TieFrame, Features]](), dict[str, tuple[Reason, ...]]()
    found = find_all_features(frames, options.wanted, workers)
    for done, (frame, features_or_reason) in enumerate(zip(frames, found, strict=True), 1):
        if isinstance(features_or_reason, Reason):
            unreadable[frame.image] = (features_or_reason,)
        else:
            readable.append((frame, features_or_reason))
        tell(frame.image, done, steps)
    frames, features = [frame for frame, _ in readable], [each for _, each in readable]
    shared = verify_pairs(frames, features, workers)
    tell("pairs of scans", len(unreadable) + len(frames) + 1, steps)
    candidates = find_candidates(frames, features, shared, options.images)
    sizes_px = [each.size_px for each in features]
    points = measure_points(frames, sizes_px, candidates, options.wanted, options.images, workers)
    tell("all scans together", steps, steps)
    found_all = _result(frames, points, len(candidates), shared, options)
    return replace(found_all, problems={**unreadable, **found_all.problems})


def _result(
    frames: Sequence[TieFrame],
    points: Sequence[TiePoint],
    candidate_count: int,
    shared: Shared,
    options: TieOptions,
) -> Ties:
    marks: dict[str, list[MarkMeasurement]] = {frame.image: [] for frame in frames}
    for number, point in enumerate(points, 1):
        for frame in point.candidate.maps:
            marks[frames[frame].image].append(_mark(f"tie{number:04d}", point, frame, options))
    found = sum(len(point.standing) >= options.images for point in points)
    problems = _problems(frames, found, candidate_count, shared, options)
    by_image = {frames[0].image: problems} if frames and problems else {}
    return Ties({image: tuple(own) for image, own in marks.items()}, by_image)


def _mark(name: str, point: TiePoint, frame: int, options: TieOptions) -> MarkMeasurement:
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
        "size_px": 2.0 * point.candidate.radius_px + 1.0,
    }
    status, reason = Status.MEASURED, NO_REASON
    if frame in point.refused:
        status, reason = Status.REJECTED, point.refused[frame]
    elif len(point.standing) < options.images:
        status, reason = (
            Status.REJECTED,
            Reason(f"only {len(point.standing)} scans agree on the point, {options.images} are to", Code.FEW_SCANS),
        )
    elif not point.is_sharp(frame):
        message = f"the texture fixes it to {point.error_px(frame):.2f} px only"
        status, reason = Status.WEAK, Reason(message, Code.IMPRECISE)
    covariance = Covariance.of_noise(piece.covariance_px2)
    return MarkMeasurement(name, "tie", piece.center_px, covariance, status, reason, quality)


def _problems(
    frames: Sequence[TieFrame],
    found: int,
    candidate_count: int,
    shared: Shared,
    options: TieOptions,
) -> tuple[Reason, ...]:
    """A sentence where fewer points than wanted were found, with the reason."""
    if found >= options.wanted:
        return ()
    if not candidate_count:
        counts = ", ".join(
            f"{frames[i].image} and {frames[j].image} {len(pairs)}" for (i, j), pairs in sorted(shared.items())
        )
        message = (
            f"No natural point was found: none is in {options.images} scans. Features that pairs of scans share, of "
            f"{FEWEST_PAIRS} at least: {counts or 'none'}. Overlapping photographs of one season would have some."
        )
    else:
        message = (
            f"Of {options.wanted} natural points wanted, {found} were found: {candidate_count} features are in "
            f"{options.images} scans or more."
        )
    return (Reason(message, Code.FEW_TIES),)

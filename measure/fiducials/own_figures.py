"""Test of sizes, rotations, blurs and cross arms of a camera's marks across its frames.

A cross of a réseau plate with one short arm looks covered in every frame. Deviations common to all frames belong to the
plate: with three or more frames a mark is tested against itself in the others, no longer against the other marks.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from measure.array_types import Array
from measure.fiducials.mark_comparison import blur_spread, mean_of_unlike, size_spread, unlike_blur, unlike_others
from measure.flags import FALSE_DOUBT, NO_REASON, Code, Reason, Status
from measure.results import FrameMeasurement, MarkMeasurement

_FEWEST = 3  # frames needed: of two, either may be the outlier
_NEAR = 3.0  # standard deviations from the median, within which frames agree
_SHORTEST = 0.1  # lower bound of ratios: an arm shorter than this counts as missing
_ARM, _SHAPE, _BLUR = "arm", "shape", "blur"
Key = tuple[str, str]  # a mark and its figure: size, turn, blur, arm1, arm2, ...


@dataclass(frozen=True, eq=False)
class OwnFigure:
    """Figure of a mark, estimated from the frames that agree: logarithm of a ratio, or rotation (rad).

    Attributes
    ----------
    value, sigma : mean and its standard deviation.
    off, off_sigma : (n,) deviation of each frame from the mean of the other agreeing ones, and its standard deviation.
    """

    value: float
    sigma: float
    off: Array
    off_sigma: Array

    @classmethod
    def from_frames(cls, values: Array, sigmas: Array, is_blur: bool) -> "OwnFigure | None":
        """Estimate the figure from its values (n,) in the frames. Returns None for fewer than three frames, or if no
        more than half of them agree."""
        spread_of = blur_spread if is_blur else size_spread
        near = _NEAR * np.hypot(sigmas, spread_of(0.0, 1))
        agrees = np.abs(values - np.median(values)) <= near
        if len(values) < _FEWEST or 2 * agrees.sum() <= len(values):
            return None
        value, sigma, spread = mean_of_unlike(values[agrees], sigmas[agrees], spread_of)
        weights = agrees / (sigmas**2 + spread**2)
        others = weights.sum() - weights
        off = values - (weights.sum() * value - weights * values) / others
        return cls(value, sigma, off, np.sqrt(1 / others + sigmas**2 + spread**2))


def own_figures(frames: Sequence[FrameMeasurement]) -> dict[Key, tuple[list[int], OwnFigure]]:
    """For each mark and figure on which enough frames agree: indices of the frames that contain it, and its
    estimate."""
    figures = defaultdict[Key, list[tuple[int, float, float]]](list)
    for place, frame in enumerate(frames):
        for key, (value, sigma) in _figures(frame).items():
            figures[key].append((place, value, sigma))
    pooled = {}
    for key, each in figures.items():
        places, values, sigmas = zip(*each, strict=True)
        own = OwnFigure.from_frames(np.array(values), np.array(sigmas), key[1] == _BLUR)
        if own is not None:
            pooled[key] = list(places), own
    return pooled


def _figures(frame: FrameMeasurement) -> dict[Key, tuple[float, float]]:
    """Figures of the marks of a frame and their standard deviations. Rotations are those of an unmirrored scan. Arms
    are relative to the median of the frame, since exposure makes all of them longer or shorter."""
    mirrored = -1.0 if frame.pose and frame.pose.name.endswith("m") else 1.0
    figures: dict[Key, tuple[float, float]] = {}
    for mark in frame.marks:
        if mark.status.is_observation:
            own = {name: value for name, value in mark.quality.items() if name.endswith("_ratio")}
            if "arm1_ratio" in own:
                del own["size_ratio"]
            for name, ratio in own.items():
                kind = name.removesuffix("_ratio")
                figures[mark.point, kind] = float(np.log(max(ratio, _SHORTEST))), mark.quality[f"{kind}_sigma"]
            if "turn_rad" in mark.quality:
                figures[mark.point, "turn"] = mirrored * mark.quality["turn_rad"], mark.quality["turn_sigma"]
    arms = [key for key in figures if key[1].startswith(_ARM)]
    usual = float(np.median([figures[key][0] for key in arms])) if arms else 0.0
    return figures | {key: (figures[key][0] - usual, figures[key][1]) for key in arms}


def check_own_figures(frames: Sequence[FrameMeasurement]) -> list[FrameMeasurement]:
    """Set marks to weak whose figures differ in one frame only, and back to measured where all frames share the
    deviation."""
    figures = own_figures(frames)
    tests = sum(len(places) for places, _ in figures.values())
    findings: list[dict[str, dict[str, Reason]]] = [defaultdict(dict) for _ in frames]
    arms = defaultdict[str, list[float]](list)
    for (point, kind), (places, own) in figures.items():
        p_values = 2 * ndtr(-np.abs(own.off / own.off_sigma)) * tests
        speaks_for = _BLUR if kind == _BLUR else _SHAPE
        arms[point] += [own.value] if kind.startswith(_ARM) else []
        for place, off, p_value in zip(places, own.off.tolist(), p_values.tolist(), strict=True):
            finding, reason = findings[place][point], _unlike_frames(kind, off) if p_value < FALSE_DOUBT else NO_REASON
            finding[speaks_for] = finding.get(speaks_for) or reason
    return [
        replace(
            frame, marks=tuple(_assess_mark(mark, found.get(mark.point, {}), arms[mark.point]) for mark in frame.marks)
        )
        for frame, found in zip(frames, findings, strict=True)
    ]


def _unlike_frames(kind: str, off: float) -> Reason:
    """Reason why a mark is weak: the figure differs from that in the other frames."""
    there, covered = "in the camera's other frames", "something may cover or touch it"
    if kind == _BLUR:
        return Reason(f"its blur is {np.exp(off):.2f} times that {there}", Code.BLUR)
    if kind == "turn":
        figure = f"it is turned by {np.degrees(off):.1f} degrees against what it is {there}"
    else:
        long = "it is {:.2f} times as large as" if kind == "size" else "one of its arms is {:.2f} times as long as"
        figure = f"{long.format(np.exp(off))} {there}"
    return Reason(f"{figure}: {covered}", Code.SIZE, Code.COVERED)


def _assess_mark(mark: MarkMeasurement, findings: Mapping[str, Reason], arms: Sequence[float]) -> MarkMeasurement:
    """Update the status of a mark. findings: reason why shape or blur differ from the other frames, empty if they
    agree; arms: log lengths of the arms on the plate, which explain the size of a cross within their range."""
    quality, unlike = mark.quality, findings.get(_SHAPE, NO_REASON)
    if unlike and Code.SIZE not in mark.reason.codes:
        return replace(mark, status=Status.WEAK, reason=Reason.combine((mark.reason, unlike)))
    settled = set[str]()
    if not findings.get(_BLUR, True):
        settled.add(unlike_blur(quality["blur_ratio"]))
    if not findings.get(_SHAPE, True) and _explains(arms, quality):
        settled.add(unlike_others(quality["size_ratio"], quality.get("turn_rad")))
    is_settled = mark.status is Status.WEAK and settled.issuperset(mark.reason.split("; "))
    return replace(mark, status=Status.MEASURED, reason=NO_REASON) if is_settled else mark


def _explains(arms: Sequence[float], quality: Mapping[str, float]) -> bool:
    """Whether the arms of a cross, if it has any, explain its size: a match yields a size between those of its arms."""
    size = float(np.log(quality["size_ratio"]))
    near = _NEAR * float(np.hypot(quality["size_sigma"], size_spread(0.0, 1)))
    return not arms or min(arms) - near <= size <= max(arms) + near

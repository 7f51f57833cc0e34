"""Arms of crosses, sizes, turns and blurs of a camera's marks by all of its frames.

A cross of a réseau plate one arm of which is short looks covered in every frame. What is alike in all frames is the
plate's: from three frames on a mark is tested against what it is in the others, and no longer against the other marks.
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

_FEWEST = 3  # frames: of two nobody knows which is as the plate is
_NEAR = 3.0  # standard deviations from the median, within which frames agree
_SHORTEST = 0.1  # of an arm: what is shorter is as good as gone
_ARM, _SHAPE, _BLUR = "arm", "shape", "blur"
Key = tuple[str, str]  # a mark and its figure: size, turn, blur, arm1, arm2, ...


@dataclass(frozen=True, eq=False)
class OwnFigure:
    """A figure of a mark by the frames that agree: a logarithm of a ratio, or its turn (rad).

    value, sigma: mean and its standard deviation. off (n,): of each frame from the mean of the others that agree, and
    off_sigma (n,), its standard deviation.
    """

    value: float
    sigma: float
    off: Array
    off_sigma: Array

    @classmethod
    def from_frames(cls, values: Array, sigmas: Array, is_blur: bool) -> "OwnFigure | None":
        """From the figures (n,) of a mark in the frames; None of fewer than three, or where no more than half of them
        agree."""
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
    """Of each mark and figure, where enough frames agree: the frames that tell it, by index, and what they tell."""
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
    """Of its marks, with standard deviations, as a scan that is not mirrored shows them; arms beside those of the whole
    frame, which exposure makes longer or shorter."""
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
    """The frames of a camera, with marks weak that have another size, arm or turn in one of them only, and without the
    doubt of those that have it in all."""
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
    """Why a mark differs from what it is in the other frames."""
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
    """The mark with what the other frames say; findings: why shape and blur are not as there, empty where they are;
    arms: of its plate, which explain the size of a cross if one of them has it."""
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
    """Whether the arms of a plate's cross, if it has any, explain its size: a match takes that of some of them."""
    size = float(np.log(quality["size_ratio"]))
    near = _NEAR * float(np.hypot(quality["size_sigma"], size_spread(0.0, 1)))
    return not arms or min(arms) - near <= size <= max(arms) + near

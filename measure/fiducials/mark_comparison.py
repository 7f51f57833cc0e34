"""Comparison of each mark with the others in blur, size and rotation, in a frame and across a camera's frames.

Lens and scanner make the blur of a frame's marks uniform; marks of one drawing have size and rotation in common. A
faint mark is matched with the blur of the others as an observation, since noise may make its edges look sharp; a speck
that covers part of a dot changes its apparent size. A cross of a réseau plate with one short arm looks covered in every
frame: with three or more frames a mark is tested against itself in the others, no longer against the other marks.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from measure.array_types import Array
from measure.flags import FALSE_DOUBT, MARK_UNLIKE_THE_OTHERS, NO_REASON, Code, Reason, Status
from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.results import FrameMeasurement, MarkFit, MarkMeasurement

# Standard deviation of a figure from mark to mark: from the variance between marks in excess of their own variances,
# and the number of marks.
_Spread = Callable[[float, int], float]

_FEWEST_BLURS = 3  # other marks needed to estimate their scatter in blur
_FEWEST_SHAPES = 2  # other marks needed: the scatter in size has a prior, but of two marks either may be the outlier
_BLUR_SPREAD = 0.05  # standard deviation of the logarithm of the blur within an image
_TELLING = 0.05  # standard deviation of the log blur up to which that of the place is wrong by no more than this share
# Exposure scatters the marks of a frame in the logarithm of their size and, since the edges are uneven, in rotation.
# Prior standard deviation, with the weight of two marks. In three frames of ring-crosses it was 0.005 to 0.008, in four
# of a réseau 0.014 to 0.021: this is their root mean square.
_SIZE_SPREAD, _BEFORE = 0.014, 2
# Prior probability that something touches a mark on one side, without and with damaged pixels cut out next to it.
_WHOLE, _DAMAGED = 0.01, 0.03
# Specks do not depend on the size of the mark: rms displacement of the mean outline of a touched round mark,
# multiplied by its radius. Five touched dots of 0.15 mm had it displaced by 8 um.
_SPECK_MM2 = 0.00125
_TOUCHED_PX = 0.3  # rms displacement of the edges of wedges and notches that the background touches
# A local displacement of an outline shifts the centre by twice as much as it changes the mean radius.
_AS_MUCH = 2.0
_FEWEST_FRAMES = 3  # needed: of two, either may be the outlier
_NEAR = 3.0  # standard deviations from the median, within which frames agree
_WIDTH_SIGMA = 0.15  # standard deviation of the logarithm of the width of a frame's lines over the drawn one
_LEAST_WIDTH, _LONGEST_WIDTH = 0.03, 0.2  # of the same: a smaller change is ignored, a larger one is not linear
_SHORTEST = 0.1  # lower bound of ratios: an arm shorter than this counts as missing
_ARM, _SHAPE, _BLUR = "arm", "shape", "blur"
Key = tuple[str, str]  # a mark and its figure: size, turn, blur, arm1, arm2, ...


@dataclass(frozen=True)
class SharedBlur:
    """Blur of a mark predicted from the other marks.

    blur_px; sigma: standard deviation of the logarithm of the total blur, pixel included; differs: whether the mark's
    own blur differs significantly, or else is only poorly determined.
    """

    blur_px: float
    sigma: float
    differs: bool

    def is_confirmed(self, fit: MarkFit) -> bool:
        """Whether a match with this blur as an observation agrees with it. Noise shifts the estimate from the
        observation by the square root of the reduction in variance."""
        moved = _log_total_px(fit.blur_px) - _log_total_px(self.blur_px)
        off = abs(moved) / np.sqrt(max(self.sigma**2 - fit.blur_sigma**2, 1e-12))
        return bool(fit.blur_sigma < self.sigma and 2 * ndtr(-off) >= MARK_UNLIKE_THE_OTHERS)


def shared_blurs(fits: Sequence[MarkFit]) -> list[SharedBlur | None]:
    """Predict the blur of each mark from the others. None if these are too few, or if the mark's own blur is well
    determined and agrees with theirs."""
    own = np.array([_log_total_px(fit.blur_px) for fit in fits])
    sigma = np.array([fit.blur_sigma for fit in fits])
    expected_blurs = _expect_from_others(own, sigma, blur_spread, _FEWEST_BLURS)
    return [
        None
        if expected is None or not (expected.differs or own_sigma > _TELLING)
        else SharedBlur(_remove_pixel(expected.value), expected.sigma, expected.differs)
        for expected, own_sigma in zip(expected_blurs, sigma.tolist(), strict=True)
    ]


@dataclass(frozen=True, eq=False)
class SharedShape:
    """Shape of a mark relative to the others.

    off: (k,) difference in the logarithm of its size, and in its rotation (rad) if the frame gave it; sigma: (k,) their
    standard deviations; differs: whether the mark is an outlier.
    """

    off: Array
    sigma: Array
    differs: bool

    def touched(self, spread: float, is_damaged: bool) -> float:
        """Posterior probability that something touches the mark on one side, less the prior one. spread: standard
        deviation of the figures of touched marks; is_damaged: whether damaged pixels were cut out next to it."""
        share = _DAMAGED if is_damaged else _WHOLE
        touched = share * _density(self.off, np.hypot(self.sigma, spread))
        untouched = (1 - share) * _density(self.off, self.sigma)
        return max(touched / max(touched + untouched, 1e-300) - share, 0.0)


def shared_line_width(widths: Sequence[tuple[float, float] | None]) -> float:
    """Ratio of the width of the lines of crosses of one drawing to the drawn width; 1 if not significant.

    widths: logarithm of each cross's own ratio and its standard deviation; None where the blur explains its lines.
    """
    found = [width for width in widths if width is not None]
    if len(found) < max(_FEWEST_BLURS, len(widths) / 2):
        return 1.0
    values, sigmas = np.array(found).T
    off = np.abs(values - np.median(values))
    near = off <= _NEAR * np.hypot(sigmas, np.median(off))
    mean, sigma, _ = mean_of_unlike(values[near], sigmas[near], size_spread)
    known = float(mean / (1 + (sigma / _WIDTH_SIGMA) ** 2))
    is_clear = abs(known) > max(_NEAR * sigma, _LEAST_WIDTH)
    return float(np.exp(np.clip(known, -_LONGEST_WIDTH, _LONGEST_WIDTH))) if is_clear else 1.0


def unlike_others(size_ratio: float, turn_rad: float | None) -> Reason:
    """Reason why a mark is weak: its size, or also its rotation where the frame gave it, differs from the others."""
    larger = f"{size_ratio:.2f} times as large as the other marks"
    if turn_rad is None:
        figure = f"it is {larger}"
    else:
        figure = f"its edges make it {larger}, and turned by {np.degrees(turn_rad):.1f} degrees"
    return Reason(f"{figure}: something may cover or touch it", Code.SIZE, Code.COVERED)


def unlike_blur(ratio: float) -> Reason:
    """Reason why a mark is weak: its blur differs from the others."""
    return Reason(f"its blur is {ratio:.2f} times that of the other marks", Code.BLUR)


def _density(off: Array, sigma: Array) -> float:
    """Density of independent normal deviations."""
    return float(np.prod(np.exp(-0.5 * (off / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)))


@dataclass(frozen=True)
class Touch:
    """Possible contact of a mark with another object: its probability, and the displacement it causes, normally
    distributed (px)."""

    probability: float
    moved_px: float
    sigma_px: float

    @property
    def variance_px2(self) -> float:
        """Variance of a coordinate, for a displacement in an unknown direction."""
        return self.probability * (self.moved_px**2 + self.sigma_px**2) / 2

    def exceedance(self, px: float) -> float:
        """Probability of a displacement larger than px."""
        ends = (np.array([self.moved_px, -self.moved_px]) - px) / max(self.sigma_px, 1e-12)
        return self.probability * float(ndtr(ends).sum())


def touch_of_round(shape: SharedShape, radius_px: float, px_per_mm: float, is_damaged: bool) -> Touch:
    """Estimate the displacement of a round mark from its size."""
    spread = _SPECK_MM2 * px_per_mm**2 / radius_px**2
    prior, measured = spread**2, float(shape.sigma[0]) ** 2
    moved = _AS_MUCH * radius_px * abs(float(shape.off[0])) * prior / (prior + measured)
    sigma = _AS_MUCH * radius_px * float(np.sqrt(prior * measured / (prior + measured)))
    return Touch(shape.touched(spread, is_damaged), moved, sigma)


def touch_of_edges(shape: SharedShape, on_place: Array, middle_px: float, is_damaged: bool) -> Touch:
    """Estimate the displacement of a wedge or notch from its own scale and rotation.

    on_place: (2, k) derivatives of the place with respect to these; middle_px: mean distance of the edges from the
    measured point.
    """
    return Touch(shape.touched(_TOUCHED_PX / middle_px, is_damaged), float(np.hypot(*(on_place @ shape.off))), 0.0)


def shared_shapes(own: Array, sigma: Array) -> list[SharedShape | None]:
    """Compare the shapes of marks of one drawing, or of all marks held by the frame.

    Parameters
    ----------
    own, sigma : (n, k) logarithm of the size of each mark, and its rotation (rad) if the frame gave it, and their
        standard deviations, inf where not estimated.

    Returns
    -------
    Shape of each mark relative to the others, None where these are too few.
    """
    columns = [_expect_from_sound(*pair) for pair in zip(own.T, sigma.T, strict=True)]
    result: list[SharedShape | None] = []
    for figures, sigmas, each in zip(own, sigma, zip(*columns, strict=True), strict=True):
        expected = [one for one in each if one is not None]
        if len(expected) < len(figures):
            result.append(None)
            continue
        off = figures - [one.value for one in expected]
        off_sigma = np.hypot(sigmas, [one.sigma for one in expected])
        result.append(SharedShape(off, off_sigma, any(one.differs for one in expected)))
    return result


def _expect_from_sound(own: Array, sigma: Array) -> "list[_Expected | None]":
    """Predict one figure of each mark's shape from the others, without outliers if enough marks remain."""
    every = _expect_from_others(own, sigma, size_spread, _FEWEST_SHAPES)
    odd = np.array([each is not None and each.differs for each in every])
    sound = _expect_from_others(own, np.where(odd, np.inf, sigma), size_spread, _FEWEST_SHAPES)
    return [first if is_odd else again or first for first, again, is_odd in zip(every, sound, odd, strict=True)]


def blur_spread(shown: float, marks: int) -> float:
    """Standard deviation of the log blur from mark to mark. shown: observed variance in excess of the marks' own."""
    return float(np.hypot(np.sqrt(shown), _BLUR_SPREAD))


def size_spread(shown: float, marks: int) -> float:
    """Standard deviation of log size or rotation from mark to mark, combined with the prior. shown: variance that the
    marks show in excess of their own."""
    return float(np.sqrt((_BEFORE * _SIZE_SPREAD**2 + (marks - 1) * shown) / (_BEFORE + marks - 1)))


def _log_total_px(blur_px: float) -> float:
    """Logarithm of the total blur, pixel included."""
    return float(np.log(blur_px**2 + PIXEL_VARIANCE_PX2) / 2)


def _remove_pixel(log_seen_px: float) -> float:
    return float(np.sqrt(max(np.exp(2 * log_seen_px) - PIXEL_VARIANCE_PX2, 0.0)))


@dataclass(frozen=True)
class _Expected:
    """Figure predicted from the other marks. sigma: standard deviation of the prediction for one more mark; differs:
    whether the mark's own figure differs significantly."""

    value: float
    sigma: float
    differs: bool


def _expect_from_others(own: Array, sigma: Array, spread: _Spread, fewest: int) -> "list[_Expected | None]":
    """Predict figures (n,) from at least so many others. sigma (n,): inf where not estimated."""
    result: list[_Expected | None] = []
    for index in range(len(own)):
        others = np.isfinite(sigma) & (np.arange(len(own)) != index)
        if others.sum() < fewest:
            result.append(None)
            continue
        mean, mean_sigma, apart = mean_of_unlike(own[others], sigma[others], spread)
        predicted = float(np.hypot(mean_sigma, apart))
        off = abs(own[index] - mean) / np.hypot(predicted, sigma[index])
        result.append(_Expected(mean, predicted, bool(2 * ndtr(-off) * len(own) < MARK_UNLIKE_THE_OTHERS)))
    return result


def mean_of_unlike(values: Array, sigma: Array, spread: _Spread) -> tuple[float, float, float]:
    """Random-effects mean of values that scatter by more than their standard deviations.

    Returns
    -------
    Weighted mean, its standard deviation, and the standard deviation between the values, as spread gives it.

    Notes
    -----
    The variance between the values is the moment estimator of DerSimonian and Laird (1986).
    """
    weights = 1 / sigma**2
    rest = values - weights @ values / weights.sum()
    exceedance = weights @ rest**2 - (len(values) - 1)
    between = max(exceedance / (weights.sum() - (weights**2).sum() / weights.sum()), 0.0)
    apart = spread(float(between), len(values))
    weights = 1 / (sigma**2 + apart**2)
    return float(weights @ values / weights.sum()), float(1 / np.sqrt(weights.sum())), apart


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
        if len(values) < _FEWEST_FRAMES or 2 * agrees.sum() <= len(values):
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
    """Figures of a frame's marks, as in an unmirrored scan and with arms relative to the frame's, and their sigmas."""
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
    """Update the status of a mark. findings: reasons by kind, empty if frames agree; arms: log lengths on the plate."""
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

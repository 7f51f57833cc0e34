"""Comparison of each mark with the others in blur, size and rotation, in a frame and across a camera's frames.

Lens and scanner make the blur of a frame's marks uniform; marks of one drawing have size and rotation in common. A
faint mark is matched with the blur of the others as an observation, since noise may make its edges look sharp; a speck
that covers part of a dot changes its apparent size. A cross of a réseau plate with short arms looks covered in every
frame: with three or more frames a mark is tested against itself in the others, no longer against the other marks.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from measure.array_types import Array, Mask
from measure.flags import FALSE_DOUBT, MARK_UNLIKE_THE_OTHERS, NO_REASON, Cause, Code, Reason, Status
from measure.marks.rendering import render
from measure.marks.shapes import Bar, Disk, MarkShape, Part, Ring
from measure.matching.models import PIXEL_VARIANCE_PX2, background_planes
from measure.matching.window import ScanWindow
from measure.noise.noise_model import covariance_along, may_be_noise
from measure.results import FrameMeasurement, MarkFit, MarkMeasurement

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
# A local displacement of an outline shifts the centre by twice as much as it changes the mean radius.
_AS_MUCH = 2.0
_FEWEST_FRAMES = 3  # needed: of two, either may be the outlier
_NEAR = 3.0  # standard deviations from the median, within which frames agree
_WIDTH_SIGMA = 0.15  # standard deviation of the logarithm of the width of a frame's lines over the drawn one
_LEAST_WIDTH, _LONGEST_WIDTH = 0.03, 0.2  # of the same: a smaller change is ignored, a larger one is not linear
_LEAST_GAIN = 0.1  # fraction of the fitted contrast: a smaller gain is replaced by it
_PART_STEPS, _SETTLED_PX = 12, 0.01  # steps of parts; the last one
_PARTS_APART_PX = 0.5  # an error that a mark with status measured must not have
_SHAPE, _BLUR = "shape", "blur"


def blur_spread(shown: Array, marks: Array) -> Array:
    """Standard deviation of the log blur from mark to mark. shown: observed variance in excess of the marks' own."""
    return np.sqrt(shown + _BLUR_SPREAD**2)


def size_spread(shown: Array, marks: Array) -> Array:
    """Standard deviation of log size or rotation from mark to mark, combined with the prior. shown: variance that the
    marks show in excess of their own; marks: their number."""
    return np.asarray(np.sqrt((_BEFORE * _SIZE_SPREAD**2 + (marks - 1) * shown) / (_BEFORE + marks - 1)))


_Spread = Callable[[Array, Array], Array]


def mean_of_unlike(values: Array, sigmas: Array, among: Mask, spread: _Spread) -> tuple[Array, Array, Array]:
    """Random-effects means of values that scatter by more than their standard deviations.

    Parameters
    ----------
    values, sigmas : (n,)
    among : (..., n) the values, two or more, of each mean.
    spread : standard deviation between the values from their variance in excess of their own, and their number.

    Returns
    -------
    Weighted means (...), their standard deviations, and the standard deviations between the values.

    Notes
    -----
    The variance between the values is the moment estimator of DerSimonian and Laird (1986).
    """
    weights, count = among / sigmas**2, among.sum(axis=-1)
    total = weights.sum(axis=-1)
    rest = values - (weights @ values / total)[..., None]
    excess = (weights * rest**2).sum(axis=-1) - (count - 1)
    apart = spread(np.maximum(excess / (total - (weights**2).sum(axis=-1) / total), 0.0), count)
    weights = among / (sigmas**2 + apart[..., None] ** 2)
    total = weights.sum(axis=-1)
    return weights @ values / total, 1 / np.sqrt(total), apart


@dataclass(frozen=True, eq=False)
class _Expected:
    """Figures (n,) predicted from the other marks, nan where these are too few. sigma: standard deviations of the
    predictions for one more mark; off: deviations from them; differs: whether these are significant."""

    value: Array
    sigma: Array
    off: Array
    differs: Mask

    @classmethod
    def from_others(cls, own: Array, sigmas: Array, spread: _Spread, fewest: int) -> "_Expected":
        """Predict figures from at least so many others. sigmas (n,): inf where not estimated."""
        among = np.isfinite(sigmas) & ~np.eye(len(own), dtype=bool)
        enough = among.sum(axis=1) >= fewest
        value, sigma = np.full((2, len(own)), np.nan)
        value[enough], mean_sigma, apart = mean_of_unlike(own, sigmas, among[enough], spread)
        sigma[enough] = np.hypot(mean_sigma, apart)
        p_values = 2 * ndtr(-np.abs(own - value) / np.hypot(sigma, sigmas)) * len(own)
        return cls(value, sigma, own - value, p_values < MARK_UNLIKE_THE_OTHERS)


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


def smear_px2(blur_px: float, usual_px: float) -> Array:
    """(2, 2) variance by which something smears a mark of a blur beyond the usual one; 0 for a sharper mark.

    A second exposure beside the first, say: each lies as far from the mean of both as the smear is wide.
    """
    return np.asarray(max(blur_px**2 - usual_px**2, 0.0) * np.eye(2))


def shared_blurs(fits: Sequence[MarkFit]) -> list[SharedBlur | None]:
    """Predict the blur of each mark from the others. None if these are too few, or if the mark's own blur is well
    determined and agrees with theirs."""
    own = np.array([_log_total_px(fit.blur_px) for fit in fits])
    sigmas = np.array([fit.blur_sigma for fit in fits])
    found = _Expected.from_others(own, sigmas, blur_spread, _FEWEST_BLURS)
    needed = ~np.isnan(found.value) & (found.differs | (sigmas > _TELLING))
    blurs_px = np.sqrt(np.maximum(np.exp(2 * found.value) - PIXEL_VARIANCE_PX2, 0.0))
    blurs = map(SharedBlur, blurs_px.tolist(), found.sigma.tolist(), found.differs.tolist())
    return [blur if is_needed else None for blur, is_needed in zip(blurs, needed, strict=True)]


def _log_total_px(blur_px: float) -> float:
    """Logarithm of the total blur, pixel included."""
    return float(np.log(blur_px**2 + PIXEL_VARIANCE_PX2) / 2)


def shared_line_width(widths: Sequence[tuple[float, float] | None]) -> float:
    """Ratio of the width of the lines of crosses of one drawing to the drawn width; 1 if not significant.

    widths: logarithm of each cross's own ratio and its standard deviation; None where the blur explains its lines.
    """
    found = [width for width in widths if width is not None]
    if len(found) < max(_FEWEST_BLURS, len(widths) / 2):
        return 1.0
    values, sigmas = np.array(found).T
    off = np.abs(values - np.median(values))
    mean, sigma, _ = mean_of_unlike(values, sigmas, off <= _NEAR * np.hypot(sigmas, np.median(off)), size_spread)
    known = float(mean / (1 + (sigma / _WIDTH_SIGMA) ** 2))
    is_clear = abs(known) > max(_NEAR * float(sigma), _LEAST_WIDTH)
    return float(np.exp(np.clip(known, -_LONGEST_WIDTH, _LONGEST_WIDTH))) if is_clear else 1.0


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


def _density(off: Array, sigma: Array) -> float:
    """Density of independent normal deviations."""
    return float(np.prod(np.exp(-0.5 * (off / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)))


def shared_shapes(own: Array, sigmas: Array) -> list[SharedShape | None]:
    """Compare the shapes of marks of one drawing, or of all marks held by the frame.

    Parameters
    ----------
    own, sigmas : (n, k) logarithm of the size of each mark, and its rotation (rad) if the frame gave it, and their
        standard deviations, inf where not estimated.

    Returns
    -------
    Shape of each mark relative to the others, None where these are too few.
    """
    off, off_sigma, differs = np.zeros(own.shape), np.zeros(own.shape), np.zeros(own.shape, dtype=bool)
    for column, (values, sigma) in enumerate(zip(own.T, sigmas.T, strict=True)):
        every = _Expected.from_others(values, sigma, size_spread, _FEWEST_SHAPES)
        sound = _Expected.from_others(values, np.where(every.differs, np.inf, sigma), size_spread, _FEWEST_SHAPES)
        # Outliers do not count where enough marks remain.
        by_all = every.differs | np.isnan(sound.value)
        off[:, column] = np.where(by_all, every.off, sound.off)
        off_sigma[:, column] = np.hypot(sigma, np.where(by_all, every.sigma, sound.sigma))
        differs[:, column] = np.where(by_all, every.differs, sound.differs)
    shapes = map(SharedShape, off, off_sigma, map(any, differs.tolist()))
    return [None if np.isnan(shape.off).any() else shape for shape in shapes]


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


def measure_parts(
    window: ScanWindow, mark: MarkShape, pixel_from_mark: Array, fit: MarkFit
) -> tuple[Array, Array] | None:
    """Fit the places of a drawing's lines, and of its rings and disks, separately, by Gauss-Newton steps.

    Contrast and ground are eliminated in each step, and the first decides whether there are more: not by the driver.

    Parameters
    ----------
    window : window with the mark.
    pixel_from_mark : (2, 3) in pixels of the scan: the matched place, and the linear part of the frame.

    Returns
    -------
    (2, 2) offsets (px) of both from the matched place, and the covariance (2, 2) of their difference; None where the
    first step finds them where they are drawn.
    """
    groups = lines_and_rounds(mark)
    place = pixel_from_mark - np.column_stack([np.zeros((2, 2)), window.origin_px])
    (height, width), used = window.grey.shape, window.usable & (window.ends == 0)
    planes, grey, offsets = background_planes(height, width), window.grey[used], np.zeros((2, 2))
    for number in range(_PART_STEPS):
        first, second = (
            _cover(replace(mark, parts=parts), np.column_stack([place[:, :2], place[:, 2] + off]), width, height, fit)
            for parts, off in zip(groups, offsets, strict=True)
        )
        # Both together cover what either covers.
        moves = [first[1:] * (second[0] - 1), second[1:] * (first[0] - 1)]
        design = np.concatenate([*moves, (1 - (1 - first[0]) * (1 - second[0]))[None], planes])[:, used]
        inverse: Array = np.asarray(np.linalg.pinv(design @ design.T), float)
        solution = inverse @ (design @ grey)
        gain, left = solution[4], np.zeros(used.shape)
        if abs(gain) < _LEAST_GAIN * abs(fit.contrast_dn):
            return None
        step, left[used] = (solution[:4] / gain).reshape(2, 2), grey - solution @ design
        offsets = offsets + step / max(float(np.hypot(*step.T).max()), 1.0)
        variance = float(np.sum(left**2)) / max(used.sum() - len(design), 1)
        among = variance / gain**2 * inverse[:4, :4].reshape(2, 2, 2, 2)
        between = among[0, :, 0] + among[1, :, 1] - among[0, :, 1] - among[1, :, 0]
        apart = step[0] - step[1]
        if not number and may_be_noise(apart, between):
            return None
        if np.abs(step).max() < _SETTLED_PX:
            break
    rho = float(np.clip(covariance_along(left, used, 1) / max(variance, 1e-300), 0.0, 0.9))
    return offsets, between * (1 + rho) / (1 - rho)


def lines_and_rounds(mark: MarkShape) -> list[tuple[Part, ...]]:
    """Lines of a drawing, and its rings and disks; empty without either."""
    lines = tuple(part for part in mark.parts if isinstance(part, Bar))
    rounds = tuple(part for part in mark.parts if isinstance(part, Ring | Disk))
    groups: list[tuple[Part, ...]] = [lines, rounds]
    return groups if all(groups) else []


def _cover(mark: MarkShape, pixel_from_mark: Array, width: int, height: int, fit: MarkFit) -> Array:
    """(3, height, width) image of a mark under the blur of a fit, and its derivatives along columns and rows."""
    shown = render(mark, pixel_from_mark, width, height, fit.blur_px)
    return np.stack([shown.value, shown.by_col, shown.by_row]).astype(float)


def parts_apart(offsets: Array, between: Array) -> tuple[Reason, Array]:
    """Judge parts of a mark that lie apart.

    Parameters
    ----------
    offsets, between : of `measure_parts`.

    Returns
    -------
    Reason why the mark is weak, empty if they lie close to one another, and the (2, 2) covariance of a place that is
    that of the one or the other; 0 if noise may be the cause.
    """
    apart = offsets[0] - offsets[1]
    if may_be_noise(apart, between):
        return NO_REASON, np.zeros((2, 2))
    distance = float(np.hypot(*apart))
    unlike = f"its lines lie {distance:.1f} px from its ring or disk: compare its drawing with the scan"
    return Reason(unlike, Code.LIKENESS) if distance > _PARTS_APART_PX else NO_REASON, offsets.T @ offsets / 2


def check_own_figures(frames: Sequence[FrameMeasurement]) -> list[FrameMeasurement]:
    """Set marks to weak whose figures differ in one frame only, and back to measured where all frames share the
    deviation."""
    figures = defaultdict[tuple[str, str], list[tuple[int, float, float]]](list)
    for place, frame in enumerate(frames):
        for key, (value, sigma) in _figures(frame).items():
            figures[key].append((place, value, sigma))
    compared = {}
    for key, each in figures.items():
        _, values, sigmas = np.array(each).T
        compared[key] = compare_frames(values, sigmas, key[1])
    tests = sum(len(figures[key]) for key, own in compared.items() if own is not None)
    findings: list[dict[str, dict[str, Reason]]] = [defaultdict(dict) for _ in frames]
    for (point, kind), own in compared.items():
        if own is None:
            continue
        off, off_sigmas = own
        p_values = 2 * ndtr(-np.abs(off / off_sigmas)) * tests
        speaks_for = _BLUR if kind == _BLUR else _SHAPE
        for (place, *_), one, p_value in zip(figures[point, kind], off.tolist(), p_values.tolist(), strict=True):
            finding, reason = findings[place][point], _unlike_frames(kind, one) if p_value < FALSE_DOUBT else NO_REASON
            finding[speaks_for] = finding.get(speaks_for) or reason
    return [
        replace(
            frame,
            marks=tuple(
                _assess(mark, found.get(mark.point, {})) if mark.kind == "fiducial" else mark for mark in frame.marks
            ),
        )
        for frame, found in zip(frames, findings, strict=True)
    ]


def compare_frames(values: Array, sigmas: Array, kind: str) -> tuple[Array, Array] | None:
    """Compare a figure of a mark, logarithm of a ratio or rotation (rad), with that in the other frames that agree.

    Parameters
    ----------
    values, sigmas : (n,) in the frames, with standard deviations.
    kind : of the figure: size, turn or blur.

    Returns
    -------
    (n,) deviation of each frame from the mean of the others, and its standard deviation. None for fewer than three
    frames, or if no more than half of them agree.
    """
    spread = blur_spread if kind == _BLUR else size_spread
    near = _NEAR * np.hypot(sigmas, spread(np.zeros(1), np.ones(1)))
    agrees = np.abs(values - np.median(values)) <= near
    if len(values) < _FEWEST_FRAMES or 2 * agrees.sum() <= len(values):
        return None
    *_, apart = mean_of_unlike(values, sigmas, agrees, spread)
    weights = agrees / (sigmas**2 + apart**2)
    others = weights.sum() - weights
    off = values - (weights @ values - weights * values) / others
    return off, np.sqrt(1 / others + sigmas**2 + apart**2)


def _figures(frame: FrameMeasurement) -> dict[tuple[str, str], tuple[float, float]]:
    """Figures of fiducials, as in an unmirrored scan, and their standard deviations."""
    mirrored = -1.0 if frame.pose and frame.pose.name.endswith("m") else 1.0
    figures: dict[tuple[str, str], tuple[float, float]] = {}
    for mark in frame.marks:
        if mark.kind == "fiducial" and mark.status.is_observation:
            for kind in ("size", "blur"):
                if f"{kind}_ratio" in mark.quality:
                    figures[mark.point, kind] = np.log(mark.quality[f"{kind}_ratio"]), mark.quality[f"{kind}_sigma"]
            if "turn_rad" in mark.quality:
                figures[mark.point, "turn"] = mirrored * mark.quality["turn_rad"], mark.quality["turn_sigma"]
    return figures


def _unlike_frames(kind: str, off: float) -> Reason:
    """Reason why a mark is weak: the figure differs from that in the other frames."""
    there, covered = "in the camera's other frames", "something may cover or touch it"
    if kind == _BLUR:
        return Reason(f"its blur is {np.exp(off):.2f} times that {there}", Code.BLUR)
    figure = f"it is {np.exp(off):.2f} times as large as {there}"
    if kind == "turn":
        figure = f"it is turned by {np.degrees(off):.1f} degrees against what it is {there}"
    return Reason(f"{figure}: {covered}", Code.SIZE, Code.COVERED)


def _assess(mark: MarkMeasurement, findings: Mapping[str, Reason]) -> MarkMeasurement:
    """Update the status of a mark. findings: reasons by kind, empty if frames agree."""
    quality, unlike = mark.quality, findings.get(_SHAPE, NO_REASON)
    if unlike and Code.SIZE not in mark.reason.codes:
        return replace(mark, status=Status.WEAK, reason=Reason.combine((mark.reason, unlike)))
    settled = set[str]()
    if not findings.get(_BLUR, True):
        settled.add(unlike_blur(quality["blur_ratio"]))
    if not findings.get(_SHAPE, True):
        settled.add(unlike_others(quality["size_ratio"], quality.get("turn_rad")))
    if not (mark.status is Status.WEAK and settled.issuperset(mark.reason.split("; "))):
        return mark
    own = None if mark.covariance is None else mark.covariance.without(Cause.SMEAR)
    return replace(mark, status=Status.MEASURED, reason=NO_REASON, covariance=own)

"""Detection of the faint marks of a frame, around the places predicted from its inliers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.array_types import Array
from measure.detection.faint_marks import FaintMark, detect_faint
from measure.detection.localisation import MarkPrediction
from measure.fiducials.frame import Frame
from measure.fiducials.mark_fit import Detection
from measure.flags import NO_REASON, TEXTURE_LIKE_A_FAINT_MARK, Code, Reason
from measure.marks.rendering import extent_px
from measure.marks.shapes import FrameCorner, Mark
from measure.results import MarkFit
from measure.scans.scan import Scan

_FAINT_CONTRAST = 1 / 250  # fraction of full scale: less is one grey level of 8 bits, or a compression artefact
_FAINT_SIGMA_PX = 0.75  # px, largest standard deviation of a measured faint mark
_LEAST_REACH_PX = 3.0  # px: film deformation displaces single marks so far, however well most agree
_SAME_PX = 1.0  # px between two places of one mark at most; each is more accurate than that
_REACH = 4.0  # times the median misfit of the inliers: nearly five standard deviations
_NEAR = 2.0  # times the same: one good mark in sixteen lies farther off
_EXTREMES = (0.5, 99.5)  # percentiles of the grey values taken as darkest and lightest
_SURROUND = 6.0  # times a mark's own extent: enough of the scan for its darkest and lightest grey values
_TYPICAL = 8  # inliers from which the usual grey values of marks are taken
_SHOWS = 1 / 3  # fraction of the usual contrast: a background that leaves less to a mark hides it


@dataclass(frozen=True)
class Ground:
    """Background at a mark's place.

    Attributes
    ----------
    is_light : whether the mark is lighter than its background.
    room_dn : largest contrast that a mark can have there, given the extreme grey values.
    sigma_dn : standard deviation of the grey values there.
    """

    is_light: bool
    room_dn: float
    sigma_dn: float


def detect_faint_marks(frame: Frame, reach_px: float) -> Frame:
    """Detect again every mark that is not clear or deviates from its predicted place.

    A candidate that stands out from the texture there is taken for the mark; its deviation is film deformation. A clear
    fit farther off may be a pattern beside the mark.
    """
    near = frame.inliers & (frame.misfit_mm <= _NEAR * max(frame.scatter_mm, frame.options.film_sigma_mm))
    faint = [
        index
        for index, detection in enumerate(frame.detections)
        if detection.inside and not (frame.is_clear(index) and near[index])
        if not isinstance(frame.layout.marks[index].mark, FrameCorner)  # it has no lines that stand out from texture
    ]
    agreeing = frame.inlier_fits
    if not faint or not agreeing:
        return frame
    # Blur and contrast come from the inliers: a faint mark gives both less accurately.
    blur_px = float(np.median([fit.blur_px for fit in agreeing.values()]))
    usual_dn = float(np.median([abs(fit.stored_contrast_dn) for fit in agreeing.values()]))
    extremes, reached = _extremes_dn(frame), _reached_dn(frame, agreeing)
    detections, certain = {}, frame.certain.copy()
    for index in faint:
        expected = frame.prediction(index, reach_px)
        extreme_dn = float(extremes[int(expected.polarity > 0)])
        mark = detect_faint(frame.scan, expected, extreme_dn, blur_px)
        is_certain = mark is not None and _is_certain(frame.scan, mark)
        ground = _ground(frame, expected, (extreme_dn, reached.get(expected.polarity, extreme_dn)))
        why_not = reason_not_found(ground, usual_dn, reach_px, mark, is_certain)
        known = mark if is_certain and mark is not None and mark.sigma_px <= _FAINT_SIGMA_PX else None
        detections[index], certain[index] = _decide(frame, index, known, why_not)
    return replace(frame.replace_detections(detections), certain=certain)


def faint_reach_px(frame: Frame) -> float:
    """Search radius around a place predicted from many other marks."""
    return min(frame.gate_px, max(_REACH * frame.scatter_mm / float(frame.pitch_mm.mean()), _LEAST_REACH_PX))


def _extremes_dn(frame: Frame) -> Array:
    """Darkest and lightest grey values around the marks, which are spread over the scan."""
    inside = [index for index, detection in enumerate(frame.detections) if detection.inside]
    expected = [frame.prediction(index, 0.0) for index in inside]
    grey = [_surrounding_grey(frame, each.mark, each.pixel_from_mark, _SURROUND).ravel() for each in expected]
    return np.asarray(np.percentile(np.concatenate(grey), _EXTREMES))


def _reached_dn(frame: Frame, agreeing: Mapping[int, MarkFit]) -> dict[int, float]:
    """Usual grey value of light (+1) and dark (-1) inliers: it may exceed the extreme of the scan around them."""
    reached: dict[int, list[float]] = {}
    for index, fit in list(agreeing.items())[:_TYPICAL]:
        is_light = fit.contrast_dn > 0
        grey = _surrounding_grey(frame, frame.layout.marks[index].mark, fit.pixel_from_mark)
        reached.setdefault(1 if is_light else -1, []).append(float(np.percentile(grey, _EXTREMES[int(is_light)])))
    return {polarity: float(np.median(tones)) for polarity, tones in reached.items()}


def _ground(frame: Frame, expected: MarkPrediction, tones_dn: Sequence[float]) -> Ground:
    """Describe the background around a mark's place. tones_dn: grey values that a mark can have."""
    grey = _surrounding_grey(frame, expected.mark, expected.pixel_from_mark)
    room_dn = max(*(expected.polarity * (tone_dn - float(np.median(grey))) for tone_dn in tones_dn), 0.0)
    return Ground(expected.polarity > 0, room_dn, float(grey.std()))


def _surrounding_grey(frame: Frame, mark: Mark, pixel_from_mark: Array, times: float = 1.0) -> Array:
    """Grey values in a mark's bounding rectangle, enlarged by a factor."""
    center = pixel_from_mark[:, 2]
    least, greatest = (center + times * (corner - center) for corner in extent_px(mark, pixel_from_mark))
    low, size = np.floor(least).astype(int), np.ceil(greatest - least).astype(int) + 1
    window = frame.scan.window(int(low[0]), int(low[1]), int(size[0]), int(size[1]), frame.weights)
    return np.asarray(window, dtype=float)


def _decide(frame: Frame, index: int, mark: FaintMark | None, why_not: Reason) -> tuple[Detection, bool]:
    """Choose between the earlier detection of a mark and the faint one; returns also whether it is certain."""
    before, is_clear = frame.detections[index], frame.is_clear(index)
    if mark is None:
        return before if is_clear else Detection(before.predicted_px, True, None, why_not), False
    away_px = np.inf if before.fit is None else float(np.hypot(*(before.fit.center_px - mark.fit.center_px)))
    if is_clear and away_px <= _SAME_PX:
        # A second detection from the same pixels is no new evidence for a clear inlier.
        return before, bool(frame.certain[index]) or not frame.inliers[index]
    reason = NO_REASON
    if is_clear:
        reason = Reason(f"{away_px:.0f} px from it is a second candidate", Code.AMBIGUOUS)
    return Detection(before.predicted_px, True, mark.fit, reason), True


def _is_certain(scan: Scan, mark: FaintMark) -> bool:
    """Whether the mark is significant against texture and rounding."""
    strong = abs(mark.fit.stored_contrast_dn) >= _FAINT_CONTRAST * scan.full_scale_dn
    return mark.false_alarms <= TEXTURE_LIKE_A_FAINT_MARK and strong


def reason_not_found(
    ground: Ground, usual_dn: float, reach_px: float, mark: FaintMark | None, is_certain: bool
) -> Reason:
    """Give the first reason that holds: no room for contrast, too little of it visible, rounding, or texture.

    Parameters
    ----------
    ground : background at the mark's place.
    usual_dn : usual contrast of the other marks.
    reach_px : search radius.
    mark : best candidate within it.
    is_certain : whether that candidate is no false alarm.
    """
    if ground.room_dn < _SHOWS * usual_dn:
        shade = "light" if ground.is_light else "dark"
        return Reason(
            f"the background at its place is so {shade} that the mark could change it by "
            f"{_grey(ground.room_dn)} only, the others by {usual_dn:.0f}",
            Code.GROUND,
        )
    if mark is not None and is_certain:
        return Reason(
            f"only {1 - mark.fit.damaged_fraction:.0%} of it shows: that gives its place to {mark.sigma_px:.1f} px "
            "only",
            Code.COVERED,
        )
    within = f"within {reach_px:.0f} px of its place"
    could = min(ground.room_dn, usual_dn)
    if mark is not None and abs(mark.fit.stored_contrast_dn) < _SHOWS * could:
        return Reason(
            f"no candidate {within}: the best one changes the background by "
            f"{_grey(abs(mark.fit.stored_contrast_dn))}, where the mark could by {could:.0f}",
            Code.NOT_FOUND,
        )
    return Reason(
        f"nothing {within} stands out of the texture: the background there varies by {_grey(ground.sigma_dn)}, and "
        f"a mark could change it by {could:.0f}",
        Code.CONTRAST,
    )


def _grey(dn: float) -> str:
    if dn < 0.5:
        return "less than half a grey value"
    return f"{dn:.0f} grey value{'s' if round(dn) > 1 else ''}"

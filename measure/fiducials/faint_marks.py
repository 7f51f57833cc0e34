"""The faint marks of a frame: looked for once more where the marks that agree put them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.detection.faint_marks import FaintMark, find_faint
from measure.detection.prediction import MarkPrediction
from measure.fiducials.frame_sighter import FrameSighter
from measure.fiducials.mark_fit import Sighting
from measure.flags import NO_REASON, TEXTURE_LIKE_A_FAINT_MARK, Code, Reason
from measure.marks.rendering import extent_px
from measure.marks.shapes import FrameCorner, Mark
from measure.results import MarkFit

Array = NDArray[np.float64]

_FAINT_CONTRAST = 1 / 250  # of full scale: less is a grey level of eight bits, or what compression made of it
_FAINT_SIGMA_PX = 0.75  # a mark that is known no better is not measured
_LEAST_REACH_PX = 3.0  # film bends marks so far off, however well most agree
_SAME_PX = 1.0  # apart: two places of one mark, each of which is known to better than that
_REACH = 4.0  # times the scatter of the others, a median: nearly five standard deviations
_NEAR = 2.0  # times the same: one good mark in sixteen lies farther off
_EXTREMES = (0.5, 99.5)  # per cent: of the darkest and lightest grey values about all marks, or about one
_SURROUND = 6.0  # times as far about each as it reaches itself: enough of the scan to tell how dark or light it can be
_LOOKED_AT = 8  # marks that agree: these tell how light or dark marks are
_SHOWS = 1 / 3  # of the others' contrast: ground that leaves less to a mark hides it


@dataclass(frozen=True)
class Ground:
    """The ground at a mark's place. is_light: whether a mark is sought that is lighter than it; room_dn: by which such
    a mark could change it, the scan having none lighter or darker; sigma_dn: its own standard deviation."""

    is_light: bool
    room_dn: float
    sigma_dn: float


def look_for_faint(sighter: FrameSighter, reach_px: float) -> None:
    """Look again at every mark that is not clear, or does not lie where the others put it: what stands out of its
    texture there is this mark, the film being deformed where it lies off. A clear one may be a pattern beside it.
    """
    near = sighter.belongs & (sighter.misfit_mm() <= _NEAR * max(sighter.scatter_mm(), sighter.options.film_sigma_mm))
    faint = [
        (index, sighting)
        for index, sighting in enumerate(sighter.sightings)
        if sighting is not None and sighting.inside and not (sighter.clear(index) and near[index])
        if not isinstance(sighter.layout.marks[index].mark, FrameCorner)  # it has no lines to stand out of texture
    ]
    agreeing = {
        index: sighting.fit
        for index, sighting in enumerate(sighter.sightings)
        if sighter.belongs[index] and sighting is not None and sighting.fit
    }
    if not faint or not agreeing:
        return
    # The marks that agree tell both better than a faint mark does itself.
    blur_px = float(np.median([fit.blur_px for fit in agreeing.values()]))
    usual_dn = float(np.median([abs(fit.stored_contrast_dn) for fit in agreeing.values()]))
    extremes = _extremes_dn(sighter)
    reached = _reached_dn(sighter, agreeing)
    for index, sighting in faint:
        expected = sighter.expected(index, reach_px)
        extreme_dn = float(extremes[int(expected.polarity > 0)])
        seen = find_faint(sighter.scan, expected, extreme_dn, blur_px)
        known = seen is not None and seen.sigma_px <= _FAINT_SIGMA_PX
        certain = seen is not None and _is_certain(sighter, seen)
        ground = _ground(sighter, expected, (extreme_dn, reached.get(expected.polarity, extreme_dn)))
        unseen = reason_unseen(ground, usual_dn, reach_px, seen, certain)
        _take(sighter, index, sighting, seen if certain and known else None, unseen)


def faint_reach_px(sighter: FrameSighter) -> float:
    """How far a faint mark can be from where many others put it."""
    return min(sighter.gate_px, max(_REACH * sighter.scatter_mm() / float(sighter.pitch.mean()), _LEAST_REACH_PX))


def _extremes_dn(sighter: FrameSighter) -> Array:
    """The darkest and the lightest grey values about the marks: they are spread over the scan, and no more of it has
    to be read."""
    expected = [
        sighter.expected(index, 0.0)
        for index, sighting in enumerate(sighter.sightings)
        if sighting is not None and sighting.inside
    ]
    grey = [_about(sighter, each.mark, each.pixel_from_mark, _SURROUND).ravel() for each in expected]
    return np.asarray(np.percentile(np.concatenate(grey), _EXTREMES))


def _reached_dn(sighter: FrameSighter, agreeing: Mapping[int, MarkFit]) -> dict[int, float]:
    """How light, or dark, the marks that agree are: in a scan without lights they pass its extreme."""
    reached: dict[int, list[float]] = {}
    for index, fit in list(agreeing.items())[:_LOOKED_AT]:
        is_light = fit.contrast_dn > 0
        grey = _about(sighter, sighter.layout.marks[index].mark, fit.pixel_from_mark)
        reached.setdefault(1 if is_light else -1, []).append(float(np.percentile(grey, _EXTREMES[int(is_light)])))
    return {polarity: float(np.median(tones)) for polarity, tones in reached.items()}


def _ground(sighter: FrameSighter, expected: MarkPrediction, tones_dn: Sequence[float]) -> Ground:
    """About a mark's place; tones_dn: grey values that a mark can have."""
    grey = _about(sighter, expected.mark, expected.pixel_from_mark)
    room_dn = max(*(expected.polarity * (tone_dn - float(np.median(grey))) for tone_dn in tones_dn), 0.0)
    return Ground(expected.polarity > 0, room_dn, float(grey.std()))


def _about(sighter: FrameSighter, mark: Mark, pixel_from_mark: Array, times: float = 1.0) -> Array:
    """The grey values about a mark's place, as far as it reaches or so many times as far."""
    center = pixel_from_mark[:, 2]
    least, greatest = (center + times * (corner - center) for corner in extent_px(mark, pixel_from_mark))
    low, size = np.floor(least).astype(int), np.ceil(greatest - least).astype(int) + 1
    window = sighter.scan.window(int(low[0]), int(low[1]), int(size[0]), int(size[1]), sighter.weights)
    return np.asarray(window, dtype=float)


def _take(sighter: FrameSighter, index: int, sighting: Sighting, seen: FaintMark | None, unseen: Reason) -> None:
    """Keep a clear fit where what was seen is the same mark; else what was seen counts, or that nothing was. Texture
    does not feign what was seen; but where a clear fit lies elsewhere, either may be the mark."""
    clear, away = sighter.clear(index), np.inf
    if seen is not None and sighting.fit is not None:
        away = float(np.hypot(*(sighting.fit.center_px - seen.fit.center_px)))
    # That the same pixels answer twice proves nothing of a clear mark that agreed with the others anyway.
    again = clear and bool(sighter.belongs[index]) and away <= _SAME_PX
    sighter.certain[index] = seen is not None and (bool(sighter.certain[index]) or not again)
    if seen is None and not clear:
        sighter.sightings[index] = Sighting(sighting.predicted_px, True, None, unseen)
    elif seen is not None and (not clear or away > _SAME_PX):
        told = Reason(f"{away:.0f} px from it something looks like it, too", Code.AMBIGUOUS) if clear else NO_REASON
        sighter.sightings[index] = Sighting(sighting.predicted_px, True, seen.fit, told)


def _is_certain(sighter: FrameSighter, seen: FaintMark) -> bool:
    """Whether neither texture nor rounding feigns it."""
    strong = abs(seen.fit.stored_contrast_dn) >= _FAINT_CONTRAST * sighter.scan.full_scale_dn
    return seen.chance <= TEXTURE_LIKE_A_FAINT_MARK and strong


def reason_unseen(ground: Ground, usual_dn: float, reach_px: float, seen: FaintMark | None, certain: bool) -> Reason:
    """A sentence, the first that holds: ground as dark as anything in the scan leaves a dark mark no room; too little
    of it shows to give its place; what answers is no more than rounding; texture hides it.

    usual_dn: by which the other marks change their ground. seen: the strongest answer within reach_px, and certain
    whether chance would not make it.
    """
    if ground.room_dn < _SHOWS * usual_dn:
        shade = "light" if ground.is_light else "dark"
        return Reason(
            f"the ground at its place is so {shade} that the mark could change it by {_grey(ground.room_dn)} only, the "
            f"others by {usual_dn:.0f}",
            Code.GROUND,
        )
    if seen is not None and certain:
        return Reason(
            f"only {1 - seen.fit.damaged_fraction:.0%} of it shows: that gives its place to {seen.sigma_px:.1f} px "
            "only",
            Code.COVERED,
        )
    within = f"within {reach_px:.0f} px of its place"
    could = min(ground.room_dn, usual_dn)
    if seen is not None and abs(seen.fit.stored_contrast_dn) < _SHOWS * could:
        return Reason(
            f"nothing {within} looks like it: what does so most changes the ground by "
            f"{_grey(abs(seen.fit.stored_contrast_dn))}, where the mark could by {could:.0f}",
            Code.NOT_FOUND,
        )
    return Reason(
        f"nothing {within} stands out of the texture like it: the ground there varies by {_grey(ground.sigma_dn)}, and "
        f"a mark could change it by {could:.0f}",
        Code.CONTRAST,
    )


def _grey(dn: float) -> str:
    if dn < 0.5:
        return "less than half a grey value"
    return f"{dn:.0f} grey value{'s' if round(dn) > 1 else ''}"

"""The marks of a frame settled by what it says of them: matched again where the frame or the other marks know better,
and doubted where they look unlike the others."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from measure.fiducials.frame import CLEAR_LIKENESS, WRONG_PX
from measure.fiducials.frame_edges import told_by_edges
from measure.fiducials.frame_sighter import FrameSighter
from measure.fiducials.mark_comparison import (
    SharedBlur,
    shared_blurs,
    shared_shapes,
    shared_sizes,
    touch_of_edges,
    touch_of_round,
)
from measure.fiducials.mark_fit import leans_on_frame, sight, strained_px
from measure.flags import LARGE_ERROR, Cause, Code, Reason
from measure.marks.rendering import reach_px
from measure.marks.shapes import Disk, Mark, MarkShape, Ring
from measure.matching.models import is_round
from measure.matching.options import MatchOptions
from measure.noise.noise_model import may_be_noise
from measure.results import MarkFit
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import FrameTone, MarkTone

Array = NDArray[np.float64]

_STRAINED = 1 / 3  # of its standard deviation: an error of a twentieth more
_TONE_ROUNDS = 5  # of matching by a better curve
_OTHER_STARTS, _AGREED = (2.2, 1.0), 0.1  # powers; how unsettled a curve is that needs none of them
_MOVED = 0.3  # of its standard deviation that a mark may still move
_SETTLED_PX = 1.5  # about a mark that was matched already


def settle(sighter: FrameSighter) -> None:
    """Match marks that do not tell their own rotation and scale once more, with those of the frame; and those that the
    frame's stretch and shear move, which no match tells; and as long as they say of the tone curve what moves them,
    those by that curve. Far from the right curve noise is not even, and may hide it: where what the marks say does not
    agree, other curves are begun with, too."""
    if sighter.belongs.sum() < 2:
        return
    _settle_from(sighter, sighter.scan.tone)
    for power in _OTHER_STARTS if sighter.tone.disagreement > _AGREED and _leans_on_tone(sighter) else ():
        before = sighter.tone, sighter.scan, list(sighter.sightings)
        _settle_from(sighter, sighter.prior_tone.shift_to_power(power))
        if sighter.tone.disagreement >= before[0].disagreement:
            sighter.tone, sighter.scan, sighter.sightings = before
            sighter.judge()


def _settle_from(sighter: FrameSighter, tone: Tone) -> None:
    """From where the marks were seen, beginning with a tone curve."""
    unsettled = {index for index, fit in _clear(sighter).items() if _leans_or_is_strained(sighter, index, fit)}
    if tone is not sighter.scan.tone:
        sighter.scan, unsettled = sighter.scan.replace_tone(tone), set(_told_of_tone(sighter))
    edges = _told_by_edges(sighter)
    for _ in range(_TONE_ROUNDS):
        unsettled |= _moved_by_tone(sighter, _frame_tone(sighter, edges))
        if not unsettled:
            continue
        frame_sigma = _frame_sigma(sighter)
        for index in sorted(unsettled):
            _match_again(sighter, index, sighter.options.match, frame_sigma)
        sighter.judge()
        edges, unsettled = _told_by_edges(sighter), set()
    sighter.tone = _frame_tone(sighter, edges)


def _leans_or_is_strained(sighter: FrameSighter, index: int, fit: MarkFit) -> bool:
    mark, linear = sighter.layout.marks[index].mark, sighter.pixel_from_camera[:, :2]
    off_px = strained_px(mark, fit.pixel_from_mark[:, :2], linear, _frame_sigma(sighter))
    return leans_on_frame(mark) or off_px > _STRAINED * fit.sigma_px


def _moved_by_tone(sighter: FrameSighter, found: FrameTone) -> set[int]:
    """The marks that say something of the curve, if what was found moves any; the scan is then seen through that."""
    told, before = _told_of_tone(sighter), sighter.scan.tone
    clear = _clear(sighter)
    if not any(found.shift_px(one, before) > _MOVED * clear[index].sigma_px for index, one in told.items()):
        return set()
    sighter.scan = sighter.scan.replace_tone(found.next_curve(before))
    return set(told)


def _frame_tone(sighter: FrameSighter, edges: Sequence[ToneInformation]) -> FrameTone:
    """By the marks and the frame's edges."""
    return FrameTone.from_marks(sighter.prior_tone, _told_of_tone(sighter), sighter.scan.tone, edges)


def _told_by_edges(sighter: FrameSighter) -> list[ToneInformation]:
    """By the frame's edges beside the marks, where one of these leans on the curve. What lossy compression rounds away
    is alike all along an edge, and looks like a curve."""
    if sighter.scan.is_lossy or not _leans_on_tone(sighter):
        return []
    return told_by_edges(sighter.scan, sighter.layout, sighter.pixel_from_camera, sighter.weights)


def _leans_on_tone(sighter: FrameSighter) -> bool:
    """Whether what is not known of any curve moves a mark by more than its standard deviation."""
    fits = _clear(sighter)
    return any(one.sensitivity_px > fits[index].sigma_px for index, one in _told_of_tone(sighter).items())


def _told_of_tone(sighter: FrameSighter) -> dict[int, MarkTone]:
    return {index: fit.tone for index, fit in _clear(sighter).items() if fit.tone is not None}


def count_tone(sighter: FrameSighter) -> None:
    """What is not known of the tone curve, in the covariance of each mark that it moves."""
    for index, sighting in enumerate(sighter.sightings):
        told = None if sighting is None or sighting.fit is None else sighting.fit.tone
        if told is not None:
            sighter.widen(index, Cause.TONE, sighter.tone.covariance_px2(told))


def share_blur(sighter: FrameSighter) -> None:
    """Match marks that hardly tell their own blur once more, with that of the others, and marks that were only seen as
    faint ones, with that where it is known; what differs from the others' blur is doubted."""
    seen_only = _only_seen(sighter)
    fits = {**_adjusted(sighter), **seen_only}
    told = zip(fits, shared_blurs(list(fits.values())), strict=True)
    shared = {index: blur for index, blur in told if blur is not None or index in seen_only}
    if not shared or sighter.belongs.sum() < 2:
        return
    frame_sigma = _frame_sigma(sighter)
    for index, blur in shared.items():
        if blur is None or index in seen_only:
            _match_faint(sighter, index, frame_sigma, blur)
            continue
        _match_again(sighter, index, _with_blur(sighter.options.match, blur), frame_sigma)
        if blur.differs:
            own_px = fits[index].blur_px
            reason = f"its blur is {own_px:.2f} px, where the other marks have {blur.blur_px:.2f}"
            sighter.doubt(index, Reason(reason, Code.BLUR))
    sighter.judge()


def compare_sizes(sighter: FrameSighter) -> None:
    """Doubt marks of another size than the others that are drawn alike: dust, say, that covers one. A round mark is
    known no better than its size says, and doubted where something was cut out beside it that may well have moved
    it far."""
    alike: dict[Mark, list[int]] = defaultdict(list)
    fits = _adjusted(sighter)
    for index in fits:
        mark = sighter.layout.marks[index].mark
        if not leans_on_frame(mark):
            alike[mark].append(index)
    for mark, indices in alike.items():
        sizes = shared_sizes([fits[index] for index in indices], sighter.pixel_from_camera[:, :2])
        for index, size in zip(indices, sizes, strict=True):
            if size is not None and size.differs:
                told = f"it is {size.ratio:.2f} times as large as the other marks: something may cover or touch it"
                sighter.doubt(index, Reason(told, Code.SIZE, Code.COVERED))
            if size is not None and is_round(mark):
                linear, is_damaged = fits[index].pixel_from_mark[:, :2], fits[index].damaged_fraction > 0
                px_per_mm = float(np.sqrt(abs(np.linalg.det(linear))))
                touch = touch_of_round(size, _radius_mm(mark) * px_per_mm, px_per_mm, is_damaged)
                sighter.widen(index, Cause.TOUCHED, touch.variance_px2 * np.eye(2))
                if is_damaged and not size.differs and touch.beyond(WRONG_PX) > LARGE_ERROR:
                    told = (
                        f"it is {size.ratio:.2f} times as large as the other marks and damaged beside it: something "
                        f"may touch it and have moved it by more than {WRONG_PX} px"
                    )
                    sighter.doubt(index, Reason(told, Code.SIZE, Code.COVERED))


def compare_shapes(sighter: FrameSighter) -> None:
    """Doubt marks whose rotation and scale are the frame's, but whose own pictures say otherwise than those of the
    others. Such a mark is known no better than the difference would move it."""
    fits = _adjusted(sighter)
    own = {
        index: fit.own_shape
        for index, fit in fits.items()
        if fit.own_shape is not None and leans_on_frame(sighter.layout.marks[index].mark)
    }
    for (index, shape), other in zip(own.items(), shared_shapes(list(own.values())), strict=True):
        if other is None:
            continue
        if other.differs:
            turn_deg = np.degrees(other.off[1])
            told = (
                f"its edges make it {other.ratio:.2f} times as large as the other marks, and turned by {turn_deg:.1f} "
                "degrees: something may cover or touch it"
            )
            sighter.doubt(index, Reason(told, Code.SIZE, Code.COVERED))
        middle_px = reach_px(sighter.layout.marks[index].mark, fits[index].pixel_from_mark[:, :2]) / 2
        touch = touch_of_edges(other, shape.on_place, middle_px, fits[index].damaged_fraction > 0)
        sighter.widen(index, Cause.TOUCHED, touch.variance_px2 * np.eye(2))


def _radius_mm(mark: Mark) -> float:
    """Of a round mark's outline."""
    parts = mark.parts if isinstance(mark, MarkShape) else ()
    return max(part.radius_mm for part in parts if isinstance(part, Disk | Ring))


def _clear(sighter: FrameSighter) -> dict[int, MarkFit]:
    """The fits of marks that belong and are plainly there."""
    return {
        index: sighting.fit
        for index, sighting in enumerate(sighter.sightings)
        if sighter.belongs[index] and sighter.clear(index) and sighting is not None and sighting.fit is not None
    }


def _adjusted(sighter: FrameSighter) -> dict[int, MarkFit]:
    """Those of them that were matched, not only seen as faint marks, and are drawn: a chip has a blur of its own."""
    return {
        index: fit
        for index, fit in _clear(sighter).items()
        if fit.covariance is not None and isinstance(sighter.layout.marks[index].mark, MarkShape)
    }


def _only_seen(sighter: FrameSighter) -> dict[int, MarkFit]:
    """The fits of marks that belong and are drawn, but were only seen as faint marks, with no blur of their own."""
    return {
        index: sighting.fit
        for index, sighting in enumerate(sighter.sightings)
        if sighter.belongs[index] and sighting is not None and sighting.fit is not None
        if sighting.fit.covariance is None and isinstance(sighter.layout.marks[index].mark, MarkShape)
    }


def _frame_sigma(sighter: FrameSighter) -> float:
    """The standard deviation of rotation (rad), scale, stretch and shear at a mark: of the frame by its marks, and
    by as much as film bends between them."""
    belonging = sighter.camera[sighter.belongs]
    radius_mm = float(np.hypot(*(belonging - belonging.mean(axis=0)).T).mean())
    bent = float(np.hypot(sighter.options.film_sigma_mm, sighter.scatter_mm())) / radius_mm
    return float(np.hypot(sighter.linear_sigma, bent))


def _match_again(sighter: FrameSighter, index: int, options: MatchOptions, frame_sigma: float) -> None:
    """Where it was found, with the frame's rotation and scale where it leans on them. What does not look like the mark
    any longer, a line along which it slid, is no better than what did."""
    fit = _matched(sighter, index, options, frame_sigma)
    if fit is not None and (fit.likeness >= CLEAR_LIKENESS or not sighter.clear(index)):
        _take(sighter, index, fit)


def _with_blur(options: MatchOptions, blur: SharedBlur | None) -> MatchOptions:
    return options if blur is None else replace(options, blur_px=blur.blur_px, blur_sigma=blur.sigma)


def _match_faint(sighter: FrameSighter, index: int, frame_sigma: float, blur: SharedBlur | None) -> None:
    """A mark that was only seen, for that takes all that is finer than the mark for texture: in plain noise a match
    knows its place far better. It counts where it means the same mark, of the others' blur, and is the better known."""
    seen = sighter.sightings[index]
    fit = _matched(sighter, index, _with_blur(sighter.options.match, blur), frame_sigma)
    if seen is None or seen.fit is None or fit is None or not (blur is None or blur.is_borne_out_by(fit)):
        return
    off = fit.center_px - seen.fit.center_px
    if fit.sigma_px < seen.fit.sigma_px and may_be_noise(off, seen.fit.covariance_px2 + fit.covariance_px2):
        _take(sighter, index, fit)


def _matched(sighter: FrameSighter, index: int, options: MatchOptions, frame_sigma: float) -> MarkFit | None:
    """A mark where it was seen, matched with the frame's rotation and scale where it leans on them."""
    before = sighter.sightings[index]
    if before is None or before.fit is None:
        return None
    expected = sighter.expected(index, _SETTLED_PX).moved(before.fit.center_px)
    return sight(sighter.scan, expected, options, frame_sigma).fit


def _take(sighter: FrameSighter, index: int, fit: MarkFit) -> None:
    """Another fit of a mark that was seen; what was said of it holds."""
    sighting = sighter.sightings[index]
    if sighting is not None:
        sighter.sightings[index] = replace(sighting, fit=fit)

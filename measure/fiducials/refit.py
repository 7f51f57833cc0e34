"""Refinement of a frame's mark fits with its rotation, scale, strain, tone curve and blur; test of marks that look
unlike the others."""

from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from dataclasses import replace

import numpy as np

from measure.array_types import Array
from measure.fiducials.frame import CLEAR_LIKENESS, WRONG_PX, Frame, orient_frame
from measure.fiducials.mark_comparison import (
    SharedBlur,
    SharedShape,
    shared_blurs,
    shared_line_width,
    shared_shapes,
    touch_of_edges,
    touch_of_round,
    unlike_blur,
    unlike_others,
)
from measure.fiducials.mark_fit import Detection, detect_mark, is_held_by_frame, strain_error_px
from measure.fiducials.options import film_terms, interleaved
from measure.flags import LARGE_ERROR, Cause
from measure.geometry import linear_scale
from measure.marks.rendering import reach_px
from measure.marks.shapes import Disk, Mark, MarkShape, Ring, widen_lines
from measure.matching.match import is_cross, mark_window, measure_arms
from measure.matching.models import PIXEL_VARIANCE_PX2, MatchOptions, is_round
from measure.matching.window import read_window
from measure.noise.noise_model import may_be_noise
from measure.results import MarkFit
from measure.tone.curve import Tone
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import FEWEST_MARKS, Sharpening, estimate_sharpening

_STRAINED = 1 / 3  # fraction of a mark's standard deviation: a larger strain error raises it by more than a twentieth
_TONE_ROUNDS = 5  # largest number of refits with an improved tone curve
_OTHER_STARTS, _AGREED = (2.2, 1.0), 0.1  # gammas of further initial curves; disagreement up to which none is tried
_TELLING = 8  # most significant marks, refitted until widths, sharpening and tone curve are settled: more cost time
_SHARED_ROUNDS = 8  # largest number of refits with improved widths and sharpening
_MOVED = 0.3  # fraction of a mark's standard deviation: smaller shifts by a better curve are ignored
_UNCHECKED = 3  # marks, which an affine transformation fits without residuals
_REFIT_PX = 1.5  # search range around a mark that was fitted already


def refit_frame(frame: Frame) -> Frame:
    """Refit the marks of a frame with parameters estimated from all of them, and compare them with one another.

    Marks whose image does not determine rotation and scale take those of the frame, as do marks displaced by stretch
    and shear, which no single fit determines. Marks displaced by the tone curve are refitted with the curve estimated
    from all marks. Marks whose blur is poorly determined take that of the others.
    """
    if len(frame.inlier_fits) >= 2:
        frame = _refit_with_blur(_refit_with_tone(frame))
    return _compare_shapes(_add_common_covariances(frame))


def fit_lines_and_sharpening(frame: Frame, fewest: int = 0) -> Frame:
    """Estimate what all marks of the scan share, the width of their lines and its sharpening, and refit them with it.

    fewest: marks without which the sharpening is left for later.

    Exposure widens or narrows the lines of all crosses of a frame alike. Where a line is drawn too wide, the size of a
    cross takes that up, and the ends of its arms are taken for damage, as are the halos of a sharpened scan.
    """
    begun, plainest = frame, _by_significance(frame)
    options, telling = replace(frame.options.match, tells_sharpening=True), plainest
    last = before = frame.scan.tone.sharpening
    for _ in range(_SHARED_ROUNDS):
        drawn = _widen_drawings(frame, telling)
        fits = (frame.detections[index].fit for index in telling)
        scores = [fit.sharpening for fit in fits if fit and fit.sharpening and fit.sharpening.normal.any()]
        found = before
        if begun.agrees and len(scores) >= max(fewest, FEWEST_MARKS):
            found = estimate_sharpening(before, scores, len(frame.scan.tone.mean)) or Sharpening()
        if drawn is frame and found.is_as(before):
            break
        last, before = before, found.damped(before, last) if last else found
        telling = telling[:_TELLING]
        frame = _refit(_sharpened(drawn, before), dict.fromkeys(telling, options), orient=False)
    if frame is begun:
        return frame
    return _refit(_sharpened(frame, found), dict.fromkeys({*plainest} - {*telling}, options))


def _widen_drawings(frame: Frame, among: Sequence[int]) -> Frame:
    """Draw the lines of crosses as wide as those among the marks show them; the same frame if they are so already."""
    groups: dict[Mark, list[tuple[float, float] | None]] = defaultdict(list)
    for index in among:
        fit = frame.detections[index].fit
        groups[frame.layout.marks[index].mark].append(None if fit is None else fit.line_width)
    ratios = {mark: shared_line_width(widths) for mark, widths in groups.items() if isinstance(mark, MarkShape)}
    if all(ratio == 1 for ratio in ratios.values()):
        return frame
    wider: dict[Mark, Mark] = {mark: widen_lines(mark, ratio) for mark, ratio in ratios.items()}
    marks = tuple(replace(each, mark=wider.get(each.mark, each.mark)) for each in frame.layout.marks)
    return replace(frame, layout=replace(frame.layout, marks=marks))


def _sharpened(frame: Frame, sharpening: Sharpening) -> Frame:
    return replace(frame, scan=frame.scan.replace_tone(frame.scan.tone.sharpened(sharpening)))


def _refit_with_tone(frame: Frame) -> Frame:
    """Refit the marks with the tone curve estimated from the telling ones; if these disagree, from further curves."""
    prior, begun, options = frame.scan.tone.prior, frame.scan.tone, frame.options.match
    sigma = _linear_sigma(frame)
    pending = {index for index, fit in frame.clear_fits.items() if _needs_frame(frame, index, fit, sigma)}
    telling = {*_by_significance(frame)[:_TELLING]}
    best = _settle_tone(frame, prior, telling, pending & telling)
    is_open = best.tone.disagreement > _AGREED and any(
        tone.sensitivity_px > best.clear_fits[index].sigma_px for index, tone in _mark_tones(best).items()
    )
    for power in _OTHER_STARTS if is_open else ():
        start = replace(best, scan=best.scan.replace_tone(prior.shift_to_power(power)))
        start = _refit(start, dict.fromkeys(telling & _mark_tones(best).keys(), options))
        other = _settle_tone(start, prior, telling, frozenset())
        is_better = not other.tone.is_doubted and other.tone.disagreement < best.tone.disagreement
        best = other if is_better else best
    rest = pending if best.scan.tone is begun else pending | {*_mark_tones(best)}
    if rest <= telling:
        return best
    best = _refit(best, dict.fromkeys(rest - telling, options))
    every = FrameTone.from_marks(prior, _mark_tones(best), best.scan.tone)
    return best if best.tone.is_doubted else replace(best, tone=every)


def _settle_tone(frame: Frame, prior: Tone, telling: Set[int], pending: Set[int]) -> Frame:
    """Refit marks and estimate the tone curve from the telling ones in turn.

    prior: curve known before; pending: telling marks to be refitted with any curve.
    """
    for rounds_left in range(_TONE_ROUNDS, -1, -1):
        tones, fits = _mark_tones(frame, telling), frame.clear_fits
        estimate = FrameTone.from_marks(prior, tones, frame.scan.tone)
        frame = replace(frame, tone=estimate)
        moves = [estimate.shift_px(each, frame.scan.tone) > _MOVED * fits[n].sigma_px for n, each in tones.items()]
        changed = pending | tones.keys() if any(moves) else pending
        if not (changed and rounds_left):
            break
        if any(moves):
            frame = replace(frame, scan=frame.scan.replace_tone(estimate.next_curve(frame.scan.tone)))
        frame, pending = _refit(frame, dict.fromkeys(changed, frame.options.match)), frozenset()
        if estimate.is_doubted:  # by the prior curve again, the marks would only lead to the same estimate
            break
    return frame


def _needs_frame(frame: Frame, index: int, fit: MarkFit, linear_sigma: float) -> bool:
    """Whether a fit depends on rotation, scale, stretch or shear of the frame; with a film model or lens all do."""
    if frame.film is not None or frame.options.lens is not None:
        return True
    mark, linear = frame.layout.marks[index].mark, frame.linear(index)
    error_px = strain_error_px(mark, fit.pixel_from_mark[:, :2], linear, linear_sigma)
    return is_held_by_frame(mark) or error_px > _STRAINED * fit.sigma_px


def _mark_tones(frame: Frame, among: Set[int] | None = None) -> dict[int, MarkTone]:
    """Information of the clear marks, or of those among them, on the tone curve."""
    fits = frame.clear_fits.items()
    return {index: fit.tone for index, fit in fits if fit.tone is not None and (among is None or index in among)}


def _by_significance(frame: Frame) -> list[int]:
    """Indices of the clear marks, the most significant first."""
    return sorted(frame.clear_fits, key=lambda index: -frame.clear_fits[index].significance)


def _add_common_covariances(frame: Frame) -> Frame:
    """Add the uncertainties of tone curve, sharpening and taking lens to the covariance of each mark."""
    sharpening, by_lens = frame.scan.tone.sharpening, _lens_covariances(frame)
    detections = list(frame.detections)
    for index, detection in enumerate(detections):
        fit, parts = detection.fit, {Cause.LENS: by_lens[index]} if index in by_lens else {}
        if fit is not None and fit.tone is not None:
            parts[Cause.TONE] = frame.tone.covariance_px2(fit.tone)
        if fit is not None and fit.sharpening is not None and sharpening:
            parts[Cause.SHARPENING] = fit.sharpening.covariance_px2(sharpening)
        detections[index] = detection.amend(parts=parts)
    return replace(frame, detections=tuple(detections))


def _lens_covariances(frame: Frame) -> dict[int, Array]:
    """Covariances (2, 2) of the inliers by the taking lens, as far as affine transformation and film model leave
    them."""
    fits, lens = frame.inlier_fits, frame.options.lens
    if lens is None or not fits:
        return {}
    covariance = lens.covariance_px2(np.array([fit.center_px for fit in fits.values()]))
    given = frame.camera_mm[list(fits)] / np.abs(frame.camera_mm).max()
    (x, y), one, none = given.T, np.ones(len(given)), np.zeros(len(given))
    affine = interleaved((x, none), (y, none), (one, none), (none, x), (none, y), (none, one))
    free = np.hstack([affine, film_terms(frame.options.film_model, given)])
    left = np.eye(len(free)) - free @ np.linalg.pinv(free)
    parts = (left @ covariance @ left).reshape(len(fits), 2, len(fits), 2)
    return {index: parts[number, :, number] for number, index in enumerate(fits)}


def _refit_with_blur(frame: Frame) -> Frame:
    """Refit faint marks and those with a poorly determined blur, with the blur of the others as an observation."""
    drawn = {index: fit for index, fit in frame.inlier_fits.items() if _is_drawn(frame, index)}
    faint = {index: fit for index, fit in drawn.items() if fit.covariance is None}
    fits = {index: fit for index, fit in drawn.items() if index not in faint and frame.is_clear(index)} | faint
    shared = dict(zip(fits, shared_blurs(list(fits.values())), strict=True))
    options = {
        index: replace(frame.options.match, blur_px=blur.blur_px, blur_sigma=blur.sigma)
        for index, blur in shared.items()
        if blur is not None
    }
    matched = _refit(frame, {index: each for index, each in options.items() if index not in faint}, orient=False)
    sigma = _linear_sigma(frame)
    again = {index: _fit_again(frame, index, options.get(index, frame.options.match), sigma) for index in faint}
    better = {index: fit for index, fit in again.items() if fit and _is_better(faint[index], fit, shared[index])}
    matched, amended = matched.replace_fits(better), {}
    total_px = {index: float(np.sqrt(fit.blur_px**2 + PIXEL_VARIANCE_PX2)) for index, fit in fits.items()}
    usual_px = float(np.median(list(total_px.values()))) if total_px else 1.0
    for index, blur in shared.items():
        ratio, blur_sigma = total_px[index] / usual_px, fits[index].blur_sigma
        figures = {"blur_ratio": ratio, "blur_sigma": blur_sigma} if np.isfinite(blur_sigma) else {}
        is_unlike = blur is not None and blur.differs and index not in faint
        amended[index] = matched.detections[index].amend(*[unlike_blur(ratio)] * is_unlike, figures=figures)
    return orient_frame(matched.replace_detections(amended))


def _is_better(before: MarkFit, fit: MarkFit, blur: SharedBlur | None) -> bool:
    """Whether the fit of a faint mark replaces its filtered place: same mark, others' blur, smaller sigma."""
    if blur is not None and not blur.is_confirmed(fit):
        return False
    off = fit.center_px - before.center_px
    return fit.sigma_px < before.sigma_px and may_be_noise(off, before.covariance_px2 + fit.covariance_px2)


def _compare_shapes(frame: Frame) -> Frame:
    """Doubt marks with an outlying size or rotation; each covariance grows by what an object touching it may cause."""
    fits = {index: fit for index, fit in frame.clear_fits.items() if fit.covariance is not None}
    groups: dict[Mark | None, list[int]] = defaultdict(list)
    for index, fit in fits.items():
        mark = frame.layout.marks[index].mark
        if _is_drawn(frame, index) and not is_held_by_frame(mark):
            groups[mark].append(index)
        elif _is_drawn(frame, index) and fit.own_shape is not None:
            groups[None].append(index)
    changed = {}
    for drawn, indices in groups.items():
        figures = [_shape_figures(fits[index], frame.linear(index), drawn is None) for index in indices]
        own, sigmas = (np.array(each) for each in zip(*figures, strict=True))
        for index, shape, sigma in zip(indices, shared_shapes(own, sigmas), sigmas, strict=True):
            if shape is not None:
                changed[index] = _doubt_shape(frame, index, fits[index], shape, sigma)
    return frame.replace_detections(changed)


def _shape_figures(fit: MarkFit, linear: Array, is_held: bool) -> tuple[Array, Array]:
    """Log ratio of a mark's size to the frame's, and its rotation (rad) if the frame gave it; standard deviations."""
    if is_held and fit.own_shape is not None:
        return fit.own_shape.change, fit.own_shape.sigma
    return np.array([np.log(linear_scale(fit.pixel_from_mark) / linear_scale(linear))]), np.array([fit.size_sigma])


def _doubt_shape(frame: Frame, index: int, fit: MarkFit, shape: SharedShape, sigma: Array) -> Detection:
    """Store the shape of a mark relative to the others, and doubt an outlier. sigma (k,): of the mark's own figures."""
    mark, is_damaged, touch = frame.layout.marks[index].mark, fit.damaged_fraction > 0, None
    figures = dict(
        zip(("size_ratio", "turn_rad"), (float(np.exp(shape.off[0])), *shape.off[1:].tolist()), strict=False)
    )
    figures |= dict(zip(("size_sigma", "turn_sigma"), sigma.tolist(), strict=False))
    if isinstance(mark, MarkShape) and is_cross(mark):
        place = np.column_stack([frame.linear(index), fit.center_px])
        window = read_window(frame.scan, mark_window(mark, place, frame.options.match.margin_px), frame.weights)
        for number, (length, sigma_length) in enumerate(zip(*measure_arms(window, mark, place, fit), strict=True), 1):
            figures |= {f"arm{number}_ratio": float(length), f"arm{number}_sigma": float(sigma_length)}
    unlike = unlike_others(figures["size_ratio"], figures.get("turn_rad"))
    if fit.own_shape is not None and is_held_by_frame(mark):
        middle_px = reach_px(mark, fit.pixel_from_mark[:, :2]) / 2
        touch = touch_of_edges(shape, fit.own_shape.on_place, middle_px, is_damaged)
    elif is_round(mark):
        px_per_mm = linear_scale(fit.pixel_from_mark)
        touch = touch_of_round(shape, _radius_mm(mark) * px_per_mm, px_per_mm, is_damaged)
    reasons = [unlike] if shape.differs else []
    if not reasons and touch and is_round(mark) and is_damaged and touch.exceedance(WRONG_PX) > LARGE_ERROR:
        near = f"and the picture next to it is damaged: something may touch it; error over {WRONG_PX} px"
        reasons = [unlike.reword(f"{unlike.split(':')[0]}, {near}")]
    parts = {} if touch is None else {Cause.TOUCHED: touch.variance_px2 * np.eye(2)}
    return frame.detections[index].amend(*reasons, parts=parts, figures=figures)


def _radius_mm(mark: Mark) -> float:
    """Radius of the outline of a round mark."""
    parts = mark.parts if isinstance(mark, MarkShape) else ()
    return max(part.radius_mm for part in parts if isinstance(part, Disk | Ring))


def _is_drawn(frame: Frame, index: int) -> bool:
    """Whether a mark is given as a drawing; a template brings its own blur."""
    return isinstance(frame.layout.marks[index].mark, MarkShape)


def _linear_sigma(frame: Frame) -> float:
    """Standard deviation of the frame's rotation (rad), scale, stretch and shear at a mark, bending included."""
    places = frame.camera_mm[frame.inliers]
    radius_mm = float(np.hypot(*(places - places.mean(axis=0)).T).mean())
    bend = float(np.hypot(frame.options.film_sigma_mm, frame.scatter_mm)) / radius_mm
    unchecked = 0.0
    if frame.inliers.sum() <= _UNCHECKED:  # a wrong name or place appears as stretch and shear
        greater, less = np.linalg.svd(frame.pixel_from_camera[:, :2] * frame.pitch_mm[:, None], compute_uv=False)
        unchecked = (greater - less) / (greater + less)
    return float(np.linalg.norm([frame.linear_sigma, bend, unchecked]))


def _refit(frame: Frame, options: Mapping[int, MatchOptions], orient: bool = True) -> Frame:
    """Refit marks at their places, with options by index. A clear fit stays if the new one is not clear."""
    sigma = _linear_sigma(frame) if options else np.inf
    fits = {index: _fit_again(frame, index, each, sigma) for index, each in sorted(options.items())}
    kept = {
        index: fit
        for index, fit in fits.items()
        if fit is not None and (fit.likeness >= CLEAR_LIKENESS or not frame.is_clear(index))
    }
    frame = frame.replace_fits(kept)
    return orient_frame(frame) if orient else frame


def _fit_again(frame: Frame, index: int, options: MatchOptions, linear_sigma: float) -> MarkFit | None:
    """Refit a mark at its measured place, with the frame's rotation and scale if it is held by them."""
    before = frame.detections[index].fit
    if before is None:
        return None
    expected = frame.prediction(index, _REFIT_PX).shift_to(before.center_px)
    # Marks whose size, place and blur are less separate begin anew: they have further minima.
    begun = before if isinstance(expected.mark, MarkShape) and is_cross(expected.mark) else None
    return detect_mark(frame.scan, expected, options, linear_sigma, begun).fit

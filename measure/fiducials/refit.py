"""The marks of a frame fitted once more with what the frame says of them: rotation, scale and strain, tone curve, blur;
and those doubted that look unlike the others."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from measure.array_types import Array
from measure.fiducials.constellation import Placement
from measure.fiducials.film_model import film_terms, interleaved
from measure.fiducials.frame import CLEAR_LIKENESS, WRONG_PX, Frame, orient_frame
from measure.fiducials.mark_comparison import (
    SharedBlur,
    SharedShape,
    shared_blurs,
    shared_shapes,
    touch_of_edges,
    touch_of_round,
    unlike_blur,
    unlike_others,
)
from measure.fiducials.mark_fit import detect_mark, is_held_by_frame, strain_error_px
from measure.flags import LARGE_ERROR, Cause
from measure.geometry import linear_scale
from measure.marks.rendering import extent_px, reach_px
from measure.marks.shapes import Disk, FiducialLayout, FrameCorner, LayoutMark, Mark, MarkShape, Ring
from measure.matching.arms import is_cross, measure_arms
from measure.matching.frame_edge import Course, edge_along, pool_edge_tones
from measure.matching.match import mark_window
from measure.matching.models import PIXEL_VARIANCE_PX2, is_round
from measure.matching.options import MatchOptions
from measure.matching.window import read_window
from measure.noise.noise_model import may_be_noise
from measure.results import MarkFit
from measure.scans.scan import Scan
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import estimate_sharpening

_NEAR_MM = 3.0  # from the frame's edge: a mark nearer has it beside itself, in what is read of the scan anyway
_BESIDE_MM, _LONGEST_MM = 0.5, 6.0  # from a mark, to where an edge begins and ends
_PIECES = 8  # of edges that are asked, at most
_SEARCH_MM = 0.3  # about where the frame's size puts its edge
_SHARE_PX, _FEWEST = 8.0, 5  # of an edge that a profile is of, and how many an edge has at least
_STRAINED = 1 / 3  # of its standard deviation: an error of a twentieth more
_TONE_ROUNDS = 5  # of fitting by a better curve
_OTHER_STARTS, _AGREED = (2.2, 1.0), 0.1  # powers; how unsettled a curve is that needs none of them
_TELLING = 8  # marks, the plainest of a frame, that tell its scan's sharpening: more take their time
_SHARPENING_ROUNDS = 6  # of fitting by a better estimate of a scan's sharpening
_MOVED = 0.3  # of its standard deviation that a mark may still move
_UNCHECKED = 3  # marks, which an affine transformation fits without residuals
_REFIT_PX = 1.5  # about a mark that was fitted already


def refit_frame(frame: Frame) -> Frame:
    """Fit the marks of a frame once more with all that the frame says of them, and compare them with one another.

    Marks whose own pictures do not tell rotation and scale get the frame's; marks that the frame's stretch and shear
    move get these, which no single fit tells; what the tone curve moves is fitted by the curve that the marks tell;
    marks that hardly tell their own blur get that of the others.
    """
    if frame.inliers.sum() >= 2:
        frame = _refit_with_tone(frame)
        frame = _refit_with_blur(frame)
    return _compare_shapes(_add_lens_covariance(_add_tone_covariance(frame)))


def sharpen_frame(frame: Frame) -> Frame:
    """The frame with its clear marks fitted in what the scan was before it was sharpened, as they say by how much; the
    same where they do not say that it was."""
    if not frame.agrees:
        return frame
    plainest, begun = sorted(clear_fits(frame).items(), key=lambda item: -item[1].significance), frame
    telling = [index for index, fit in plainest if fit.sharpening is not None]
    for _ in range(_SHARPENING_ROUNDS):
        before = frame.scan.tone.sharpening
        scores = [fit.sharpening for index in telling if (fit := frame.detections[index].fit) and fit.sharpening]
        found = estimate_sharpening(before, scores, len(frame.scan.tone.mean))
        if found is None or found.is_as(before):
            break
        frame = replace(frame, scan=frame.scan.replace_tone(frame.scan.tone.sharpened(found)))
        telling = telling[:_TELLING]
        frame = _refit(frame, dict.fromkeys(telling, frame.options.match), orient=False)
    if found is not None:
        frame = replace(frame, scan=frame.scan.replace_tone(frame.scan.tone.sharpened(found)))
    rest = {index for index, _ in plainest} - {*telling}
    return begun if frame is begun else _refit(frame, dict.fromkeys(rest, frame.options.match))


def _refit_with_tone(frame: Frame) -> Frame:
    """Far from the right curve noise is not even, and may hide it: where what the marks say does not agree, other
    curves are begun with, too."""
    prior = frame.scan.tone.prior
    best = _refit_from_curve(frame, prior, frame.scan.tone)
    for power in _OTHER_STARTS if best.tone.disagreement > _AGREED and _depends_on_tone(best) else ():
        other = _refit_from_curve(best, prior, prior.shift_to_power(power))
        best = other if other.tone.disagreement < best.tone.disagreement else best
    return best


def _refit_from_curve(frame: Frame, prior: Tone, start: Tone) -> Frame:
    """From where the marks were found, beginning with a tone curve; prior: the one before this frame."""
    if start is frame.scan.tone:
        pending = {index for index, fit in clear_fits(frame).items() if _needs_frame(frame, index, fit)}
    else:
        frame, pending = replace(frame, scan=frame.scan.replace_tone(start)), set(_mark_tones(frame))
    edges = _edges(frame)
    for _ in range(_TONE_ROUNDS):
        estimate = FrameTone.from_marks(prior, _mark_tones(frame), frame.scan.tone, edges)
        moved = _moved_by_tone(frame, estimate)
        if moved:
            frame = replace(frame, scan=frame.scan.replace_tone(estimate.next_curve(frame.scan.tone)))
        if not pending | moved:
            break
        frame = _refit(frame, dict.fromkeys(pending | moved, frame.options.match))
        edges, pending = _edges(frame), set()
    return replace(frame, tone=FrameTone.from_marks(prior, _mark_tones(frame), frame.scan.tone, edges))


def _needs_frame(frame: Frame, index: int, fit: MarkFit) -> bool:
    """Whether a fit changes with the frame's rotation and scale, or with its stretch and shear: on film that is more
    than affinely deformed, or seen through a lens, every one does, for there marks look otherwise at each place."""
    if frame.film is not None or frame.options.lens is not None:
        return True
    mark, linear = frame.layout.marks[index].mark, frame.linear(index)
    error_px = strain_error_px(mark, fit.pixel_from_mark[:, :2], linear, _linear_sigma(frame))
    return is_held_by_frame(mark) or error_px > _STRAINED * fit.sigma_px


def _moved_by_tone(frame: Frame, estimate: FrameTone) -> set[int]:
    """The marks that tell something of the curve, if the estimated one moves any of them."""
    fits, tones = clear_fits(frame), _mark_tones(frame)
    moves = (estimate.shift_px(tone, frame.scan.tone) > _MOVED * fits[index].sigma_px for index, tone in tones.items())
    return set(tones) if any(moves) else set()


def _edges(frame: Frame) -> Sequence[ToneInformation]:
    """Of the curve by the frame's edges beside the marks, where one of these depends on it. What lossy compression
    rounds away is alike all along an edge, and looks like a curve."""
    if frame.scan.is_lossy or not _depends_on_tone(frame):
        return []
    return edge_tone_information(frame.scan, frame.layout, frame.fitted_placement, frame.weights)


def _depends_on_tone(frame: Frame) -> bool:
    """Whether what is not known of any curve moves a mark by more than its standard deviation."""
    fits = clear_fits(frame)
    return any(tone.sensitivity_px > fits[index].sigma_px for index, tone in _mark_tones(frame).items())


def _mark_tones(frame: Frame) -> dict[int, MarkTone]:
    return {index: fit.tone for index, fit in clear_fits(frame).items() if fit.tone is not None}


def _add_tone_covariance(frame: Frame) -> Frame:
    """What is not known of tone curve and sharpening, in the covariance of each mark that it moves."""
    for index, detection in enumerate(frame.detections):
        if detection.fit is not None and detection.fit.tone is not None:
            frame = frame.add_covariance(index, Cause.TONE, frame.tone.covariance_px2(detection.fit.tone))
        if detection.fit is not None and detection.fit.sharpening is not None and frame.scan.tone.sharpening:
            unknown = detection.fit.sharpening.covariance_px2(frame.scan.tone.sharpening)
            frame = frame.add_covariance(index, Cause.SHARPENING, unknown)
    return frame


def _add_lens_covariance(frame: Frame) -> Frame:
    """What is not known of the taking lens and the film model does not take, in the covariance of each mark."""
    fits, lens = _inlier_fits(frame), frame.options.lens
    if lens is None or not fits:
        return frame
    covariance = lens.covariance_px2(np.array([fit.center_px for fit in fits.values()]))
    given = frame.camera_mm[list(fits)] / np.abs(frame.camera_mm).max()
    (x, y), one, none = given.T, np.ones(len(given)), np.zeros(len(given))
    affine = interleaved((x, none), (y, none), (one, none), (none, x), (none, y), (none, one))
    free = np.hstack([affine, film_terms(frame.options.film_model, given)])
    left = np.eye(len(free)) - free @ np.linalg.pinv(free)
    parts = (left @ covariance @ left).reshape(len(fits), 2, len(fits), 2)
    for number, index in enumerate(fits):
        frame = frame.add_covariance(index, Cause.LENS, parts[number, :, number])
    return frame


def _refit_with_blur(frame: Frame) -> Frame:
    """Fit marks that hardly tell their own blur once more with that of the others, and faint marks, whose places are a
    filter's, too; what differs from the others' blur is doubted."""
    drawn = {index: fit for index, fit in _inlier_fits(frame).items() if _is_drawn(frame, index)}
    faint = {index: fit for index, fit in drawn.items() if fit.covariance is None}
    fits = {index: fit for index, fit in drawn.items() if index not in faint and frame.is_clear(index)} | faint
    shared = dict(zip(fits, shared_blurs(list(fits.values())), strict=True))
    options = {index: _set_blur(frame.options.match, blur) for index, blur in shared.items() if blur is not None}
    matched = _refit(frame, {index: each for index, each in options.items() if index not in faint}, orient=False)
    for index, before in faint.items():
        fit = _fit_again(frame, index, options.get(index, frame.options.match))
        if fit is not None and _is_better(before, fit, shared[index]):
            matched = matched.replace_fits({index: fit})
    total_px = {index: float(np.sqrt(fit.blur_px**2 + PIXEL_VARIANCE_PX2)) for index, fit in fits.items()}
    for index, blur in shared.items():
        ratio = total_px[index] / float(np.median(list(total_px.values())))
        if np.isfinite(fits[index].blur_sigma):
            matched = matched.add_figures(index, {"blur_ratio": ratio, "blur_sigma": fits[index].blur_sigma})
        if blur is not None and blur.differs and index not in faint:
            matched = matched.add_reason(index, unlike_blur(ratio))
    return orient_frame(matched)


def _set_blur(options: MatchOptions, blur: SharedBlur) -> MatchOptions:
    return replace(options, blur_px=blur.blur_px, blur_sigma=blur.sigma)


def _is_better(before: MarkFit, fit: MarkFit, blur: SharedBlur | None) -> bool:
    """Whether a fit of a faint mark counts: where it means the same mark, of the others' blur, and is the better known.
    A faint mark takes all that is finer than the mark for texture: in plain noise a fit knows its place far better."""
    if blur is not None and not blur.is_confirmed(fit):
        return False
    off = fit.center_px - before.center_px
    return fit.sigma_px < before.sigma_px and may_be_noise(off, before.covariance_px2 + fit.covariance_px2)


def _compare_shapes(frame: Frame) -> Frame:
    """Doubt marks of another size, or turn, than the others: something, dust say, covers or touches one.

    Marks that tell their own size are compared with those drawn alike; those held by the frame all together, by what
    their own pictures say of its rotation and scale. A mark is known no better than what may touch it moves it.
    """
    fits = {index: fit for index, fit in clear_fits(frame).items() if fit.covariance is not None}
    groups: dict[Mark | None, list[int]] = defaultdict(list)
    for index, fit in fits.items():
        mark = frame.layout.marks[index].mark
        if _is_drawn(frame, index) and not is_held_by_frame(mark):
            groups[mark].append(index)
        elif _is_drawn(frame, index) and fit.own_shape is not None:
            groups[None].append(index)
    for drawn, indices in groups.items():
        figures = [_shape_figures(fits[index], frame.linear(index), drawn is None) for index in indices]
        own, sigmas = (np.array(each) for each in zip(*figures, strict=True))
        for index, shape, sigma in zip(indices, shared_shapes(own, sigmas), sigmas, strict=True):
            if shape is not None:
                frame = _doubt_shape(frame, index, fits[index], shape, sigma)
    return frame


def _shape_figures(fit: MarkFit, linear: Array, is_held: bool) -> tuple[Array, Array]:
    """The logarithm of a mark's size over the frame's, and its turn where the frame held it; standard deviations."""
    if is_held and fit.own_shape is not None:
        return fit.own_shape.change, fit.own_shape.sigma
    return np.array([np.log(linear_scale(fit.pixel_from_mark) / linear_scale(linear))]), np.array([fit.size_sigma])


def _doubt_shape(frame: Frame, index: int, fit: MarkFit, shape: SharedShape, sigma: Array) -> Frame:
    """sigma (k,): standard deviations of the mark's own figures."""
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
    frame = frame.add_figures(index, figures)
    unlike = unlike_others(figures["size_ratio"], figures.get("turn_rad"))
    if fit.own_shape is not None and is_held_by_frame(mark):
        middle_px = reach_px(mark, fit.pixel_from_mark[:, :2]) / 2
        touch = touch_of_edges(shape, fit.own_shape.on_place, middle_px, is_damaged)
    elif is_round(mark):
        px_per_mm = linear_scale(fit.pixel_from_mark)
        touch = touch_of_round(shape, _radius_mm(mark) * px_per_mm, px_per_mm, is_damaged)
    if shape.differs:
        frame = frame.add_reason(index, unlike)
    elif touch is not None and is_round(mark) and is_damaged and touch.exceedance(WRONG_PX) > LARGE_ERROR:
        size = unlike.split(":")[0]
        near = f"{size}, and the picture next to it is damaged: something may touch it; error over {WRONG_PX} px"
        frame = frame.add_reason(index, unlike.reword(near))
    if touch is not None:
        frame = frame.add_covariance(index, Cause.TOUCHED, touch.variance_px2 * np.eye(2))
    return frame


def _radius_mm(mark: Mark) -> float:
    """Of a round mark's outline."""
    parts = mark.parts if isinstance(mark, MarkShape) else ()
    return max(part.radius_mm for part in parts if isinstance(part, Disk | Ring))


def _is_drawn(frame: Frame, index: int) -> bool:
    """Whether a mark is a drawing: a template has a blur of its own."""
    return isinstance(frame.layout.marks[index].mark, MarkShape)


def _inlier_fits(frame: Frame) -> dict[int, MarkFit]:
    return {index: fit for index, fit in enumerate(frame.fits) if fit is not None}


def clear_fits(frame: Frame) -> dict[int, MarkFit]:
    """The fits of the inliers that are plainly there, by index."""
    return {index: fit for index, fit in _inlier_fits(frame).items() if fit.likeness >= CLEAR_LIKENESS}


def _linear_sigma(frame: Frame) -> float:
    """The standard deviation of rotation (rad), scale, stretch and shear at a mark: of the frame by its marks, and by
    as much as film bends between them. Three marks show no gross error: a mark under a wrong name, or off its place,
    makes stretch and shear of its own, so that what they show of these counts as unknown."""
    places = frame.camera_mm[frame.inliers]
    radius_mm = float(np.hypot(*(places - places.mean(axis=0)).T).mean())
    bend = float(np.hypot(frame.options.film_sigma_mm, frame.scatter_mm)) / radius_mm
    unchecked = 0.0
    if frame.inliers.sum() <= _UNCHECKED:
        greater, less = np.linalg.svd(frame.pixel_from_camera[:, :2] * frame.pitch_mm[:, None], compute_uv=False)
        unchecked = (greater - less) / (greater + less)
    return float(np.linalg.norm([frame.linear_sigma, bend, unchecked]))


def _refit(frame: Frame, options: Mapping[int, MatchOptions], orient: bool = True) -> Frame:
    """Fit marks, by index, where they were found. What does not look like the mark any longer, a line along which it
    slid, is no better than what did."""
    fits = {index: _fit_again(frame, index, each) for index, each in sorted(options.items())}
    kept = {
        index: fit
        for index, fit in fits.items()
        if fit is not None and (fit.likeness >= CLEAR_LIKENESS or not frame.is_clear(index))
    }
    frame = frame.replace_fits(kept)
    return orient_frame(frame) if orient else frame


def _fit_again(frame: Frame, index: int, options: MatchOptions) -> MarkFit | None:
    """A mark where it was found, with the frame's rotation and scale where it is held by them."""
    before = frame.detections[index].fit
    if before is None:
        return None
    expected = frame.prediction(index, _REFIT_PX).moved(before.center_px)
    return detect_mark(frame.scan, expected, options, _linear_sigma(frame)).fit


# Tips of wedges, wings and notches are short, and their own edges tell the tone curve badly. The edge of the exposed
# frame beside them is a long one, between the same dark and the same light.


def edge_tone_information(
    scan: Scan, layout: FiducialLayout, placement: Placement, weights: Sequence[float] | None
) -> list[ToneInformation]:
    """None or one, of all pieces of the frame's edge that are seen as straight lines."""
    px_per_mm = linear_scale(placement.pixel_from_camera)
    tones = []
    pieces = list(_pieces(layout))
    for start_mm, along_mm, inwards_mm, length_mm in pieces[:: max(len(pieces) // _PIECES, 1)]:
        count = int(length_mm * px_per_mm / _SHARE_PX)
        if count < _FEWEST:
            continue
        linear = placement.linear(start_mm)
        along, across = linear @ along_mm, linear @ inwards_mm
        across = across - along * (across @ along) / (along @ along)
        course = Course(
            scan,
            placement.places_px(start_mm[None])[0],
            along / np.hypot(*along),
            across / np.hypot(*across),
            weights,
        )
        edge = edge_along(course, (0.0, length_mm * px_per_mm), _SEARCH_MM * px_per_mm, 0, count)
        if edge is not None and edge.tone is not None:
            tones.append(edge.tone)
    return [pool_edge_tones(tones, scan.tone)] if tones else []


def _pieces(layout: FiducialLayout) -> Iterator[tuple[Array, Array, Array, float]]:
    """Of the frame's edge on both sides of each mark near it, in mm: where it begins, which way it runs, which way the
    frame's inside lies, and its length."""
    half = np.array(layout.frame_mm) / 2
    for mark in layout.marks:
        at = np.array(mark.xy_mm)
        side = int(np.argmin(half - np.abs(at)))
        if half[side] - abs(at[side]) > _NEAR_MM or isinstance(mark.mark, FrameCorner):
            continue
        inwards, run = np.zeros(2), np.zeros(2)
        inwards[side], run[1 - side] = -np.sign(at[side]), 1.0
        on_edge = np.where(np.arange(2) == side, np.sign(at) * half, at)
        reach = _reach_mm(mark, 1 - side) + _BESIDE_MM
        for way in (1.0, -1.0):
            room = half[1 - side] - way * at[1 - side]  # to the corner
            neighbours = [
                way * (np.array(other.xy_mm) - at)[1 - side] for other in _same_side_marks(layout, mark, side)
            ]
            room = min([room, *(gap - reach for gap in neighbours if gap > 0)]) - _BESIDE_MM
            yield on_edge + way * reach * run, way * run, inwards, min(room, _LONGEST_MM) - reach


def _same_side_marks(layout: FiducialLayout, mark: LayoutMark, side: int) -> list[LayoutMark]:
    """The other marks near the same edge."""
    half, sign = layout.frame_mm[side] / 2, np.sign(mark.xy_mm[side])
    return [one for one in layout.marks if one is not mark and half - sign * one.xy_mm[side] < 2 * _NEAR_MM]


def _reach_mm(mark: LayoutMark, axis: int) -> float:
    """How far a mark reaches from its place along an axis."""
    least, greatest = extent_px(mark.mark, np.eye(2, 3))
    return float(max(-least[axis], greatest[axis]))


# The marks of a frame fitted once more with what the frame says of them: rotation, scale and strain, tone curve, blur;
# and those doubted that look unlike the others.

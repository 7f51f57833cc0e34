"""Measurement of one frame at full resolution, starting from its placement.

The marks are detected and the interior orientation is estimated from the inliers. The other marks are detected where it
predicts them. All marks are then refitted with what they have in common: rotation, scale and strain of the frame, width
of the lines, sharpening, tone curve and blur.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from measure.array_types import Array
from measure.detection.correlation import CLOSE
from measure.detection.localisation import MarkPrediction, highest_peak
from measure.fiducials.consistency import FrameMarks, Scatter, gross_errors
from measure.fiducials.constellation import NARROW, Placement
from measure.fiducials.faint_marks import detect_faint_marks, faint_reach_px
from measure.fiducials.frame import LEAST_SIGNIFICANCE, MANY, REDUCED_PX, Frame
from measure.fiducials.interior_orientation import film_terms, fit_frame, interleaved
from measure.fiducials.mark_comparison import SharedBlur, compare_shapes, shared_blurs, shared_line_width, unlike_blur
from measure.fiducials.mark_fit import Detection, detect_mark, not_found, strain_error_px
from measure.fiducials.options import SCATTER_DEGREES, FiducialOptions
from measure.fiducials.significance import random_matches
from measure.flags import FAINT_MARK_BY_NOISE, TEXTURE_LIKE_A_FAINT_MARK, Cause
from measure.geometry import UP_FROM_CAMERA
from measure.marks.rendering import mark_window, picture
from measure.marks.shapes import MOST_GIVEN_SIGMA_MM, FiducialLayout, Mark, MarkShape, widen_lines
from measure.matching.models import PIXEL_VARIANCE_PX2, MatchOptions
from measure.noise.noise_model import may_be_noise
from measure.results import MarkFit
from measure.scans.parallel import map_in_threads
from measure.scans.scan import LUMINANCE, SINGLE_CHANNELS, Scan
from measure.tone.curve import Tone
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import FEWEST_MARKS, Sharpening, estimate_sharpening

LEAST_LIKENESS = 0.35  # correlation with the drawing: below it texture, text and scratches are as similar
_FAINT_SIGNIFICANCE = 2.0  # the same where noise hardly gives such a peak: there is contrast, at 95 %
_MARGIN_PX = 4.0  # width of the background around a mark, used to estimate its offset and slopes
_BLUR_PX = 0.8  # blur of a mark's image, the initial value of a match
_CLEAR_PEAK = 0.25  # NCC before the fit that corresponds to the likeness of a clear mark after it
_TRIALS = 6  # about this many marks are used to choose the channels, or to test a placement
_CHANNELS = "red", "green", "blue"
_COINCIDING_PX, _FEWEST_SHIFTS = 0.5, 3  # px between two channels below which they coincide, by this many marks
_SHRINK = 0.1  # shrinkage of the noise covariance towards a multiple of the unit matrix: few pixels determine it poorly
_FEWEST_SHARPENED = 4  # clear marks for a first estimate of the sharpening: of three, one may be taken for halos
_ROUNDS = 2  # of detecting faint marks: the first marks found improve the predictions of the others
_STRAINED = 1 / 3  # fraction of a mark's standard deviation: a larger strain error raises it by more than a twentieth
_BETTER_KNOWN = 2 / 3  # ratio of the standard deviations of rotation and scale after and before a refit for another one
_TONE_ROUNDS = 5  # largest number of refits with an improved tone curve
_OTHER_STARTS, _AGREED = (2.2, 1.0), 0.1  # gammas of further initial curves; disagreement up to which none is tried
_TELLING = 8  # most significant marks, refitted until widths, sharpening and tone curve are settled: more cost time
_SHARED_ROUNDS = 8  # largest number of refits with improved widths and sharpening
_UNCHECKED = 3  # marks, which an affine transformation fits without residuals
_REFIT_PX = 1.5  # search range around a mark that was fitted already


def measure_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Measure a frame from its placement."""
    return refit_frame(fit_lines_and_sharpening(detect_frame(scan, layout, placement, options)))


def detect_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Detect the marks of a frame, clear and faint ones, without the refit."""
    frame = start_frame(scan, layout, placement, options)
    clear = orient_frame(_detect(frame, range(len(layout.marks)), frame.first_search_px))
    return detect_missing_marks(fit_lines_and_sharpening(clear, _FEWEST_SHARPENED))


def start_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Start a frame from its placement, with the channel weights of a colour scan.

    Some marks are located, each in the channel (or the luminance) with the highest correlation peak. The weights are
    then estimated from these marks. Where channels do not coincide, only those count that do with one another.
    If no mark is drawn as light or dark, the weights also determine the polarity.
    """
    frame = Frame.from_placement(scan, layout, placement, options)
    if scan.channels == 1:
        return frame
    marks = layout.marks
    tried = range(0, len(marks), max(1, len(marks) // _TRIALS))
    predictions = [frame.prediction(index, frame.first_search_px) for index in tried]
    peaks = [
        [highest_peak(frame.scan, replace(expected, weights=weights)) for weights in (*SINGLE_CHANNELS, LUMINANCE)]
        for expected in predictions
    ]
    among, note = registered_channels([each[:-1] for each in peaks])
    places = []
    for expected, own in zip(predictions, peaks, strict=True):
        place, height = max((own[each] for each in (among if note else range(len(own)))), key=lambda peak: peak[1])
        if height > _CLEAR_PEAK:
            places.append((expected.mark, expected.shift_to(place).pixel_from_mark, expected.polarity))
    unsaid = all(mark.mark.polarity == "auto" for mark in marks)
    best = best_weights(frame.scan, places, (1, -1) if unsaid else (1,), among)
    if best is None:
        return frame
    weights, sign = best
    placement = replace(frame.placement, polarity=sign * frame.placement.polarity)
    return replace(frame, weights=weights, channel_note=note, placement=placement)


def registered_channels(peaks: Sequence[Sequence[tuple[Array, float]]]) -> tuple[list[int], str]:
    """Find the largest group of channels that coincide.

    Parameters
    ----------
    peaks : place (px) and height of the correlation peak of each mark in red, green and blue.

    Returns
    -------
    Indices of these channels, and a note if others do not coincide with them.
    """
    places, heights = (np.array([[peak[part] for peak in each] for each in peaks]) for part in (0, 1))
    count, clear = len(SINGLE_CHANNELS), heights > _CLEAR_PEAK
    shifts = np.zeros((count, count, 2))
    for one, other in permutations(range(count), 2):
        between = (places[:, other] - places[:, one])[clear[:, one] & clear[:, other]]
        shift = np.median(between, axis=0) if len(between) >= _FEWEST_SHIFTS else np.zeros(2)
        if len(between) and np.median(np.hypot(*(between - shift).T)) < _COINCIDING_PX:  # else peaks of something else
            shifts[one, other] = shift
    coincide = np.hypot(*np.moveaxis(shifts, -1, 0)) <= _COINCIDING_PX
    best = max(range(count), key=lambda each: (coincide[each].sum(), heights[:, coincide[each]].sum()))
    among, apart = (np.flatnonzero(coincide[best] == one).tolist() for one in (True, False))
    if not apart:
        return among, ""
    own = " and ".join(_CHANNELS[each] for each in among)
    shifted = " and ".join(
        f"{_CHANNELS[each]} lies ({shifts[best, each, 0]:+.1f}, {shifts[best, each, 1]:+.1f}) px" for each in apart
    )
    note = f"The colour channels do not coincide: {shifted} from {own}. Marks are measured in {own} alone."
    return among, note


def best_weights(
    scan: Scan, marks: Sequence[tuple[Mark, Array, int]], signs: Sequence[int] = (1,), among: Sequence[int] = (0, 1, 2)
) -> tuple[tuple[float, ...], int] | None:
    """Estimate channel weights by Fisher's linear discriminant.

    Parameters
    ----------
    scan : colour scan.
    marks : marks with pixel_from_mark (2, 3) and sign: +1 lighter than the background, -1 darker.
    signs : common factors of all signs to try, since a mark may be lighter in one channel and darker in another.
    among : channels that may have a weight.

    Returns
    -------
    Weights with sum 1, and the best of signs. None for a grey scan, or if no mark has any contrast.

    Notes
    -----
    Negative weights are set to 0: a difference of channels would show their misregistration.
    """
    if scan.channels == 1 or not marks:
        return None
    units = np.eye(scan.channels)[list(among)]
    contrast, covariance = np.zeros(len(units)), np.zeros((len(units), len(units)))
    for mark, pixel_from_mark, sign in marks:
        col0, row0, width, height = mark_window(mark, pixel_from_mark, _MARGIN_PX)
        channels = np.stack([scan.window(col0, row0, width, height, unit).ravel() for unit in units.tolist()])
        shifted = np.array(pixel_from_mark)
        shifted[:, 2] -= (col0, row0)
        value = picture(mark, shifted, width, height, _BLUR_PX).ravel()
        row, col = np.mgrid[:height, :width].reshape(2, -1).astype(float)
        design = np.stack([value, np.ones_like(value), col, row], axis=1)
        solution, *_ = np.linalg.lstsq(design, channels.T, rcond=None)
        contrast += sign * solution[0]
        covariance += np.atleast_2d(np.cov(channels - (design @ solution).T))
    covariance += _SHRINK * np.trace(covariance) / len(covariance) * np.eye(len(covariance))
    if not np.linalg.det(covariance) > 0:
        return None
    discriminant = np.linalg.solve(covariance, contrast)

    def contrast_over_noise(sign: int) -> float:
        """Contrast over noise of the non-negative weights for a sign."""
        weights = np.maximum(sign * discriminant, 0.0)
        return float(sign * weights @ contrast / np.sqrt(max(weights @ covariance @ weights, 1e-300)))

    best = max(signs, key=contrast_over_noise)
    if not contrast_over_noise(best) > 0:
        return None
    weights = np.maximum(best * discriminant, 0.0) @ units
    return tuple(float(weight) for weight in weights / weights.sum()), best


def _detect(frame: Frame, indices: Iterable[int], search_px: float, at_any_likeness: bool = False) -> Frame:
    """Detect marks again within search_px of their current predictions."""
    # From the bottom upwards: the search in windows ended there, and the rows read last are still decoded.
    upwards = sorted(indices, key=lambda index: -frame.predicted_px[index, 1])
    least = 0.0 if at_any_likeness else LEAST_LIKENESS
    detections = map_in_threads(lambda index: _detection(frame, frame.prediction(index, search_px), least), upwards)
    return frame.replace_detections(dict(zip(upwards, detections, strict=True)))


def _detection(frame: Frame, expected: MarkPrediction, least_likeness: float = LEAST_LIKENESS) -> Detection:
    """Detect one mark; a fit that texture could give is dropped, unless all marks together decide on the frame.

    Faint marks of a frame of many are detected later, where the others predict them.
    """
    detection = detect_mark(frame.scan, expected, replace(frame.options.match, tells_sharpening=True))
    fit, closer = detection.fit, frame.placement.surroundings.robust
    sure = detection.false_alarms <= FAINT_MARK_BY_NOISE
    likeness = (0.0 if closer else least_likeness) if sure else LEAST_LIKENESS
    is_faint = sure and (closer or len(frame.detections) <= MANY)
    significance = _FAINT_SIGNIFICANCE if is_faint else LEAST_SIGNIFICANCE
    if fit is not None and (fit.likeness < likeness or fit.significance < significance):
        return Detection(detection.predicted_px, True, None, not_found(expected.search_px))
    return detection


def orient_frame(frame: Frame) -> Frame:
    """Separate inliers from gross errors and estimate the interior orientation from the inliers.

    Each place has the covariance of its fit and of its given coordinates; the film's scatter is added to the weights.
    Certain and clicked marks are never removed.
    """
    found = np.array([each.fit is not None for each in frame.detections])
    inliers = found.copy()
    if found.sum() < 2:
        return replace(frame, inliers=inliers)
    index = np.flatnonzero(found)
    fits = [frame.detections[i].fit for i in index]
    up = frame.up_mm(np.array([fit.center_px for fit in fits if fit]))
    scaled = np.diag(frame.pitch_mm)
    covariances = np.array([scaled @ fit.covariance_px2 @ scaled for fit in fits if fit])
    given = np.array([min(*frame.layout.marks[i].sigma_mm, MOST_GIVEN_SIGMA_MM) for i in index])
    covariances += given[:, None, None] ** 2 * np.eye(2)
    film = Scatter(frame.options.film_sigma_mm, SCATTER_DEGREES)
    camera, model = frame.camera_mm, frame.options.film_model
    clicked = {click.point for click in frame.options.clicks}
    known = frame.certain | [mark.id in clicked for mark in frame.layout.marks]
    out = gross_errors(FrameMarks.from_places(camera[index], up, covariances, model), film, frame.options.gate_mm)
    out &= ~known[index]
    inliers[index[out]] = False
    sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 2 + film.sigma**2)
    fit = fit_frame(camera[index[~out]], up[~out], sigma[~out], UP_FROM_CAMERA[frame.placement.pose], model)
    pixel_from_camera = np.diag([1.0, -1.0]) @ fit.up_from_camera / frame.pitch_mm[:, None]
    return replace(
        frame, inliers=inliers, pixel_from_camera=pixel_from_camera, linear_sigma=fit.linear_sigma, film=fit.film
    )


def detect_missing_marks(frame: Frame) -> Frame:
    """Detect the missing and unclear marks around the places predicted from the inliers."""
    if frame.accepted:
        frame = orient_frame(_detect_closer(frame))
    if frame.inliers.sum() >= 2 and not frame.is_certain_of_places:
        if len(frame.detections) > MANY:
            # If the frame itself is uncertain, the wide radius would turn texture into marks.
            reach_px = (
                REDUCED_PX * frame.placement.reduction + NARROW * frame.largest_misfit_px
                if frame.placement.surroundings.robust
                else frame.gate_px
            )
            frame = detect_faint_marks(frame, reach_px)
            # With such a search radius no mark is exempt from the outlier test.
            frame = replace(frame, certain=np.zeros_like(frame.certain))
        else:
            frame = _detect_elsewhere(frame)
        frame = orient_frame(frame)
    for _ in range(_ROUNDS):
        if frame.is_certain_of_places:
            frame = orient_frame(detect_faint_marks(frame, faint_reach_px(frame)))
    return frame


def _detect_closer(frame: Frame) -> Frame:
    """Detect unclear marks again with narrow surroundings, since dust or an edge may lie beside."""
    changed = {}
    for index in range(len(frame.detections)):
        if frame.detections[index].is_clear and frame.inliers[index]:
            continue
        expected = replace(frame.prediction(index, frame.gate_px), surroundings=CLOSE)
        detection = detect_mark(frame.scan, expected, frame.options.match)
        fit, is_sure = detection.fit, detection.false_alarms <= TEXTURE_LIKE_A_FAINT_MARK
        if is_sure and fit and fit.is_clear and fit.significance >= LEAST_SIGNIFICANCE:
            changed[index] = replace(detection, closer=True)
    return frame.replace_detections(changed)


def _detect_elsewhere(frame: Frame) -> Frame:
    """Detect unclear marks within the gate of their predictions, then farther off, where only clear fits count.

    An unclear fit counts if no random place matches as well: halos, clipping and motion make a mark unlike its drawing.
    """
    for index in [index for index, each in enumerate(frame.detections) if not each.is_clear]:
        near = far = _detect(frame, [index], frame.gate_px, at_any_likeness=True)
        far_px = _farthest_px(frame, index)
        if not near.detections[index].is_clear and far_px > frame.gate_px:
            far = _detect(frame, [index], far_px)
        frame = far if far.detections[index].is_clear else _without_texture(near, index)
    return frame


def _without_texture(frame: Frame, index: int) -> Frame:
    """Drop a mark that random places match as well."""
    found = frame.detections[index]
    if found.fit is None or not any(random_matches(frame, [index])[0].values()):
        return frame
    return frame.replace_detections({index: replace(found, fit=None, reason=not_found(frame.gate_px))})


def _farthest_px(frame: Frame, index: int) -> float:
    """Largest distance of a mark from the place predicted by the others at which its residual keeps the gate.

    In the adjustment with the mark itself, the residual is that distance divided by 1 + q, where q is the variance of
    the prediction from the others in units of a mark's variance.
    """
    others = np.flatnonzero(frame.inliers & (np.arange(len(frame.inliers)) != index))
    affine = np.column_stack([frame.camera_mm, np.ones(len(frame.camera_mm))])
    if np.linalg.matrix_rank(affine[others]) < affine.shape[1]:
        return frame.gate_px
    variance = float(affine[index] @ np.linalg.inv(affine[others].T @ affine[others]) @ affine[index])
    return min((1 + variance) * frame.gate_px, frame.first_search_px)


def fit_lines_and_sharpening(frame: Frame, fewest: int = 0) -> Frame:
    """Estimate what all marks of the scan share, the width of their lines and its sharpening, and refit them with it.

    fewest: marks without which the sharpening is left for later.

    Exposure widens or narrows the lines of all crosses of a frame alike. Where a line is drawn too wide, the size of a
    cross takes that up, and the ends of its arms are taken for damage, as are the halos of a sharpened scan.
    """
    begun, plainest = frame, _by_significance(frame)
    options, telling = replace(frame.options.match, tells_sharpening=True), plainest
    before, last = frame.scan.tone.sharpening, None
    for _ in range(_SHARED_ROUNDS):
        drawn = _widen_drawings(frame, telling)
        fits = {index: frame.detections[index].fit for index in telling}
        scores = {index: fit.sharpening for index, fit in fits.items() if fit and fit.sharpening}
        found = before
        if begun.agrees and len(scores) >= max(fewest, FEWEST_MARKS):
            found = estimate_sharpening(before, list(scores.values()), len(frame.scan.tone.mean)) or Sharpening()
        if drawn is frame and found.is_as(before):
            break
        telling = telling[:_TELLING]
        if before and last:  # of the others the detail is fitted, which tells nothing of it
            telling = [index for index in telling if index in scores] or telling
        last, before = (before, found), found.accelerated(before, last)
        frame = _refit(
            _replace_tone(drawn, drawn.scan.tone.sharpened(before)), dict.fromkeys(telling, options), orient=False
        )
    if frame is begun:
        return frame
    return _refit(
        _replace_tone(frame, frame.scan.tone.sharpened(found)), dict.fromkeys({*plainest} - {*telling}, options)
    )


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


def _replace_tone(frame: Frame, tone: Tone) -> Frame:
    """Return the frame of the scan with another tone curve, or sharpening."""
    return replace(frame, scan=frame.scan.replace_tone(tone))


def refit_frame(frame: Frame) -> Frame:
    """Refit the marks of a frame with parameters estimated from all of them, and compare them with one another.

    Marks whose image does not determine rotation and scale take those of the frame, as do marks displaced by stretch
    and shear, which no single fit determines. Marks displaced by the tone curve are refitted with the curve estimated
    from all marks. Marks whose blur is poorly determined take that of the others.
    """
    if len(frame.inlier_fits) >= 2:
        frame = orient_frame(shift_to_curve(_refit_with_blur(_refit_with_tone(frame))))
    return compare_shapes(_add_common_covariances(frame))


def _refit_with_blur(frame: Frame) -> Frame:
    """Refit faint marks and those with a poorly determined blur, with the blur of the others as an observation."""
    marks, match, detections = frame.layout.marks, frame.options.match, frame.detections
    drawn = {index: fit for index, fit in frame.inlier_fits.items() if isinstance(marks[index].mark, MarkShape)}
    faint = {index: fit for index, fit in drawn.items() if fit.covariance is None}
    fits = {index: fit for index, fit in drawn.items() if index in faint or detections[index].is_clear}
    shared = dict(zip(fits, shared_blurs(list(fits.values())), strict=True))
    known = {index: blur for index, blur in shared.items() if blur is not None}
    options = {index: replace(match, blur_px=blur.blur_px, blur_sigma=blur.sigma) for index, blur in known.items()}
    matched = _refit(frame, {index: each for index, each in options.items() if index not in faint}, orient=False)
    sigma = _linear_sigma(frame)
    again = {index: _fit_again(frame, index, options.get(index, match), sigma) for index in faint}
    matched = matched.replace_fits(
        {index: choose_fit(faint[index], fit, shared[index]) for index, fit in again.items()}
    )
    amended = {}
    total_px = {index: float(np.sqrt(fit.blur_px**2 + PIXEL_VARIANCE_PX2)) for index, fit in fits.items()}
    usual_px = float(np.median(list(total_px.values()))) if total_px else 1.0
    for index, blur in shared.items():
        ratio, blur_sigma = total_px[index] / usual_px, fits[index].blur_sigma
        figures = {"blur_ratio": ratio, "blur_sigma": blur_sigma} if np.isfinite(blur_sigma) else {}
        is_unlike = blur is not None and blur.differs and index not in faint
        amended[index] = matched.detections[index].amend(*[unlike_blur(ratio)] * is_unlike, figures=figures)
    return matched.replace_detections(amended)


def choose_fit(filtered: MarkFit, fit: MarkFit | None, blur: SharedBlur | None) -> MarkFit:
    """Choose between the filtered place of a faint mark and its fit, which has to have the others' blur.

    Both are of the same pixels. Where the fit is not taken, the difference is what the filter's template, of the
    others' sharpness and of lines as drawn, may have moved the place.
    """
    if fit is None or (blur is not None and not blur.is_confirmed(fit)):
        return filtered
    off = fit.center_px - filtered.center_px
    if fit.sigma_px < filtered.sigma_px and may_be_noise(off, filtered.covariance_px2 + fit.covariance_px2):
        return fit
    covariance = filtered.place_covariance.plus(Cause.SECOND_METHOD, np.outer(off, off))
    return replace(filtered, place_covariance=covariance)


def _refit_with_tone(frame: Frame) -> Frame:
    """Refit the marks with the tone curve estimated from all of them; if these disagree, from further curves."""
    sigma, options = _linear_sigma(frame), frame.options.match
    pending = [index for index, fit in frame.clear_fits.items() if _needs_frame(frame, index, fit, sigma)]
    best = _refit(frame, dict.fromkeys(pending, options))
    if _linear_sigma(best) < _BETTER_KNOWN * sigma:  # the uncertain places of before had left the frame's scale open
        best = _refit(best, dict.fromkeys(pending, options))
    best = _settle_tone(best)
    is_open = (
        best.tone.is_determined
        and best.tone.disagreement > _AGREED
        and any(tone.sensitivity_px > best.clear_fits[index].sigma_px for index, tone in _mark_tones(best).items())
    )
    for power in _OTHER_STARTS if is_open else ():
        start = _replace_tone(best, frame.scan.tone.prior.shift_to_power(power))
        other = _settle_tone(_refit(start, dict.fromkeys(_mark_tones(best), options)))
        is_better = not other.tone.is_doubted and other.tone.disagreement < best.tone.disagreement
        best = other if is_better else best
    return best


def _settle_tone(frame: Frame) -> Frame:
    """Estimate the tone curve from the marks, and refit these with it as long as it moves any of them by much."""
    for rounds_left in range(_TONE_ROUNDS, -1, -1):
        tones, fits, before = _mark_tones(frame), frame.clear_fits, frame.scan.tone
        estimate = FrameTone.from_marks(before.prior, tones, before)
        frame = replace(frame, tone=estimate)
        is_moved = estimate.is_determined and any(
            estimate.moves(each, before, fits[n].covariance_px2) for n, each in tones.items()
        )
        if not (is_moved and rounds_left):
            break
        frame = _replace_tone(frame, estimate.next_curve(before))
        frame = _refit(frame, dict.fromkeys(tones, frame.options.match))
        if estimate.is_doubted:  # by the prior curve again, the marks would only lead to the same estimate
            break
    return frame


def shift_to_curve(frame: Frame) -> Frame:
    """Move the marks by the last step of the tone curve, which was too short for a refit, as the linearised fits do."""
    fits = {index: each.fit for index, each in enumerate(frame.detections) if each.fit and each.fit.tone}
    by_curve = frame.tone.tone.mean - frame.scan.tone.mean
    return frame.replace_fits(
        {index: fit.shifted(fit.tone.on_place @ by_curve) for index, fit in fits.items() if fit.tone}
    )


def _needs_frame(frame: Frame, index: int, fit: MarkFit, linear_sigma: float) -> bool:
    """Whether a fit depends on rotation, scale, stretch or shear of the frame; with a film model or lens all do."""
    if frame.film is not None or frame.options.lens is not None:
        return True
    mark, linear = frame.layout.marks[index].mark, frame.linear(index)
    error_px = strain_error_px(mark, fit.pixel_from_mark[:, :2], linear, linear_sigma)
    return mark.is_held_by_frame or error_px > _STRAINED * fit.sigma_px


def _mark_tones(frame: Frame) -> dict[int, MarkTone]:
    """Information of the clear marks on the tone curve."""
    return {index: fit.tone for index, fit in frame.clear_fits.items() if fit.tone is not None}


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


def _by_significance(frame: Frame) -> list[int]:
    """Indices of the clear marks, the most significant first."""
    return sorted(frame.clear_fits, key=lambda index: -frame.clear_fits[index].significance)


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
        if fit is not None and (fit.is_clear or not frame.detections[index].is_clear)
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
    begun = before if isinstance(expected.mark, MarkShape) and expected.mark.is_cross else None
    return detect_mark(frame.scan, expected, options, linear_sigma, begun).fit


def shows_marks(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> bool:
    """Whether any of some marks, spread over the frame, is clear in a placement."""
    frame = start_frame(scan, layout, placement, options)
    some = range(0, len(layout.marks), max(1, len(layout.marks) // _TRIALS))
    return any(_detect(frame, [index], frame.first_search_px).detections[index].is_clear for index in some)


def rename_frame(scan: Scan, frame: Frame, pose: str) -> Frame:
    """Name the marks of a frame as in another pose.

    Marks found are fitted at their places, the others are detected. The frame is kept unchanged if fewer marks agree
    under the new names.
    """
    placement = frame.fitted_placement.posed(pose, frame.camera_mm)
    found = np.array([fit.center_px for fit in frame.fits if fit])
    names = placement.names(found, frame.camera_mm).tolist() if len(found) else []
    renamed = Frame.from_placement(scan, frame.layout, placement, frame.options)
    renamed = replace(renamed, weights=frame.weights, channel_note=frame.channel_note)
    places = {name: place for name, place in zip(names, found, strict=True) if name >= 0}
    renamed = orient_frame(
        renamed.replace_detections(
            {name: _detection(renamed, renamed.prediction(name, 0.0).shift_to(place)) for name, place in places.items()}
        )
    )
    unclear = [index for index, each in enumerate(renamed.detections) if not each.is_clear]
    renamed = refit_frame(detect_missing_marks(orient_frame(_detect(renamed, unclear, renamed.first_search_px))))
    return renamed if renamed.inliers.sum() >= frame.inliers.sum() else frame

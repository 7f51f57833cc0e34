"""Measurement of one frame at full resolution, starting from its placement.

The marks are detected, the interior orientation is estimated from the inliers, the other marks are detected where it
predicts them, and all marks are refitted with the frame's rotation, scale, stretch and shear as priors.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from measure.array_types import Array
from measure.detection.correlation import CLOSE
from measure.detection.localisation import MarkPrediction, highest_peak
from measure.fiducials.constellation import NARROW, Placement
from measure.fiducials.faint_marks import detect_faint_marks, faint_reach_px
from measure.fiducials.frame import CLEAR_LIKENESS, MANY, Frame, orient_frame
from measure.fiducials.mark_fit import Detection, detect_mark, not_found
from measure.fiducials.options import FiducialOptions
from measure.fiducials.refit import fit_lines_and_sharpening, refit_frame
from measure.flags import FAINT_MARK_BY_NOISE, TEXTURE_LIKE_A_FAINT_MARK
from measure.marks.rendering import picture
from measure.marks.shapes import FiducialLayout, Mark
from measure.matching.match import mark_window
from measure.scans.parallel import map_in_threads
from measure.scans.scan import LUMINANCE, SINGLE_CHANNELS, Scan

LEAST_LIKENESS = 0.35  # correlation with the drawing: below it texture, text and scratches are as similar
_LEAST_SIGNIFICANCE = 4.5  # standard deviations of the contrast: texture alone stays below it
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


def measure_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Measure a frame from its placement."""
    return refit_frame(fit_lines_and_sharpening(detect_frame(scan, layout, placement, options)))


def detect_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Detect the marks of a frame, clear and faint ones, without the refit."""
    clear = detect_clear_marks(scan, layout, placement, options)
    return detect_missing_marks(fit_lines_and_sharpening(clear, _FEWEST_SHARPENED))


def detect_clear_marks(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Detect the marks of a frame around the places predicted by its placement, and orient the frame."""
    frame = choose_channels(Frame.from_placement(scan, layout, placement, options))
    return orient_frame(_detect(frame, range(len(layout.marks)), frame.first_search_px()))


def shows_marks(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> bool:
    """Whether any of some marks, spread over the frame, is clear in a placement."""
    frame = choose_channels(Frame.from_placement(scan, layout, placement, options))
    some = range(0, len(layout.marks), max(1, len(layout.marks) // _TRIALS))
    return any(_detect(frame, [index], frame.first_search_px()).is_clear(index) for index in some)


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
    unclear = [index for index in range(len(frame.detections)) if not renamed.is_clear(index)]
    renamed = refit_frame(detect_missing_marks(orient_frame(_detect(renamed, unclear, renamed.first_search_px()))))
    return renamed if renamed.inliers.sum() >= frame.inliers.sum() else frame


def detect_missing_marks(frame: Frame) -> Frame:
    """Detect the missing and unclear marks around the places predicted from the inliers."""
    if frame.accepted:
        frame = orient_frame(_detect_closer(frame))
    if frame.inliers.sum() >= 2 and not frame.is_certain_of_places:
        if len(frame.detections) > MANY:
            # If the frame itself is uncertain, the wide radius would turn texture into marks.
            reach_px = frame.first_search_px(NARROW) if frame.placement.surroundings.robust else frame.gate_px
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


def _detect(frame: Frame, indices: Iterable[int], search_px: float) -> Frame:
    """Detect marks again within search_px of their current predictions."""
    # From the bottom upwards: the search in windows ended there, and the rows read last are still decoded.
    upwards = sorted(indices, key=lambda index: -frame.predicted_px[index, 1])
    detections = map_in_threads(lambda index: _detection(frame, frame.prediction(index, search_px)), upwards)
    return frame.replace_detections(dict(zip(upwards, detections, strict=True)))


def _detection(frame: Frame, expected: MarkPrediction) -> Detection:
    """Detect one mark; a fit that texture could give is dropped, unless faint marks together decide on the frame."""
    detection = detect_mark(frame.scan, expected, replace(frame.options.match, tells_sharpening=True))
    fit, closer = detection.fit, frame.placement.surroundings.robust
    sure = closer and detection.false_alarms <= FAINT_MARK_BY_NOISE
    likeness, significance = (0.0, _FAINT_SIGNIFICANCE) if sure else (LEAST_LIKENESS, _LEAST_SIGNIFICANCE)
    if fit is not None and (fit.likeness < likeness or fit.significance < significance):
        return Detection(detection.predicted_px, True, None, not_found(expected.search_px))
    return detection


def _detect_closer(frame: Frame) -> Frame:
    """Detect unclear marks again with narrow surroundings, since dust or an edge may lie beside."""
    changed = {}
    for index in range(len(frame.detections)):
        if frame.is_clear(index) and frame.inliers[index]:
            continue
        expected = replace(frame.prediction(index, frame.gate_px), surroundings=CLOSE)
        detection = detect_mark(frame.scan, expected, frame.options.match)
        fit, is_sure = detection.fit, detection.false_alarms <= TEXTURE_LIKE_A_FAINT_MARK
        if is_sure and fit and fit.likeness >= CLEAR_LIKENESS and fit.significance >= _LEAST_SIGNIFICANCE:
            changed[index] = replace(detection, closer=True)
    return frame.replace_detections(changed)


def _detect_elsewhere(frame: Frame) -> Frame:
    """Detect unclear marks within the gate of their predictions, then farther off, where only clear fits count."""
    for index in [index for index in range(len(frame.detections)) if not frame.is_clear(index)]:
        near = _detect(frame, [index], frame.gate_px)
        far_px = _farthest_px(frame, index)
        far = _detect(frame, [index], far_px) if not near.is_clear(index) and far_px > frame.gate_px else near
        frame = far if far.is_clear(index) else near
    return frame


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
    return min((1 + variance) * frame.gate_px, frame.first_search_px())


def choose_channels(frame: Frame) -> Frame:
    """Choose the channel weights of a colour scan.

    Some marks are located, each in the channel (or the luminance) with the highest correlation peak. The weights are
    then estimated from these marks. Where channels do not coincide, only those count that do with one another.
    If no mark is drawn as light or dark, the weights also determine the polarity.
    """
    if frame.scan.channels == 1:
        return frame
    marks = frame.layout.marks
    tried = range(0, len(marks), max(1, len(marks) // _TRIALS))
    predictions = [frame.prediction(index, frame.first_search_px()) for index in tried]
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
    scan: Scan,
    marks: Sequence[tuple[Mark, Array, int]],
    signs: Sequence[int] = (1,),
    among: Sequence[int] = (0, 1, 2),
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

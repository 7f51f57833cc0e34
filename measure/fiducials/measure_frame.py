"""One frame measured at full resolution from its placement: detect its marks, orient the frame by those that agree,
detect the others where these put them, refit all of them by what the frame says."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from measure.detection.correlation import CLOSE
from measure.detection.localisation import MarkPrediction
from measure.fiducials.channels import choose_channels
from measure.fiducials.constellation import Placement
from measure.fiducials.faint_marks import detect_faint_marks, faint_reach_px
from measure.fiducials.frame import CLEAR_LIKENESS, MANY, Frame, orient_frame
from measure.fiducials.mark_fit import Detection, detect_mark, not_found
from measure.fiducials.options import FiducialOptions
from measure.fiducials.refit import refit_frame, sharpen_frame
from measure.flags import FAINT_MARK_BY_NOISE, TEXTURE_LIKE_A_FAINT_MARK
from measure.marks.shapes import FiducialLayout
from measure.scans.parallel import map_in_threads
from measure.scans.scan import Scan

LEAST_LIKENESS = 0.35  # below it texture, text and scratches look like a mark as well
_LEAST_SIGNIFICANCE = 4.5  # of the contrast: what texture feigns stays below it
_FAINT_SIGNIFICANCE = 2.0  # the same where noise hardly makes what is seen: contrast there is, at 95 %
_ROUNDS = 2  # of detecting faint marks: the first ones tell where the others are


def measure_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Measure a frame from its placement. Marks that are not clear are detected again in a scan that shows itself to be
    sharpened."""
    frame = detect_frame(scan, layout, placement, options)
    sharpened = sharpen_frame(frame)
    if sharpened.scan.tone.sharpening and not scan.tone.sharpening:
        sharpened = sharpen_frame(detect_missing_marks(_detect_unfitted(sharpened)))
    return refit_frame(sharpened)


def detect_frame(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Measure a frame without the refit: which of its marks are there, and how they look."""
    return detect_missing_marks(detect_clear_marks(scan, layout, placement, options))


def detect_clear_marks(scan: Scan, layout: FiducialLayout, placement: Placement, options: FiducialOptions) -> Frame:
    """Detect the marks of a frame that are clear where its placement puts them."""
    frame = choose_channels(Frame.from_placement(scan, layout, placement, options))
    return orient_frame(_detect(frame, range(len(layout.marks)), frame.first_search_px))


def _detect_unfitted(frame: Frame) -> Frame:
    """Detect once more the marks that are not clear, or were placed by a filter only; what is no clearer stays."""
    fits = [each.fit for each in frame.detections]
    pending = [i for i, fit in enumerate(fits) if not frame.is_clear(i) or (fit and fit.covariance is None)]
    again = _detect(frame, pending, frame.gate_px)
    return orient_frame(frame.replace_detections({i: again.detections[i] for i in pending if again.is_clear(i)}))


def rename_frame(scan: Scan, frame: Frame, pose: str) -> Frame:
    """Name the marks of a frame as in another pose.

    They are fitted where they were found, and the others are detected. The frame is kept as it is where fewer of its
    marks agree under those names.
    """
    placement = frame.fitted_placement.posed(pose, frame.camera_mm)
    found = np.array([fit.center_px for fit in frame.fits if fit])
    names = placement.names(found, frame.camera_mm).tolist() if len(found) else []
    renamed = replace(Frame.from_placement(scan, frame.layout, placement, frame.options), weights=frame.weights)
    places = {name: place for name, place in zip(names, found, strict=True) if name >= 0}
    renamed = orient_frame(
        renamed.replace_detections(
            {name: _detection(renamed, renamed.prediction(name, 0.0).moved(place)) for name, place in places.items()}
        )
    )
    unclear = [index for index in range(len(frame.detections)) if not renamed.is_clear(index)]
    renamed = refit_frame(detect_missing_marks(orient_frame(_detect(renamed, unclear, renamed.first_search_px))))
    return renamed if renamed.inliers.sum() >= frame.inliers.sum() else frame


def detect_missing_marks(frame: Frame) -> Frame:
    """Detect the marks that are not clear where the others put them."""
    if frame.accepted:
        frame = orient_frame(_detect_closer(frame))
    if frame.inliers.sum() >= 2 and not frame.is_certain_of_places:
        if len(frame.detections) > MANY:
            # Where the frame is hardly known to be there, texture must not feign a mark of it so far off.
            reach_px = frame.near_px if frame.placement.surroundings.robust else frame.gate_px
            frame = detect_faint_marks(frame, reach_px)
            # So far from its place a mark still has to agree with the others.
            frame = replace(frame, certain=np.zeros_like(frame.certain))
        else:
            frame = _detect_elsewhere(frame)
        frame = orient_frame(frame)
    for _ in range(_ROUNDS):
        if frame.is_certain_of_places:
            frame = orient_frame(detect_faint_marks(frame, faint_reach_px(frame)))
    return frame


def _detect(frame: Frame, indices: Iterable[int], search_px: float) -> Frame:
    """Detect marks anew, within search_px of where they are predicted now."""
    # From below upwards: the search of windows ended there, and what it read last is still decoded.
    upwards = sorted(indices, key=lambda index: -frame.predicted_px[index, 1])
    detections = map_in_threads(lambda index: _detection(frame, frame.prediction(index, search_px)), upwards)
    return frame.replace_detections(dict(zip(upwards, detections, strict=True)))


def _detection(frame: Frame, expected: MarkPrediction) -> Detection:
    """At a closer look a mark may be as faint as what texture feigns, where it seldom does so near by: all marks
    together decide of the frame."""
    detection = detect_mark(frame.scan, expected, replace(frame.options.match, tells_sharpening=True))
    fit, closer = detection.fit, frame.placement.surroundings.robust
    sure = closer and detection.false_alarms <= FAINT_MARK_BY_NOISE
    likeness, significance = (0.0, _FAINT_SIGNIFICANCE) if sure else (LEAST_LIKENESS, _LEAST_SIGNIFICANCE)
    if fit is not None and (fit.likeness < likeness or fit.significance < significance):
        return Detection(detection.predicted_px, True, None, not_found(expected.search_px))
    return detection


def _detect_closer(frame: Frame) -> Frame:
    """Detect marks that are not clear or do not agree at a closer look, where the others put them: beside one may lie
    dust, or the frame's edge. Only what is plainly there counts."""
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
    """Detect marks that are not clear where the others put them, first near by, then as far off as one may lie that
    keeps the gate: so far only what is plainly there counts."""
    for index in [index for index in range(len(frame.detections)) if not frame.is_clear(index)]:
        near = _detect(frame, [index], frame.gate_px)
        far_px = _farthest_px(frame, index)
        far = _detect(frame, [index], far_px) if not near.is_clear(index) and far_px > frame.gate_px else near
        frame = far if far.is_clear(index) else near
    return frame


def _farthest_px(frame: Frame, index: int) -> float:
    """A mark that is fitted pulls the frame to itself, and the more the fewer the others are: its distance from where
    they alone put it is its residual times one more than their prediction's variance, a mark's being one."""
    others = np.flatnonzero(frame.inliers & (np.arange(len(frame.inliers)) != index))
    affine = np.column_stack([frame.camera_mm, np.ones(len(frame.camera_mm))])
    if np.linalg.matrix_rank(affine[others]) < affine.shape[1]:
        return frame.gate_px
    variance = float(affine[index] @ np.linalg.inv(affine[others].T @ affine[others]) @ affine[index])
    return min((1 + variance) * frame.gate_px, frame.first_search_px)

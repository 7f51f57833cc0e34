"""Measurement of a frame from clicks: the user marked three or more of its marks by name."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.array_types import Array
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.measure_frame import measure_frame
from measure.fiducials.options import CLICK_SIGMA_PX, Click, FiducialOptions
from measure.flags import NO_REASON, Cause, Code, Reason, Status
from measure.geometry import POSES, UP_FROM_CAMERA, linear_scale
from measure.marks.shapes import FiducialLayout
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from measure.scans.scan import Scan

LEAST_CLICKS = 3  # two do not determine whether the frame is mirrored
_TOLD = ("the marks that were pointed at say so.",)
_COLLINEAR = 1e-3  # fraction of their extent: marks closer to a line do not determine it either


def is_shown(layout: FiducialLayout, options: FiducialOptions) -> bool:
    """Whether enough marks were clicked to determine the frame."""
    return len(_clicked_places(layout, options.clicks)[0]) >= LEAST_CLICKS


def clicked_frame(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> tuple[Frame, ScanOrientation]:
    """Measure the frame from a similarity through the clicked marks.

    Returns the frame and its scan orientation, which is decided if the project sets it or the clicked marks are not
    collinear.
    """
    camera, clicked = _clicked_places(layout, options.clicks)
    pixel_mm = np.array(pitch_um or (1.0, 1.0)) / 1000.0
    ideal = clicked if options.lens is None else options.lens.ideal_px(clicked)
    up_mm = ideal * pixel_mm * (1.0, -1.0)
    pose, up = _clicked_pose(camera, up_mm, POSES if options.pose == "auto" else (options.pose,))
    if pitch_um is None:  # estimate it from the separations of the marks
        pixel_mm = pixel_mm / linear_scale(up)
        up = up / linear_scale(up)
    matrix = np.diag([1.0, -1.0]) @ up / pixel_mm[:, None]
    pitch_mm = (float(pixel_mm[0]), float(pixel_mm[1]))
    polarities = (1, -1) if any(mark.mark.polarity == "auto" for mark in layout.marks) else (1,)
    placements = [
        Placement(pose, matrix, 0.0, len(camera), polarity, 1, pitch_mm, lens=options.lens) for polarity in polarities
    ]
    frames = [measure_frame(scan, layout, placement, options) for placement in placements]
    frame = max(frames, key=lambda one: (one.measured_count, int(one.inliers.sum())))
    tells = options.pose != "auto" or not are_collinear(camera)
    evidence = _TOLD if tells else ("the marks that were pointed at lie on a line, which has two sides.",)
    return frame, ScanOrientation(pose, tells, evidence)


def contradicted_pose(layout: FiducialLayout, options: FiducialOptions, pitch_um: tuple[float, float] | None) -> Reason:
    """Reason why the clicks contradict the scan orientation that is set; empty if they agree or do not determine
    one."""
    camera, clicked = _clicked_places(layout, options.clicks)
    if options.pose == "auto" or are_collinear(camera):
        return NO_REASON
    pose, _ = _clicked_pose(camera, clicked * np.array(pitch_um or (1.0, 1.0)) / 1000.0 * (1.0, -1.0), POSES)
    if pose == options.pose:
        return NO_REASON
    sentence = (
        f"the marks that were pointed at show the scan orientation {pose}, and {options.pose} is set. A viewer that "
        "obeys the file's orientation tag shows other columns and rows than the file has. Point at them in the picture "
        "as it is stored, or set the right orientation"
    )
    return Reason(sentence, Code.POSE)


def are_collinear(places: Array) -> bool:
    """Whether places (n, 2) are collinear, and so do not determine whether the frame is mirrored."""
    singular = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(singular[1] <= _COLLINEAR * singular[0])


def place_clicked_marks(frame: FrameMeasurement, clicks: Sequence[Click]) -> FrameMeasurement:
    """Place clicked marks that could not be matched where the user clicked, with the standard deviation of a click."""
    by_point = {click.point: click for click in clicks}
    marks = (_place_clicked(mark, by_point[mark.point]) if mark.point in by_point else mark for mark in frame.marks)
    return replace(frame, marks=tuple(marks))


def _clicked_places(layout: FiducialLayout, clicks: Sequence[Click]) -> tuple[Array, Array]:
    """(n, 2) given places of the clicked marks, mm, and (n, 2) clicked places, px."""
    places = {mark.id: mark.xy_mm for mark in layout.marks}
    known = [click for click in clicks if click.point in places]
    camera = np.array([places[click.point] for click in known]).reshape(-1, 2)
    return camera, np.array([(click.col_px, click.row_px) for click in known]).reshape(-1, 2)


def _clicked_pose(camera: Array, up_mm: Array, poses: Sequence[str]) -> tuple[str, Array]:
    """Scan orientation that fits the marks best, then with the least rotation; and its similarity (2, 3)."""
    found = [(pose, *_similarity(camera, up_mm, pose)) for pose in poses]
    pose, up, _ = min(found, key=lambda one: (round(one[2] / np.ptp(up_mm), 9), abs(_turn_rad(one[1], one[0]))))
    return pose, up


def _similarity(camera: Array, up_mm: Array, pose: str) -> tuple[Array, float]:
    """Similarity (2, 3) from camera mm to mm right and up in a scan orientation; largest residual, mm."""
    turned = camera @ UP_FROM_CAMERA[pose].T
    own, observed = turned @ (1.0, 1j), up_mm @ (1.0, 1j)
    design = np.column_stack([own, np.ones(len(own))])
    (scale, shift), *_ = np.linalg.lstsq(design, observed, rcond=None)
    linear = np.array([[scale.real, -scale.imag], [scale.imag, scale.real]]) @ UP_FROM_CAMERA[pose]
    left = float(np.abs(design @ (scale, shift) - observed).max())
    return np.column_stack([linear, [shift.real, shift.imag]]), left


def _turn_rad(up_from_mm: Array, pose: str) -> float:
    """Rotation of the frame relative to a scan orientation."""
    own = up_from_mm[:, :2] @ np.linalg.inv(UP_FROM_CAMERA[pose])
    return float(np.arctan2(own[1, 0], own[0, 0]))


def _place_clicked(mark: MarkMeasurement, click: Click) -> MarkMeasurement:
    if mark.status.is_observation:
        return mark
    place = np.array([click.col_px, click.row_px])
    covariance = Covariance({Cause.CLICK: CLICK_SIGMA_PX**2 * np.eye(2)})
    sentence = f"it is where a person pointed, for nothing could be matched there: {mark.reason}"
    reason = Reason(sentence, Code.CLICKED, *mark.reason.codes)
    return replace(mark, center_px=place, covariance=covariance, status=Status.WEAK, reason=reason)

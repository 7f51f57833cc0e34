"""Measurement of a frame from clicks: the user marked three or more of its marks by name."""

from collections.abc import Sequence
from operator import itemgetter

import numpy as np

from measure.array_types import Array
from measure.fiducials.constellation import Placement
from measure.fiducials.measure_frame import Frame, measure_frame
from measure.fiducials.options import FiducialOptions
from measure.flags import NO_REASON, Code, Reason
from measure.geometry import POSES, UP_FROM_CAMERA, fit_similarity, linear_scale, similarity_matrix
from measure.marks.shapes import FiducialLayout
from measure.results import ScanOrientation
from measure.scans.scan import Scan

LEAST_CLICKS = 3  # two do not determine whether the frame is mirrored
_BY_CLICKS = ("the marks that were pointed at say so.",)
_COLLINEAR = 1e-3  # fraction of their extent: marks closer to a line do not determine it either


def clicked_frame(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> tuple[Frame, ScanOrientation, Reason] | None:
    """Measure the frame from a similarity through the clicked marks; None if too few were clicked to determine it.

    Returns the frame, its scan orientation, which is decided if the project sets it or the clicked marks are not
    collinear, and the reason why the clicks contradict the orientation that is set; empty if they agree.
    """
    given_mm = {mark.id: mark.xy_mm for mark in layout.marks}
    known = [click for click in options.clicks if click.point in given_mm]
    if len(known) < LEAST_CLICKS:
        return None
    camera = np.array([given_mm[click.point] for click in known])
    clicked = np.array([(click.col_px, click.row_px) for click in known])
    is_set, is_determined = options.pose != "auto", not are_collinear(camera)
    pixel_mm = np.array(pitch_um or (1.0, 1.0)) / 1000.0
    ideal = clicked if options.lens is None else options.lens.ideal_px(clicked)
    pose, up = _clicked_pose(camera, ideal * pixel_mm * (1.0, -1.0), (options.pose,) if is_set else POSES)
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
    frame = max(frames, key=lambda one: (len(one.unblemished), int(one.inliers.sum())))
    evidence = (
        _BY_CLICKS
        if is_set or is_determined
        else ("the marks that were pointed at lie on a line, which has two sides.",)
    )
    contradiction = NO_REASON
    if is_set and is_determined:
        shown, _ = _clicked_pose(camera, clicked * np.array(pitch_um or (1.0, 1.0)) / 1000.0 * (1.0, -1.0), POSES)
        sentence = (
            f"the marks that were pointed at show the scan orientation {shown}, and {pose} is set. A viewer that "
            "obeys the file's orientation tag shows other columns and rows than the file has. Point at them in the "
            "picture as it is stored, or set the right orientation"
        )
        contradiction = NO_REASON if shown == pose else Reason(sentence, Code.POSE)
    return frame, ScanOrientation(pose, is_set or is_determined, evidence), contradiction


def are_collinear(places: Array) -> bool:
    """Whether places (n, 2) are collinear, and so do not determine whether the frame is mirrored."""
    singular = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(singular[1] <= _COLLINEAR * singular[0])


def _clicked_pose(camera: Array, up_mm: Array, poses: Sequence[str]) -> tuple[str, Array]:
    """Scan orientation in which a similarity from camera mm to mm right and up fits the marks best, then with the least
    rotation; and that similarity (2, 3)."""
    found = []
    for pose in poses:
        own, observed = camera @ UP_FROM_CAMERA[pose].T @ (1.0, 1j), up_mm @ (1.0, 1j)
        scale, shift = fit_similarity(own, observed, np.ones(len(own)))
        misfit_mm = float(np.abs(scale * own + shift - observed).max())
        similarity = similarity_matrix(scale, shift)
        up = np.column_stack([similarity[:, :2] @ UP_FROM_CAMERA[pose], similarity[:, 2]])
        found.append((round(misfit_mm / np.ptp(up_mm), 9), abs(float(np.angle(scale))), pose, up))
    _, _, pose, up = min(found, key=itemgetter(0, 1))
    return pose, up

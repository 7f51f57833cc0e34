"""Checks of one measured frame: its pixel pitch, and marks on pixels that its file does not give."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from measure.fiducials.options import AFFINITY_SIGMA
from measure.flags import RIGHT_PITCH_REFUSED, Code, Reason, Status
from measure.marks.shapes import FiducialLayout
from measure.results import FrameMeasurement, MarkMeasurement
from measure.scans.scan import Scan

_LEAST_MARKS = 3  # with two, a false one makes a pitch of its own
_REACH_PX = 20.0  # about a mark whose size is not told: that of a disk or crossing of a field, with its ground


def pitch_problem(
    frame: FrameMeasurement, layout: FiducialLayout, pitch_um: tuple[float, float], source: str
) -> Reason | None:
    """A sentence that names the pitch which the marks suggest, None where the given one (um, by source) is as good.

    Film and scanner stretch by some thousandths, and the given separations have their own standard deviations: what
    goes beyond both, at a probability of one in a hundred for the two axes together, is the pitch's.
    """
    found = {mark.point for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation}
    marks = [mark for mark in layout.marks if mark.id in found]
    is_named = any(Code.PITCH in problem.codes for problem in frame.problems)  # of pixels longer one way
    if frame.pixel_from_camera is None or len(marks) < _LEAST_MARKS or is_named:
        return None
    seen_um = 1000 / np.hypot(*frame.pixel_from_camera[:, :2].T)  # film mm for each pixel, across and down
    places = np.array([mark.xy_mm for mark in marks])
    lever_mm = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=0)).min())  # of all marks, along one axis
    given = float(np.median([max(mark.sigma_mm) for mark in marks]))
    if not lever_mm > given:
        return None
    sigma = float(np.hypot(AFFINITY_SIGMA, given / lever_mm))
    limit = -float(ndtri(RIGHT_PITCH_REFUSED / 2 / 2)) * sigma
    excess = seen_um / np.asarray(pitch_um) - 1
    if np.abs(excess).max() <= limit:
        return None
    return Reason(
        f"{source} gives a pitch of {pitch_um[0]:.2f} x {pitch_um[1]:.2f} µm, but the marks' separations suggest "
        f"{seen_um[0]:.2f} x {seen_um[1]:.2f} µm ({100 * excess[0]:+.1f} and {100 * excess[1]:+.1f} %, where they and "
        f"the film allow {100 * limit:.1f} %): set pitch_um = [{seen_um[0]:.2f}, {seen_um[1]:.2f}] in the project, or "
        "check whether the camera is the right one.",
        Code.PITCH,
    )


def without_lost(scan: Scan, marks: Sequence[MarkMeasurement]) -> tuple[MarkMeasurement, ...]:
    """The marks; those at places where the file does not give the pixels are `predicted` there, with that reason."""
    return tuple(_check_loss(scan, mark) for mark in marks)


def with_damage(scan: Scan, frame: FrameMeasurement) -> FrameMeasurement:
    """The frame without observations where the scan's file is damaged, which is the first of its problems."""
    if not scan.damage:
        return frame
    marks = without_lost(scan, frame.marks)
    sentence = f"{scan.damage[0].upper()}{scan.damage[1:]}. No mark is measured there: copy the file again, or rescan."
    problem = Reason(sentence, Code.DAMAGED_FILE)
    return replace(frame, marks=marks, problems=(problem, *(each for each in frame.problems if each != problem)))


def _check_loss(scan: Scan, mark: MarkMeasurement) -> MarkMeasurement:
    if mark.center_px is None or not mark.status.is_observation:
        return mark
    half = int(np.ceil(mark.quality.get("size_px", 2 * _REACH_PX) / 2))
    col, row = np.rint(mark.center_px).astype(int)
    why = scan.loss_reason(int(col) - half, int(row) - half, 2 * half + 1, 2 * half + 1)
    if not why:
        return mark
    reason = Reason(f"the scan's file is damaged at its place: {why}", Code.DAMAGED_FILE)
    return replace(mark, covariance=None, status=Status.PREDICTED, reason=reason)

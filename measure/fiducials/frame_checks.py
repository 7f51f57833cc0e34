"""Checks of one measured frame: its pixel pitch, and marks on damaged parts of its file."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from measure.fiducials.options import AFFINITY_SIGMA
from measure.flags import RIGHT_PITCH_REFUSED, Code, Reason, Status
from measure.marks.shapes import FiducialLayout
from measure.results import FrameMeasurement, MarkMeasurement
from measure.scans.scan import Scan

_LEAST_MARKS = 3  # with two, a false one yields a wrong pitch
_REACH_PX = 20.0  # around a mark of unknown size: that of a disk or crossing of a test field, with its background


def pitch_problem(
    frame: FrameMeasurement, layout: FiducialLayout, pitch_um: tuple[float, float], source: str
) -> Reason | None:
    """Test the given pixel pitch against the separations of the marks.

    Film and scanner stretch by some thousandths, and the given separations have their own standard deviations. The
    pitch is rejected beyond both, at a significance level of 1 % for the two axes together.

    Parameters
    ----------
    pitch_um, source : given pitch and where it comes from.

    Returns
    -------
    Problem with the pitch that the marks suggest; None if the given one is not rejected.
    """
    found = {mark.point for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation}
    marks = [mark for mark in layout.marks if mark.id in found]
    is_named = any(Code.PITCH in problem.codes for problem in frame.problems)  # unequal pixel sizes
    if frame.pixel_from_camera is None or len(marks) < _LEAST_MARKS or is_named:
        return None
    film_um = 1000 / np.hypot(*frame.pixel_from_camera[:, :2].T)  # film per pixel, um, across and down
    places = np.array([mark.xy_mm for mark in marks])
    lever_mm = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=0)).min())  # root sum of squares, one axis
    given = float(np.median([max(mark.sigma_mm) for mark in marks]))
    if not lever_mm > given:
        return None
    sigma = float(np.hypot(AFFINITY_SIGMA, given / lever_mm))
    limit = -float(ndtri(RIGHT_PITCH_REFUSED / 2 / 2)) * sigma
    excess = film_um / np.asarray(pitch_um) - 1
    if np.abs(excess).max() <= limit:
        return None
    return Reason(
        f"{source} gives a pitch of {pitch_um[0]:.2f} x {pitch_um[1]:.2f} µm, but the marks' separations suggest "
        f"{film_um[0]:.2f} x {film_um[1]:.2f} µm ({100 * excess[0]:+.1f} and {100 * excess[1]:+.1f} %, where they and "
        f"the film allow {100 * limit:.1f} %): set pitch_um = [{film_um[0]:.2f}, {film_um[1]:.2f}] in the project, or "
        "check whether the camera is the right one.",
        Code.PITCH,
    )


def without_lost(scan: Scan, marks: Sequence[MarkMeasurement]) -> tuple[MarkMeasurement, ...]:
    """Set marks on damaged parts of the scan's file to `predicted`, with this reason."""
    return tuple(_check_loss(scan, mark) for mark in marks)


def with_damage(scan: Scan, frame: FrameMeasurement) -> FrameMeasurement:
    """Remove the observations on damaged parts of the scan's file, and put the damage first among the problems."""
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

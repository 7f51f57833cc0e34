"""Marks that were seen on pixels which their scan's file is too damaged to give: none of them is an observation."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.reason import Code, Reason
from measure.results import FrameMeasurement, MarkMeasurement
from measure.scans.scan import Scan
from measure.status import Status

_REACH_PX = 20.0  # about a mark whose size is not told: that of a disk or crossing of a field, with its ground


def without_lost(scan: Scan, marks: Sequence[MarkMeasurement]) -> tuple[MarkMeasurement, ...]:
    """The marks; those at places where the file does not give the pixels are `predicted` there, with that reason."""
    return tuple(_told(scan, mark) for mark in marks)


def with_damage(scan: Scan, frame: FrameMeasurement) -> FrameMeasurement:
    """The frame without observations where the scan's file is damaged, which is the first of its problems."""
    if not scan.damage:
        return frame
    marks = without_lost(scan, frame.marks)
    told = f"{scan.damage[0].upper()}{scan.damage[1:]}. No mark is measured there: copy the file anew, or rescan."
    problem = Reason(told, Code.DAMAGED_FILE)
    return replace(frame, marks=marks, problems=(problem, *(each for each in frame.problems if each != problem)))


def _told(scan: Scan, mark: MarkMeasurement) -> MarkMeasurement:
    if mark.center_px is None or not mark.status.is_observation:
        return mark
    half = int(np.ceil(mark.quality.get("size_px", 2 * _REACH_PX) / 2))
    col, row = np.rint(mark.center_px).astype(int)
    why = scan.lost_in(int(col) - half, int(row) - half, 2 * half + 1, 2 * half + 1)
    if not why:
        return mark
    reason = Reason(f"the scan's file is damaged at its place: {why}", Code.DAMAGED_FILE)
    return replace(mark, covariance=None, status=Status.PREDICTED, reason=reason)

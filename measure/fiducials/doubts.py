"""Doubts of measured marks: why a check of the frames doubts one, and what becomes of its covariance and status."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from measure.flags import NO_REASON, Cause, Reason, Status
from measure.results import FrameMeasurement, MarkMeasurement

Array = NDArray[np.float64]
TOLD = np.log(100.0)  # log-odds at which one cause rather than another is taken for what is off


@dataclass(frozen=True)
class Doubt:
    """How far off a check puts a mark, and the cause to which that is counted; reason: why it is no longer called
    measured, empty where it still is, only less well known."""

    reason: Reason
    off_px: float
    cause: Cause

    @property
    def px2(self) -> Array:
        """(2, 2) by which the mark's covariance grows: the mean square, an axis, of how far it is off."""
        return self.off_px**2 / 2 * np.eye(2)

    def without_reason(self) -> "Doubt":
        return replace(self, reason=NO_REASON)


def observed(frame: FrameMeasurement) -> list[MarkMeasurement]:
    """The fiducials of a frame that are observations."""
    return [mark for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation]


def doubted(frame: FrameMeasurement, doubts: Mapping[str, Doubt]) -> FrameMeasurement:
    """The frame with those fiducials weak, or less well known, that doubts has, by their names."""
    marks = tuple(
        _doubted(mark, doubts[mark.point]) if mark.kind == "fiducial" and mark.point in doubts else mark
        for mark in frame.marks
    )
    return replace(frame, marks=marks)


def _doubted(mark: MarkMeasurement, doubt: Doubt) -> MarkMeasurement:
    assert mark.covariance is not None  # an observation has one
    known = replace(mark, covariance=mark.covariance.plus(doubt.cause, doubt.px2))
    if not doubt.reason:
        return known
    return replace(known, status=Status.WEAK, reason=Reason.combine((mark.reason, doubt.reason)))

"""What a check of measured fiducial marks finds: why a mark is doubted, and what becomes of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.covariance import Cause
from measure.results import FrameMeasurement, MarkMeasurement
from measure.status import Status

CHANCE = 0.01  # of doubting any good mark, of each check
TOLD = np.log(100.0)  # log-odds at which one cause rather than another is taken for what is off
MEDIAN_EFFICIENCY = 0.37  # of a variance from the median, against one from the mean of squares


@dataclass(frozen=True)
class Doubt:
    """Why a mark is no longer called measured, how far off that puts it, and the cause to which that is counted."""

    reason: str
    off_px: float
    cause: Cause


def observed(frame: FrameMeasurement) -> list[MarkMeasurement]:
    """The fiducials of a frame that are observations."""
    return [mark for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation]


def doubted(frame: FrameMeasurement, doubts: Mapping[str, Doubt]) -> FrameMeasurement:
    """The frame with those fiducials weak that doubts has, by their names."""
    marks = tuple(
        _weakened(mark, doubts[mark.point]) if mark.kind == "fiducial" and mark.point in doubts else mark
        for mark in frame.marks
    )
    return replace(frame, marks=marks)


def _weakened(mark: MarkMeasurement, doubt: Doubt) -> MarkMeasurement:
    """Its variance enlarged by the mean square, an axis, of how far it is off."""
    assert mark.covariance is not None  # an observation has one
    reason = f"{mark.reason}; {doubt.reason}" if mark.reason else doubt.reason
    covariance = mark.covariance.plus(doubt.cause, doubt.off_px**2 / 2 * np.eye(2))
    return replace(mark, status=Status.WEAK, reason=reason, covariance=covariance)


def from_others(off_mm: float, names: Sequence[str]) -> str:
    """Why one of the marks called names is doubted that lies off_mm from where the camera's other frames have it."""
    if len(names) == 1:
        return f"it lies {off_mm:.3f} mm from where the camera's other frames have it, more than they scatter"
    return (
        f"one of the marks {', '.join(names)} lies off where the camera's other frames have it, this one by "
        f"{off_mm:.3f} mm; which one, they do not tell"
    )

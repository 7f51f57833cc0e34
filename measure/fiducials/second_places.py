"""Test of second places: the place from a mark's edges differs from the matched one if the mark is damaged or not as
drawn.

The covariance of the difference describes the noise. Larger differences in many of a camera's marks mean that the
drawings are not exact, or the noise model is not: a variance factor of the differences is estimated from their median,
with a prior of 1. An outlier even with this factor is damaged, and becomes weak. Any other significant difference is
added to the mark's covariance, and makes it weak only if it exceeds the error allowed for a measured mark.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc

from measure.array_types import Array
from measure.fiducials.frame import may_be_wrong
from measure.flags import FALSE_DOUBT, NO_REASON, Cause, Code, Reason, Status
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY
from measure.results import FrameMeasurement, MarkMeasurement

_AXES = 2
_BELIEVED_DEGREES = 4.0  # degrees of freedom of the prior of the variance factor: on real film the edges differ by 1.4


@dataclass(frozen=True)
class Doubt:
    """Variance along an axis that a check adds to a mark, and its cause. reason: why the mark becomes weak, empty if it
    does not."""

    variance_px2: float
    cause: Cause
    reason: Reason = NO_REASON


def observed_fiducials(frame: FrameMeasurement) -> list[MarkMeasurement]:
    """Fiducials of a frame that are observations."""
    return [mark for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation]


def add_doubts(frame: FrameMeasurement, doubts: Mapping[str, Doubt]) -> FrameMeasurement:
    """Add doubts, by name, to the fiducials of a frame: their variance, and the status weak if they have a reason."""
    marks = list(frame.marks)
    for number, mark in enumerate(marks):
        doubt = doubts.get(mark.point) if mark.kind == "fiducial" else None
        if doubt is None or mark.covariance is None:
            continue
        status, reason = (Status.WEAK if doubt.reason else mark.status), Reason.combine((mark.reason, doubt.reason))
        covariance = mark.covariance.plus(doubt.cause, doubt.variance_px2 * np.eye(2))
        marks[number] = replace(mark, covariance=covariance, status=status, reason=reason)
    return replace(frame, marks=tuple(marks))


def check_second_places(frames: Sequence[FrameMeasurement]) -> list[FrameMeasurement]:
    """Test the second places of all frames of a camera, and add doubts where they differ significantly from the
    matched places."""
    tested = [[mark for mark in observed_fiducials(each) if "second_method_sigmas" in mark.quality] for each in frames]
    squares = np.array([mark.quality["second_method_sigmas"] ** 2 for own in tested for mark in own])
    by_noise = iter(chdtrc(_AXES, squares) * len(squares))
    among_others = iter(_p_values_among_others(squares) * len(squares))
    checked = []
    for frame, own in zip(frames, tested, strict=True):
        p_values = [(mark, next(by_noise), next(among_others)) for mark in own]
        doubts = {mark.point: _edge_doubt(mark, rest < FALSE_DOUBT) for mark, p, rest in p_values if p < FALSE_DOUBT}
        checked.append(add_doubts(frame, doubts))
    return checked


def _p_values_among_others(squares: Array) -> Array:
    """(n,) p-values of squared normalised differences of the two places, with the variance factor of the other
    marks."""
    others = [np.median(np.delete(squares, n)) for n in range(len(squares))] if len(squares) > 1 else [0.0]
    degrees = MEDIAN_EFFICIENCY * _AXES * (len(squares) - 1)
    factor = (_BELIEVED_DEGREES + degrees * np.array(others) / chdtri(_AXES, 0.5)) / (_BELIEVED_DEGREES + degrees)
    # A variance factor below 1 is not applied: small differences do not make the test stricter.
    return np.asarray(fdtrc(_AXES, _BELIEVED_DEGREES + degrees, squares / _AXES / np.maximum(factor, 1.0)))


def _edge_doubt(mark: MarkMeasurement, is_alone: bool) -> Doubt:
    before = np.asarray(mark.covariance_px2)
    off_px = float(np.hypot(mark.quality["second_method_col_px"], mark.quality["second_method_row_px"]))
    is_weak = is_alone or (may_be_wrong(before + off_px**2 / 2 * np.eye(2)) and not may_be_wrong(before))
    reason = Reason(
        f"its edges put it {off_px:#.2g} px elsewhere, {mark.quality['second_method_sigmas']:.1f} standard "
        "deviations of the difference: it is damaged, or not as drawn",
        Code.EDGES,
    )
    return Doubt(off_px**2 / 2, Cause.SECOND_METHOD, reason if is_weak else NO_REASON)

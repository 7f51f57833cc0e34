"""Second places. The edges of a mark put it elsewhere than the match does where it is damaged or not as drawn.

Noise explains such a difference by its covariance. Where more is left in many of a camera's marks, their drawings are
not quite true, or the film's noise is not quite what it is taken for: their median gives the factor of the variance
of the differences, beside 1 as it is believed. A mark that stands out among them too is damaged, and weak; any other
is known no better than its two places differ, and weak only if that is more than a measured mark may be off by.
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
_BELIEVED_DEGREES = 4.0  # of freedom of the factor of second places' variances: on real film the edges differ by 1.4


@dataclass(frozen=True)
class Doubt:
    """The variance, along an axis, by which a check finds a mark less well known, and the cause to which that is
    counted; reason: why it is no longer called measured, empty where it still is."""

    variance_px2: float
    cause: Cause
    reason: Reason = NO_REASON


def observed_fiducials(frame: FrameMeasurement) -> list[MarkMeasurement]:
    """The fiducials of a frame that are observations."""
    return [mark for mark in frame.marks if mark.kind == "fiducial" and mark.status.is_observation]


def add_doubts(frame: FrameMeasurement, doubts: Mapping[str, Doubt]) -> FrameMeasurement:
    """The frame, its fiducials less well known by doubts, by name, and weak where these have a reason."""
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
    """The frames of a camera, with doubt where second places differ from matched ones by more than noise explains."""
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
    """(n,) that a mark's two places differ by so many standard deviations, squared, as the others' do."""
    others = [np.median(np.delete(squares, n)) for n in range(len(squares))] if len(squares) > 1 else [0.0]
    degrees = MEDIAN_EFFICIENCY * _AXES * (len(squares) - 1)
    factor = (_BELIEVED_DEGREES + degrees * np.array(others) / chdtri(_AXES, 0.5)) / (_BELIEVED_DEGREES + degrees)
    # Differences that are smaller than noise makes them are no reason to ask more of the others.
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

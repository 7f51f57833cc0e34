"""Marks whose edges put them elsewhere than the match does: damaged ones, or those of a drawing that is not quite true.

Noise explains such a difference by its covariance. Where more is left in many of a camera's marks, their drawings are
not quite true, or the film's noise is not quite what it is taken for: their median says by what factor the variance of
the differences is larger, beside 1 as it is believed. A mark that stands out among them too is damaged, and weak; any
other is known no better than its two places differ, and weak only if that is more than a measured mark may be off by.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri, fdtrc

from measure.checks.doubts import Doubt, observed
from measure.covariance import Cause
from measure.frames.frame import may_be_wrong
from measure.noise.robust_estimation import MEDIAN_EFFICIENCY
from measure.probabilities import FALSE_DOUBT
from measure.reason import Code, Reason
from measure.results import FrameMeasurement, MarkMeasurement

Array = NDArray[np.float64]

_AXES = 2
_BELIEVED_DEGREES = 4.0  # of freedom that the factor is known with beforehand: on real film the edges differ by 1.4


def by_second_places(frames: Sequence[FrameMeasurement]) -> Iterator[dict[str, Doubt]]:
    """What the second places of each frame's marks say, of those where chance does not make the difference."""
    tested = [[mark for mark in observed(frame) if "second_method_sigmas" in mark.quality] for frame in frames]
    squares = np.array([mark.quality["second_method_sigmas"] ** 2 for own in tested for mark in own])
    by_noise = chdtrc(_AXES, squares) * len(squares)
    among_others = _chances(squares) * len(squares)
    told = iter(zip(by_noise.tolist(), among_others.tolist(), strict=True))
    for own in tested:
        chances = [(mark, *next(told)) for mark in own]
        yield {mark.point: _doubt(mark, among < FALSE_DOUBT) for mark, noise, among in chances if noise < FALSE_DOUBT}


def _chances(squares: Array) -> Array:
    """(n,) that a mark's two places differ by so many standard deviations, squared, as the others' do."""
    others = [np.median(np.delete(squares, n)) for n in range(len(squares))] if len(squares) > 1 else [0.0]
    degrees = MEDIAN_EFFICIENCY * _AXES * (len(squares) - 1)
    factor = (_BELIEVED_DEGREES + degrees * np.array(others) / chdtri(_AXES, 0.5)) / (_BELIEVED_DEGREES + degrees)
    # Differences that are smaller than noise makes them are no reason to ask more of the others.
    return np.asarray(fdtrc(_AXES, _BELIEVED_DEGREES + degrees, squares / _AXES / np.maximum(factor, 1.0)))


def _doubt(mark: MarkMeasurement, is_alone: bool) -> Doubt:
    assert mark.covariance_px2 is not None  # an observation has one
    off_px = float(np.hypot(mark.quality["second_method_col_px"], mark.quality["second_method_row_px"]))
    doubt = Doubt(
        Reason(
            f"its edges put it {off_px:#.2g} px elsewhere, {mark.quality['second_method_sigmas']:.1f} standard "
            "deviations of the difference: it is damaged or unlike its drawing",
            Code.EDGES,
        ),
        off_px,
        Cause.SECOND_METHOD,
    )
    before, after = mark.covariance_px2, mark.covariance_px2 + doubt.px2
    is_told = is_alone or (may_be_wrong(after) and not may_be_wrong(before))
    return doubt if is_told else doubt.without_reason()

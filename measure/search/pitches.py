"""What a scan's pixels may measure: as given; longer one way than the other; or such that the frame fills the scan."""

from collections.abc import Sequence
from dataclasses import dataclass

from measure.fiducial_options import FiducialOptions
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan

_STRETCHES = (-0.015, 0.015, -0.03, 0.03)  # an office scanner's carriage may run by per cents too fast
_SCALE_STEPS = (1.1, 1.0, 0.91, 0.83, 0.75)  # of the largest scale at which the frame fits into the scan
_STEP_TOLERANCE = 0.06  # so that each step reaches the next


@dataclass(frozen=True)
class PitchHypothesis:
    """mm: of a pixel, across and down. tolerance: by what share both together may be wrong. drawn_mm: what the marks
    are drawn with where they are looked for; for pixels longer one way that of pixels alike, which hardly differ."""

    mm: tuple[float, float]
    tolerance: float
    drawn_mm: tuple[float, float]


def pitch_hypotheses(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[Sequence[PitchHypothesis]]:
    """The hypotheses, the likelier ones first: those of a later group are for a scan in which the earlier ones fail.

    pitch_um: as given; None where it is not known: then the frame's size is all there is.
    """
    long_mm, short_mm = max(layout.frame_mm), min(layout.frame_mm)
    long_px, short_px = max(scan.width_px, scan.height_px), min(scan.width_px, scan.height_px)
    largest = min(long_px / long_mm, short_px / short_mm)
    filling = [
        PitchHypothesis(pair, _STEP_TOLERANCE, pair) for s in _SCALE_STEPS for pair in [(1 / (s * largest),) * 2]
    ]
    if pitch_um is None:
        return [filling]
    x, y = given = (pitch_um[0] / 1000, pitch_um[1] / 1000)
    tolerance = options.scale_tolerance
    longer = [PitchHypothesis((x * (1 + s / 2), y * (1 - s / 2)), tolerance, given) for s in _STRETCHES]
    as_given: list[Sequence[PitchHypothesis]] = [[PitchHypothesis(given, tolerance, given)], longer]
    return as_given if options.pitch_is_right else [*as_given, filling]

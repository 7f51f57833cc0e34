"""What a scan's pixels may measure: as given; longer one way than the other; or such that the frame fills the scan."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from measure.fiducial_options import FiducialOptions
from measure.marks.shapes import FiducialLayout
from measure.scans.scan import Scan

_STRETCHES = (-0.015, 0.015, -0.03, 0.03)  # an office scanner's carriage may run by per cents too fast
_SLIGHT = (-0.005, 0.005, -0.01, 0.01)  # where marks are so faint that they are looked for near by only
_SCALE_STEPS = (1.1, 1.0, 0.91, 0.83, 0.75)  # of the largest scale at which the frame fits into the scan
_STEP_TOLERANCE = 0.06  # so that each step reaches the next


@dataclass(frozen=True)
class PitchHypothesis:
    """mm: of a pixel, across and down. tolerance: by what share both together may be wrong. drawn_mm: what the marks
    are drawn with where they are looked for; for pixels longer one way that of pixels alike, which hardly differ."""

    mm: tuple[float, float]
    tolerance: float
    drawn_mm: tuple[float, float]


Hypotheses = Sequence[PitchHypothesis]


def pitch_hypotheses(
    scan: Scan, layout: FiducialLayout, pitch_um: tuple[float, float] | None, options: FiducialOptions
) -> list[Hypotheses]:
    """The hypotheses, the likelier ones first: those of a later group are for a scan in which the earlier ones fail.

    pitch_um: as given; None where it is not known: then the frame's size is all there is, as it is where the frame
    would be far from filling the scan at that pitch.
    """
    long_mm, short_mm = max(layout.frame_mm), min(layout.frame_mm)
    long_px, short_px = max(scan.width_px, scan.height_px), min(scan.width_px, scan.height_px)
    largest = min(long_px / long_mm, short_px / short_mm)
    filling = [
        PitchHypothesis(pair, _STEP_TOLERANCE, pair) for s in _SCALE_STEPS for pair in [(1 / (s * largest),) * 2]
    ]
    filling_longer = [longer(each, stretch) for each in filling for stretch in _STRETCHES]
    if pitch_um is None:
        return [filling, filling_longer]
    pair = (pitch_um[0] / 1000, pitch_um[1] / 1000)
    given = PitchHypothesis(pair, options.scale_tolerance, pair)
    as_given: list[Hypotheses] = [[given], [longer(given, stretch) for stretch in _STRETCHES]]
    if options.pitch_is_right or options.part:
        return as_given
    fills = any(abs(pair[0] / each.mm[0] - 1) < _STEP_TOLERANCE for each in filling)
    return [*as_given, filling] if fills else [*as_given, filling, filling_longer]


def slightly_longer(given: PitchHypothesis, tolerance: float) -> tuple[Hypotheses, Hypotheses]:
    """A given pitch as it is, and with pixels slightly longer one way, each right by a tolerance."""
    near = replace(given, tolerance=tolerance)
    return [near], [longer(near, stretch) for stretch in _SLIGHT]


def longer(given: PitchHypothesis, stretch: float) -> PitchHypothesis:
    """The same with pixels that are longer across than down by a share, or less long."""
    x, y = given.mm
    return replace(given, mm=(x * (1 + stretch / 2), y * (1 - stretch / 2)))

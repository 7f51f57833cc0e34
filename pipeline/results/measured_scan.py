"""What one scan gave: the value that measuring hands on, and that files keep."""

from dataclasses import dataclass
from pathlib import Path

from measure.results import FrameMeasurement


@dataclass(frozen=True)
class MeasuredScan:
    """A scan and what was measured in it. notes: what is worth knowing of its file, and needs no action."""

    scan: Path
    width_px: int
    height_px: int
    pitch_um: tuple[float, float]
    frame: FrameMeasurement
    notes: tuple[str, ...] = ()

"""A scan file, opened by windows."""

from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


class Scan:
    """An opened scan: its size, its pitch, and windows of grey values that grow with light on the scanner's sensor.

    width_px, height_px; full_scale_dn: the largest grey value that the bit depth allows; pitch_um: (x, y) from the
    file's resolution tags, None where it has none.
    """

    path: Path
    name: str  # the file's name without its ending
    width_px: int
    height_px: int
    full_scale_dn: float
    pitch_um: tuple[float, float] | None

    def window(self, col0: int, row0: int, width: int, height: int) -> Array:
        """(height, width) float32 grey values; parts outside of the scan repeat its edge."""
        raise NotImplementedError

    def reduced(self, factor: int) -> Array:
        """The whole scan, area-averaged by an integer factor: pixel (i, j) is the mean over factor x factor pixels,
        its centre at column factor * j + (factor - 1) / 2. The last partial row and column are dropped."""
        raise NotImplementedError

    def __enter__(self) -> "Scan":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def open_scan(path: Path) -> Scan:
    """Open a scan. Raises MeasurementError, with what to do, for a file that is missing, unreadable or no picture."""
    raise NotImplementedError

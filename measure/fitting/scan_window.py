"""A window of a scan as a fit takes it: its grey values, where it lies, and what is known of its pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from measure.fitting.clipping import Sides, clipped_sides
from measure.scans.scan import Scan

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ScanWindow:
    """grey (height, width), whose top-left pixel's centre is at origin_px (col, row) of the scan; valid: which of its
    pixels are true ones, None if all; clipped: which are at an end of the scanner's range, as `clipped_sides` gives it,
    None if none. is_lossy: whether it was compressed with loss."""

    grey: NDArray[np.floating]
    origin_px: tuple[float, float] = (0.0, 0.0)
    valid: Mask | None = None
    clipped: Sides | None = None
    is_lossy: bool = False

    @property
    def usable(self) -> Mask:
        """(height, width): which pixels tell a grey value."""
        known = np.asarray(np.isfinite(self.grey))
        return known if self.valid is None else known & self.valid

    @property
    def sides(self) -> Sides:
        return np.zeros(self.grey.shape, np.int8) if self.clipped is None else self.clipped

    def without(self, lost: Mask) -> "ScanWindow":
        """The same, some of its pixels (height, width) no longer being true ones."""
        return replace(self, valid=self.usable & ~lost)


def read_window(scan: Scan, place_px: tuple[int, int, int, int], weights: Sequence[float] | None = None) -> ScanWindow:
    """The window at col0, row0, width, height of the scan. weights: what each channel counts, as `Scan.window` takes
    them."""
    col0, row0, _, _ = place_px
    return ScanWindow(
        scan.window(*place_px, weights).astype(float),
        (col0, row0),
        scan.inside(*place_px),
        clipped_sides(scan, *place_px, weights),
        scan.is_lossy,
    )

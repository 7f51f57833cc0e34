"""A window of a scan as a scan of its own: what lies outside of it is not there."""

from collections.abc import Mapping, Sequence

from measure.scans.radiometry import Samples
from measure.scans.resolution import Pitch
from measure.scans.scan import Scan
from measure.scans.scan_part import Window
from measure.scans.segments import LostPart, OpenedPicture, Place

_BAND_PX = 1 << 18  # of the window that are read at a time


def windowed(scan: Scan, window: Window) -> Scan:
    """The window's pixels count from its own first one; the scan stays open as long as it is read. Raises ValueError
    for a window that the scan does not have."""
    col, row, width, height = window
    if min(width, height) < 1 or min(col, row) < 0 or col + width > scan.width_px or row + height > scan.height_px:
        raise ValueError(
            f"the window {col} {row} {width} {height} does not lie in {scan.width_px} x {scan.height_px} px"
        )
    pitch, segments = Pitch(scan.pitch_um, scan.pitch_note), WindowSegments(scan, window)
    opened = OpenedPicture(segments, pitch, scan.notes, scan.problems, orientation=scan.orientation)
    seen = Scan(scan.path, segments, pitch, opened).named(scan.name)
    return seen.seen_through(scan.tone)


class WindowSegments:
    """A window of a scan in bands of rows, as `Segments` has it."""

    def __init__(self, scan: Scan, window: Window) -> None:
        self._scan = scan
        self._col0, self._row0, self.width_px, self.height_px = window
        self.segment_width_px = self.width_px
        self.segment_height_px = min(max(_BAND_PX // self.width_px, 1), self.height_px)
        self.channels = scan.channels
        self.full_scale_dn = scan.full_scale_dn
        self.sample_bytes = scan.samples_dtype().itemsize
        self.rounding_step_dn = scan.rounding_step_dn

    @property
    def lost(self) -> Sequence[LostPart]:
        return tuple(
            LostPart(part.col0 - self._col0, part.row0 - self._row0, part.width, part.height, part.why)
            for part in self._scan.lost
        )

    def fetched(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        return {}

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """A band of rows."""
        first = row * self.segment_height_px
        height = min(self.segment_height_px, self.height_px - first)
        return self._scan.samples(self._col0, self._row0 + first, self.width_px, height)

    def close(self) -> None:
        """The scan is another's to close."""

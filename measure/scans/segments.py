"""What a scan file is to those who read windows: a grid of segments."""

from typing import Protocol

from measure.scans.radiometry import Samples


class Segments(Protocol):
    """A picture as its file stores it: a grid of tiles or strips, each decoded on its own.

    height_px, width_px: of the picture; segment_height_px, segment_width_px: of a segment, those at the right and lower
    border being smaller; channels: 1 (grey) or 3 (red, green, blue); full_scale_dn: the largest value;
    sample_bytes: 1 or 2; rounding_step_dn: to which a compression with loss, as JPEG, rounds coarse detail, 0 where
    there is none.
    """

    height_px: int
    width_px: int
    segment_height_px: int
    segment_width_px: int
    channels: int
    full_scale_dn: float
    sample_bytes: int
    rounding_step_dn: float

    def read(self, row: int, column: int) -> Samples:
        """Segment (row, column) of the grid: (height, width, channels), values that grow with light."""

    def close(self) -> None: ...

"""What a scan file is to those who read windows: a grid of segments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from measure.scans.radiometry import Samples

Place = tuple[int, int]  # row and column in a grid of segments


@dataclass(frozen=True)
class LostPart:
    """A part of a picture that its file is too damaged to give: its first column and row, its size, and why."""

    col0: int
    row0: int
    width: int
    height: int
    why: str


class Segments(Protocol):
    """A picture as its file stores it: a grid of tiles or strips, each decoded on its own.

    height_px, width_px: of the picture; segment_height_px, segment_width_px: of a segment, those at the right and lower
    border being smaller; channels: 1 (grey) or 3 (red, green, blue); full_scale_dn: the largest value;
    sample_bytes: 1 or 2; rounding_step_dn: to which a compression with loss, as JPEG, rounds coarse detail, 0 where
    there is none; lost: what of the segments read so far is damaged. Its samples are in the middle of the range, so
    that nothing there looks like a mark.
    """

    height_px: int
    width_px: int
    segment_height_px: int
    segment_width_px: int
    channels: int
    full_scale_dn: float
    sample_bytes: int
    rounding_step_dn: float

    @property
    def lost(self) -> Sequence[LostPart]: ...

    def fetched(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        """What the file has stored of segments (row, column), where asking for all together is quicker than for one
        after the other; else nothing."""

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """Segment (row, column) of the grid: (height, width, channels), values that grow with light. stored: as
        `fetched` gives it."""

    def close(self) -> None: ...

"""The grid of segments (tiles, strips) of a picture, and a cache of those decoded last."""

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from threading import Lock

import numpy as np

from measure.scans.metadata import Pitch, Samples

Place = tuple[int, int]  # row and column in a grid of segments

CACHE_BYTES = 40 << 20  # seven rows of tiles of 256 px, 16 bit, 11,500 px across


@dataclass(frozen=True)
class LostPart:
    """A part of a picture that its file is too damaged to give: its first column and row, its size, and why."""

    col0: int
    row0: int
    width: int
    height: int
    why: str


class Segments(ABC):
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
    def lost(self) -> Sequence[LostPart]:
        return ()

    def fetch(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        """What the file has stored of segments (row, column), where asking for all together is quicker than for one
        after the other; else nothing."""
        return {}

    @abstractmethod
    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """Segment (row, column) of the grid: (height, width, channels), values that grow with light. stored: as
        `fetch` gives it."""

    @abstractmethod
    def close(self) -> None:
        """Close the file, where one is open."""


@dataclass(frozen=True, eq=False)
class OpenedPicture:
    """A scan's picture as its file gives it.

    notes: what is unusual about the file, a sentence each; problems: what needs a look; overviews: the same picture
    made small; orientation: the tag by which viewers turn the picture, 1 where they do not (TIFF 6.0).
    """

    segments: Segments
    pitch: Pitch
    notes: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    overviews: tuple[Segments, ...] = ()
    orientation: int = 1


@dataclass(eq=False)
class _Segment:
    """samples: None until the thread that decodes them, which holds the lock, is done."""

    samples: Samples | None = None
    lock: Lock = field(default_factory=Lock)


class SegmentCache:
    """As many segments as a memory limit allows, and at least two rows of the grid: reading a scan
    from top to bottom decodes each once, wherever its bands begin. A thread that wants what another is decoding waits
    for it."""

    def __init__(self, segments: Segments) -> None:
        self._segments = segments
        self._row_bytes = segments.width_px * segments.channels * segments.sample_bytes
        tall = min(2 * segments.segment_height_px, segments.height_px)
        self._limit = max(CACHE_BYTES, tall * self._row_bytes)
        self._held = 0
        self._kept: OrderedDict[Place, _Segment] = OrderedDict()
        self._lock = Lock()

    @property
    def rows_kept(self) -> int:
        """How many rows of the picture have room."""
        return self._limit // self._row_bytes

    def fill(self, samples: Samples, row0: int, col0: int) -> None:
        """Samples (height, width, channels) of the picture from a row and column on. Segments that other threads are
        decoding come last: there may be more to decode meanwhile."""
        tall, wide = self._segments.segment_height_px, self._segments.segment_width_px
        height, width, _ = samples.shape
        rows = range(row0 // tall, (row0 + height - 1) // tall + 1)
        cols = range(col0 // wide, (col0 + width - 1) // wide + 1)

        def take(i: int, j: int, decoded: Samples) -> None:
            row, col = i * tall - row0, j * wide - col0
            part = decoded[max(-row, 0) : height - row, max(-col, 0) : width - col]
            row, col = max(row, 0), max(col, 0)
            samples[row : row + part.shape[0], col : col + part.shape[1]] = part

        wanted = {key: self._segment(key) for key in product(rows, cols)}
        others = [key for key, segment in wanted.items() if segment.samples is None and segment.lock.locked()]
        own = [key for key, segment in wanted.items() if segment.samples is None and not segment.lock.locked()]
        stored = self._segments.fetch(own)
        for key in sorted(wanted, key=others.__contains__):
            take(*key, self._decode(key, wanted[key], stored.get(key, ())))

    def _segment(self, key: Place) -> _Segment:
        """Of the grid, by row and column."""
        with self._lock:
            segment = self._kept.setdefault(key, _Segment())
            self._kept.move_to_end(key)
        return segment

    def _decode(self, key: Place, segment: _Segment, stored: Sequence[bytes] = ()) -> Samples:
        """Decoded here unless another thread has begun to."""
        with segment.lock:
            samples = segment.samples
            if samples is None:
                samples = segment.samples = self._segments.read(*key, stored)
                self._make_room(samples.nbytes)
        return samples

    def _make_room(self, added: int) -> None:
        """For so many bytes, from the segments that were wanted longest ago."""
        with self._lock:
            self._held += added
            while self._held > self._limit:
                oldest, samples = next((key, own.samples) for key, own in self._kept.items() if own.samples is not None)
                self._held -= samples.nbytes
                del self._kept[oldest]


class WholePicture(Segments):
    """A picture in memory: (height, width, channels) of 8 or 16 bits, one segment. damage: why it cannot be trusted, a
    part of a sentence, empty where it can."""

    def __init__(
        self,
        samples: Samples,
        rounding_step_dn: float = 0.0,
        damage: str = "",
        full_scale_dn: float | None = None,
    ) -> None:
        """full_scale_dn: None: all bits of a sample are used."""
        self._samples, self._damage, self.rounding_step_dn = samples, damage, rounding_step_dn
        self.height_px, self.width_px, self.channels = samples.shape
        self.segment_height_px, self.segment_width_px = self.height_px, self.width_px
        self.sample_bytes = samples.itemsize
        self.full_scale_dn = float(2 ** (8 * samples.itemsize) - 1) if full_scale_dn is None else full_scale_dn
        if damage:
            self._samples = np.full_like(samples, self.full_scale_dn // 2)

    @property
    def lost(self) -> Sequence[LostPart]:
        return (LostPart(0, 0, self.width_px, self.height_px, self._damage),) if self._damage else ()

    def close(self) -> None:
        """Nothing is open."""

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """All of it."""
        return self._samples

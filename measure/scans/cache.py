"""Grid of segments (tiles or strips) of an image, and a cache of decoded segments."""

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
    """Undecodable part of an image: first column and row, size, and reason."""

    col0: int
    row0: int
    width: int
    height: int
    why: str


class Segments(ABC):
    """An image as stored in a file: a grid of tiles or strips that are decoded separately.

    Attributes
    ----------
    height_px, width_px : of the image.
    segment_height_px, segment_width_px : of a segment; those at the right and lower border are smaller.
    channels : 1 (grey) or 3 (red, green, blue).
    full_scale_dn : largest value.
    sample_bytes : 1 or 2.
    quantisation_step_dn : of coarse detail by lossy compression; 0 without any.
    first_block_px : column and row, 0 to 7, at which the first whole block of a JPEG compression begins.
    origin_px : column and row of the first pixel in the picture of the file.
    lost : undecodable parts of the segments read so far. Their samples are set to half of the full scale, so that
        nothing there resembles a mark.
    """

    height_px: int
    width_px: int
    segment_height_px: int
    segment_width_px: int
    channels: int
    full_scale_dn: float
    sample_bytes: int
    quantisation_step_dn: float
    first_block_px: tuple[int, int] = (0, 0)
    origin_px: tuple[int, int] = (0, 0)

    @property
    def lost(self) -> Sequence[LostPart]:
        return ()

    def fetch(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        """Stored bytes of several segments (row, column), where one request for all is faster; otherwise empty."""
        return {}

    @abstractmethod
    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """Decode segment (row, column): (height, width, channels), values that increase with light. stored: from
        `fetch`."""

    @abstractmethod
    def close(self) -> None:
        """Close the file, if one is open."""


@dataclass(frozen=True, eq=False)
class OpenedPicture:
    """The image of a scan file.

    notes, problems: one sentence each; overviews: reduced copies of the image; orientation: the orientation tag, 1 if
    viewers do not rotate the image (TIFF 6.0); bits: of a sample as the file stores it, 0 if not known.
    """

    segments: Segments
    pitch: Pitch
    notes: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    overviews: tuple[Segments, ...] = ()
    orientation: int = 1
    bits: int = 0


@dataclass(eq=False)
class _Segment:
    """samples: None until the thread that holds the lock has decoded them."""

    samples: Samples | None = None
    lock: Lock = field(default_factory=Lock)


class SegmentCache:
    """Cache of decoded segments within a memory limit, at least two rows of the grid.

    Reading a scan from top to bottom then decodes each segment once, wherever its bands begin. A thread that needs a
    segment which another is decoding waits for it.
    """

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
        """Number of rows of the image that fit into the cache."""
        return self._limit // self._row_bytes

    def fill(self, samples: Samples, row0: int, col0: int) -> None:
        """Fill samples (height, width, channels) from a row and column on. Segments under decoding by other threads are
        taken last."""
        tall, wide = self._segments.segment_height_px, self._segments.segment_width_px
        height, width, _ = samples.shape
        rows = range(row0 // tall, (row0 + height - 1) // tall + 1)
        cols = range(col0 // wide, (col0 + width - 1) // wide + 1)
        with self._lock:
            wanted = {key: self._kept.setdefault(key, _Segment()) for key in product(rows, cols)}
            for key in wanted:
                self._kept.move_to_end(key)
        others = [key for key, segment in wanted.items() if segment.samples is None and segment.lock.locked()]
        own = [key for key, segment in wanted.items() if segment.samples is None and not segment.lock.locked()]
        stored = self._segments.fetch(own)
        for key in sorted(wanted, key=others.__contains__):
            decoded = self._decode(key, wanted[key], stored.get(key, ()))
            row, col = key[0] * tall - row0, key[1] * wide - col0
            part = decoded[max(-row, 0) : height - row, max(-col, 0) : width - col]
            row, col = max(row, 0), max(col, 0)
            samples[row : row + part.shape[0], col : col + part.shape[1]] = part

    def _decode(self, key: Place, segment: _Segment, stored: Sequence[bytes]) -> Samples:
        """Decode a segment unless another thread has begun to, and drop the least recently used ones to make room."""
        with segment.lock:
            samples = segment.samples
            if samples is None:
                samples = segment.samples = self._segments.read(*key, stored)
                with self._lock:
                    self._held += samples.nbytes
                    while self._held > self._limit:
                        kept = ((key, one.samples) for key, one in self._kept.items() if one.samples is not None)
                        oldest, dropped = next(kept)
                        self._held -= dropped.nbytes
                        del self._kept[oldest]
        return samples


class WholePicture(Segments):
    """An image in memory, (height, width, channels) of 8 or 16 bits, as one segment. damage: why it cannot be trusted,
    a part of a sentence; empty if it can."""

    def __init__(
        self, samples: Samples, quantisation_step_dn: float = 0.0, damage: str = "", full_scale_dn: float | None = None
    ) -> None:
        """full_scale_dn: None if all bits of a sample are used."""
        self._samples, self._damage, self.quantisation_step_dn = samples, damage, quantisation_step_dn
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
        """Return the whole image."""
        return self._samples

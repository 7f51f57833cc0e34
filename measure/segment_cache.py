"""The segments of a scan decoded last, for all threads that read it."""

from collections import OrderedDict
from concurrent.futures import Future
from itertools import product
from threading import Lock

from measure.radiometry import Samples
from measure.segments import Segments

CACHE_BYTES = 40 << 20


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
        self._decoded: OrderedDict[tuple[int, int], Future[Samples]] = OrderedDict()
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

        def take(i: int, j: int, segment: Samples) -> None:
            row, col = i * tall - row0, j * wide - col0
            part = segment[max(-row, 0) : height - row, max(-col, 0) : width - col]
            row, col = max(row, 0), max(col, 0)
            samples[row : row + part.shape[0], col : col + part.shape[1]] = part

        others: list[tuple[int, int, Future[Samples]]] = []
        for i, j in product(rows, cols):
            segment = self._segment(i, j)
            if segment.done():
                take(i, j, segment.result())
            else:
                others.append((i, j, segment))
        for i, j, segment in others:
            take(i, j, segment.result())

    def _segment(self, row: int, column: int) -> "Future[Samples]":
        """Segment (row, column) of the grid, decoded here unless another thread has begun to."""
        key = (row, column)
        with self._lock:
            known = self._decoded.get(key)
            if known is None:
                own = self._decoded[key] = Future()
            else:
                self._decoded.move_to_end(key)
        if known is not None:
            return known
        self._decode(key, own)
        return own

    def _decode(self, key: tuple[int, int], own: "Future[Samples]") -> None:
        try:
            samples = self._segments.read(*key)
        except BaseException as error:
            with self._lock:
                del self._decoded[key]
            own.set_exception(error)
            raise
        own.set_result(samples)
        with self._lock:
            self._held += samples.nbytes
            while self._held > self._limit and (oldest := self._oldest_but(key)):
                self._held -= self._decoded.pop(oldest).result().nbytes

    def _oldest_but(self, key: tuple[int, int]) -> tuple[int, int] | None:
        """Of the segments that are decoded, the one that was wanted longest ago, and is not of this key."""
        return next((other for other, segment in self._decoded.items() if other != key and segment.done()), None)

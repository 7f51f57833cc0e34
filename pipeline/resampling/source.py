"""The pixels of a scan by windows, however it lies: a scan in strips that lies across is decoded once, into a file."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from measure.scans.scan import Scan

Samples = NDArray[np.uint8 | np.uint16]
Mask = NDArray[np.bool_]

_BAND_PX = 256  # rows that are decoded at a time into the scratch file


class Source(Protocol):
    """What is interpolated: its size, and windows (height, width, channels) whose outside repeats its edge."""

    width_px: int
    height_px: int
    channels: int
    dtype: type[np.uint8] | type[np.uint16]

    def window(self, col0: int, row0: int, width: int, height: int) -> Samples: ...

    def known(self, col0: int, row0: int, width: int, height: int) -> Mask: ...


class _ByWindows:
    """A scan whose file gives windows without reading the rest."""

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self.width_px, self.height_px, self.channels = scan.width_px, scan.height_px, scan.channels
        self.dtype = scan.samples_dtype

    def window(self, col0: int, row0: int, width: int, height: int) -> Samples:
        return self.scan.samples(col0, row0, width, height)

    def known(self, col0: int, row0: int, width: int, height: int) -> Mask:
        return self.scan.inside(col0, row0, width, height) | ~_within(self, col0, row0, width, height)


class _Decoded(_ByWindows):
    """A scan decoded into a file without compression, whose rows are read by place: mapped memory would count."""

    def __init__(self, scan: Scan, file: int) -> None:
        super().__init__(scan)
        self.file, self.row_bytes = file, scan.width_px * scan.channels * np.dtype(self.dtype).itemsize
        for row in range(0, scan.height_px, _BAND_PX):
            height = min(_BAND_PX, scan.height_px - row)
            os.write(file, scan.samples(0, row, scan.width_px, height).tobytes())

    def window(self, col0: int, row0: int, width: int, height: int) -> Samples:
        rows = np.clip(np.arange(row0, row0 + height), 0, self.height_px - 1)
        left, right = (min(max(col, 0), self.width_px - 1) for col in (col0, col0 + width - 1))
        pixel_bytes = self.row_bytes // self.width_px
        read = {
            row: os.pread(self.file, (right + 1 - left) * pixel_bytes, row * self.row_bytes + left * pixel_bytes)
            for row in np.unique(rows).tolist()
        }
        inside = np.array([np.frombuffer(read[row], self.dtype).reshape(-1, self.channels) for row in rows.tolist()])
        return inside[:, np.clip(np.arange(col0, col0 + width), left, right) - left]


def _within(source: _ByWindows, col0: int, row0: int, width: int, height: int) -> Mask:
    cols, rows = np.arange(col0, col0 + width), np.arange(row0, row0 + height)
    in_rows = (rows >= 0) & (rows < source.height_px)
    return np.asarray(in_rows[:, None] & (cols >= 0) & (cols < source.width_px))


@contextmanager
def source_of(scan: Scan, rows_at_a_time: int, scratch: Path) -> Iterator[Source]:
    """The scan, of which a row of tiles needs `rows_at_a_time` rows. scratch: a folder for what is decoded."""
    wide = scan.segment_px[1] >= scan.width_px
    if not wide or rows_at_a_time <= scan.rows_kept:
        yield _ByWindows(scan)
        return
    with tempfile.TemporaryFile(dir=scratch, prefix=".decoded-") as file:
        yield _Decoded(scan, file.fileno())

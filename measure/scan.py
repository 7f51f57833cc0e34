"""A scan file, opened by windows."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from itertools import product
from math import lcm
from pathlib import Path
from types import TracebackType
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.picture_scan import open_picture
from measure.radiometry import Samples
from measure.resolution import Pitch
from measure.segment_cache import SegmentCache
from measure.segments import Segments
from measure.tiff_scan import open_tiff

Array = NDArray[np.float32]

LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601: red, green, blue
GREEN = (0.0, 1.0, 0.0)
BAND_PIXELS = 1 << 18  # that a thread averages at a time: they stay in the processor's cache
SEGMENT_PX = 256  # of the scan, that a segment of its reduction holds along a side, about
LARGEST_SEGMENT_PX = 2048
REDUCED_SHARE = 0.25  # of a scan's cache, for a reduction of it

Item = TypeVar("Item")
Result = TypeVar("Result")


class Scan:
    """An opened scan: its size, its pitch, and windows of grey values that grow with light on the scanner's sensor.

    width_px, height_px; channels: 1 or 3; full_scale_dn: the largest grey value that the bit depth allows;
    rounding_step_dn: of a compression with loss, which is_lossy says that there is; pitch_um: (x, y) from the file's
    resolution tags, None where it has none that can be believed, and then pitch_note says why;
    notes: what else is unusual about the file, a sentence each.
    The pixels are those that the file stores: a tag that asks a viewer to turn the picture is not obeyed.
    """

    def __init__(
        self,
        path: Path,
        segments: Segments,
        pitch: Pitch,
        notes: tuple[str, ...] = (),
        cache: SegmentCache | None = None,
    ) -> None:
        self.path = path
        self.name = path.stem
        self.width_px = segments.width_px
        self.height_px = segments.height_px
        self.channels = segments.channels
        self.full_scale_dn = segments.full_scale_dn
        self.rounding_step_dn = segments.rounding_step_dn
        self.is_lossy = self.rounding_step_dn > 0
        self.pitch_um = pitch.um
        self.pitch_note = pitch.note
        self.notes = notes
        self._segments = segments
        self._cache = cache or SegmentCache(segments)
        self._reduced: dict[int, Array] = {}
        self._segment_px = SEGMENT_PX
        self._grey_weights: Sequence[float] = (1.0,) if self.channels == 1 else LUMINANCE

    @property
    def rows_kept(self) -> int:
        """How many rows of the scan stay decoded for the next windows, however they lie to its segments."""
        return self._cache.rows_kept

    def green(self) -> "Scan":
        """The same scan with its green for grey value, if it has colours. A lens draws red and blue at scales of their
        own, some 1e-4 off; a mark in a mixture of all has no one place."""
        scan = copy(self)
        if self.channels == len(GREEN):
            scan._grey_weights = GREEN
        return scan

    def window(self, col0: int, row0: int, width: int, height: int, weights: Sequence[float] | None = None) -> Array:
        """(height, width) float32 grey values; parts outside of the scan repeat its edge.

        weights: what each channel counts, (channels,); None is the grey value itself, or the luminance of a colour.
        """
        if width < 1 or height < 1:
            raise ValueError(f"a window has at least one pixel, not {width} x {height}")
        return np.asarray(self._planes(col0, row0, width, height, self._weights(weights)[None])[0])

    def reduced(self, factor: int, weights: Sequence[float] | None = None) -> Array:
        """The whole scan, area-averaged by an integer factor: pixel (i, j) is the mean over factor x factor pixels,
        its centre at column factor * j + (factor - 1) / 2. The last partial row and column are dropped.

        The scan is streamed in bands of rows: memory holds the result, all its channels for the next call, and a band
        for each thread.
        """
        height, width = self.height_px // factor, self.width_px // factor
        if factor < 1 or height < 1 or width < 1:
            raise ValueError(f"{self.name}: cannot be reduced by {factor}: it is {self.width_px} x {self.height_px} px")
        if factor not in self._reduced:
            self._reduced.clear()
            self._reduced[factor] = self._reduced_channels(factor, width, height)
        return weighted(self._reduced[factor], self._weights(weights))

    def reduced_window(
        self, factor: int, col0: int, row0: int, width: int, height: int, weights: Sequence[float] | None = None
    ) -> Array:
        """(height, width) pixels of the reduced scan from its column col0 and row row0 on, read from the file by
        themselves; parts outside of the scan repeat its edge."""
        return np.asarray(self._reduced_planes(factor, col0, row0, width, height, self._weights(weights)[None])[0])

    def reduction(self, factor: int) -> "Scan":
        """The grey values area-averaged by an integer factor, as `reduced` gives them, as a scan of its own: parts of
        this one are read as its windows ask for them, and the last of them kept."""
        if factor == 1:
            return self
        pitch = self.pitch_um and (self.pitch_um[0] * factor, self.pitch_um[1] * factor)
        segments = ReducedSegments(self, factor)
        cache = SegmentCache(segments, share=REDUCED_SHARE)
        reduction = Scan(self.path, segments, Pitch(pitch, self.pitch_note), self.notes, cache)
        reduction._segment_px = max(self._segment_px // factor, 1)
        return reduction

    def decode(self, row0: int, row1: int) -> None:
        """Decode what the rows row0 to row1 (exclusive) need, side by side: windows side by side would wait for the
        strips that they share."""
        tall, wide = self._segments.segment_height_px, self._segments.segment_width_px
        rows = range(max(row0, 0) // tall, (min(row1, self.height_px) - 1) // tall + 1)

        def read(key: tuple[int, int]) -> None:
            self._cache.read(*key)  # what is returned would be held until all is read

        self.each(read, product(rows, range(-(-self.width_px // wide))))

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """What the function makes of each item, in their order, by as many threads as OpenCV may use: decoders and
        filters run side by side."""
        with ThreadPoolExecutor(max(cv2.getNumThreads(), 1)) as threads:
            return list(threads.map(function, items))

    def close(self) -> None:
        self._segments.close()

    def __enter__(self) -> "Scan":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _reduced_channels(self, factor: int, width: int, height: int) -> Array:
        """(height, width, channels): every segment is decoded once."""
        result = np.empty((height, width, self.channels), np.float32)
        single = np.eye(self.channels, dtype=np.float32)
        band = reduced_rows(width, factor)

        def fill(row0: int) -> None:
            rows = min(band, height - row0)
            planes = self._reduced_planes(factor, 0, row0, width, rows, single)
            result[row0 : row0 + rows] = np.moveaxis(planes, 0, -1)

        self.each(fill, range(0, height, band))
        return result

    def _reduced_planes(self, factor: int, col0: int, row0: int, width: int, height: int, weights: Array) -> Array:
        """(n, height, width) of the reduced scan, for weights (n, channels)."""
        result, band = np.empty((len(weights), height, width), np.float32), reduced_rows(width, factor)
        for first in range(0, height, band):
            rows = min(band, height - first)
            fine = self._planes(col0 * factor, (row0 + first) * factor, width * factor, rows * factor, weights)
            for plane, each in zip(result, fine, strict=True):
                plane[first : first + rows] = cv2.resize(each, (width, rows), interpolation=cv2.INTER_AREA)
        return result

    def _weights(self, weights: Sequence[float] | None) -> Array:
        if weights is None:
            weights = self._grey_weights
        if len(weights) != self.channels:
            raise ValueError(f"{self.name}: {len(weights)} weights for {self.channels} channels")
        return np.asarray(weights, np.float32)

    def _planes(self, col0: int, row0: int, width: int, height: int, weights: Array) -> Array:
        """(n, height, width) for weights (n, channels); parts outside of the scan repeat its edge."""
        top, bottom = (min(max(row, 0), self.height_px - 1) for row in (row0, row0 + height - 1))
        left, right = (min(max(col, 0), self.width_px - 1) for col in (col0, col0 + width - 1))
        inner = self._inside(top, bottom + 1, left, right + 1, weights)
        if inner.shape[1:] == (height, width):
            return inner
        above, before = min(max(-row0, 0), height - 1), min(max(-col0, 0), width - 1)
        below, after = height - above - inner.shape[1], width - before - inner.shape[2]
        return np.stack([cv2.copyMakeBorder(each, above, below, before, after, cv2.BORDER_REPLICATE) for each in inner])

    def _inside(self, row0: int, row1: int, col0: int, col1: int, weights: Array) -> Array:
        """Rows row0 to row1 and columns col0 to col1 (exclusive), all inside the scan, from the segments they touch."""
        tall, wide = self._segments.segment_height_px, self._segments.segment_width_px
        result = np.empty((len(weights), row1 - row0, col1 - col0), np.float32)
        for i in range(row0 // tall, (row1 - 1) // tall + 1):
            top, bottom = max(row0, i * tall), min(row1, (i + 1) * tall)
            for j in range(col0 // wide, (col1 - 1) // wide + 1):
                left, right = max(col0, j * wide), min(col1, (j + 1) * wide)
                part = self._cache.read(i, j)[top - i * tall : bottom - i * tall, left - j * wide : right - j * wide]
                for plane, each in zip(result, weights, strict=True):
                    plane[top - row0 : bottom - row0, left - col0 : right - col0] = grey(part, each)
        return result


class ReducedSegments:
    """A scan's grey values area-averaged by a factor, in segments that hold whole ones of the scan where these are not
    too large."""

    def __init__(self, scan: Scan, factor: int) -> None:
        self._scan, self._factor = scan, factor
        self.height_px, self.width_px = scan.height_px // factor, scan.width_px // factor
        tall, wide = scan._segments.segment_height_px, scan._segments.segment_width_px
        self.segment_height_px = min(reduced_side(tall, factor, scan._segment_px), self.height_px)
        # Strips are wanted once, whole.
        self.segment_width_px = self.width_px if wide >= scan.width_px else reduced_side(wide, factor, scan._segment_px)
        self.channels, self.full_scale_dn, self.sample_bytes = 1, scan.full_scale_dn, 4
        self.rounding_step_dn = scan.rounding_step_dn

    def read(self, row: int, column: int) -> Array:
        """Segment (row, column) of the grid."""
        row0, col0 = row * self.segment_height_px, column * self.segment_width_px
        height = min(self.segment_height_px, self.height_px - row0)
        width = min(self.segment_width_px, self.width_px - col0)
        return self._scan.reduced_window(self._factor, col0, row0, width, height)[..., None]

    def close(self) -> None:
        """The scan stays open."""


def reduced_side(fine_px: int, factor: int, most_px: int) -> int:
    """The side of a reduced segment: about most_px of the scan, in whole segments if these are not much larger."""
    unit = lcm(fine_px, factor)
    return max((unit * max(most_px // unit, 1) if unit <= LARGEST_SEGMENT_PX else most_px) // factor, 1)


def reduced_rows(width: int, factor: int) -> int:
    """How many rows of a reduced picture are averaged at a time."""
    return max(BAND_PIXELS // (width * factor * factor), 1)


def open_scan(path: Path) -> Scan:
    """Open a TIFF, BigTIFF, JPEG or PNG file, told apart by its first bytes and not by its name.

    Raises MeasurementError, with what to do, for a file that is missing, empty, truncated or no such picture.
    """
    path = Path(path)
    start = first_bytes(path)
    if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        segments, pitch, notes = open_tiff(path)
    else:
        segments, pitch, notes = open_picture(path, start)
    return Scan(path, segments, pitch, notes)


def first_bytes(path: Path) -> bytes:
    """The file's first 16 bytes, or why there are none."""
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except FileNotFoundError:
        raise MeasurementError(
            f"there is no scan {path} (looked for {path.resolve()}): check the name in `scans`; "
            "paths are relative to the project file"
        ) from None
    except OSError as error:
        raise MeasurementError(
            f"{path} cannot be read: {error.strerror}; check that it is a file you may read"
        ) from error
    if not start:
        raise MeasurementError(f"{path} is empty (0 bytes): copy or scan it anew")
    return start


def grey(samples: Samples, weights: Array) -> Samples:
    """(height, width) grey values of (height, width, channels) samples, as they are where there is one channel."""
    return samples[..., 0] if len(weights) == 1 and weights[0] == 1.0 else weighted(samples, weights)


def weighted(samples: Samples | Array, weights: Array) -> Array:
    """(height, width) float32 grey values of (height, width, channels) samples."""
    grey = samples[..., 0].astype(np.float32)
    if weights[0] != 1.0:
        grey *= weights[0]
    for channel in range(1, samples.shape[-1]):
        grey += weights[channel] * samples[..., channel]
    return grey

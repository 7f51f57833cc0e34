"""A scan file, opened by windows."""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from itertools import product
from math import lcm
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Single
from measure.scans.cache import LostPart, OpenedPicture, SegmentCache, Segments
from measure.scans.jpeg import BLOCK_PX, earlier_compression
from measure.scans.metadata import Pitch, Samples
from measure.scans.parallel import map_in_threads
from measure.scans.remote import ScanPart, Window
from measure.scans.tiff import RawRows
from measure.tone.curve import LINEAR, Tone

LUMINANCE = (0.299, 0.587, 0.114)  # ITU-R BT.601: red, green, blue
_GREEN = (0.0, 1.0, 0.0)
SINGLE_CHANNELS = (1.0, 0.0, 0.0), _GREEN, (0.0, 0.0, 1.0)
_BAND_PIXELS = 1 << 18  # averaged by a thread at a time: fits into the processor's cache
_PART_PX = 512  # approximate side of the part that a thread reduces at a time, px of the scan
_LARGEST_PART_PX = 2048  # largest side of a part in whole segments; larger segments are divided
_COMPRESSION_PX = 256  # side of the central part tested for an earlier compression: 1000 blocks
_PLAINLY_COARSER = 1.5  # least ratio to the file's own rounding step, which shows as well
_SIZE_TOLERANCE_PX = 0.01  # tolerance of an overview's size, px, where its last pixel covers only a part
_COUNTED_PX, _COUNTED_SIDE = 64, 4  # side of the windows in which values are counted, and their number a side
_NAMED = 3  # damaged parts listed by name; more are counted
_LEAST_UNIT_DN = 16  # least step of grey values of 8 bits stored in 16: 12 bits in the high bits have this step


class Scan:
    """An open scan: size, pitch, and windows of grey values.

    Grey values increase with light on the scanner's sensor. Pixels are as stored in the file: an orientation tag is not
    applied.

    Attributes
    ----------
    width_px, height_px : int
    channels : 1 or 3.
    weights : (channels,) weights of the channels in the grey values.
    full_scale_dn : largest grey value of the bit depth.
    tone : tone curve between light and grey values, with its uncertainty.
    pitch_um : (x, y) from the resolution tags; None where there are no credible ones, for the reason in pitch_note.
    problems : problems of the file, one sentence each.
    orientation : see `OpenedPicture`.
    origin_px : column and row of the first pixel in the picture of the file; (0, 0) but for a window of it.
    """

    def __init__(self, path: Path, segments: Segments, pitch: Pitch, opened: OpenedPicture | None = None) -> None:
        """opened: metadata of the file."""
        opened = opened or OpenedPicture(segments, pitch)
        self.path = path
        self.name = path.stem
        self.width_px = segments.width_px
        self.height_px = segments.height_px
        self.channels = segments.channels
        self.full_scale_dn = segments.full_scale_dn
        self.pitch_um = pitch.um
        self.pitch_note = pitch.note
        self.problems = opened.problems
        self.orientation = opened.orientation
        self.origin_px = segments.origin_px
        self.tone = LINEAR
        self._file_notes = opened.notes
        self._segments = segments
        self._cache = SegmentCache(segments)
        self._source = segments if isinstance(segments, RawRows) else self._cache
        self._reduced: dict[int, Samples | Single] = {}
        self._overviews = [Scan(path, own, pitch) for own in opened.overviews]
        self.weights: Sequence[float] = (1.0,) if self.channels == 1 else LUMINANCE

    @cached_property
    def quantisation_step_dn(self) -> float:
        """Quantisation step of coarse detail by lossy compression, of the file or an earlier one; 0 without any."""
        return max(self._segments.quantisation_step_dn, self._earlier[0])

    @property
    def first_block_px(self) -> tuple[int, int]:
        """Column and row, 0 to 7, at which the first whole block of 8 x 8 px of the compression begins."""
        return self._earlier[1] if self._earlier[0] else self._segments.first_block_px

    @property
    def is_lossy(self) -> bool:
        return self.quantisation_step_dn > 0

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the file, one sentence each."""
        if not self._earlier[0]:
            return self._file_notes
        return *self._file_notes, (
            "the picture was compressed as JPEG before it was stored as it is (to steps of some"
            f" {self._earlier[0]:.0f} grey values): its marks have the larger standard deviations of such a file"
        )

    @cached_property
    def is_two_valued(self) -> bool:
        """Whether only two values occur in windows spread over it: thresholding took the grey values from its edges."""
        width, height = (min(side, _COUNTED_PX) for side in (self.width_px, self.height_px))
        lefts, tops = (
            np.linspace(0, side - own, _COUNTED_SIDE).astype(int).tolist()
            for side, own in ((self.width_px, width), (self.height_px, height))
        )
        values = set[int]()
        for left, top in product(lefts, tops):
            values.update(np.unique(self.samples(left, top, width, height)).tolist())
            if len(values) > 2:
                return False
        return len(values) == 2

    @property
    def samples_dtype(self) -> type[np.uint8] | type[np.uint16]:
        return np.uint8 if self._segments.sample_bytes == 1 else np.uint16

    @property
    def rows_kept(self) -> int:
        """Number of rows that stay decoded for the next windows."""
        return self._cache.rows_kept

    @property
    def segment_px(self) -> tuple[int, int]:
        """Height and width of a tile or strip of the file."""
        return self._segments.segment_height_px, self._segments.segment_width_px

    def replace_name(self, name: str) -> "Scan":
        """The scan under its name in a project: files in several folders may share a name."""
        scan = copy(self)
        scan.name = name
        return scan

    def replace_tone(self, tone: Tone) -> "Scan":
        """The scan with another tone curve."""
        scan = copy(self)
        scan.tone = tone
        return scan

    def replace_weights(self, weights: Sequence[float]) -> "Scan":
        """The scan with another weighted mean (channels,) of its channels as its grey value."""
        scan = copy(self)
        scan.weights = weights
        return scan

    def green_channel(self) -> "Scan":
        """The scan with green as its grey value, if it has colours and no weights of its own. Lateral chromatic
        aberration scales red and blue by some 1e-4, so that a mark in a mixture of channels has no unique place."""
        return self.replace_weights(_GREEN) if self.weights == LUMINANCE else self

    def window(self, col0: int, row0: int, width: int, height: int, weights: Sequence[float] | None = None) -> Single:
        """(height, width) float32 grey values; outside of the scan its edge is repeated.

        weights: (channels,) of the channels; None: the grey value itself, or the luminance of a colour.
        """
        if width < 1 or height < 1:
            raise ValueError(f"a window has at least one pixel, not {width} x {height}")
        return weighted(self.samples(col0, row0, width, height), self._weights(weights))

    def light(self, col0: int, row0: int, width: int, height: int, weights: Sequence[float] | None = None) -> Single:
        """(height, width) window in linear light, by the tone curve: blur is linear in light, so marks are fitted
        there."""
        if not self.tone.sharpening:
            samples = self.samples(col0, row0, width, height)
            light = samples if self.tone.is_identity else self.tone.light(samples, self.full_scale_dn)
            return weighted(light, self._weights(weights))
        reach = self.tone.sharpening.reach_px
        wide = self.samples(col0 - reach, row0 - reach, width + 2 * reach, height + 2 * reach)
        codes = self.tone.sharpening.unsharpen(np.moveaxis(wide, -1, 0).astype(np.float32))
        codes = np.moveaxis(codes[:, reach : reach + height, reach : reach + width], 0, -1)
        light = self.tone.light(np.clip(codes, 0.0, self.full_scale_dn), self.full_scale_dn)
        return weighted(light, self._weights(weights))

    def samples(self, col0: int, row0: int, width: int, height: int, out: Samples | None = None) -> Samples:
        """(height, width, channels) stored values; outside of the scan its edge is repeated.

        out: array of that shape and samples_dtype to fill instead of a new one.
        """
        samples = np.empty((height, width, self.channels), self.samples_dtype) if out is None else out
        top, bottom = (min(max(row, 0), self.height_px - 1) for row in (row0, row0 + height - 1))
        left, right = (min(max(col, 0), self.width_px - 1) for col in (col0, col0 + width - 1))
        above, before = min(max(-row0, 0), height - 1), min(max(-col0, 0), width - 1)
        rows = samples[above : above + bottom + 1 - top]
        inside = rows[:, before : before + right + 1 - left]
        self._source.fill(inside, top, left)
        rows[:, :before], rows[:, before + inside.shape[1] :] = inside[:, :1], inside[:, -1:]
        samples[:above], samples[above + len(rows) :] = rows[0], rows[-1]
        return samples

    @property
    def part_px(self) -> Window:
        """First column and row, width and height of the window that the path names, or of the whole picture."""
        part = self.path.window if isinstance(self.path, ScanPart) else None
        return part or (0, 0, self.width_px, self.height_px)

    def contains(self, col_px: float, row_px: float) -> bool:
        """Whether a place lies within the pixels of the scan."""
        return -0.5 <= col_px <= self.width_px - 0.5 and -0.5 <= row_px <= self.height_px - 0.5

    def inside(self, col0: int, row0: int, width: int, height: int, is_read: bool = False) -> NDArray[np.bool_]:
        """(height, width) mask of the pixels of a window that lie in the scan and could be decoded. is_read: the window
        has been read before, so that its losses are known."""
        cols, rows = np.arange(col0, col0 + width), np.arange(row0, row0 + height)
        in_rows = (rows >= 0) & (rows < self.height_px)
        known = np.asarray(in_rows[:, None] & (cols >= 0) & (cols < self.width_px))
        for part in self._window_losses(col0, row0, width, height, is_read):
            top, left = max(part.row0 - row0, 0), max(part.col0 - col0, 0)
            known[top : part.row0 + part.height - row0, left : part.col0 + part.width - col0] = False
        return known

    def loss_reason(self, col0: int, row0: int, width: int, height: int) -> str:
        """Why some pixels of a window could not be decoded, a part of a sentence; empty if all could."""
        return next((part.why for part in self._window_losses(col0, row0, width, height)), "")

    @property
    def lost(self) -> Sequence[LostPart]:
        """Parts of the file found undecodable so far."""
        return self._segments.lost

    @property
    def is_lost(self) -> bool:
        """Whether no pixel of the file could be decoded."""
        return sum(part.width * part.height for part in self._segments.lost) == self.width_px * self.height_px

    @property
    def damage(self) -> str:
        """Damage found so far, with its rows in the file, a part of a sentence; empty without any."""
        lost = self._segments.lost
        if not lost:
            return ""
        firsts = [part.row0 + self.origin_px[1] for part in lost[:_NAMED]]
        named = zip(firsts, lost, strict=False)
        places = "; ".join(f"rows {first} to {first + part.height - 1}, {part.why}" for first, part in named)
        more = f"; and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
        what = (
            f"none of it can be trusted ({lost[0].why})"
            if self.is_lost
            else f"parts cannot be trusted ({places}{more})"
        )
        return f"the scan's file is damaged: {what}"

    def reduced(self, factor: int, weights: Sequence[float] | None = None) -> Single:
        """Reduce the whole scan by area averages over factor x factor pixels.

        The centre of pixel (i, j) lies at column factor * j + (factor - 1) / 2; partial rows and columns at the end are
        dropped. The scan is streamed by segments: memory holds the result, all its channels for the next call, and some
        segments for each thread.
        """
        if not 1 <= factor <= min(self.height_px, self.width_px):
            raise ValueError(f"{self.name}: cannot be reduced by {factor}: it is {self.width_px} x {self.height_px} px")
        if factor not in self._reduced:
            self._reduced.clear()
            self._reduced[factor] = self._reduced_channels(factor, self.width_px // factor, self.height_px // factor)
        return weighted(self._reduced[factor], self._weights(weights))

    @property
    def last_reduction(self) -> tuple[int, Single] | None:
        """Factor and grey values of the last reduction of the whole scan; None before the first one."""
        return next(((f, weighted(grey, self.weights)) for f, grey in self._reduced.items()), None)

    def reduced_window(
        self, factor: int, col0: int, row0: int, width: int, height: int, weights: Sequence[float] | None = None
    ) -> Single:
        """(height, width) window of the reduced scan from its column col0 and row row0, decoded on its own; outside of
        the scan its edge is repeated."""
        return weighted(self._reduced_part(factor, col0, row0, width, height), self._weights(weights))

    def close(self) -> None:
        self._segments.close()

    def __enter__(self) -> "Scan":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _window_losses(self, col0: int, row0: int, width: int, height: int, is_read: bool = False) -> list[LostPart]:
        """Undecodable parts of a window; those of segments are known once they were read."""
        if self._source is self._cache and not is_read:
            self.samples(col0, row0, width, height)
        return [
            part
            for part in self._segments.lost
            if col0 < part.col0 + part.width
            and part.col0 < col0 + width
            and row0 < part.row0 + part.height
            and part.row0 < row0 + height
        ]

    @cached_property
    def _earlier(self) -> tuple[float, tuple[int, int]]:
        """Quantisation step of an earlier JPEG compression, from the luminance in the centre of the scan, and the first
        column and row of a block of it; 0 if the step is not clearly coarser than the file's. JPEG has 8 bits: in a
        file of 16 bits its values are multiples of a unit."""
        none = 0.0, (0, 0)
        width, height = (min(side, _COMPRESSION_PX) for side in (self.width_px, self.height_px))
        col0, row0 = (self.width_px - width) // 2, (self.height_px - height) // 2
        samples = self.samples(col0, row0, width, height)
        unit = 1 if samples.dtype == np.uint8 else int(np.gcd.reduce(samples, axis=None))
        if samples.dtype != np.uint8 and unit < _LEAST_UNIT_DN:
            return none
        luminance = weighted(samples, LUMINANCE if self.channels > 1 else (1.0,))
        step_dn, (col, row) = earlier_compression(luminance / np.float32(unit))
        is_coarser = unit * step_dn > _PLAINLY_COARSER * self._segments.quantisation_step_dn
        return (unit * step_dn, ((col0 + col) % BLOCK_PX, (row0 + row) % BLOCK_PX)) if is_coarser else none

    def _reduced_channels(self, factor: int, width: int, height: int) -> Samples | Single:
        """(height, width, channels) reduction of the whole scan, stored values at full size; every segment is decoded
        once."""
        if overview := self._overview(factor):
            whole, scale, shift = overview._steps_to(self, factor)
            picture = overview._reduced_channels(whole, overview.width_px // whole, overview.height_px // whole)
            return _interpolated(np.asarray(picture, np.float32), scale, shift, width, height)
        result = np.empty((height, width, self.channels), np.float32 if factor > 1 else self.samples_dtype)
        tall, wide = self.segment_px
        cols = width if wide >= self.width_px else _reduced_side(wide, factor, _PART_PX)
        rows = _reduced_side(tall, factor, max(_PART_PX**2 // (cols * factor), 1))

        def fill(part: tuple[int, int]) -> None:
            row0, col0 = part
            own = result[row0 : row0 + rows, col0 : col0 + cols]
            own_rows, own_cols = own.shape[:2]
            own[:] = means(self.samples(col0 * factor, row0 * factor, own_cols * factor, own_rows * factor), factor)

        map_in_threads(fill, product(range(0, height, rows), range(0, width, cols)))
        return result

    def _overview(self, factor: int) -> "Scan | None":
        """Smallest overview that is at least as large as the scan reduced by a factor."""
        fine = [one for one in self._overviews if one.width_px * factor >= self.width_px]
        return min(fine, key=lambda one: one.width_px, default=None)

    def _reduced_part(self, factor: int, col0: int, row0: int, width: int, height: int) -> Single:
        """(height, width, channels) window of the reduced scan."""
        if overview := self._overview(factor):
            whole, scale, shift = overview._steps_to(self, factor)
            first, last = np.array([col0, row0]), np.array([col0 + width, row0 + height]) - 1
            low = np.floor(scale * first + shift).astype(int)
            high = np.ceil(scale * last + shift).astype(int) + 1
            picture = overview._reduced_part(whole, *low.tolist(), *(high - low).tolist())
            return _interpolated(picture, scale, scale * first + shift - low, width, height)
        return means(self.samples(col0 * factor, row0 * factor, width * factor, height * factor), factor)

    def _steps_to(self, scan: "Scan", factor: int) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
        """Resampling from this overview to its scan reduced by a factor: integer factor of averaging, then step (x, y)
        and position (x, y) of the first pixel for the interpolation."""
        px = np.array([scan.width_px / self.width_px, scan.height_px / self.height_px])  # of the scan to one of these
        whole = max(int(factor / px.max() + _SIZE_TOLERANCE_PX), 1)
        scale = factor / (whole * px)
        return whole, scale, scale / 2 - 0.5

    def _weights(self, weights: Sequence[float] | None) -> Sequence[float]:
        if weights is None:
            weights = self.weights
        if len(weights) != self.channels:
            raise ValueError(f"{self.name}: {len(weights)} weights for {self.channels} channels")
        return weights


def _interpolated(
    picture: Single, scale: NDArray[np.float64], shift: NDArray[np.float64], width: int, height: int
) -> Single:
    """(height, width, channels) image (rows, columns, channels) sampled in steps of scale (x, y) from shift (x, y)."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    matrix = np.column_stack([np.diag(scale), shift])
    warped = cv2.warpAffine(picture, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, np.float32).reshape(height, width, -1)


def _reduced_side(fine_px: int, factor: int, most_px: int) -> int:
    """Side of a part of a reduced scan: about most_px of the scan, in whole segments unless these are much larger."""
    unit = lcm(fine_px, factor)
    return max((unit * max(most_px // unit, 1) if unit <= _LARGEST_PART_PX else most_px) // factor, 1)


def means(samples: Samples | Single, factor: int) -> Single:
    """(height / factor, width / factor, channels) means of samples (height, width, channels) over squares."""
    height, width, channels = samples.shape
    result = np.empty((height // factor, width // factor, channels), np.float32)
    rows = max(_BAND_PIXELS // (width * factor), 1)
    for row in range(0, len(result), rows):
        band = samples[row * factor : (row + rows) * factor].astype(np.float32)
        for step in _reduction_steps(factor):
            size = band.shape[1] // step, band.shape[0] // step
            band = np.asarray(cv2.resize(band, size, interpolation=cv2.INTER_AREA), np.float32)
        result[row : row + rows] = band.reshape(-1, width // factor, channels)
    return result


def _reduction_steps(factor: int) -> tuple[int, ...]:
    """Factors of two, which OpenCV averages fastest, then the remaining factor."""
    if factor % 2 == 0:
        return 2, *_reduction_steps(factor // 2)
    return (factor,) if factor > 1 else ()


def weighted(samples: Samples | Single, weights: Sequence[float]) -> Single:
    """(..., height, width) float32 grey values of (..., height, width, channels) samples."""
    grey = samples[..., 0].astype(np.float32)
    if weights[0] != 1.0:
        grey *= weights[0]
    for channel in range(1, samples.shape[-1]):
        if weights[channel]:
            grey += weights[channel] * samples[..., channel]
    return grey

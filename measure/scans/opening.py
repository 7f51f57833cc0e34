"""Opening of scans by their format, reading of their heads, and views of scans: windows and thumbnails."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from measure.errors import MeasurementError, MissingError
from measure.scans.cache import LostPart, OpenedPicture, Segments, WholePicture
from measure.scans.jpeg import (
    BLOCK_PX,
    JPEG_END,
    JPEG_START,
    jpeg_camera,
    jpeg_colour_tags,
    jpeg_form,
    jpeg_pitch,
    open_jpeg,
)
from measure.scans.metadata import DECODING_ERRORS, NO_TAGS, PictureForm, Pitch, Samples, damage_error
from measure.scans.parallel import map_in_threads
from measure.scans.png_and_jpeg2000 import (
    BMP_START,
    JPEG2000_END,
    JPEG2000_STARTS,
    PNG_END,
    PNG_START,
    PNM_STARTS,
    jpeg2000_colour_tags,
    jpeg2000_form,
    jpeg2000_pitch,
    open_jpeg2000,
    open_plain,
    open_png,
    plain_form,
    png_colour_tags,
    png_form,
    png_pitch,
)
from measure.scans.remote import Address, ScanPart, Window, scan_path
from measure.scans.scan import Scan
from measure.scans.tiff import TIFF_STARTS, open_tiff, tiff_colour_tags
from measure.tone.curve import Tone, tone_of_tags

_OPENERS = {
    **dict.fromkeys(TIFF_STARTS, open_tiff),
    JPEG_START: open_jpeg,
    PNG_START: open_png,
    **dict.fromkeys(JPEG2000_STARTS, open_jpeg2000),
    **dict.fromkeys((BMP_START, *PNM_STARTS), open_plain),
}
_HEADERS_BYTES = 1 << 18  # head of a JPEG or PNG file: profiles and Exif blocks are smaller
_END_BYTES = 1 << 16  # end of a complete JPEG or PNG file, which holds the end marker
_BAND_PX = 1 << 18  # approximate number of pixels read at a time
_FULL_SCALE_DN = 65535.0  # of a thumbnail of 16 bits


def open_scan(path: str | Path, max_pixels: int | None = None) -> Scan:
    """Open a TIFF, BigTIFF, JPEG, JPEG 2000, PNG, BMP, PGM or PPM file. The format is taken from its first bytes, not
    from its name.

    Parameters
    ----------
    path : of a file, or an address, see `Address`.
    max_pixels : largest number of pixels; None: the limits of `check_size`.

    Raises
    ------
    MeasurementError
        If the file is missing, empty, truncated or not an image; the message gives the remedy.
    UnreachableError
        If an address does not answer.

    Examples
    --------
    >>> with open_scan("scans/0001.tif") as scan:
    ...     grey = scan.window(100, 200, 64, 64)
    """
    path = scan_path(path)
    start = _file_start(path)
    if isinstance(path, ScanPart) and (path.page or 1) > 1 and start not in TIFF_STARTS:
        raise MeasurementError(f"{path}: such a file has one page: take `page` out of images.csv")
    opened = _OPENERS[start](path, max_pixels)
    segments = opened.segments
    is_one = segments.segment_height_px >= segments.height_px and segments.segment_width_px >= segments.width_px
    if isinstance(path, Address) and is_one:
        whole = "the file has its picture in one piece, and was fetched whole: of a tiled file only a part is fetched"
        opened = replace(opened, notes=(*opened.notes, whole))
    return Scan(path, segments, opened.pitch, opened)


def _file_start(path: Path) -> bytes:
    """The bytes of `_OPENERS` that a file begins with. A pipe or device is not opened: reading might never end."""
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise MeasurementError(f"{path} is no regular file, but a pipe or a device: give the file of a scan")
        with path.open("rb") as file:
            begin = file.read(16)
    except FileNotFoundError:
        message = f"there is no scan {path} (searched at {path.absolute()}): check its name and its folder"
        raise MissingError(message) from None
    except OSError as error:
        raise _reading_error(path, error) from error
    if not begin:
        raise MeasurementError(f"{path} is empty (0 bytes): copy or scan it again")
    start = next((start for start in _OPENERS if begin.startswith(start)), None)
    if start is None:
        raise MeasurementError(
            f"{path} is no TIFF, JPEG, JPEG 2000, PNG, BMP, PGM or PPM picture (it begins with {begin[:8]!r}): give "
            "the scan itself, or convert it"
        )
    return start


def _reading_error(path: Path, error: OSError) -> MeasurementError:
    return MeasurementError(f"{path} cannot be read: {error.strerror}; check that it is a file you may read")


@dataclass(frozen=True)
class ScanHead:
    """Head of a scan file. file_format: TIFF, JPEG, JPEG 2000, PNG, BMP or PNM; bits: per sample; notes: one sentence
    each; camera: digital camera of the Exif block, "" for a scan."""

    file_format: str
    width_px: int
    height_px: int
    channels: int
    bits: int
    pitch: Pitch
    notes: tuple[str, ...] = ()
    camera: str = ""


def read_head(path: Path, max_pixels: int | None = None) -> ScanHead:
    """Read the head of a scan file, some kilobytes for any file size.

    Parameters
    ----------
    max_pixels : see `open_scan`.

    Raises
    ------
    MeasurementError
        If head and length show that the file cannot be opened as a scan. Damage within a JPEG, JPEG 2000 or PNG image
        is found only by decoding.
    """
    start = _file_start(path)
    if start in TIFF_STARTS:
        opened = open_tiff(path, max_pixels)
        segments, notes = opened.segments, (*opened.problems, *opened.notes)
        segments.close()
        size = segments.width_px, segments.height_px
        return ScanHead("TIFF", *size, segments.channels, opened.bits, opened.pitch, notes)
    try:
        file_bytes = path.stat().st_size
        with path.open("rb") as file:
            data = file.read(_HEADERS_BYTES)
            file.seek(max(file_bytes - _END_BYTES, 0))
            end = file.read()
    except OSError as error:
        raise _reading_error(path, error) from error
    form: PictureForm | None
    if start == JPEG_START:
        file_format, form, marker, pitch = "JPEG", jpeg_form(data), JPEG_END, jpeg_pitch(data)
    elif start in JPEG2000_STARTS:
        file_format, form, marker, pitch = "JPEG 2000", jpeg2000_form(data), JPEG2000_END, jpeg2000_pitch(data)
    elif start in (BMP_START, *PNM_STARTS):
        plain = plain_form(data)
        file_format, form, marker = "BMP" if start == BMP_START else "PNM", plain, b""
        pitch = plain.pitch if plain else NO_TAGS
    else:
        file_format, form, marker, pitch = "PNG", png_form(data), PNG_END, png_pitch(data)
    if form is None or 0 in (form.width_px, form.height_px, form.channels, form.bits):
        raise damage_error(path, "its header is cut short")
    if marker not in end:
        open_scan(path, max_pixels).close()  # fails unless the marker only precedes trailing data
    form.check(path, file_bytes, max_pixels)
    camera, channels = jpeg_camera(data) if file_format == "JPEG" else "", 1 if form.channels < 3 else 3
    return ScanHead(file_format, form.width_px, form.height_px, channels, form.bits, pitch, camera=camera)


def declared_tone(path: Path) -> Tone | None:
    """Tone curve declared by a file's tags; None if there is no usable one. File content never raises an error."""
    try:
        with path.open("rb") as opened:
            start = opened.read(16)
        if start[:2] in (b"II", b"MM"):
            return tone_of_tags(tiff_colour_tags(path))
        if start.startswith(JPEG2000_STARTS):
            return tone_of_tags(jpeg2000_colour_tags(path))
        if start.startswith((BMP_START, *PNM_STARTS)):
            return None
        return tone_of_tags(png_colour_tags(path) if start.startswith(PNG_START) else jpeg_colour_tags(path))
    except (*DECODING_ERRORS, zlib.error):
        return None


def crop_scan(scan: Scan, window: Window) -> Scan:
    """View a window of a scan as a scan, with pixels counted from the window's first one.

    Parameters
    ----------
    scan : must stay open while the window is read.

    Raises
    ------
    ValueError
        If the window does not lie in the scan.
    """
    col, row, width, height = window
    if min(width, height) < 1 or min(col, row) < 0 or col + width > scan.width_px or row + height > scan.height_px:
        raise ValueError(
            f"the window {col} {row} {width} {height} does not lie in {scan.width_px} x {scan.height_px} px"
        )
    pitch, segments = Pitch(scan.pitch_um, scan.pitch_note), WindowSegments(scan, window)
    opened = OpenedPicture(segments, pitch, scan.notes, scan.problems, orientation=scan.orientation)
    view = Scan(scan.path, segments, pitch, opened).replace_name(scan.name)
    return view.replace_tone(scan.tone).replace_weights(scan.weights)


class WindowSegments(Segments):
    """A window of a scan in bands of rows; closing it does not close the scan."""

    def __init__(self, scan: Scan, window: Window) -> None:
        self._scan = scan
        self._col0, self._row0, self.width_px, self.height_px = window
        self.segment_width_px = self.width_px
        self.segment_height_px = min(max(_BAND_PX // self.width_px, 1), self.height_px)
        self.channels = scan.channels
        self.full_scale_dn = scan.full_scale_dn
        self.sample_bytes = scan.samples_dtype().itemsize
        self.quantisation_step_dn = scan.quantisation_step_dn
        (col, row), (first_col, first_row) = scan.origin_px, scan.first_block_px
        self.origin_px = col + self._col0, row + self._row0
        self.first_block_px = (first_col - self._col0) % BLOCK_PX, (first_row - self._row0) % BLOCK_PX

    @property
    def lost(self) -> Sequence[LostPart]:
        """The undecodable parts within the window."""
        within = list[LostPart]()
        for part in self._scan.lost:
            left, top = max(part.col0 - self._col0, 0), max(part.row0 - self._row0, 0)
            width = min(part.col0 + part.width - self._col0, self.width_px) - left
            height = min(part.row0 + part.height - self._row0, self.height_px) - top
            within += [LostPart(left, top, width, height, part.why)] if min(width, height) > 0 else []
        return tuple(within)

    def close(self) -> None:
        """Nothing is open."""

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """Read a band of rows."""
        first = row * self.segment_height_px
        height = min(self.segment_height_px, self.height_px - first)
        return self._scan.samples(self._col0, self._row0 + first, self.width_px, height)


def thumbnail(scan: Scan, largest_px: int) -> Scan:
    """Grey values of a scan with 16 bits, area-averaged so that no side exceeds largest_px; the pitch is scaled
    accordingly."""
    shrunk = max(max(scan.width_px, scan.height_px) / largest_px, 1.0)
    factor, unit = int(shrunk), _FULL_SCALE_DN / scan.full_scale_dn
    grey = np.empty((scan.height_px // factor, scan.width_px // factor), np.uint16)
    rows = max(_BAND_PX // scan.width_px // factor, 1)

    def fill(row: int) -> None:
        """Average a band of rows; the whole scan at once would take its memory."""
        band = grey[row : row + rows]
        band[:] = np.rint(np.float32(unit) * scan.reduced_window(factor, 0, row, grey.shape[1], len(band)))

    map_in_threads(fill, range(0, len(grey), rows))
    size = round(scan.width_px / shrunk), round(scan.height_px / shrunk)
    same = size == grey.shape[::-1]
    samples = grey if same else np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint16)
    pitch = Pitch(None if scan.pitch_um is None else (shrunk * scan.pitch_um[0], shrunk * scan.pitch_um[1]))
    picture = WholePicture(samples[:, :, None], scan.quantisation_step_dn * unit / shrunk)
    return Scan(scan.path, picture, pitch)

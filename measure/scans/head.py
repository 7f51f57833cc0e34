"""The head of a scan file: format, size, pixel pitch and declared tone curve, without decoding a pixel."""

import zlib
from dataclasses import dataclass
from pathlib import Path

from measure.errors import MeasurementError
from measure.scans.file_checks import DECODING_ERRORS, check_size, damage_error, first_bytes, no_picture_error
from measure.scans.jpeg import JPEG_START, jpeg_colour_tags, jpeg_pitch, picture_form
from measure.scans.metadata import Pitch
from measure.scans.png import PNG_START, png_colour_tags, png_form, png_pitch
from measure.scans.scan import open_scan
from measure.scans.tiff import TIFF_STARTS, open_tiff, tiff_colour_tags
from measure.tone.curve import Tone
from measure.tone.declared import tone_of_tags

_HEADERS_BYTES = 1 << 18  # of a JPEG or PNG file, before its picture: profiles and Exif blocks take less
_END_BYTES = 1 << 16  # in which nearly every JPEG or PNG file that is whole has its end marker


@dataclass(frozen=True)
class ScanHead:
    """file_format: TIFF, JPEG or PNG; bits: of a sample, as they are measured; notes: what is unusual, a sentence
    each."""

    file_format: str
    width_px: int
    height_px: int
    channels: int
    bits: int
    pitch: Pitch
    notes: tuple[str, ...] = ()


def read_head(path: Path, max_pixels: int | None = None) -> ScanHead:
    """Reads the head of a scan file: some kilobytes, however large the file is.

    Parameters
    ----------
    max_pixels : as `open_scan` takes it.

    Raises
    ------
    MeasurementError
        For a file that cannot be opened as a scan, as far as its head and its length show. Damage of a JPEG or PNG
        picture shows only when it is decoded.
    """
    start = first_bytes(path)
    if start[:4] in TIFF_STARTS:
        opened = open_tiff(path, max_pixels)
        segments, notes = opened.segments, (*opened.problems, *opened.notes)
        segments.close()
        bits = int(segments.full_scale_dn + 1).bit_length() - 1
        return ScanHead("TIFF", segments.width_px, segments.height_px, segments.channels, bits, opened.pitch, notes)
    if not start.startswith((JPEG_START, PNG_START)):
        raise no_picture_error(path, start)
    data, end = _head_and_end(path)
    if start.startswith(JPEG_START):
        form, marker, pitch = picture_form(data), b"\xff\xd9", jpeg_pitch(data)
        file_format = "JPEG"
    else:
        form, marker, pitch = png_form(data), b"IEND", png_pitch(data)
        file_format = "PNG"
    if form is None or 0 in form:
        raise damage_error(path, "its header is cut short")
    if marker not in end:
        open_scan(path, max_pixels).close()  # which says whether it stands before something else
    width, height, channels, bits = form
    check_size(path, "a picture", (width, height), width * height * channels, path.stat().st_size, max_pixels)
    return ScanHead(file_format, width, height, min(channels, 3), bits, pitch)


def declared_tone(path: Path) -> Tone | None:
    """The tone curve that a file declares.

    Returns
    -------
    None where the file says nothing that can be used. Nothing is raised for what it holds.
    """
    try:
        with path.open("rb") as opened:
            start = opened.read(16)
        if start[:2] in (b"II", b"MM"):
            return tone_of_tags(tiff_colour_tags(path))
        return tone_of_tags(png_colour_tags(path) if start.startswith(PNG_START) else jpeg_colour_tags(path))
    except (*DECODING_ERRORS, zlib.error):
        return None


def _head_and_end(path: Path) -> tuple[bytes, bytes]:
    try:
        with path.open("rb") as file:
            head = file.read(_HEADERS_BYTES)
            file.seek(max(path.stat().st_size - _END_BYTES, 0))
            return head, file.read()
    except OSError as error:
        raise MeasurementError(
            f"{path} cannot be read: {error.strerror}; check that it is a file you may read"
        ) from error

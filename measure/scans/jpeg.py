"""JPEG files and streams: decoded whole, and what their segments say.

A decoder goes on through a damaged stream: behind a lost or a changed byte it soon reads right codes again, but of
blocks that belong elsewhere. At the end, or at a restart marker, codes are then missing or left over: libjpeg-turbo
warns of it, and simplejpeg tells its warnings.
"""

import struct
from io import BytesIO
from pathlib import Path

import imagecodecs
import numpy as np
import simplejpeg
from tifffile import TiffFile, TiffPage

from measure.errors import MeasurementError
from measure.scans.cache import OpenedPicture, WholePicture
from measure.scans.metadata import (
    DECODING_ERRORS,
    JFIF_UNIT,
    MOST_CHANNELS,
    NO_TAGS,
    Pitch,
    Samples,
    check_size,
    damage_error,
    exif_tags,
    grey_or_colour,
    orientation_notes,
    orientation_tag,
    pitch_from_density,
    tag_pitch,
    taking_camera,
)
from measure.tone.declared import ColourTags

JPEG_START = b"\xff\xd8\xff"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of frame headers
_END = b"\xff\xd9"
_OF_DAMAGE = ("Corrupt JPEG data", "Premature end")  # how libjpeg's warnings of it begin
_DQT = 0xDB
UNKNOWN_DN = 15.0  # where a file does not say it: as at quality 50, which no scan should be below
_INKS = 4  # components
_COARSE = 15  # coefficients in the order of the table: up to two periods in a block of 8 px, as blurred edges have them


def stream_damage(data: bytes, tables: bytes | None = None) -> str:
    """Why a stream's samples cannot be trusted, a part of a sentence; empty where libjpeg-turbo warns of nothing.

    tables: a stream of those tables that the other leaves to its file.
    """
    whole = data if tables is None else data[:2] + tables[2 : tables.rfind(_END)] + data[2:]
    try:
        simplejpeg.decode_jpeg(whole, "GRAY", min_factor=8, strict=True)
    except ValueError as error:
        # What else it raises is of streams that it does not know: CMYK, say.
        message = str(error)
        return f"its decoder says: {message}" if message.startswith(_OF_DAMAGE) else ""
    return ""


def picture_form(data: bytes) -> tuple[int, int, int, int] | None:
    """Width, height, channels and bits of a sample as the frame header says; None without one."""
    for marker, body in jpeg_headers(data):
        if marker in _FRAMES and len(body) >= 6:
            return int.from_bytes(body[3:5], "big"), int.from_bytes(body[1:3], "big"), body[5], body[0]
    return None


def jpeg_headers(data: bytes) -> list[tuple[int, bytes]]:
    """Marker and body of the segments before the picture's data."""
    headers, position = [], 2
    while position + 4 <= len(data) and data[position] == 0xFF and data[position + 1] not in (0xDA, 0xD9):
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        headers.append((data[position + 1], data[position + 4 : position + 2 + length]))
        position += 2 + max(length, 2)
    return headers


def _header_bytes(data: bytes) -> int:
    return 2 + sum(4 + len(body) for _, body in jpeg_headers(data))


def rounding_step_dn(data: bytes) -> float:
    """The mean step to which the coarser detail of the luminance is rounded, in grey values: from a JPEG file, or its
    beginning up to the picture's data."""
    for marker, body in jpeg_headers(data):
        position = 0
        while marker == _DQT and position < len(body):
            size, number = 1 + (body[position] >> 4), body[position] & 15
            steps = body[position + 1 : position + 1 + 64 * size]
            if number == 0 and len(steps) == 64 * size:
                coarse = (int.from_bytes(steps[size * k : size * (k + 1)], "big") for k in range(_COARSE))
                return sum(coarse) / _COARSE
            position += 1 + 64 * size
    return UNKNOWN_DN


def open_jpeg(path: Path, max_pixels: int | None = None) -> OpenedPicture:
    """The picture of a JPEG file, decoded whole.

    Parameters
    ----------
    max_pixels : as `check_size` takes it.

    Raises
    ------
    MeasurementError
        For a truncated file, for one that claims more than such a file can hold, and for one of inks. A damaged one is
        opened: its pixels count as lost.
    """
    data = path.read_bytes()
    samples, damage = _jpeg_samples(path, data, max_pixels)
    exif = _exif_page(data)
    orientation = 1 if exif is None else orientation_tag(exif)
    bits = (picture_form(data) or (0, 0, 0, 8))[3]
    picture = WholePicture(samples, rounding_step_dn(data), damage, 2.0**bits - 1)
    return OpenedPicture(picture, jpeg_pitch(data), orientation_notes(orientation), orientation=orientation)


def _jpeg_samples(path: Path, data: bytes, max_pixels: int | None) -> tuple[Samples, str]:
    """Grey or RGB, and why it cannot be trusted; a decoder that fills a truncated file with grey is not asked."""
    width, height, channels, _ = picture_form(data) or (0, 0, 0, 0)
    if channels == _INKS:
        raise MeasurementError(
            f"{path} is a JPEG of four inks (CMYK), and its black ink alone may hold the marks: save it as a grey or "
            "RGB picture, or as a CMYK TIFF"
        )
    check_size(path, "a picture", (width, height), width * height * MOST_CHANNELS, len(data), max_pixels)
    if _END not in data[_header_bytes(data) :]:
        raise damage_error(path, "its end marker is missing")
    try:
        return grey_or_colour(imagecodecs.jpeg_decode(data)), stream_damage(data)
    except DECODING_ERRORS as error:
        if not width * height:
            raise damage_error(path, str(error)) from error
        return np.zeros((height, width, 1), np.uint8), str(error)


def jpeg_pitch(data: bytes) -> Pitch:
    """The JFIF density, or the Exif resolution where that has no unit."""
    pitch = NO_TAGS
    for marker, body in jpeg_headers(data):
        if marker == 0xE0 and body.startswith(b"JFIF\0") and len(body) >= 12:
            unit, x, y = struct.unpack(">BHH", body[7:12])
            pitch = pitch_from_density(x, y, JFIF_UNIT.get(unit))
    exif = _exif_page(data) if pitch.um is None else None
    by_exif = pitch if exif is None else tag_pitch(exif)
    return by_exif if by_exif.um is not None or pitch is NO_TAGS else pitch


def jpeg_camera(data: bytes) -> str:
    """The digital camera that took a stream's picture, as `taking_camera` names it."""
    exif = _exif_page(data)
    return "" if exif is None else taking_camera(exif)


def _exif_page(data: bytes) -> TiffPage | None:
    """The tags of a stream's Exif block, which is a small TIFF file without a picture; None where there are none."""
    for marker, body in jpeg_headers(data):
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            try:
                return TiffFile(BytesIO(body[6:])).pages.first.aspage()
            except DECODING_ERRORS:
                return None
    return None


def jpeg_colour_tags(path: Path) -> ColourTags:
    """An ICC profile, which may be cut into several segments (ICC.1:2022, B.4), and Exif. Raises one of
    DECODING_ERRORS."""
    data = path.read_bytes()
    profiles = (body for marker, body in jpeg_headers(data) if marker == 0xE2 and body.startswith(b"ICC_PROFILE\0"))
    pieces = {body[12]: body[14:] for body in profiles}
    exif = _exif_page(data)
    tags = {} if exif is None else {**exif_tags(exif), "Orientation": orientation_tag(exif)}
    return ColourTags(b"".join(pieces[number] for number in sorted(pieces)), exif=tags)

"""JPEG files and streams: decoded whole, with a check that a stream holds what its header says.

A decoder goes on through a damaged stream: behind a lost or a changed byte it soon reads right codes again, but of
blocks that belong elsewhere. libjpeg-turbo warns of codes that are missing or left over where a scan, or a part of one
between restart markers, ends; simplejpeg hands its warnings out.
"""

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import simplejpeg
from tifffile import TiffFile

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
)
from measure.tone.declared import ColourTags

JPEG_START = b"\xff\xd8\xff"
_END = b"\xff\xd9"
_OF_DAMAGE = ("Corrupt JPEG data", "Premature end")  # how libjpeg's warnings of it begin
_DQT = 0xDB  # marker of quantisation tables (ITU-T T.81, B.2.4.1)
UNKNOWN_DN = 15.0  # where a file does not say it: as at quality 50, which no scan should be below
_COARSE = 15  # coefficients in the order of the table: up to two periods in a block of 8 px, as blurred edges have them


def stream_damage(data: bytes, tables: bytes | None = None) -> str:
    """Says why the samples of a stream are not to be trusted, a part of a sentence; empty where they can be.

    Parameters
    ----------
    data : the stream.
    tables : a stream of those tables that the other leaves to its file.
    """
    whole = data if tables is None else data[:2] + tables[2 : tables.rfind(_END)] + data[2:]
    try:
        simplejpeg.decode_jpeg(whole, "GRAY", min_factor=8, strict=True)
    except ValueError as error:
        # What else it raises is of streams that it does not know: CMYK, or of 12 bits, say.
        message = str(error)
        return f"its decoder says: {message}" if message.startswith(_OF_DAMAGE) else ""
    return ""


def picture_size(data: bytes) -> tuple[int, int] | None:
    """Width and height as the frame header says, px; None without one."""
    form = picture_form(data)
    return None if form is None else form[:2]


def picture_form(data: bytes) -> tuple[int, int, int, int] | None:
    """Width, height, channels and bits of a sample as the frame header says; None without one."""
    for marker, body in jpeg_headers(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and len(body) >= 6:
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


def rounding_step_dn(data: bytes) -> float:
    """The mean step to which the coarser detail of the luminance is rounded, in grey values: from a JPEG file, or its
    beginning up to the picture's data."""
    for marker, body in jpeg_headers(data):
        if marker == _DQT:
            table = _quantisation_table(body, 0)
            if table:
                return sum(table[:_COARSE]) / _COARSE
    return UNKNOWN_DN


def _quantisation_table(body: bytes, wanted: int) -> list[int]:
    """The 64 steps of a table of that number, empty where the segment does not hold it."""
    position = 0
    while position < len(body):
        size, number = 1 + (body[position] >> 4), body[position] & 15
        steps = body[position + 1 : position + 1 + 64 * size]
        if number == wanted and len(steps) == 64 * size:
            return [int.from_bytes(steps[at : at + size], "big") for at in range(0, len(steps), size)]
        position += 1 + 64 * size
    return []


def open_jpeg(path: Path, max_pixels: int | None = None) -> OpenedPicture:
    """The picture of a JPEG file, decoded whole.

    Parameters
    ----------
    max_pixels : as `check_size` takes it.

    Raises
    ------
    MeasurementError
        For a truncated file, and for one that claims more than such a file can hold. A damaged one is opened: its
        pixels count as lost.
    """
    data = path.read_bytes()
    samples, damage = _jpeg_samples(path, data, max_pixels)
    orientation, picture = _jpeg_orientation(data), WholePicture(samples, rounding_step_dn(data), damage)
    return OpenedPicture(picture, jpeg_pitch(data), orientation_notes(orientation), orientation=orientation)


def _jpeg_samples(path: Path, data: bytes, max_pixels: int | None) -> tuple[Samples, str]:
    """Grey or RGB, and why it cannot be trusted; a decoder that fills a truncated file with grey is not asked."""
    size = picture_size(data)
    if size is not None:
        check_size(path, "a picture", size, size[0] * size[1] * MOST_CHANNELS, len(data), max_pixels)
    picture = 2 + sum(4 + len(body) for _, body in jpeg_headers(data))
    if b"\xff\xd9" not in data[picture:]:
        raise damage_error(path, "its end marker is missing")
    try:
        return grey_or_colour(imagecodecs.jpeg_decode(data)), stream_damage(data)
    except DECODING_ERRORS as error:
        if size is None or 0 in size:
            raise damage_error(path, str(error)) from error
        return np.zeros((size[1], size[0], 1), np.uint8), str(error)


def jpeg_pitch(data: bytes) -> Pitch:
    """The JFIF density, or the Exif resolution where that has no unit."""
    pitch = NO_TAGS
    for marker, body in jpeg_headers(data):
        if marker == 0xE0 and body.startswith(b"JFIF\0") and len(body) >= 12:
            unit, x, y = struct.unpack(">BHH", body[7:12])
            pitch = pitch_from_density(x, y, JFIF_UNIT.get(unit))
        elif marker == 0xE1 and body.startswith(b"Exif\0\0") and pitch.um is None:
            pitch = _exif_pitch(body[6:], pitch)
    return pitch


def _jpeg_orientation(data: bytes) -> int:
    """As an Exif block gives it; 1 without one."""
    for marker, body in jpeg_headers(data):
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            try:
                with TiffFile(BytesIO(body[6:])) as file:
                    return orientation_tag(file.pages.first.aspage())
            except DECODING_ERRORS:
                return 1
    return 1


def _exif_pitch(exif: bytes, otherwise: Pitch) -> Pitch:
    """The resolution tags of an Exif block, which is a small TIFF file without a picture."""
    try:
        with TiffFile(BytesIO(exif)) as file:
            pitch = tag_pitch(file.pages.first)
    except DECODING_ERRORS:
        return otherwise
    return pitch if pitch.um is not None or otherwise is NO_TAGS else otherwise


def jpeg_colour_tags(path: Path) -> ColourTags:
    """An ICC profile, which may be cut into several segments (ICC.1:2022, B.4), and Exif. Raises one of
    DECODING_ERRORS."""
    pieces, exif = dict[int, bytes](), dict[str, Any]()
    for marker, body in jpeg_headers(path.read_bytes()):
        if marker == 0xE2 and body.startswith(b"ICC_PROFILE\0"):
            pieces[body[12]] = body[14:]
        elif marker == 0xE1 and body.startswith(b"Exif\0\0"):
            with TiffFile(BytesIO(body[6:])) as file:
                exif = dict(exif_tags(file.pages.first.aspage()))
    return ColourTags(b"".join(pieces[number] for number in sorted(pieces)), exif=exif)

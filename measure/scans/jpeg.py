"""JPEG files and streams: decoded whole, with a check that a stream holds what its header says.

A decoder goes on through a damaged stream: behind a lost or a changed byte it soon reads right codes again, but of
blocks that belong elsewhere. At the end there are then blocks too many or too few. So the picture is decoded as if it
were taller. Of an intact stream the first block below its end is what the bits that fill its last byte make, and no
others are there: a decoder leaves them grey (ITU-T T.81, B.1.1.5 and F.1.2.3; libjpeg's `insufficient_data`). The rows
of the picture itself come out as they would without.

Streams of several scans, as progressive ones are, and streams with restart markers have many such ends, of which this
shows the last. There a second decoder is asked, libjpeg-turbo by simplejpeg, which tells what libjpeg warns of: codes
that are missing or left over before a marker.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import simplejpeg
from numpy.typing import NDArray
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

Decode = Callable[[bytes], NDArray[np.generic]]

JPEG_START = b"\xff\xd8\xff"
_HUFFMAN_FRAMES = (0xC0, 0xC1, 0xC2)  # sequential and progressive: others than lossless and arithmetic ones
_END = b"\xff\xd9"
_SCAN_OR_RESTART = re.compile(
    rb"\xff[\xda\xd0-\xd7]"
)  # as markers, for in a scan's data a byte 0 follows such a byte 255
_MORE = "its stream holds more blocks than the picture"
_OF_DAMAGE = ("Corrupt JPEG data", "Premature end")  # how libjpeg's warnings of it begin
_BLEED_PX = 2  # that the decoder's interpolation of colour takes from the blocks beside
_BELOW = 2  # rows of blocks added: a picture of one block a row has further ones below its first, too
_TAIL = bytes(range(64, 192)) * 2  # codes of some blocks, none of them a marker


_DQT = 0xDB
UNKNOWN_DN = 15.0  # where a file does not say it: as at quality 50, which no scan should be below
_COARSE = 15  # coefficients in the order of the table: up to two periods in a block of 8 px, as blurred edges have them


@dataclass(frozen=True)
class _Frame:
    """The frame header of a stream: where its height stands, the size of the picture and of a unit of blocks, px, the
    bits of a sample, and whether rows of colour are interpolated."""

    height_at: int
    height_px: int
    width_px: int
    unit_height_px: int
    unit_width_px: int
    bits: int
    interpolates_rows: bool


def decode_checked(data: bytes, decode: Decode, tables: bytes | None = None) -> tuple[NDArray[np.generic], str]:
    """The samples (height, width) or (height, width, channels) that a stream holds, and why they are not to be trusted;
    empty where they are. decode: a decoder of streams, which may raise what it will. tables: a stream of those tables
    that the other leaves to its file."""
    frame = _frame(data)
    if frame is None:
        return decode(data), ""
    rows = -(-frame.height_px // frame.unit_height_px) * frame.unit_height_px
    taller = decode(_stream_with_height(data, frame, rows + _BELOW * frame.unit_height_px))
    if _has_one_end(data):
        why = _stream_damage(data, frame, taller, rows, decode)
    else:
        why = _libjpeg_warning(data, tables) or (_MORE if _has_more_blocks(taller, frame, rows) else "")
    samples = decode(data) if frame.interpolates_rows else taller[: frame.height_px]
    return samples, why


def _has_one_end(data: bytes) -> bool:
    """Whether it is of one scan, without restart markers."""
    start = 2 + sum(4 + len(body) for _, body in jpeg_headers(data))
    return len(_SCAN_OR_RESTART.findall(data, start, data.find(_END, start))) == 1


def _libjpeg_warning(data: bytes, tables: bytes | None) -> str:
    whole = data if tables is None else data[:2] + tables[2 : tables.rfind(_END)] + data[2:]
    try:
        simplejpeg.decode_jpeg(whole, "GRAY", min_factor=8, strict=True)
    except ValueError as error:
        # What else it raises is of streams that it does not know: CMYK, say.
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


def _frame(data: bytes) -> _Frame | None:
    """None for streams whose blocks say nothing: lossless and arithmetic ones, and those too tall to be made taller."""
    position = 2
    for marker, body in jpeg_headers(data):
        if marker in _HUFFMAN_FRAMES and len(body) >= 6 and len(body) >= 6 + 3 * body[5]:
            factors = [body[7 + 3 * component] for component in range(body[5])]
            across, down = max(f >> 4 for f in factors), max(f & 15 for f in factors)
            if len(factors) == 1:  # its blocks stand by themselves, whatever its factors say
                across = down = 1
            height, width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
            if not (across and down and height and width) or height > 0xFFFF - (_BELOW + 1) * 8 * down:
                return None
            return _Frame(position + 5, height, width, 8 * down, 8 * across, body[0], down > 1)
        position += 4 + len(body)
    return None


def _stream_with_height(data: bytes, frame: _Frame, height_px: int) -> bytes:
    return data[: frame.height_at] + height_px.to_bytes(2, "big") + data[frame.height_at + 2 :]


def _stream_damage(data: bytes, frame: _Frame, taller: NDArray[np.generic], rows: int, decode: Decode) -> str:
    """What the blocks below the picture say of the stream: nothing, or a part of a sentence."""
    if _has_more_blocks(taller, frame, rows):
        return _MORE
    grey = 2 ** (frame.bits - 1)
    first = taller[rows + _BLEED_PX :][: frame.unit_height_px - 2 * _BLEED_PX, : frame.unit_width_px - _BLEED_PX]
    if (first == grey).all() and not (
        _ends_grey(taller[:rows], frame, grey) and _ends_whole(data, frame, taller, rows, decode)
    ):
        return "its stream ends before the picture does"
    return ""


def _has_more_blocks(taller: NDArray[np.generic], frame: _Frame, rows: int) -> bool:
    """Whether there are further blocks below the picture than the first."""
    below = taller[rows + _BLEED_PX :] != 2 ** (frame.bits - 1)
    return bool(below[:, frame.unit_width_px + _BLEED_PX :].any() or below[frame.unit_height_px :].any())


def _ends_grey(samples: NDArray[np.generic], frame: _Frame, grey: int) -> bool:
    """Whether the last block of the picture is such a grey itself: after it the bits that fill the last byte may be
    one more."""
    last = samples[-frame.unit_height_px :, (frame.width_px - 1) // frame.unit_width_px * frame.unit_width_px :]
    return bool((last == grey).all())


def _ends_whole(data: bytes, frame: _Frame, taller: NDArray[np.generic], rows: int, decode: Decode) -> bool:
    """Whether further codes at the end of the stream leave the picture as it is: where blocks are missing, they would
    be taken for these."""
    end = data.rfind(_END)
    longer = data[:end] + _TAIL + data[end:]
    again = decode(_stream_with_height(longer, frame, rows + _BELOW * frame.unit_height_px))
    above = rows - _BLEED_PX
    return bool(np.array_equal(again[:above], taller[:above]))


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
        samples, damage = decode_checked(data, imagecodecs.jpeg_decode)
        return grey_or_colour(samples), damage
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

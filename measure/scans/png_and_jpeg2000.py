"""PNG, JPEG 2000 (ITU-T T.800, A and I), BMP, PGM and PPM files, the last three as machine vision cameras write them:
the picture, decoded whole, and its metadata."""

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import imagecodecs
import numpy as np

from measure.errors import MeasurementError
from measure.scans.cache import OpenedPicture, WholePicture
from measure.scans.metadata import (
    DECODING_ERRORS,
    NO_TAGS,
    PNG_UNIT,
    PictureForm,
    Pitch,
    damage_error,
    grey_or_colour,
    pitch_from_density,
)
from measure.tone.curve import ColourTags

PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = ">IIBB"  # width, height, bits and kind of colour (PNG specification, 11.2.2)
_PNG_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 2, 6: 4}  # by that kind; a palette is decoded to colours and transparency
PNG_END = b"IEND"
JPEG2000_STARTS = (b"\x00\x00\x00\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51")  # a file of boxes, and a bare codestream
JPEG2000_END = b"\xff\xd9"
_SIZ, _COD, _SOT = b"\xff\x51", 0xFF52, 0xFF90
_IRREVERSIBLE = 0  # the wavelet transformation 9-7 of a COD marker
_LOSS_DN = 1.0  # a coded step: the file does not state the errors of its lossy compression
_LOSSY = "compressed as JPEG 2000 with loss: what that moved is not in the standard deviations"
_BY_PROFILE = (b"\x02", b"\x03")  # methods of a colour box: a restricted or any ICC profile
_HEADER_BOXES = (b"jp2h", b"res ")  # that contain other boxes
BMP_START = b"BM"
PNM_STARTS = (b"P5", b"P6")
_BMP_HEADER = "<I4xiiHH8xii"  # from byte 10: offset, width, height, planes, bits, pixels a metre
_BMP_CHANNELS = {8: 1, 24: 3, 32: 4}  # by the bits of a pixel
_PNM_HEADER = re.compile(rb"P([56])" + 3 * rb"(?:\s+|#[^\n]*\n)+(\d+)" + rb"\s")


def open_png(path: Path, max_pixels: int | None) -> OpenedPicture:
    """Open and decode a PNG file. Raises MeasurementError for a truncated or damaged file, and as
    `PictureForm.check`."""
    data = path.read_bytes()
    form = png_form(data)
    if form is None:
        raise damage_error(path, "its header is cut short")
    form.check(path, len(data), max_pixels)
    try:
        samples = grey_or_colour(imagecodecs.png_decode(data))
    except DECODING_ERRORS as error:
        raise damage_error(path, str(error)) from error
    return OpenedPicture(WholePicture(samples), png_pitch(data))


def png_pitch(data: bytes) -> Pitch:
    """Read the pitch from the pHYs chunk, which precedes the picture's data (PNG specification, 11.3.5.3)."""
    physical = next((body for kind, body in _chunks(data) if kind == b"pHYs" and len(body) == 9), None)
    if physical is None:
        return NO_TAGS
    x, y, unit = struct.unpack(">IIB", physical)
    return pitch_from_density(x, y, PNG_UNIT.get(unit))


def png_colour_tags(path: Path) -> ColourTags:
    """Read the chunk that declares the tone curve, in the order of precedence iCCP, sRGB, gAMA (PNG specification,
    4.3). Raises one of DECODING_ERRORS, or zlib.error."""
    chunks = dict(_chunks(path.read_bytes()))
    if b"iCCP" in chunks:
        # Name, zero byte, method, and the deflated profile.
        return ColourTags(zlib.decompress(chunks[b"iCCP"].split(b"\0", 1)[1][1:]))
    if b"gAMA" in chunks and b"sRGB" not in chunks:
        return ColourTags(light_power=1e5 / struct.unpack(">I", chunks[b"gAMA"])[0])
    return ColourTags(is_srgb=b"sRGB" in chunks)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and body of the chunks before the picture's data."""
    position = len(PNG_START)
    while position + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        if kind == b"IDAT":
            break
        yield kind, data[position + 8 : position + 8 + length]
        position += 12 + length


def png_form(data: bytes) -> PictureForm | None:
    """Form of a picture by the header, which is the first chunk."""
    try:
        width, height, bits, kind = struct.unpack(_PNG_HEADER, data[16:26])
        return PictureForm(width, height, _PNG_CHANNELS[kind], bits)
    except DECODING_ERRORS:
        return None


@dataclass(frozen=True)
class Jpeg2000Form(PictureForm):
    """Form of a picture by the head of its codestream."""

    is_signed: bool
    is_lossy: bool


def open_jpeg2000(path: Path, max_pixels: int | None) -> OpenedPicture:
    """Open and decode a JPEG 2000 file. Raises MeasurementError for a truncated or damaged file, for a size that
    exceeds the limits of `check_size`, and for samples other than unsigned ones of 2 to 16 bits."""
    data = path.read_bytes()
    form = jpeg2000_form(data)
    if form is None:
        raise damage_error(path, "its header is cut short")
    form.check(path, len(data), max_pixels)
    if form.is_signed or not 1 < form.bits <= 16:
        kind = "signed " if form.is_signed else ""
        raise MeasurementError(
            f"{path} is a JPEG 2000 picture of {kind}samples of {form.bits} bits: save it with 8 or 16 bits a sample"
        )
    if JPEG2000_END not in data[-4096:]:
        raise damage_error(path, "its end marker is missing")
    try:
        decoded = imagecodecs.jpeg2k_decode(data)
        bands = 1 if decoded.ndim == 2 else decoded.shape[2]
        samples = grey_or_colour(decoded if bands <= 4 else decoded[..., :3])
    except DECODING_ERRORS as error:
        raise damage_error(path, str(error)) from error
    notes = (_LOSSY,) if form.is_lossy else ()
    if bands > 4:
        notes = (*notes, f"the picture has {bands} bands: the first three are used, as red, green and blue")
    picture = WholePicture(samples, _LOSS_DN if form.is_lossy else 0.0, full_scale_dn=2.0**form.bits - 1)
    return OpenedPicture(picture, jpeg2000_pitch(data), notes)


def jpeg2000_form(data: bytes) -> Jpeg2000Form | None:
    """Read the head of the codestream (T.800, A.5.1 and A.6.1); None without one."""
    start = data.find(_SIZ)
    try:
        right, down, left, top = struct.unpack_from(">4I", data, start + 6)
        channels, depth = struct.unpack_from(">HB", data, start + 38)
        place, is_lossy = start, False
        while (marker := struct.unpack_from(">H", data, place)[0]) != _SOT and marker >> 8 == 0xFF:
            if marker == _COD:
                is_lossy = data[place + 13] == _IRREVERSIBLE
            place += 2 + struct.unpack_from(">H", data, place + 2)[0]
    except (struct.error, IndexError):
        return None
    if start < 0:
        return None
    return Jpeg2000Form(right - left, down - top, channels, (depth & 127) + 1, depth > 127, is_lossy)


def jpeg2000_pitch(data: bytes) -> Pitch:
    """Read the pitch from the capture resolution, else the display resolution: pixels a metre, fractions with powers of
    ten (T.800, I.5.3.7)."""
    if data.startswith(JPEG2000_STARTS[1]):
        return NO_TAGS
    stored = {kind: body for kind, body in _boxes(data) if kind in (b"resc", b"resd") and len(body) >= 10}
    if not stored:
        return NO_TAGS
    rows, rows_by, cols, cols_by, rows_power, cols_power = struct.unpack_from(
        ">4H2b", stored.get(b"resc") or stored[b"resd"]
    )
    if not (rows_by and cols_by):
        return Pitch(None, "the file's resolution box holds no resolution")
    return pitch_from_density(cols / cols_by * 10.0**cols_power, rows / rows_by * 10.0**rows_power, "metre")


def jpeg2000_colour_tags(path: Path) -> ColourTags:
    """Read the ICC profile of a file (T.800, I.5.3.3). Every file has a colour box, and programs fill it with sRGB or
    its grey without knowing: this declares no tone curve. Raises one of DECODING_ERRORS."""
    data = path.read_bytes()
    bodies = () if data.startswith(JPEG2000_STARTS[1]) else (body for kind, body in _boxes(data) if kind == b"colr")
    return ColourTags(next((body[3:] for body in bodies if body[:1] in _BY_PROFILE), b""))


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and body of the boxes before the codestream, those within the header included."""
    place = 0
    while place + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        if kind == b"jp2c" or (length < 8 and length != 0):
            return
        body = data[place + 8 : place + length if length else len(data)]
        yield kind, body
        if kind in _HEADER_BOXES:
            yield from _boxes(body)
        place += length or len(data)


@dataclass(frozen=True)
class PlainForm(PictureForm):
    """Form of an uncompressed picture. full_scale_dn: its largest grey value; stored_bytes: of header and rows."""

    full_scale_dn: float
    stored_bytes: int
    pitch: Pitch = NO_TAGS


def open_plain(path: Path, max_pixels: int | None) -> OpenedPicture:
    """Open and decode a BMP, PGM or PPM file. Raises MeasurementError for a truncated or damaged file, for a size that
    exceeds the limits of `check_size`, and for other than 8, 24 or 32 bits a pixel of a BMP."""
    data = path.read_bytes()
    form = plain_form(data)
    if form is None:
        raise damage_error(path, "its header is cut short")
    if data.startswith(BMP_START) and form.bits != 8:
        raise MeasurementError(f"{path} is a BMP of {form.bits} bits a pixel: save it with 8 or 24")
    form.check(path, len(data), max_pixels)
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if len(data) < form.stored_bytes or decoded is None:
        raise damage_error(path, "it is cut short")
    picture = grey_or_colour(decoded if decoded.ndim == 2 else decoded[..., 2::-1])
    return OpenedPicture(WholePicture(picture, full_scale_dn=form.full_scale_dn), form.pitch)


def plain_form(data: bytes) -> PlainForm | None:
    """Form of a picture by its header; None if it is cut short."""
    if data.startswith(BMP_START):
        if len(data) < 10 + struct.calcsize(_BMP_HEADER):
            return None
        offset, width, height, _, bits, across, down = struct.unpack_from(_BMP_HEADER, data, 10)
        row_bytes = -(-width * bits // 32) * 4
        pitch = pitch_from_density(across, down, "metre") if min(across, down) > 0 else NO_TAGS
        channels, bits = (_BMP_CHANNELS[bits], 8) if bits in _BMP_CHANNELS else (1, bits)
        return PlainForm(width, abs(height), channels, bits, 255.0, offset + row_bytes * abs(height), pitch)
    header = _PNM_HEADER.match(data)
    if header is None:
        return None
    kind, width, height, largest = map(int, header.groups())
    channels, bits = (1 if kind == 5 else 3), largest.bit_length()
    return PlainForm(
        width, height, channels, bits, float(largest), header.end() + width * height * channels * (1 + (bits > 8))
    )

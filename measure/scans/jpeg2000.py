"""JPEG 2000 files and codestreams: decoded whole, and what their boxes and markers say (ITU-T T.800, A and I)."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import imagecodecs

from measure.errors import MeasurementError
from measure.scans.cache import OpenedPicture, WholePicture
from measure.scans.metadata import (
    DECODING_ERRORS,
    NO_TAGS,
    Pitch,
    check_size,
    damage_error,
    grey_or_colour,
    pitch_from_density,
)

JPEG2000_STARTS = (b"\x00\x00\x00\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51")  # a file of boxes, and a bare codestream
_SIZ, _COD, _SOT, _END = b"\xff\x51", 0xFF52, 0xFF90, b"\xff\xd9"
_IRREVERSIBLE = 0  # the wavelet transformation 9-7 of a COD marker
_LOSS_DN = 1.0  # a coded step: what a compression with loss moved is not told by its file
_LOSSY = "compressed as JPEG 2000 with loss: what that moved is not in the standard deviations"
_HEADER_BOXES = (b"jp2h", b"res ")  # which hold others


@dataclass(frozen=True)
class Jpeg2000Form:
    """What a codestream's head says of its picture."""

    width_px: int
    height_px: int
    channels: int
    bits: int
    is_signed: bool
    is_lossy: bool


def open_jpeg2000(path: Path, max_pixels: int | None) -> OpenedPicture:
    """The picture of a JPEG 2000 file, decoded whole. Raises MeasurementError for a truncated or damaged file, for one
    that claims more than such a file can hold, and for samples that are not of 2 to 16 bits without sign."""
    data = path.read_bytes()
    form = jpeg2000_form(data)
    if form is None:
        raise damage_error(path, "its header is cut short")
    size, sample_bytes = (form.width_px, form.height_px), -(-form.bits // 8)
    check_size(path, "a picture", size, size[0] * size[1] * form.channels * sample_bytes, len(data), max_pixels)
    if form.is_signed or not 1 < form.bits <= 16:
        kind = "signed " if form.is_signed else ""
        raise MeasurementError(
            f"{path} is a JPEG 2000 picture of {kind}samples of {form.bits} bits: save it with 8 or 16 bits a sample"
        )
    if _END not in data[-4096:]:
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
    """None without a head (T.800, A.5.1 and A.6.1)."""
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
    """The capture resolution, or else the one to be shown by: pixels a metre as fractions with powers of ten (T.800,
    I.5.3.7)."""
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


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Those before the codestream, and inside of the header: kind and body."""
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

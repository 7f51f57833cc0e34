"""BMP and PGM or PPM files, as machine vision cameras write them: the picture, decoded whole, and its metadata."""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from measure.errors import MeasurementError
from measure.scans.cache import OpenedPicture, WholePicture
from measure.scans.metadata import NO_TAGS, PictureForm, Pitch, damage_error, grey_or_colour, pitch_from_density

BMP_START = b"BM"
PNM_STARTS = (b"P5", b"P6")
_BMP_HEADER = "<I4xiiHH8xii"  # from byte 10: offset, width, height, planes, bits, pixels a metre
_BMP_CHANNELS = {8: 1, 24: 3, 32: 4}  # by the bits of a pixel
_PNM_HEADER = re.compile(rb"P([56])" + 3 * rb"(?:\s+|#[^\n]*\n)+(\d+)" + rb"\s")


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

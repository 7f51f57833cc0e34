"""PNG files: the picture, decoded whole, and the metadata in its chunks."""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import imagecodecs

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
from measure.tone.declared import ColourTags

PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = ">IIBB"  # width, height, bits and kind of colour (PNG specification, 11.2.2)
_PNG_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 2, 6: 4}  # by that kind; a palette is decoded to colours and transparency
PNG_END = b"IEND"


def open_png(path: Path, max_pixels: int | None) -> OpenedPicture:
    """Open and decode a PNG file. Raises MeasurementError for a truncated or damaged file, and for a size that exceeds
    the limits of `check_size`."""
    data = path.read_bytes()
    form = png_form(data)
    if form is None:
        raise damage_error(path, "its header is cut short")
    if form.bits == 1:
        raise MeasurementError(
            f"{path} is a PNG of black and white pixels only (1 bit), and marks are measured by the grey values along "
            "their edges: save the scan as grey or RGB with 8 or 16 bits a sample"
        )
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

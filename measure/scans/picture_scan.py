"""JPEG and PNG files: decoded whole, for neither can be read by parts."""

import struct
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray
from tifffile import TiffFile

from measure.errors import MeasurementError
from measure.scans.broken import DECODING_ERRORS, broken
from measure.scans.compression import jpeg_headers, rounding_step_dn
from measure.scans.jpeg_stream import decoded, picture_size
from measure.scans.radiometry import Radiometry, Samples
from measure.scans.resolution import JFIF_UNIT, NO_TAGS, PNG_UNIT, Pitch, pitch_from_density
from measure.scans.segments import LostPart, OpenedPicture, Place
from measure.scans.size_limit import check_size
from measure.scans.tiff_scan import orientation_notes, orientation_of, tag_pitch

JPEG_START, PNG_START = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_PNG_SIZE = slice(16, 25)  # width, height and the bits of a sample: IHDR is the first chunk (PNG specification, 11.2.2)
_MOST_CHANNELS = 4


def open_picture(path: Path, start: bytes, max_pixels: int | None = None) -> OpenedPicture:
    """A JPEG or PNG picture. start: the file's first bytes; max_pixels: as `check_size` takes it.

    Raises MeasurementError for a truncated file, for one that is no picture, and for one that claims more than such a
    file can hold.
    """
    if start.startswith(JPEG_START):
        data = path.read_bytes()
        samples, damage = _jpeg_samples(path, data, max_pixels)
        orientation, picture = _jpeg_orientation(data), WholePicture(samples, rounding_step_dn(data), damage)
        return OpenedPicture(picture, jpeg_pitch(data), orientation_notes(orientation), orientation=orientation)
    if not start.startswith(PNG_START):
        raise no_picture(path, start)
    data = path.read_bytes()
    return OpenedPicture(WholePicture(_png_samples(path, data, max_pixels)), png_pitch(data))


def no_picture(path: Path, start: bytes) -> MeasurementError:
    """Of a file that begins so."""
    return MeasurementError(
        f"{path} is no TIFF, JPEG or PNG picture (it begins with {start[:8]!r}): give the scan itself, or convert it"
    )


class WholePicture:
    """A picture in memory: (height, width, channels) of 8 or 16 bits, one segment. damage: why it cannot be trusted, a
    part of a sentence, empty where it can."""

    def __init__(self, samples: Samples, rounding_step_dn: float = 0.0, damage: str = "") -> None:
        self._samples, self.rounding_step_dn = samples, rounding_step_dn
        self.height_px, self.width_px, self.channels = samples.shape
        self.segment_height_px, self.segment_width_px = self.height_px, self.width_px
        self.sample_bytes = samples.itemsize
        self.full_scale_dn = float(2 ** (8 * samples.itemsize) - 1)
        self.lost: Sequence[LostPart] = ()
        if damage:
            self.lost = (LostPart(0, 0, self.width_px, self.height_px, damage),)
            self._samples = np.full_like(samples, self.full_scale_dn // 2)

    def fetched(self, places: Sequence[Place]) -> Mapping[Place, Sequence[bytes]]:
        return {}

    def read(self, row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
        """All of it."""
        return self._samples

    def close(self) -> None:
        """Nothing is open."""


def _jpeg_samples(path: Path, data: bytes, max_pixels: int | None) -> tuple[Samples, str]:
    """Grey or RGB, and why it cannot be trusted; a decoder that fills a truncated file with grey is not asked."""
    size = picture_size(data)
    if size is not None:
        check_size(path, "a picture", size, size[0] * size[1] * _MOST_CHANNELS, len(data), max_pixels)
    picture = 2 + sum(4 + len(body) for _, body in jpeg_headers(data))
    if b"\xff\xd9" not in data[picture:]:
        raise broken(path, "its end marker is missing")
    try:
        samples, damage = decoded(data, imagecodecs.jpeg_decode)
        return _as_channels(samples), damage
    except DECODING_ERRORS as error:
        if size is None or 0 in size:
            raise broken(path, str(error)) from error
        return np.zeros((size[1], size[0], 1), np.uint8), str(error)


def _png_samples(path: Path, data: bytes, max_pixels: int | None) -> Samples:
    """Grey or RGB, 8 or 16 bits."""
    header = data[_PNG_SIZE]
    if len(header) < 9:
        raise broken(path, "its header is cut short")
    width, height, bits = struct.unpack(">IIB", header)
    if bits == 1:
        raise MeasurementError(
            f"{path} is a PNG of black and white pixels only (1 bit), and marks are measured by the grey values along "
            "their edges: save the scan as grey or RGB with 8 or 16 bits a sample"
        )
    decoded_bytes = width * height * _MOST_CHANNELS * -(-bits // 8)
    check_size(path, "a picture", (width, height), decoded_bytes, len(data), max_pixels)
    try:
        return _as_channels(imagecodecs.png_decode(data))
    except DECODING_ERRORS as error:
        raise broken(path, str(error)) from error


def _as_channels(picture: NDArray[Any]) -> Samples:
    """One or three channels of a decoded picture; transparency is left out. Raises one of DECODING_ERRORS."""
    if picture.size == 0:
        raise ValueError("it holds no picture")
    stored = picture[..., None] if picture.ndim == 2 else picture
    channels = {1: 1, 2: 1, 3: 3, 4: 3}[stored.shape[2]]
    return Radiometry(channels, float(np.iinfo(stored.dtype).max)).apply(stored)


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
                    return orientation_of(file.pages.first.aspage())
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


def png_pitch(data: bytes) -> Pitch:
    """The pHYs chunk, which stands before the picture's data (PNG specification, 11.3.5.3)."""
    position = len(PNG_START)
    while position + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        if kind == b"pHYs" and length == 9:
            x, y, unit = struct.unpack(">IIB", data[position + 8 : position + 17])
            return pitch_from_density(x, y, PNG_UNIT.get(unit))
        if kind == b"IDAT":
            break
        position += 12 + length
    return NO_TAGS

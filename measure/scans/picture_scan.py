"""JPEG and PNG files: decoded whole, for neither can be read by parts."""

import struct
from io import BytesIO
from pathlib import Path

import imagecodecs
import numpy as np
from tifffile import TiffFile

from measure.errors import MeasurementError
from measure.scans.quantisation import jpeg_headers, rounding_step_dn
from measure.scans.radiometry import Radiometry, Samples
from measure.scans.resolution import JFIF_UNIT, NO_TAGS, PNG_UNIT, Pitch, pitch_from_density
from measure.scans.segments import Segments
from measure.scans.tiff_scan import DECODING_ERRORS, broken, orientation_notes, tag_pitch

_JPEG_START, _PNG_START = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
_PNG_DEPTH = 24  # the byte that holds the bits of a sample: IHDR is the first chunk (PNG specification, 11.2.2)


def open_picture(path: Path, start: bytes) -> tuple[Segments, Pitch, tuple[str, ...]]:
    """A JPEG or PNG picture, its pitch, and notes. start: the file's first bytes.

    Raises MeasurementError for a truncated file and for one that is no picture.
    """
    if start.startswith(_JPEG_START):
        data = path.read_bytes()
        samples, pitch, step_dn = _jpeg_samples(path, data), _jpeg_pitch(data), rounding_step_dn(data)
        notes = _jpeg_notes(data)
    elif start.startswith(_PNG_START):
        data = path.read_bytes()
        samples, pitch, step_dn = _png_samples(path, data), _png_pitch(data), 0.0
        notes = ()
    else:
        raise MeasurementError(
            f"{path} is no TIFF, JPEG or PNG picture (it begins with {start[:8]!r}): "
            "give the scan itself, or convert it"
        )
    return WholePicture(samples, step_dn), pitch, notes


class WholePicture:
    """A picture in memory: (height, width, channels) of 8 or 16 bits, one segment."""

    def __init__(self, samples: Samples, rounding_step_dn: float = 0.0) -> None:
        self._samples, self.rounding_step_dn = samples, rounding_step_dn
        self.height_px, self.width_px, self.channels = samples.shape
        self.segment_height_px, self.segment_width_px = self.height_px, self.width_px
        self.sample_bytes = samples.itemsize
        self.full_scale_dn = float(2 ** (8 * samples.itemsize) - 1)

    def read(self, row: int, column: int) -> Samples:
        """All of it."""
        return self._samples

    def close(self) -> None:
        """Nothing is open."""


def _jpeg_samples(path: Path, data: bytes) -> Samples:
    """Grey or RGB; a decoder that fills a truncated file with grey is not asked."""
    picture = 2 + sum(4 + len(body) for _, body in jpeg_headers(data))
    if b"\xff\xd9" not in data[picture:]:
        raise broken(path, "its end marker is missing")
    try:
        return _as_channels(path, imagecodecs.jpeg_decode(data))
    except DECODING_ERRORS as error:
        raise broken(path, str(error)) from error


def _png_samples(path: Path, data: bytes) -> Samples:
    """Grey or RGB, 8 or 16 bits."""
    if data[_PNG_DEPTH : _PNG_DEPTH + 1] == b"\x01":
        raise MeasurementError(
            f"{path} is a PNG of black and white pixels only (1 bit), and marks are measured by the grey values along "
            "their edges: save the scan as grey or RGB with 8 or 16 bits a sample"
        )
    try:
        return _as_channels(path, imagecodecs.png_decode(data))
    except DECODING_ERRORS as error:
        raise broken(path, str(error)) from error


def _as_channels(path: Path, decoded: np.ndarray) -> Samples:
    """One or three channels of a decoded picture; transparency is left out."""
    stored = decoded[..., None] if decoded.ndim == 2 else decoded
    channels = {1: 1, 2: 1, 3: 3, 4: 3}[stored.shape[2]]
    return Radiometry(channels, float(np.iinfo(stored.dtype).max)).apply(stored)


def _jpeg_pitch(data: bytes) -> Pitch:
    """The JFIF density, or the Exif resolution where that has no unit."""
    pitch = NO_TAGS
    for marker, body in jpeg_headers(data):
        if marker == 0xE0 and body.startswith(b"JFIF\0") and len(body) >= 12:
            unit, x, y = struct.unpack(">BHH", body[7:12])
            pitch = pitch_from_density(x, y, JFIF_UNIT.get(unit))
        elif marker == 0xE1 and body.startswith(b"Exif\0\0") and pitch.um is None:
            pitch = _exif_pitch(body[6:], pitch)
    return pitch


def _jpeg_notes(data: bytes) -> tuple[str, ...]:
    """On the orientation that an Exif block gives."""
    for marker, body in jpeg_headers(data):
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            try:
                with TiffFile(BytesIO(body[6:])) as file:
                    return orientation_notes(file.pages.first.aspage())
            except DECODING_ERRORS:
                return ()
    return ()


def _exif_pitch(exif: bytes, otherwise: Pitch) -> Pitch:
    """The resolution tags of an Exif block, which is a small TIFF file without a picture."""
    try:
        with TiffFile(BytesIO(exif)) as file:
            pitch = tag_pitch(file.pages.first)
    except DECODING_ERRORS:
        return otherwise
    return pitch if pitch.um is not None or otherwise is NO_TAGS else otherwise


def _png_pitch(data: bytes) -> Pitch:
    """The pHYs chunk, which stands before the picture's data (PNG specification, 11.3.5.3)."""
    position = len(_PNG_START)
    while position + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        if kind == b"pHYs" and length == 9:
            x, y, unit = struct.unpack(">IIB", data[position + 8 : position + 17])
            return pitch_from_density(x, y, PNG_UNIT.get(unit))
        if kind == b"IDAT":
            break
        position += 12 + length
    return NO_TAGS

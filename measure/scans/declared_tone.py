"""The tone curve that a file says it has: its ICC profile, a TransferFunction, PNG's sRGB and gAMA, or Exif."""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tifffile import TiffFile, TiffPage

from measure.scans.addresses import tiff_file
from measure.scans.broken import DECODING_ERRORS
from measure.scans.compression import jpeg_headers
from measure.scans.tone import Tone, power, sampled, srgb

Array = NDArray[np.float64]

_WHITE_IS_ZERO = 0
_TRANSFER_FUNCTION, _ICC_PROFILE, _EXIF = 301, 34675, 34665
_PNG_START = b"\x89PNG\r\n\x1a\n"
_ICC_HEADER, _CURVES = 128, (b"kTRC", b"gTRC")  # of a grey profile, and of green (ICC.1:2022, 7.2 and 9.2)
_SAMPLES = np.linspace(0.0, 1.0, 1025)
_EXIF_SRGB = 1


def declared_tone(path: Path) -> Tone | None:
    """What the file says of its curve, None where it says nothing that can be used. Never raises for what it holds."""
    try:
        with path.open("rb") as opened:
            start = opened.read(16)
        if start[:2] in (b"II", b"MM"):
            with tiff_file(path) as file:
                return _of_page(file.pages.first.aspage())
        if start.startswith(_PNG_START):
            return _of_png(path)
        return _of_jpeg(path)
    except (*DECODING_ERRORS, KeyError, ZeroDivisionError):
        return None


def curve_of_profile(profile: bytes) -> Array | None:
    """(nodes,) light by the grey or green curve of an ICC profile; None where it has none, as profiles that are
    tables of colours have none. Raises struct.error or ValueError for one that is broken."""
    (count,) = struct.unpack_from(">I", profile, _ICC_HEADER)
    for entry in range(min(count, 100)):
        name, offset, size = struct.unpack_from(">4sII", profile, _ICC_HEADER + 4 + 12 * entry)
        if name in _CURVES:
            return _curve(profile[offset : offset + size])
    return None


def _curve(data: bytes) -> Array | None:
    """By curveType and parametricCurveType (ICC.1:2022, 10.6 and 10.18)."""
    if data[:4] == b"curv":
        (count,) = struct.unpack_from(">I", data, 8)
        if count == 0:
            return power(1.0)
        if count == 1:
            return power(struct.unpack_from(">H", data, 12)[0] / 256)
        return sampled(np.frombuffer(data, ">u2", count, 12).astype(float))
    if data[:4] != b"para":
        return None
    (kind,) = struct.unpack_from(">H", data, 8)
    numbers = [value / 65536 for value in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", data, 12)]
    g, a, b, c, d, e, f = numbers + [1.0, 0.0, 0.0, 0.0, 0.0, 0.0][len(numbers) - 1 :]
    if kind in (1, 2):
        limit, shift = -b / a, c if kind == 2 else 0.0
        low, above = np.full_like(_SAMPLES, shift), shift
    else:
        limit, above = (d, e) if kind > 2 else (0.0, 0.0)
        low = c * _SAMPLES + f
    return sampled(np.where(limit <= _SAMPLES, np.maximum(a * _SAMPLES + b, 0.0) ** g + above, low))


def _of_page(page: TiffPage) -> Tone | None:
    profile, transfer = page.tags.valueof(_ICC_PROFILE), page.tags.valueof(_TRANSFER_FUNCTION)
    if profile and (curve := curve_of_profile(bytes(profile))) is not None:
        return Tone.declared(curve, "the file's ICC profile says it")
    if transfer is not None and int(page.photometric) != _WHITE_IS_ZERO:
        first = np.asarray(transfer, float).ravel()[: 2**page.bitspersample]
        return Tone.declared(sampled(first), "the file's TransferFunction says it")
    return _of_exif(page.tags.valueof(_EXIF))


def _of_exif(exif: object) -> Tone | None:
    if not isinstance(exif, dict):
        return None
    if exif.get("ColorSpace") == _EXIF_SRGB:
        return Tone.declared(srgb(), "the file's Exif data say sRGB")
    if "Gamma" in exif:
        above, below = exif["Gamma"]
        return Tone.declared(power(above / below), "the file's Exif data say it")
    return None


def _of_png(path: Path) -> Tone | None:
    """By the first chunk of the order of precedence (PNG specification, 4.3): iCCP, sRGB, gAMA."""
    chunks = dict(_png_chunks(path.read_bytes()))
    if b"iCCP" in chunks:
        # A name, a zero, the method, and the profile, deflated.
        profile = zlib.decompress(chunks[b"iCCP"].split(b"\0", 1)[1][1:])
        curve = curve_of_profile(profile)
        return None if curve is None else Tone.declared(curve, "the file's ICC profile says it")
    if b"sRGB" in chunks:
        return Tone.declared(srgb(), "the file says sRGB")
    if b"gAMA" in chunks:
        return Tone.declared(power(1e5 / struct.unpack(">I", chunks[b"gAMA"])[0]), "the file's gAMA chunk says it")
    return None


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Those before the picture's data."""
    position = len(_PNG_START)
    while position + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        if kind == b"IDAT":
            break
        yield kind, data[position + 8 : position + 8 + length]
        position += 12 + length


def _of_jpeg(path: Path) -> Tone | None:
    """By an ICC profile, which may be cut into several segments (ICC.1:2022, B.4), or Exif."""
    pieces, exif = {}, None
    for marker, body in jpeg_headers(path.read_bytes()):
        if marker == 0xE2 and body.startswith(b"ICC_PROFILE\0"):
            pieces[body[12]] = body[14:]
        elif marker == 0xE1 and body.startswith(b"Exif\0\0"):
            with TiffFile(BytesIO(body[6:])) as file:
                exif = file.pages.first.aspage().tags.valueof(_EXIF)
    if pieces and (curve := curve_of_profile(b"".join(pieces[number] for number in sorted(pieces)))) is not None:
        return Tone.declared(curve, "the file's ICC profile says it")
    return _of_exif(exif)

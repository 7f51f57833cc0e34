"""Tone curve declared by a file: ICC profile, TransferFunction, PNG's sRGB and gAMA, or Exif."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from measure.array_types import Array
from measure.tone.curve import Tone, power, sampled_curve, srgb

_ICC_HEADER, _CURVES = 128, (b"kTRC", b"gTRC")  # bytes; tags of a grey curve and of green (ICC.1:2022, 7.2 and 9.2)
_SAMPLES = np.linspace(0.0, 1.0, 1025)  # codes at which a parametric curve is tabulated
_EXIF_SRGB = 1  # value of ColorSpace (Exif 2.3)


@dataclass(frozen=True, eq=False)
class ColourTags:
    """Tags of a file that declare its tone curve.

    icc_profile: empty if absent; transfer_function: (codes,) light of each code; exif: tags of the Exif block; is_srgb:
    PNG's sRGB chunk is present; light_power: inverse of PNG's gAMA.
    """

    icc_profile: bytes = b""
    transfer_function: Array | None = None
    exif: Mapping[str, Any] = field(default_factory=dict)
    is_srgb: bool = False
    light_power: float | None = None


def tone_of_tags(tags: ColourTags) -> Tone | None:
    """Read the tone curve declared by a file. The ICC profile has priority over all other tags.

    Returns
    -------
    Tone, or None if no tag declares a usable curve.

    Raises
    ------
    ValueError, LookupError, ArithmeticError, struct.error
        If the tags are corrupt.
    """
    if tags.icc_profile and (curve := curve_of_profile(tags.icc_profile)) is not None:
        return Tone.declared(curve, "the file's ICC profile says it")
    if tags.transfer_function is not None:
        return Tone.declared(sampled_curve(tags.transfer_function), "the file's TransferFunction says it")
    if tags.is_srgb:
        return Tone.declared(srgb(), "the file says sRGB")
    if tags.light_power is not None:
        return Tone.declared(power(tags.light_power), "the file's gAMA chunk says it")
    if tags.exif.get("ColorSpace") == _EXIF_SRGB:
        return Tone.declared(srgb(), "the file's Exif data say sRGB")
    if "Gamma" in tags.exif:
        above, below = tags.exif["Gamma"]
        return Tone.declared(power(above / below), "the file's Exif data say it")
    return None


def curve_of_profile(profile: bytes) -> Array | None:
    """(nodes,) light by the grey or green curve of an ICC profile; None if it has none, such as profiles with colour
    tables. Raises struct.error or ValueError if it is corrupt."""
    (count,) = struct.unpack_from(">I", profile, _ICC_HEADER)
    for entry in range(min(count, 100)):
        name, offset, size = struct.unpack_from(">4sII", profile, _ICC_HEADER + 4 + 12 * entry)
        if name in _CURVES:
            return _curve(profile[offset : offset + size])
    return None


def _curve(data: bytes) -> Array | None:
    """Decode curveType and parametricCurveType (ICC.1:2022, 10.6 and 10.18)."""
    if data[:4] == b"curv":
        (count,) = struct.unpack_from(">I", data, 8)
        if count == 0:
            return power(1.0)
        if count == 1:
            return power(struct.unpack_from(">H", data, 12)[0] / 256)
        return sampled_curve(np.frombuffer(data, ">u2", count, 12).astype(float))
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
    return sampled_curve(np.where(limit <= _SAMPLES, np.maximum(a * _SAMPLES + b, 0.0) ** g + above, low))

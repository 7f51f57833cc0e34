"""Metadata of a scan file: pitch, orientation, conversion of stored numbers to grey values; and their checks."""

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tifffile import TiffFileError, TiffPage

from measure.errors import MeasurementError, TooLargeError

# Errors that decoders raise for invalid files.
DECODING_ERRORS = (
    RuntimeError,
    ValueError,
    OSError,
    LookupError,
    ArithmeticError,
    TypeError,
    AttributeError,
    MemoryError,
    struct.error,
    TiffFileError,
)
MOST_PIXELS = 4_000_000_000  # 63,000 px a side: film of 23 cm at 4 µm
MOST_PER_BYTE = 1000  # decoded bytes per stored byte: the limit of deflate; film grain allows ten
ALWAYS_BYTES = 128 << 20  # decoded size that is always allowed: a synthetic image compresses to almost nothing
JPEG_COMPRESSIONS = (6, 7, 34892, 33007)  # of TIFF
WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _SEPARATED, _YCBCR = 0, 1, 2, 3, 5, 6  # PhotometricInterpretation
_CIELAB, _ICCLAB = 8, 9
_ICCLAB_FULL_DN = 65280.0  # L* of 100 in 16 bits (TIFF Technical Note 4); CIELab's is all ones (TIFF 6.0, section 23)
_INK_WEIGHTS = (0.299, 0.587, 0.114)  # of red, green and blue, the complements of cyan, magenta and yellow
_UNSIGNED, _SIGNED, _FLOATING = 1, 2, 3  # SampleFormat
WORD_DN = 65535.0
_INK_SET = 332  # 1: cyan, magenta, yellow and black
_EXIF = 34665  # the tag of an Exif block (Exif 2.3)
_COARSEST_UM = 250.0  # about 100 dpi; 72 and 96 dpi are defaults of programs
_FINEST_UM = 1.0  # finer than any film scanner

_METRE_UM = {"inch": 25400.0, "centimetre": 10000.0, "millimetre": 1000.0, "micrometre": 1.0, "metre": 1e6}
TIFF_UNIT = {2: "inch", 3: "centimetre", 4: "millimetre", 5: "micrometre"}  # 4 and 5 are not standard, but occur
JFIF_UNIT = {1: "inch", 2: "centimetre"}
PNG_UNIT = {1: "metre"}
Samples = NDArray[np.uint8 | np.uint16]


def damage_error(path: Path, what: str) -> MeasurementError:
    """what: a part of a sentence."""
    return MeasurementError(
        f"{path} is damaged or truncated ({what.rstrip('.')}): copy it again from the original, or rescan"
    )


def unsupported_error(path: Path, what: str) -> MeasurementError:
    """what: a part of a sentence."""
    return MeasurementError(
        f"{path} is a TIFF of a kind that is not read ({what}): save it as grey or RGB with 8 or 16 bits a sample"
    )


def check_size(
    path: Path, what: str, size_px: tuple[int, int], decoded_bytes: int, stored_bytes: int, max_pixels: int | None
) -> None:
    """Raise TooLargeError for an image, or a part of one, that exceeds the limits.

    what: word for it; size_px: (width, height); decoded_bytes, stored_bytes: size in memory and in the file;
    max_pixels: limit set by the user, which replaces the limits on pixels and on bytes per stored byte.
    """
    width, height = size_px
    pixels = width * height
    if max_pixels is None:
        if pixels <= MOST_PIXELS and decoded_bytes <= max(ALWAYS_BYTES, MOST_PER_BYTE * stored_bytes):
            return
        bound = (
            f"without --max-pixels at most {MOST_PIXELS} pixels are read, and beyond {ALWAYS_BYTES >> 20} MiB at most "
            f"{MOST_PER_BYTE} bytes for each that is stored"
        )
    elif pixels <= max_pixels:
        return
    else:
        bound = f"--max-pixels allows {max_pixels}"
    raise TooLargeError(
        f"{path} claims {what} of {width} x {height} pixels ({decoded_bytes} bytes), stored in {stored_bytes} bytes: "
        f"{bound}. If it is truly so large, give --max-pixels {pixels}; else the file is damaged: copy it again"
    )


@dataclass(frozen=True)
class PictureForm:
    """Form of a picture by the head of its file. channels: all that are decoded, transparency included; bits: of a
    sample."""

    width_px: int
    height_px: int
    channels: int
    bits: int

    def check(self, path: Path, stored_bytes: int, max_pixels: int | None) -> None:
        """Check the size of a picture that is decoded whole, see `check_size`, and that it has grey values."""
        if self.bits == 1:
            raise MeasurementError(
                f"{path} has black and white pixels only (1 bit), and marks are measured by the grey values along "
                "their edges: save the scan as grey or RGB with 8 or 16 bits a sample"
            )
        decoded_bytes = self.width_px * self.height_px * self.channels * -(-self.bits // 8)
        check_size(path, "a picture", (self.width_px, self.height_px), decoded_bytes, stored_bytes, max_pixels)


@dataclass(frozen=True)
class Pitch:
    """Pixel pitch. um: (x, y) in µm, None where the file has no credible one; note: the reason, else empty."""

    um: tuple[float, float] | None
    note: str = ""


NO_TAGS = Pitch(None, "the file has no resolution tags")


def pitch_from_density(x: float, y: float, unit: str | None) -> Pitch:
    """Pitch from x, y pixels per unit (`inch`, ...; None: the file names no unit)."""
    if unit is None:
        return Pitch(None, "the file's resolution tags have no unit")
    if not (x > 0.0 and y > 0.0):
        return Pitch(None, f"the file's resolution tags say {x:g} x {y:g} pixels per {unit}")
    um = (_METRE_UM[unit] / x, _METRE_UM[unit] / y)
    if max(um) > _COARSEST_UM:
        dpi = 25400.0 / max(um)
        return Pitch(
            None, f"the file's resolution tags say {dpi:.0f} dpi, which is a program's default and no scanner's"
        )
    if min(um) < _FINEST_UM:
        return Pitch(None, f"the file's resolution tags say {min(um):g} µm a pixel, finer than any scanner")
    return Pitch(um)


@dataclass(frozen=True, eq=False)
class Radiometry:
    """Conversion of stored samples to grey or colour values.

    Attributes
    ----------
    channels : 1 (grey) or 3 (red, green, blue), from the first samples of a pixel; further ones (transparency) are
        ignored.
    full_scale_dn : largest value.
    inverted : whether 0 is white.
    palette : (entries, 3) colours.
    inks_full : value of full ink, if the samples are cyan, magenta, yellow and black.
    span : stored floating-point numbers that map to 0 and full scale.
    bands : samples that make one grey value, if there are several.
    note : remark for the user.
    """

    channels: int
    full_scale_dn: float
    inverted: bool = False
    palette: Samples | None = None
    inks_full: float = 0.0
    span: tuple[float, float] | None = None
    bands: int = 0
    note: str = ""

    @property
    def used_samples(self) -> int:
        """Number of samples of a pixel that are used, from the first one."""
        return self.bands if self.inks_full else self.channels

    @property
    def sample_bytes(self) -> int:
        return 1 if self.full_scale_dn < 256 else 2

    def apply(self, stored: NDArray[np.generic]) -> Samples:
        """Convert (height, width, samples) stored numbers to (height, width, channels) values."""
        if self.palette is not None:
            indices = np.minimum(stored[..., 0].astype(np.intp), len(self.palette) - 1)
            return self.palette[indices]
        dtype = np.uint8 if self.sample_bytes == 1 else np.uint16
        if self.inks_full:
            light = 1.0 - stored[..., : self.used_samples].astype(np.float32) / self.inks_full
            luminance = light[..., 3] * (light[..., :3] @ np.array(_INK_WEIGHTS, np.float32))
            return np.asarray(np.rint(self.full_scale_dn * luminance[..., None]), dtype)
        if self.span is not None:
            low, high = self.span
            share = (np.nan_to_num(stored[..., : self.channels].astype(np.float64), nan=low) - low) / (high - low)
            stored = np.rint(self.full_scale_dn * np.clip(share, 0.0, 1.0))
        elif stored.dtype.kind == "i":
            stored = np.maximum(stored, 0)
        samples: Samples = np.ascontiguousarray(stored[..., : self.channels], dtype)
        return samples.dtype.type(self.full_scale_dn) - samples if self.inverted else samples


def orientation_tag(page: TiffPage) -> int:
    """Orientation tag of a page; 1 if it has none, or one that is no whole number from 1 to 8."""
    value = page.tags.valueof(274, default=1)
    return int(value) if isinstance(value, int) and 1 <= value <= 8 else 1


def orientation_notes(orientation: int) -> tuple[str, ...]:
    """Note on an orientation tag, for users who read positions in a viewer that obeys it."""
    if orientation == 1:
        return ()
    return (f"the file's orientation tag ({orientation}) is not applied: columns and rows are as stored",)


def tag_pitch(page: TiffPage) -> Pitch:
    """Pitch from XResolution, YResolution and ResolutionUnit (inch by default, TIFF 6.0)."""
    stored = [page.tags.valueof(name) for name in ("XResolution", "YResolution")]
    if None in stored:
        return NO_TAGS
    try:
        x, y = (numerator / denominator if denominator else 0.0 for numerator, denominator in stored)
        unit = TIFF_UNIT.get(int(page.tags.valueof("ResolutionUnit", default=2)))
    except (TypeError, ValueError):
        return Pitch(None, "the file's resolution tags hold no resolution")
    return pitch_from_density(x, y, unit)


def grey_or_colour(picture: NDArray[Any]) -> Samples:
    """One or three channels of a decoded image, without transparency; one if all are equal, as of a grey scan that was
    stored as colour. Raises one of DECODING_ERRORS."""
    if picture.size == 0:
        raise ValueError("it holds no picture")
    stored = picture[..., None] if picture.ndim == 2 else picture
    channels = {1: 1, 2: 1, 3: 3, 4: 3}[stored.shape[2]]
    if all(np.array_equal(stored[..., 0], stored[..., channel]) for channel in range(1, channels)):
        channels = 1
    return Radiometry(channels, float(np.iinfo(stored.dtype).max)).apply(stored)


def page_radiometry(page: TiffPage, path: Path) -> Radiometry:
    """Radiometry of a TIFF page."""
    bits, kind, samples = page.bitspersample, int(page.photometric), page.samplesperpixel
    if not isinstance(bits, int):
        raise unsupported_error(path, f"samples are of {' and '.join(map(str, bits))} bits")
    is_float = page.sampleformat == _FLOATING
    if page.sampleformat not in (_UNSIGNED, _SIGNED, _FLOATING) or not (1 < bits <= 16 or is_float):
        number = {_UNSIGNED: "integers", _SIGNED: "signed integers"}.get(page.sampleformat, "numbers")
        raise unsupported_error(path, f"samples are {number} of {bits} bits")
    if page.imagedepth != 1:
        raise unsupported_error(path, f"it is a volume of {page.imagedepth} slices")
    if kind == _PALETTE and page.colormap is not None:
        palette = np.asarray(page.colormap, np.uint16).T
        if palette.max() < 256:  # of 16 bits, in some old files 8
            palette = palette * np.uint16(257)
        if np.all(palette == palette[:, :1]):
            palette = palette[:, :1]
        return Radiometry(palette.shape[1], WORD_DN, palette=np.ascontiguousarray(palette))
    is_jpeg, plain = page.compression in JPEG_COMPRESSIONS, page.sampleformat == _UNSIGNED
    if kind == _SEPARATED and samples >= 4 and plain and not is_jpeg and page.tags.valueof(_INK_SET, default=1) == 1:
        note = "its colours are inks (CMYK): the luminance of their print is used"
        return Radiometry(1, WORD_DN, inks_full=float(2**bits - 1), bands=4, note=note)
    if kind in (_CIELAB, _ICCLAB) and plain and bits in (8, 16) and not is_jpeg:
        full = _ICCLAB_FULL_DN if kind == _ICCLAB and bits == 16 else float(2**bits - 1)
        return Radiometry(1, full, bands=3, note="its colours are CIE L*a*b*: the lightness L* is used")
    is_colour = kind == _RGB or (kind == _YCBCR and is_jpeg)  # its decoder gives RGB
    if not (kind in (WHITE_IS_ZERO, _BLACK_IS_ZERO) or (is_colour and samples >= 3)):
        name = getattr(page.photometric, "name", str(page.photometric))
        raise unsupported_error(path, f"its colours are {name} with {samples} samples a pixel")
    channels, inverted = 3 if is_colour else 1, kind == WHITE_IS_ZERO
    if is_float:
        note = f"its samples are floating-point numbers of {bits} bits: they are taken in 65535 steps"
        return Radiometry(channels, WORD_DN, inverted, note=note)
    if page.sampleformat == _SIGNED:
        note = f"its samples are signed numbers of {bits} bits: negative ones are taken for 0"
        return Radiometry(channels, float(2 ** (bits - 1) - 1), inverted, note=note)
    return Radiometry(channels, float(2**bits - 1), inverted)


def exif_number(tag: object) -> float | None:
    """Number of an Exif tag, which may be a fraction; None for anything else and for 0."""
    if isinstance(tag, tuple) and len(tag) == 2:
        tag = tag[0] / tag[1] if tag[1] else 0.0
    return (round(tag, 3) or None) if isinstance(tag, float | int) and math.isfinite(tag) else None


def exif_tags(page: TiffPage) -> Mapping[str, Any]:
    """Exif block of a page; empty without one."""
    exif = page.tags.valueof(_EXIF)
    return exif if isinstance(exif, dict) else {}

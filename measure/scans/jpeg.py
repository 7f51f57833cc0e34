"""JPEG files and streams: the picture, decoded whole and checked for damage, its metadata, and the effect of the
compression on marks.

A decoder continues through a damaged stream: after a lost or changed byte it soon reads valid codes again, but the
blocks are displaced. At the end there are then too many or too few blocks. The picture is therefore decoded as if it
were taller. In an intact stream the first block below the picture comes from the bits that pad the last byte, and a
decoder leaves all further blocks grey (ITU-T T.81, B.1.1.5 and F.1.2.3; libjpeg's `insufficient_data`). The rows of the
picture itself are not affected. Progressive streams and streams with restart markers have several such ends, and the
taller picture tests only the last. For these a second decoder, libjpeg-turbo by simplejpeg, reports libjpeg's warnings:
codes that are missing or left over before a marker.

JPEG rounds the cosine coefficients of every block of 8 x 8 pixels to multiples of steps, listed in tables of the file
(B.2.4.1). A TIFF or PNG file made from a JPEG preserves these multiples to some tenths of a grey value, but only in
blocks that begin where those of the JPEG began (Neelamani et al., "JPEG compression history estimation for color
images", IEEE Trans. Image Processing 15, 2006).

The compression removes fine detail of edges and of grain. Residuals contain most of its errors, so that standard
deviations computed from them are right for marks with a contrast of many steps; for faint marks they are too small. The
rounding also makes the two sides of an edge more alike in grey values, whatever the tone curve: this error is common to
the marks of a scanner and does not average out. The remaining grain is an artefact of the compression, and no weights
are derived from it.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import imagecodecs
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from scipy.fft import dct, dctn
from scipy.special import ndtri, stdtrit
from tifffile import TiffFile, TiffPage

from measure.array_types import Array, Single
from measure.errors import MeasurementError
from measure.flags import JPEG_GRID, JPEG_STEP
from measure.scans.cache import OpenedPicture, WholePicture
from measure.scans.metadata import (
    DECODING_ERRORS,
    JFIF_UNIT,
    NO_TAGS,
    PictureForm,
    Pitch,
    damage_error,
    exif_number,
    exif_tags,
    grey_or_colour,
    orientation_notes,
    orientation_tag,
    pitch_from_density,
    tag_pitch,
)
from measure.tone.curve import ColourTags

Decode = Callable[[bytes], NDArray[np.generic]]

JPEG_START, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of frame headers
_HUFFMAN_FRAMES = (0xC0, 0xC1, 0xC2)  # sequential and progressive: others than lossless and arithmetic ones
_SCAN_OR_RESTART = re.compile(rb"\xff[\xda\xd0-\xd7]")  # markers: behind such a byte 255 a scan's data have a byte 0
_OF_DAMAGE = ("Corrupt JPEG data", "Premature end")  # beginnings of libjpeg's warnings of damage
_BLEED_PX = 2  # px, reach of the decoder's interpolation of colour into a block from its neighbours
_BELOW = 2  # rows of blocks added: a picture with one block a row has further ones below its first, too
_TAIL = bytes(range(64, 192)) * 2  # codes of some blocks, none of them a marker
_DQT = 0xDB
UNKNOWN_DN = 15.0  # step assumed if a file has no tables: that of quality 50, below which no scan should be
_INKS = 4  # components
_EXPOSURE = ("FocalLength", "FNumber", "ExposureTime", "ISOSpeedRatings")  # Exif tags of a digital camera
_LONGEST_NAME = 60
_PERIODS = 5  # limit of u + v of the coarser coefficients (u, v): up to two periods in a block, as in blurred edges
_COARSE = _PERIODS * (_PERIODS + 1) // 2  # their number: the first ones in the order of the table

BLOCK_PX = 8  # a side of a block (ITU-T T.81)
_STEPS_DN = np.arange(2, 51)  # a step of 1 changes nothing; 50 is that of quality 15
_BIN_DN = 0.25  # of coefficients: a tenth of the coarser steps
_LARGEST_DN = 150.0  # largest coefficient used: three times the largest step
_LOST_PX = 0.25  # px, times (step / contrast)²: rms error that residuals do not contain (benchmarks/marks.py)
_TONE_LOST = 3.5  # times step / contrast: error of a departure, in prior standard deviations (benchmarks/RESULTS.md)
_MOST_LOST_PX = 1.0  # px, limit of that error: with a contrast of two steps there is nothing left to measure


@dataclass(frozen=True)
class _Blocks:
    """Blocks of a stream: position of the picture's height in the bytes, size of the picture and of a unit of blocks
    (px), and grey value of a block without codes."""

    height_at: int
    height_px: int
    width_px: int
    unit_height_px: int
    unit_width_px: int
    grey: int

    @property
    def rows(self) -> int:
        """Number of rows of pixels in whole units."""
        return -(-self.height_px // self.unit_height_px) * self.unit_height_px

    def taller(self, data: bytes) -> bytes:
        """Stream whose header claims further rows of blocks."""
        height_px = self.rows + _BELOW * self.unit_height_px
        return data[: self.height_at] + height_px.to_bytes(2, "big") + data[self.height_at + 2 :]


def decode_checked(data: bytes, decode: Decode, tables: bytes | None = None) -> tuple[NDArray[np.generic], str]:
    """Decode a stream and check it for damage.

    Parameters
    ----------
    decode : decoder of streams, which may raise any of DECODING_ERRORS.
    tables : stream with the tables that the other one leaves to its file.

    Returns
    -------
    Samples (height, width) or (height, width, channels), and the reason why they cannot be trusted; empty if they can.
    """
    blocks = _blocks(data)
    if blocks is None:
        return decode(data), ""
    taller = decode(blocks.taller(data))
    start = _header_bytes(data)
    has_one_end = len(_SCAN_OR_RESTART.findall(data, start, data.find(JPEG_END, start))) == 1
    why = "" if has_one_end else _libjpeg_warning(data, tables)
    below = taller[blocks.rows + _BLEED_PX :] != blocks.grey
    has_more = below[:, blocks.unit_width_px + _BLEED_PX :].any() or below[blocks.unit_height_px :].any()
    if not why and has_more:
        why = "its stream holds more blocks than the picture"
    elif not why and has_one_end and _ends_early(data, blocks, taller, decode):
        why = "its stream ends before the picture does"
    # With subsampled rows of colour the decoder interpolates the last rows in another way.
    return decode(data) if blocks.unit_height_px > BLOCK_PX else taller[: blocks.height_px], why


def _libjpeg_warning(data: bytes, tables: bytes | None) -> str:
    whole = data if tables is None else data[:2] + tables[2 : tables.rfind(JPEG_END)] + data[2:]
    try:
        simplejpeg.decode_jpeg(whole, "GRAY", min_factor=8, strict=True)
    except ValueError as error:
        # Other errors come from streams that it does not support, such as CMYK.
        message = str(error)
        return f"its decoder says: {message}" if message.startswith(_OF_DAMAGE) else ""
    return ""


def jpeg_form(data: bytes) -> PictureForm | None:
    """Form of a picture by the frame header; None without one."""
    for marker, body in jpeg_headers(data):
        if marker in _FRAMES and len(body) >= 6:
            return PictureForm(int.from_bytes(body[3:5], "big"), int.from_bytes(body[1:3], "big"), body[5], body[0])
    return None


def _blocks(data: bytes) -> _Blocks | None:
    """Blocks of a stream; None for lossless and arithmetic streams, and for those too tall to be made taller."""
    position = 2
    for marker, body in jpeg_headers(data):
        if marker in _HUFFMAN_FRAMES and len(body) >= 6 and len(body) >= 6 + 3 * body[5]:
            factors = body[7 : 7 + 3 * body[5] : 3]
            across, down = max(f >> 4 for f in factors), max(f & 15 for f in factors)
            if len(factors) == 1:  # blocks of a single component are not grouped, whatever its factors
                across = down = 1
            height, width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
            if not (across and down and height and width) or height > 0xFFFF - (_BELOW + 1) * BLOCK_PX * down:
                return None
            return _Blocks(position + 5, height, width, BLOCK_PX * down, BLOCK_PX * across, 2 ** (body[0] - 1))
        position += 4 + len(body)
    return None


def _ends_early(data: bytes, blocks: _Blocks, taller: NDArray[np.generic], decode: Decode) -> bool:
    """Whether the stream lacks the codes of the picture's last block.

    The bits that pad the last byte may decode to one more block. If that is grey, further codes appended to the stream
    leave the picture unchanged, unless blocks are missing, which they then replace.
    """
    rows, tall, wide = blocks.rows, blocks.unit_height_px, blocks.unit_width_px
    first = taller[rows + _BLEED_PX :][: tall - 2 * _BLEED_PX, : wide - _BLEED_PX]
    if (first != blocks.grey).any():
        return False
    last = taller[rows - tall : rows, (blocks.width_px - 1) // wide * wide :]
    if (last != blocks.grey).any():
        return True
    end = data.rfind(JPEG_END)
    again = decode(blocks.taller(data[:end] + _TAIL + data[end:]))
    return not np.array_equal(again[: rows - _BLEED_PX], taller[: rows - _BLEED_PX])


def jpeg_headers(data: bytes) -> list[tuple[int, bytes]]:
    """Marker and body of the segments before the picture's data."""
    headers, position = [], 2
    while position + 4 <= len(data) and data[position] == 0xFF and data[position + 1] not in (0xDA, 0xD9):
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        headers.append((data[position + 1], data[position + 4 : position + 2 + length]))
        position += 2 + max(length, 2)
    return headers


def _header_bytes(data: bytes) -> int:
    return 2 + sum(4 + len(body) for _, body in jpeg_headers(data))


def quantisation_step_dn(data: bytes) -> float:
    """Mean quantisation step of the luminance's coarser detail, in grey values. data: a JPEG file, or its beginning up
    to the picture's data."""
    for marker, body in jpeg_headers(data):
        position = 0
        while marker == _DQT and position < len(body):
            size, number = 1 + (body[position] >> 4), body[position] & 15
            steps = body[position + 1 : position + 1 + 64 * size]
            if number == 0 and len(steps) == 64 * size:
                coarse = (int.from_bytes(steps[size * k : size * (k + 1)], "big") for k in range(_COARSE))
                return sum(coarse) / _COARSE
            position += 1 + 64 * size
    return UNKNOWN_DN


def open_jpeg(path: Path, max_pixels: int | None) -> OpenedPicture:
    """Open and decode a JPEG file. The pixels of a damaged picture count as lost. Raises MeasurementError for a
    truncated file, for a size that exceeds the limits of `check_size`, and for inks."""
    data = path.read_bytes()
    form = jpeg_form(data) or PictureForm(0, 0, 0, 8)
    if form.channels == _INKS:
        raise MeasurementError(
            f"{path} is a JPEG of four inks (CMYK), and its black ink alone may hold the marks: save it as a grey or "
            "RGB picture, or as a CMYK TIFF"
        )
    form.check(path, len(data), max_pixels)
    if JPEG_END not in data[_header_bytes(data) :]:  # a decoder would fill a truncated picture with grey
        raise damage_error(path, "its end marker is missing")
    try:
        decoded, damage = decode_checked(data, imagecodecs.jpeg_decode)
        samples = grey_or_colour(decoded)
    except DECODING_ERRORS as error:
        if not form.width_px * form.height_px:
            raise damage_error(path, str(error)) from error
        samples, damage = np.zeros((form.height_px, form.width_px, 1), np.uint8), str(error)
    picture = WholePicture(samples, quantisation_step_dn(data), damage, 2.0**form.bits - 1)
    exif = _exif_page(data)
    orientation = 1 if exif is None else orientation_tag(exif)
    return OpenedPicture(picture, jpeg_pitch(data), orientation_notes(orientation), orientation=orientation)


def jpeg_pitch(data: bytes) -> Pitch:
    """Read the pitch from the JFIF density, or from the Exif resolution if the former has no unit."""
    pitch = NO_TAGS
    for marker, body in jpeg_headers(data):
        if marker == 0xE0 and body.startswith(b"JFIF\0") and len(body) >= 12:
            unit, x, y = struct.unpack(">BHH", body[7:12])
            pitch = pitch_from_density(x, y, JFIF_UNIT.get(unit))
    exif = _exif_page(data) if pitch.um is None else None
    by_exif = pitch if exif is None else tag_pitch(exif)
    return by_exif if by_exif.um is not None or pitch is NO_TAGS else pitch


def jpeg_camera(data: bytes) -> str:
    """Digital camera that took the picture: maker, model and focal length; "" for a scan, whose Exif block has no
    exposure."""
    page = _exif_page(data)
    exif = {} if page is None else exif_tags(page)
    if page is None or not any(tag in exif for tag in _EXPOSURE):
        return ""
    tags = [page.tags.valueof(name) for name in ("Make", "Model")]
    words = [re.sub(r"[^\w ./-]", " ", tag).split() if isinstance(tag, str) else [] for tag in tags]
    make, model = (" ".join(own)[:_LONGEST_NAME] for own in words)
    name = model if model.lower().startswith(make.split(" ")[0].lower()) else f"{make} {model}".strip()
    focal_mm = exif_number(exif.get("FocalLength"))
    return (name or "a digital camera") + (f", {focal_mm:g} mm" if focal_mm else "")


def _exif_page(data: bytes) -> TiffPage | None:
    """Tags of a stream's Exif block, a small TIFF file without a picture; None without one."""
    for marker, body in jpeg_headers(data):
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            try:
                return TiffFile(BytesIO(body[6:])).pages.first.aspage()
            except DECODING_ERRORS:
                return None
    return None


def jpeg_colour_tags(path: Path) -> ColourTags:
    """Read the tags that declare the tone curve: Exif, and the ICC profile, which may be divided into several segments
    (ICC.1:2022, B.4). Raises one of DECODING_ERRORS."""
    data = path.read_bytes()
    profiles = (body for marker, body in jpeg_headers(data) if marker == 0xE2 and body.startswith(b"ICC_PROFILE\0"))
    pieces = {body[12]: body[14:] for body in profiles}
    exif = _exif_page(data)
    tags = {} if exif is None else {**exif_tags(exif), "Orientation": orientation_tag(exif)}
    return ColourTags(b"".join(pieces[number] for number in sorted(pieces)), exif=tags)


def earlier_compression(grey: NDArray[np.floating]) -> tuple[float, tuple[int, int]]:
    """Find an earlier JPEG compression in a part of a picture.

    Parameters
    ----------
    grey : (height, width) grey values of 8 bits, neither resampled nor stretched since.

    Returns
    -------
    Mean step, in grey values, to which the coarser detail was rounded, 0 where nothing shows that it was; and the
    column and row at which the first whole block begins.
    """
    none = 0.0, (0, 0)
    if min(grey.shape) < 2 * BLOCK_PX:
        return none
    combs = _combs(_coefficients(grey))
    strength = combs.max(axis=2).sum(axis=1)
    best = int(strength.argmax())
    clearness, steps = combs[best].max(axis=1), _STEPS_DN[combs[best].argmax(axis=1)]
    # Test of this place against all others (Student's t).
    others = np.delete(strength, best)
    spread = others.std(ddof=1) * np.sqrt(1 + 1 / len(others))
    limit = -stdtrit(len(others) - 1, JPEG_GRID / (len(others) + 1))
    # Bonferroni correction for the number of combs tried.
    is_clear = clearness.max() >= -float(ndtri(JPEG_GRID / combs.size))
    if not is_clear or not strength[best] - others.mean() > limit * spread:
        return none
    row, col = divmod(best, BLOCK_PX)
    return float(steps[clearness > -float(ndtri(JPEG_STEP / len(_STEPS_DN)))].mean()), (col, row)


def _coefficients(grey: NDArray[np.floating]) -> Array:
    """(places, blocks, coefficients) coarser cosine coefficients of all blocks, for each of the 64 places at which the
    first block may begin."""
    waves = dct(np.eye(BLOCK_PX), axis=0, norm="ortho")[:_PERIODS]
    down = np.lib.stride_tricks.sliding_window_view(grey, BLOCK_PX, axis=0) @ waves.T
    both = np.lib.stride_tricks.sliding_window_view(down, BLOCK_PX, axis=1) @ waves.T
    periods = np.add.outer(range(_PERIODS), range(_PERIODS))
    coarse = both[..., (periods > 0) & (periods < _PERIODS)]  # without means: a uniform background has multiples, too
    tall, wide = (side // BLOCK_PX for side in coarse.shape[:2])
    blocks = coarse[: tall * BLOCK_PX, : wide * BLOCK_PX].reshape(tall, BLOCK_PX, wide, BLOCK_PX, -1)
    return blocks.transpose(1, 3, 0, 2, 4).reshape(BLOCK_PX**2, tall * wide, -1)


def _combs(coefficients: Array) -> Array:
    """(places, coefficients, steps) significance with which the coefficients are multiples of each step, in standard
    deviations of the null hypothesis.

    Coefficients below half a step are ignored. Under the null hypothesis the others lie anywhere between two multiples,
    so that the mean cosine over the step is 0, or negative, since small coefficients are more frequent.
    """
    size = np.abs(coefficients)
    places, _, kinds = size.shape
    bins = int(_LARGEST_DN / _BIN_DN) + 1
    row = np.arange(places)[:, None, None] * kinds + np.arange(kinds)
    bin_of = np.minimum(np.rint(size / _BIN_DN), bins).astype(np.intp)  # the last bin holds those that are too large
    counts = np.bincount((row * (bins + 1) + bin_of).ravel(), minlength=places * kinds * (bins + 1))
    counts = counts.reshape(places * kinds, bins + 1)[:, :bins].astype(float)
    centres = np.arange(bins)[:, None] * _BIN_DN
    counted = centres > _STEPS_DN / 2
    phases = np.cos(2 * np.pi * centres / _STEPS_DN) * counted
    clearness: Array = np.sqrt(2) * (counts @ phases) / np.sqrt(np.maximum(counts @ counted, 1))
    return clearness.reshape(places, kinds, -1)


def covariance_of_compression(quantisation_step_dn: float, contrast_dn: float) -> Array:
    """(2, 2) px², part of a mark's covariance by lossy compression. contrast_dn: in grey values of the file."""
    lost = min(_LOST_PX * (quantisation_step_dn / max(abs(contrast_dn), 1e-9)) ** 2, _MOST_LOST_PX)
    return np.asarray(lost**2 * np.eye(2))


def covariances_of_rounding(
    influences: Single, pictures: Single, origins_px: Array, quantisation_step_dn: float
) -> Array:
    """Covariances of linear estimates by the rounding of cosine coefficients.

    At edges that are sharp relative to the steps, rounding errors resemble shifts of the edges, so that residuals do
    not contain them. An error is uniform over a step; the error of a coefficient rounded to 0 is the coefficient.

    Parameters
    ----------
    influences : (n, 2, height, width) derivatives of n estimates by their pixels.
    pictures : (n, height, width) grey values.
    origins_px : (n, 2) column and row of the first pixel, from a place where a block begins.
    quantisation_step_dn : mean step of coarse detail.

    Returns
    -------
    (n, 2, 2) covariances.
    """
    images = np.concatenate([influences, pictures[:, None]], axis=1)
    number, kinds, height, width = images.shape
    blocks = -(-(max(height, width) + BLOCK_PX - 1) // BLOCK_PX)
    padded = np.zeros((number, kinds, blocks * BLOCK_PX, blocks * BLOCK_PX), np.float32)
    for own, image, (col, row) in zip(padded, images, origins_px.astype(int) % BLOCK_PX, strict=True):
        own[:, row : row + height, col : col + width] = image
    by_block = padded.reshape(number, kinds, blocks, BLOCK_PX, blocks, BLOCK_PX)
    *along, pictured = np.moveaxis(dctn(by_block, axes=(3, 5), norm="ortho"), 1, 0)
    errors = np.minimum(np.abs(pictured), quantisation_step_dn / np.sqrt(12))
    shifts = np.stack(along, axis=1) * errors[:, None]
    flat = shifts.reshape(number, 2, -1)
    return np.asarray(flat @ flat.swapaxes(1, 2), float)


def tone_variance(quantisation_step_dn: float, contrast_dn: float) -> float:
    """Variance of each departure of the tone curve, in units of its prior variance, by lossy compression; common to all
    marks of a scanner. contrast_dn: of the mark, in grey values of the file."""
    return (_TONE_LOST * quantisation_step_dn / max(abs(contrast_dn), 1e-9)) ** 2

"""JPEG files and streams, decoded whole with a check that a stream holds what its header says; and what a compression
takes from a mark's place.

A decoder goes on through a damaged stream: behind a lost or a changed byte it soon reads right codes again, but of
blocks that belong elsewhere. At the end there are then blocks too many or too few. So the picture is decoded as if it
were taller. Of an intact stream the first block below its end is what the bits that fill its last byte make, and no
others are there: a decoder leaves them grey (ITU-T T.81, B.1.1.5 and F.1.2.3; libjpeg's `insufficient_data`). The rows
of the picture itself come out as they would without. Streams of several scans, as progressive ones are, and streams
with restart markers have many such ends, of which this shows the last. There a second decoder is asked, libjpeg-turbo
by simplejpeg, which tells what libjpeg warns of: codes that are missing or left over before a marker.

JPEG rounds the cosine coefficients of every 8 x 8 pixels to multiples of a step, each its own: its tables stand in the
file (B.2.4.1). A TIFF or PNG file made of a JPEG keeps the coefficients so, to some tenths of a grey value: with blocks
begun where those of the JPEG began, and with no others, they lie on a comb. (The principle: Neelamani et al., "JPEG
compression history estimation for color images", IEEE Trans. Image Processing 15, 2006.)

The fine detail goes, a mark's edges and the grain alike. Residuals show most of it, so that a standard deviation from
them is right, where the mark's contrast is many of the file's rounding steps; what faint marks lose of their edges they
do not show. Nor that the two sides of an edge are more alike in grey values than a tone curve leaves them, for rounding
knows of no light: that is common to a scanner's marks, and does not average. The grain that is left is of the
compression's own making, and no weights are taken from it.
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
    MOST_CHANNELS,
    NO_TAGS,
    Pitch,
    check_size,
    damage_error,
    exif_number,
    exif_tags,
    grey_or_colour,
    orientation_notes,
    orientation_tag,
    pitch_from_density,
    tag_pitch,
)
from measure.tone.declared import ColourTags

Decode = Callable[[bytes], NDArray[np.generic]]

JPEG_START = b"\xff\xd8\xff"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of frame headers
_HUFFMAN_FRAMES = (0xC0, 0xC1, 0xC2)  # sequential and progressive: others than lossless and arithmetic ones
_END = b"\xff\xd9"
_SCAN_OR_RESTART = re.compile(rb"\xff[\xda\xd0-\xd7]")  # markers: behind such a byte 255 a scan's data have a byte 0
_OF_DAMAGE = ("Corrupt JPEG data", "Premature end")  # how libjpeg's warnings of it begin
_BLEED_PX = 2  # that the decoder's interpolation of colour takes from the blocks beside
_BELOW = 2  # rows of blocks added: a picture of one block a row has further ones below its first, too
_TAIL = bytes(range(64, 192)) * 2  # codes of some blocks, none of them a marker
_DQT = 0xDB
UNKNOWN_DN = 15.0  # where a file does not say it: as at quality 50, which no scan should be below
_INKS = 4  # components
_EXPOSURE = ("FocalLength", "FNumber", "ExposureTime", "ISOSpeedRatings")  # Exif tags of a digital camera
_LONGEST_NAME = 60
_COARSE = 15  # coefficients in the order of the table: up to two periods in a block of 8 px, as blurred edges have them

BLOCK_PX = 8  # a side of a block (ITU-T T.81)
_PERIODS = 5  # coefficients (u, v) with 0 < u + v below it: up to two periods in a block, as blurred edges have them
_STEPS_DN = np.arange(2, 51)  # a step of 1 takes nothing away; 50 is that of quality 15
_BIN_DN = 0.25  # of coefficients: a tenth of the coarser steps
_LARGEST_DN = 150.0  # of a coefficient that is looked at: three times the largest step
_LOST_PX = 0.25  # times the square of step over contrast: rms of what residuals do not show (benchmarks/marks.py)
_TONE_LOST = 3.5  # times step over contrast, of what is not known of any curve (benchmarks/tone_said.py)
_MOST_LOST_PX = 1.0  # where the contrast is hardly two steps, there is nothing left to measure


@dataclass(frozen=True)
class _Blocks:
    """Where the height of a stream's picture stands, its size and that of a unit of blocks, px, and the grey of a block
    without codes."""

    height_at: int
    height_px: int
    width_px: int
    unit_height_px: int
    unit_width_px: int
    grey: int

    @property
    def rows(self) -> int:
        """Of pixels, in whole units."""
        return -(-self.height_px // self.unit_height_px) * self.unit_height_px

    def taller(self, data: bytes) -> bytes:
        """A stream of a picture with further rows of blocks."""
        height_px = self.rows + _BELOW * self.unit_height_px
        return data[: self.height_at] + height_px.to_bytes(2, "big") + data[self.height_at + 2 :]


def decode_checked(data: bytes, decode: Decode, tables: bytes | None = None) -> tuple[NDArray[np.generic], str]:
    """The samples (height, width) or (height, width, channels) that a stream holds, and why they are not to be trusted;
    empty where they are. decode: a decoder of streams, which may raise what it will. tables: a stream of those tables
    that the other leaves to its file."""
    blocks = _blocks(data)
    if blocks is None:
        return decode(data), ""
    taller = decode(blocks.taller(data))
    start = _header_bytes(data)
    has_one_end = len(_SCAN_OR_RESTART.findall(data, start, data.find(_END, start))) == 1
    why = "" if has_one_end else _libjpeg_warning(data, tables)
    below = taller[blocks.rows + _BLEED_PX :] != blocks.grey
    has_more = below[:, blocks.unit_width_px + _BLEED_PX :].any() or below[blocks.unit_height_px :].any()
    if not why and has_more:
        why = "its stream holds more blocks than the picture"
    elif not why and has_one_end and _ends_early(data, blocks, taller, decode):
        why = "its stream ends before the picture does"
    # Where rows of colour are fewer than those of the picture, the decoder interpolates the last ones otherwise.
    return decode(data) if blocks.unit_height_px > BLOCK_PX else taller[: blocks.height_px], why


def _libjpeg_warning(data: bytes, tables: bytes | None) -> str:
    whole = data if tables is None else data[:2] + tables[2 : tables.rfind(_END)] + data[2:]
    try:
        simplejpeg.decode_jpeg(whole, "GRAY", min_factor=8, strict=True)
    except ValueError as error:
        # What else it raises is of streams that it does not know: CMYK, say.
        message = str(error)
        return f"its decoder says: {message}" if message.startswith(_OF_DAMAGE) else ""
    return ""


def picture_form(data: bytes) -> tuple[int, int, int, int] | None:
    """Width, height, channels and bits of a sample as the frame header says; None without one."""
    for marker, body in jpeg_headers(data):
        if marker in _FRAMES and len(body) >= 6:
            return int.from_bytes(body[3:5], "big"), int.from_bytes(body[1:3], "big"), body[5], body[0]
    return None


def _blocks(data: bytes) -> _Blocks | None:
    """None for streams whose blocks say nothing: lossless and arithmetic ones, and those too tall to be made taller."""
    position = 2
    for marker, body in jpeg_headers(data):
        if marker in _HUFFMAN_FRAMES and len(body) >= 6 and len(body) >= 6 + 3 * body[5]:
            factors = body[7 : 7 + 3 * body[5] : 3]
            across, down = max(f >> 4 for f in factors), max(f & 15 for f in factors)
            if len(factors) == 1:  # its blocks stand by themselves, whatever its factors say
                across = down = 1
            height, width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
            if not (across and down and height and width) or height > 0xFFFF - (_BELOW + 1) * BLOCK_PX * down:
                return None
            return _Blocks(position + 5, height, width, BLOCK_PX * down, BLOCK_PX * across, 2 ** (body[0] - 1))
        position += 4 + len(body)
    return None


def _ends_early(data: bytes, blocks: _Blocks, taller: NDArray[np.generic], decode: Decode) -> bool:
    """Whether the first block below the picture has no codes, nor the picture's last one.

    The bits that fill the last byte may be one more block. Where that is grey, further codes at the end of the stream
    leave the picture as it is; where blocks are missing, they would be taken for these.
    """
    rows, tall, wide = blocks.rows, blocks.unit_height_px, blocks.unit_width_px
    first = taller[rows + _BLEED_PX :][: tall - 2 * _BLEED_PX, : wide - _BLEED_PX]
    if (first != blocks.grey).any():
        return False
    last = taller[rows - tall : rows, (blocks.width_px - 1) // wide * wide :]
    if (last != blocks.grey).any():
        return True
    end = data.rfind(_END)
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


def rounding_step_dn(data: bytes) -> float:
    """The mean step to which the coarser detail of the luminance is rounded, in grey values: from a JPEG file, or its
    beginning up to the picture's data."""
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
    """The picture of a JPEG file, decoded whole. A damaged one is opened: its pixels count as lost. Raises
    MeasurementError for a truncated file, for one that claims more than such a file can hold, and for one of inks."""
    data = path.read_bytes()
    width, height, channels, bits = picture_form(data) or (0, 0, 0, 8)
    if channels == _INKS:
        raise MeasurementError(
            f"{path} is a JPEG of four inks (CMYK), and its black ink alone may hold the marks: save it as a grey or "
            "RGB picture, or as a CMYK TIFF"
        )
    check_size(path, "a picture", (width, height), width * height * MOST_CHANNELS, len(data), max_pixels)
    if _END not in data[_header_bytes(data) :]:  # a decoder would fill a truncated picture with grey
        raise damage_error(path, "its end marker is missing")
    try:
        decoded, damage = decode_checked(data, imagecodecs.jpeg_decode)
        samples = grey_or_colour(decoded)
    except DECODING_ERRORS as error:
        if not width * height:
            raise damage_error(path, str(error)) from error
        samples, damage = np.zeros((height, width, 1), np.uint8), str(error)
    picture = WholePicture(samples, rounding_step_dn(data), damage, 2.0**bits - 1)
    exif = _exif_page(data)
    orientation = 1 if exif is None else orientation_tag(exif)
    return OpenedPicture(picture, jpeg_pitch(data), orientation_notes(orientation), orientation=orientation)


def jpeg_pitch(data: bytes) -> Pitch:
    """The JFIF density, or the Exif resolution where that has no unit."""
    pitch = NO_TAGS
    for marker, body in jpeg_headers(data):
        if marker == 0xE0 and body.startswith(b"JFIF\0") and len(body) >= 12:
            unit, x, y = struct.unpack(">BHH", body[7:12])
            pitch = pitch_from_density(x, y, JFIF_UNIT.get(unit))
    exif = _exif_page(data) if pitch.um is None else None
    by_exif = pitch if exif is None else tag_pitch(exif)
    return by_exif if by_exif.um is not None or pitch is NO_TAGS else pitch


def jpeg_camera(data: bytes) -> str:
    """The digital camera that took a stream's picture, by maker, model and focal length; "" for a scanner's file, whose
    Exif block has no exposure."""
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
    """The tags of a stream's Exif block, which is a small TIFF file without a picture; None where there are none."""
    for marker, body in jpeg_headers(data):
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            try:
                return TiffFile(BytesIO(body[6:])).pages.first.aspage()
            except DECODING_ERRORS:
                return None
    return None


def jpeg_colour_tags(path: Path) -> ColourTags:
    """An ICC profile, which may be cut into several segments (ICC.1:2022, B.4), and Exif. Raises one of
    DECODING_ERRORS."""
    data = path.read_bytes()
    profiles = (body for marker, body in jpeg_headers(data) if marker == 0xE2 and body.startswith(b"ICC_PROFILE\0"))
    pieces = {body[12]: body[14:] for body in profiles}
    exif = _exif_page(data)
    tags = {} if exif is None else {**exif_tags(exif), "Orientation": orientation_tag(exif)}
    return ColourTags(b"".join(pieces[number] for number in sorted(pieces)), exif=tags)


def earlier_step_dn(grey: NDArray[np.floating]) -> float:
    """The mean step, in grey values, to which the coarser detail was rounded; 0 where nothing shows that it was.

    grey: (height, width), a part of the picture in grey values of 8 bits, neither resampled nor stretched since.
    """
    if min(grey.shape) < 2 * BLOCK_PX:
        return 0.0
    combs = _combs(_coefficients(grey))
    strength = combs.max(axis=2).sum(axis=1)
    best = int(strength.argmax())
    clearness, steps = combs[best].max(axis=1), _STEPS_DN[combs[best].argmax(axis=1)]
    # Whether this place differs from all others as chance does not make it (Student's t).
    others = np.delete(strength, best)
    spread = others.std(ddof=1) * np.sqrt(1 + 1 / len(others))
    limit = -stdtrit(len(others) - 1, JPEG_GRID / (len(others) + 1))
    # Of so many looks at no comb, one exceeds the quantile of the probability divided by their number.
    is_clear = clearness.max() >= -float(ndtri(JPEG_GRID / combs.size))
    if not is_clear or not strength[best] - others.mean() > limit * spread:
        return 0.0
    return float(steps[clearness > -float(ndtri(JPEG_STEP / len(_STEPS_DN)))].mean())


def _coefficients(grey: NDArray[np.floating]) -> Array:
    """(places, blocks, coefficients): the coarser cosine coefficients of all blocks, for each of the 64 places where
    the first of them may begin."""
    waves = dct(np.eye(BLOCK_PX), axis=0, norm="ortho")[:_PERIODS]
    down = np.lib.stride_tricks.sliding_window_view(grey, BLOCK_PX, axis=0) @ waves.T
    both = np.lib.stride_tricks.sliding_window_view(down, BLOCK_PX, axis=1) @ waves.T
    periods = np.add.outer(range(_PERIODS), range(_PERIODS))
    coarse = both[..., (periods > 0) & (periods < _PERIODS)]  # no means: ground of one grey value is a comb of its own
    tall, wide = (side // BLOCK_PX for side in coarse.shape[:2])
    blocks = coarse[: tall * BLOCK_PX, : wide * BLOCK_PX].reshape(tall, BLOCK_PX, wide, BLOCK_PX, -1)
    return blocks.transpose(1, 3, 0, 2, 4).reshape(BLOCK_PX**2, tall * wide, -1)


def _combs(coefficients: Array) -> Array:
    """(places, coefficients, steps): how plainly they are multiples of each step, in standard deviations of chance.

    Coefficients below half a step count for nothing. Chance lays the others anywhere between two multiples, so that the
    cosine over the step is 0 in the mean, or below it: there are more small ones than large ones.
    """
    size = np.abs(coefficients)
    places, _, kinds = size.shape
    bins = int(_LARGEST_DN / _BIN_DN) + 1
    row = np.arange(places)[:, None, None] * kinds + np.arange(kinds)
    bin_of = np.minimum(np.rint(size / _BIN_DN), bins).astype(np.intp)  # the last bin holds what is too large
    counts = np.bincount((row * (bins + 1) + bin_of).ravel(), minlength=places * kinds * (bins + 1))
    counts = counts.reshape(places * kinds, bins + 1)[:, :bins].astype(float)
    centres = np.arange(bins)[:, None] * _BIN_DN
    counted = centres > _STEPS_DN / 2
    phases = np.cos(2 * np.pi * centres / _STEPS_DN) * counted
    clearness: Array = np.sqrt(2) * (counts @ phases) / np.sqrt(np.maximum(counts @ counted, 1))
    return clearness.reshape(places, kinds, -1)


def covariance_of_compression(rounding_step_dn: float, contrast_dn: float) -> Array:
    """(2, 2) px2: what a scan's compression adds to the covariance of a mark of that contrast."""
    lost = min(_LOST_PX * (rounding_step_dn / max(abs(contrast_dn), 1e-9)) ** 2, _MOST_LOST_PX)
    return np.asarray(lost**2 * np.eye(2))


def covariances_of_rounding(influences: Single, pictures: Single, origins_px: Array, rounding_step_dn: float) -> Array:
    """What the rounding of cosine coefficients adds to covariances of linear estimates.

    Where edges are sharp against the steps, its errors look like their shifts, so that residuals do not show them. An
    error is uniform over a step; of smaller coefficients, which are rounded to 0, it is the coefficient.

    Parameters
    ----------
    influences : (n, 2, height, width) derivatives of n estimates by their pixels.
    pictures : (n, height, width) grey values.
    origins_px : (n, 2) column and row of the first pixel, from where the blocks begin.
    rounding_step_dn : mean step of coarse detail.

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
    errors = np.minimum(np.abs(pictured), rounding_step_dn / np.sqrt(12))
    shifts = np.stack(along, axis=1) * errors[:, None]
    flat = shifts.reshape(number, 2, -1)
    return np.asarray(flat @ flat.swapaxes(1, 2), float)


def tone_variance(rounding_step_dn: float, contrast_dn: float) -> float:
    """By how much a scan's compression makes a mark of that contrast speak of another tone curve than the scanner's:
    of each departure, in squares of what is not known of any curve; alike in all marks of a scanner."""
    return (_TONE_LOST * rounding_step_dn / max(abs(contrast_dn), 1e-9)) ** 2

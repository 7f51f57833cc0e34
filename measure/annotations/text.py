"""Text on a scan: detected and read beside its exposed frame, and along the inside of the frame's edges.

Each of the four sides is taken as a strip from left to right. Lines are detected in it at two scales, cut out of a
finer image, and read in their four possible orientations, which decides the orientation. Light text on dark film and
dark text on light film are read alike.

The networks are those of PP-OCRv4 (ONNX), run by OpenCV's DNN module. They come with the package rapidocr-onnxruntime
(Apache-2.0), of which only these files are used. Without it no text is read.
"""

import importlib.util
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.annotations.lines import Line, Reading, read_from_one_face
from measure.array_types import Array, Bytes
from measure.marks.shapes import Side
from measure.scans.scan import Scan

PACKAGE = "rapidocr_onnxruntime"
MISSING = (
    "what is written on the film is not read, for the networks that read are not installed: `pip install --no-deps "
    "rapidocr-onnxruntime` does that (without --no-deps it would replace OpenCV)"
)
_DETECTION, _RECOGNITION = "ch_PP-OCRv4_det_infer.onnx", "ch_PP-OCRv4_rec_infer.onnx"
_CHARACTERS = b"\x0a\x09character\x12"  # entry of an ONNX file's metadata: its key, and the tag of its value
_MULTIPLE_PX = 32  # the network needs sides that are multiples of this
_PART_PX = 640  # width of the parts in which text is detected: 45 MiB less than a strip of 1800 px at once
_CONTEXT_PX = 160  # read beside a part; the lines of seven aerial scans read as in whole strips
_WRITTEN = 0.3  # threshold of the probability of a text pixel
_SURE = 0.5  # least mean probability of a line
_LEAST_PX = 4.0  # least height of a detected region, which is less than half of the line's height
_UNSHRUNK = 1.6  # the network shrinks lines by this times area over circumference
_TILT_DEG = 30.0  # steeper lines belong to another side of the frame
_LONG = 1.2  # least ratio of length and height of a word
WAYS = ("0", "180", "0m", "180m")  # possible orientations of a line that runs from left to right
HEIGHT_PX = 48  # height of a line for the recognition network
_CERTAIN = 0.5  # a character of this confidence counts 0, one of confidence 1 counts 1
_BLANK, _BLANK_COLUMNS = 1.5, 1.5  # a blank: step between letters in median steps, and columns above the median
_PLAIN = str.maketrans(
    "′’‘´`″“”：，。．（）－—–／", "'''''\"\"\":,..()---/"
)  # variants of signs that the network knows

# In longer sides of the frame; 1 % is 2.3 mm for an aerial camera.
_BEYOND = 0.13  # searched outside of the frame: its data strip and half of the gap
_WITHIN = 0.045  # searched inside of the frame, where plates and counters reach into it
_ABOUT = 0.02  # search distance around the known place of a line: titles are set by hand
_FINE_PX = 2400  # least longer side of the frame in the image that lines are cut out of
_FOUND_PX = (1800, 900)  # the same for detection: plates of 1.5 mm, then handwriting
_LEAST_STRIP_PX = 12  # least side of a strip
_LONGEST_PX = 1600  # largest length of a line at reading height
_BLACK, _WHITE = 0.5, 99.5  # percentiles of a strip's grey values mapped to black and white
_LEAST_LEGIBLE = 1.5  # characters; less is a speck that resembles a letter
_READ_WELL = 0.6  # mean confidence above which a line is not read again at a coarser scale


@dataclass(frozen=True, eq=False)
class Networks:
    """detection: probability of text for each pixel; recognition: characters of one line, column by column; characters:
    by class number, the first one blank."""

    detection: cv2.dnn.Net
    recognition: cv2.dnn.Net
    characters: tuple[str, ...]


@cache
def networks() -> Networks | None:
    """Load the networks once per process; None where they are missing."""
    spec = importlib.util.find_spec(PACKAGE)  # not imported, since it needs another runtime
    if spec is None:
        return None
    models = resources.files(importlib.util.module_from_spec(spec)) / "models"
    files = (models / _DETECTION, models / _RECOGNITION)
    if not all(file.is_file() for file in files):
        return None
    contents = [file.read_bytes() for file in files]
    detection, recognition = (cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8)) for content in contents)
    # The characters are in the metadata of the ONNX file, to which OpenCV gives no access.
    length = re.compile(_CHARACTERS + rb"([\x80-\xff]*[\0-\x7f])").search(contents[1])
    assert length is not None
    size = sum((byte & 127) << 7 * place for place, byte in enumerate(length[1]))  # a protocol-buffer varint
    characters = contents[1][length.end() : length.end() + size].decode().split("\n")
    return Networks(detection, recognition, ("", *characters, " "))


@dataclass(frozen=True)
class Place:
    """Rectangle around a line: centre (column, row), length and height, px; tilt_deg: from the rows, clockwise."""

    center_px: tuple[float, float]
    length_px: float
    height_px: float
    tilt_deg: float

    def outline_px(self) -> Array:
        """(4, 2) corners, clockwise from the start of the line."""
        rectangle = self.center_px, (self.length_px, self.height_px), self.tilt_deg
        return np.roll(np.asarray(cv2.boxPoints(rectangle), float), -1, axis=0)

    def scaled(self, factor: float) -> "Place":
        """The place in an image that is enlarged by a factor."""
        col, row = ((place + 0.5) * factor - 0.5 for place in self.center_px)
        return Place((col, row), factor * self.length_px, factor * self.height_px, self.tilt_deg)

    def covers(self, other: "Place") -> bool:
        """Whether the centre of the other place lies in it."""
        outline = self.outline_px().astype(np.float32)
        return cv2.pointPolygonTest(outline, other.center_px, False) >= 0


def find_writing(picture: Bytes, networks: Networks) -> list[Place]:
    """Detect the lines of text in an image (rows, columns), in arbitrary order. The probability of text of each pixel
    is computed in parts that lie beside one another."""
    parts = []
    for start in range(0, picture.shape[1], _PART_PX):
        first = max(start - _CONTEXT_PX, 0)
        part = picture[:, first : start + _PART_PX + _CONTEXT_PX]
        height, width = part.shape
        below, right = -height % _MULTIPLE_PX, -width % _MULTIPLE_PX
        padded = cv2.copyMakeBorder(part, 0, below, 0, right, cv2.BORDER_REPLICATE)
        networks.detection.setInput(_input(np.asarray(padded, np.uint8)))
        found = np.asarray(networks.detection.forward()[0, 0, :height, :width], np.float32)
        parts.append(found[:, start - first :][:, :_PART_PX].copy())
    probability = np.concatenate(parts, axis=1)
    written = (probability > _WRITTEN).astype(np.uint8)
    contours, _ = cv2.findContours(written, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    places = (_place(np.asarray(contour), probability) for contour in contours)
    return [place for place in places if place is not None]


def _place(contour: NDArray[np.int32], probability: NDArray[np.float32]) -> Place | None:
    """Rectangle of a detected region, enlarged, since the network shrinks lines to keep them apart; None if it is not a
    line."""
    center, (length, height), angle = cv2.minAreaRect(contour)
    if length < height:
        length, height, angle = height, length, angle + 90.0
    tilt = (angle + 90.0) % 180.0 - 90.0
    if height < _LEAST_PX or abs(tilt) > _TILT_DEG:
        return None
    col, row, wide, tall = cv2.boundingRect(contour)
    inside = np.zeros((tall, wide), np.uint8)
    cv2.drawContours(inside, [contour], -1, 1, -1, offset=(-col, -row))
    if float(probability[row : row + tall, col : col + wide][inside > 0].mean()) < _SURE:
        return None
    grown = _UNSHRUNK * length * height / (length + height)
    place = Place((float(center[0]), float(center[1])), length + grown, height + grown, tilt)
    return place if place.length_px >= _LONG * place.height_px else None


def read_ways(line: Bytes, networks: Networks) -> Mapping[str, Reading]:
    """Read the image of a line (HEIGHT_PX, width) in all four orientations: upright, upside down, mirrored, both."""
    readings = dict[str, Reading]()
    turned = (line, line[::-1, ::-1], line[:, ::-1], line[::-1])
    for way, picture in zip(WAYS, turned, strict=True):  # one by one, which takes a quarter of the memory
        networks.recognition.setInput(_input(picture))
        readings[way] = _decoded(np.asarray(networks.recognition.forward()[0]), networks.characters)
    return readings


def _input(picture: Bytes) -> NDArray[np.float32]:
    """(1, 3, rows, columns) values from -1 to 1, as the networks take an image."""
    grey = np.asarray(picture, np.float32) / 127.5 - 1.0
    return np.ascontiguousarray(np.repeat(grey[None, None], 3, axis=1))


def _decoded(probabilities: NDArray[np.float32], characters: Sequence[str]) -> Reading:
    """Decode the class probabilities of the columns (columns, characters) by connectionist temporal classification:
    repeated characters are merged, blanks dropped. Characters outside ASCII are ignored."""
    best = probabilities.argmax(axis=1)
    starts = np.flatnonzero((best > 0) & np.concatenate([[True], best[1:] != best[:-1]]))
    read = [characters[best[column]].translate(_PLAIN) for column in starts]
    kept = [index for index, character in enumerate(read) if character.isascii()]
    starts, text = starts[kept], "".join(read[index] for index in kept)
    letters = np.array([letter != " " for letter in text], dtype=bool)
    confidences = probabilities.max(axis=1)[starts][letters].astype(float)
    legible = float(((confidences - _CERTAIN) / (1.0 - _CERTAIN)).clip(0.0).sum())
    # Blanks are inserted where letters are clearly farther apart: the network reports few.
    steps = np.diff(starts, prepend=starts[:1])
    usual = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
    wide = steps >= max(_BLANK * usual, usual + _BLANK_COLUMNS)
    spaced = "".join(f" {letter}" if gap else letter for letter, gap in zip(text, wide, strict=True))
    return Reading(" ".join(spaced.split()), float(confidences.mean()) if len(confidences) else 0.0, legible)


def read_writing(
    scan: Scan,
    networks: Networks,
    frame_px: Array | None = None,
    about: tuple[Side, Array] | None = None,
    enough: Callable[[Sequence[Line]], bool] = lambda _: False,
) -> tuple[Line, ...]:
    """Read the lines of text on a scan, from the side of the film with more legible text, the longest first.

    Parameters
    ----------
    frame_px : (n, 2) column and row of the corners of the exposed frame. None: the edges of the scan are read instead.
    about : side and outline (n, 2), px, of a known line; only its surroundings are read.
    enough : returns whether the lines read so far suffice; the remaining sides are then skipped.
    """
    places = [(side, None) for side in get_args(Side)] if about is None else [about]
    lines = list[Line]()
    for side, outline_px in places:
        strip = _strip(scan, side, frame_px, outline_px)
        lines += [] if strip is None else strip.lines(networks)
        if enough(read_from_one_face(lines)):
            break
    return read_from_one_face(lines)


@dataclass(frozen=True, eq=False)
class _Strip:
    """A side of the scan as an image from left to right. scan_from_strip (2, 3): pixels; poses: orientation in the scan
    by orientation in the strip; found: reduction factors of the images for detection."""

    picture: Bytes
    side: Side
    scan_from_strip: Array
    poses: Mapping[str, str]
    found: tuple[float, ...]

    def lines(self, networks: Networks) -> list[Line]:
        lines, known = list[Line](), list[Place]()
        for reduction in self.found:
            size = [max(round(side / reduction), 1) for side in self.picture.shape[::-1]]
            small = cv2.resize(self.picture, size, interpolation=cv2.INTER_AREA) if reduction > 1 else self.picture
            for place in (each.scaled(reduction) for each in find_writing(np.asarray(small, np.uint8), networks)):
                if any(other.covers(place) or place.covers(other) for other in known):
                    continue
                ways = {self.poses[way]: reading for way, reading in read_ways(self._cut(place), networks).items()}
                pose, reading = max(ways.items(), key=lambda item: item[1].legible)
                if reading.legible >= _LEAST_LEGIBLE:
                    outline = place.outline_px() @ self.scan_from_strip[:, :2].T + self.scan_from_strip[:, 2]
                    corners = tuple((float(col), float(row)) for col, row in outline)
                    lines.append(Line(ways, pose, corners, self.side))
                    known += [place] if reading.confidence >= _READ_WELL else []
        return lines

    def _cut(self, place: Place) -> Bytes:
        """Rectified image of a line (HEIGHT_PX, width)."""
        scale = place.height_px / HEIGHT_PX
        width = int(np.clip(round(place.length_px / scale), HEIGHT_PX // 2, _LONGEST_PX))
        angle = np.deg2rad(place.tilt_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        linear = turn * (place.length_px / width, scale)
        start = place.center_px - linear @ np.array([(width - 1) / 2, (HEIGHT_PX - 1) / 2])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        matrix = np.column_stack([linear, start])
        cut = cv2.warpAffine(self.picture, matrix, (width, HEIGHT_PX), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cut, np.uint8)


def _strip(scan: Scan, side: Side, frame_px: Array | None, outline_px: Array | None) -> _Strip | None:
    """Strip at a side of the frame, or around a known line; None if it is empty."""
    low, high, longer_px = _side_range(scan, side, frame_px)
    if outline_px is not None:
        low = np.maximum(low, outline_px.min(axis=0) - _ABOUT * longer_px)
        high = np.minimum(high, outline_px.max(axis=0) + _ABOUT * longer_px)
    factor = max(int(longer_px / _FINE_PX), 1)
    first = np.floor(low / factor).astype(int)
    last = np.minimum(np.ceil(high / factor).astype(int), (scan.width_px // factor, scan.height_px // factor))
    width, height = (last - first).tolist()
    if min(width, height) < _LEAST_STRIP_PX:
        return None
    reduced = scan.reduced_window(factor, int(first[0]), int(first[1]), width, height)
    black, white = np.percentile(reduced[::2, ::2], (_BLACK, _WHITE))
    grey = (255 * (reduced - black) / max(white - black, 1e-9)).clip(0, 255).astype(np.uint8)
    turn = side in ("left", "right")  # rotated clockwise by a quarter turn: its columns run upward in the scan
    linear = factor * (np.array([[0.0, 1.0], [-1.0, 0.0]]) if turn else np.eye(2))
    start = factor * (first + ((0, height - 1) if turn else (0, 0))) + (factor - 1) / 2
    return _Strip(
        picture=np.ascontiguousarray(np.rot90(grey, -1) if turn else grey),
        side=side,
        scan_from_strip=np.column_stack([linear, start]),
        poses=dict(zip(WAYS, ("90", "270", "90m", "270m") if turn else WAYS, strict=True)),
        found=tuple(max(longer_px / factor / pixels, 1.0) for pixels in _FOUND_PX),
    )


def _side_range(scan: Scan, side: Side, frame_px: Array | None) -> tuple[Array, Array, float]:
    """Start and end (column, row), px, of the area read at a side, and the frame's longer side."""
    low, high = np.zeros(2), np.array([scan.width_px, scan.height_px], dtype=float)
    longer_px = float(high.max())
    inner_low, inner_high = low + _BEYOND * longer_px, high - _BEYOND * longer_px
    if frame_px is not None:
        longer_px = float(np.ptp(frame_px, axis=0).max())
        corners = np.sort(frame_px, axis=0)  # a frame may be turned a little
        half = len(corners) // 2
        low = np.maximum(low, corners[0] - _BEYOND * longer_px)
        high = np.minimum(high, corners[-1] + _BEYOND * longer_px)
        inner_low, inner_high = corners[half - 1] + _WITHIN * longer_px, corners[half] - _WITHIN * longer_px
    axis = 0 if side in ("left", "right") else 1
    if side in ("left", "top"):
        high[axis] = inner_low[axis]
    else:
        low[axis] = inner_high[axis]
    return low, high, longer_px

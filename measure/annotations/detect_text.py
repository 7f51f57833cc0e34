"""Text detection and recognition by the networks of PP-OCRv4 (ONNX), run by OpenCV's DNN module.

The networks come with the package rapidocr-onnxruntime (Apache-2.0), of which only these files are used. Without it no
text is read.
"""

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.annotations.fields import Reading

Picture = NDArray[np.uint8]
Array = NDArray[np.float64]

PACKAGE = "rapidocr_onnxruntime"
MISSING = (
    "what is written on the film is not read, for the networks that read are not installed: `pip install --no-deps "
    "rapidocr-onnxruntime` does that (without --no-deps it would replace OpenCV)"
)
_DETECTION, _RECOGNITION = "ch_PP-OCRv4_det_infer.onnx", "ch_PP-OCRv4_rec_infer.onnx"
_METADATA, _KEY, _VALUE = 14, 1, 2  # field numbers of an ONNX ModelProto, and of an entry of its metadata
_BYTES = 2  # protocol-buffer wire type of strings and messages; other top-level fields are integers
_MULTIPLE_PX = 32  # the network needs sides that are multiples of this
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
    files = _files()
    if not files:
        return None
    detection, recognition = (file.read_bytes() for file in files)
    written = _metadata(recognition)["character"]
    return Networks(_net(detection), _net(recognition), ("", *written.split("\n"), " "))


def _files() -> tuple[Traversable, ...]:
    """Files of both networks, none if one is missing. The package is not imported, since it needs another runtime."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None:
        return ()
    models = resources.files(importlib.util.module_from_spec(spec)) / "models"
    files = (models / _DETECTION, models / _RECOGNITION)
    return files if all(file.is_file() for file in files) else ()


def _net(model: bytes) -> cv2.dnn.Net:
    return cv2.dnn.readNetFromONNX(np.frombuffer(model, np.uint8))


def _metadata(model: bytes) -> dict[str, str]:
    """Metadata of an ONNX file, which OpenCV does not give access to."""
    entries = [dict(_fields(value)) for field, value in _fields(model) if field == _METADATA]
    return {entry[_KEY].decode(): entry[_VALUE].decode() for entry in entries}


def _fields(message: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield number and content of the string and message fields of a protocol-buffer message."""
    place = 0
    while place < len(message):
        tag, place = _number(message, place)
        value, place = _number(message, place)
        if tag & 7 == _BYTES:
            yield tag >> 3, message[place : place + value]
            place += value


def _number(message: bytes, place: int) -> tuple[int, int]:
    """Decode a variable-length integer; returns it and the next position."""
    value = shift = 0
    while True:
        byte = message[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place


@dataclass(frozen=True)
class Place:
    """Rectangle around a line: centre (column, row), length and height, px; tilt_deg: from the rows, clockwise."""

    center_px: tuple[float, float]
    length_px: float
    height_px: float
    tilt_deg: float

    def outline_px(self) -> Array:
        """(4, 2) corners, clockwise from the start of the line."""
        angle = np.deg2rad(self.tilt_deg)
        along, down = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2.0
        corners = half[:, :1] * self.length_px * along + half[:, 1:] * self.height_px * down
        return np.asarray(corners + self.center_px)

    def scaled(self, factor: float) -> "Place":
        """The place in an image that is enlarged by a factor."""
        col, row = ((place + 0.5) * factor - 0.5 for place in self.center_px)
        return Place((col, row), factor * self.length_px, factor * self.height_px, self.tilt_deg)

    def covers(self, other: "Place") -> bool:
        """Whether the centre of the other place lies in it."""
        outline = self.outline_px().astype(np.float32)
        return cv2.pointPolygonTest(outline, other.center_px, False) >= 0


def find_writing(picture: Picture, networks: Networks) -> list[Place]:
    """Detect the lines of text in an image (rows, columns), in arbitrary order."""
    probability = _probability(picture, networks)
    written = (probability > _WRITTEN).astype(np.uint8)
    contours, _ = cv2.findContours(written, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    places = (_place(np.asarray(contour), probability) for contour in contours)
    return [place for place in places if place is not None]


def _probability(picture: Picture, networks: Networks) -> NDArray[np.float32]:
    height, width = picture.shape
    below, right = -height % _MULTIPLE_PX, -width % _MULTIPLE_PX
    padded = cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_REPLICATE)
    grey = np.asarray(padded, np.float32) / 127.5 - 1.0
    networks.detection.setInput(np.repeat(grey[None, None], 3, axis=1))
    return np.asarray(networks.detection.forward()[0, 0, :height, :width], np.float32)


def _place(contour: NDArray[np.int32], probability: NDArray[np.float32]) -> Place | None:
    """Rectangle of a detected region, enlarged, since the network shrinks lines to keep them apart; None if it is not a
    line."""
    center, (length, height), angle = cv2.minAreaRect(contour)
    if length < height:
        length, height, angle = height, length, angle + 90.0
    tilt = (angle + 90.0) % 180.0 - 90.0
    if height < _LEAST_PX or abs(tilt) > _TILT_DEG or _mean_probability(contour, probability) < _SURE:
        return None
    grown = _UNSHRUNK * length * height / (length + height)
    place = Place((float(center[0]), float(center[1])), length + grown, height + grown, tilt)
    return place if place.length_px >= _LONG * place.height_px else None


def _mean_probability(contour: NDArray[np.int32], probability: NDArray[np.float32]) -> float:
    col, row, width, height = cv2.boundingRect(contour)
    inside = np.zeros((height, width), np.uint8)
    cv2.drawContours(inside, [contour], -1, 1, -1, offset=(-col, -row))
    return float(probability[row : row + height, col : col + width][inside > 0].mean())


def read_ways(line: Picture, networks: Networks) -> Mapping[str, Reading]:
    """Read the image of a line (HEIGHT_PX, width) in all four orientations: upright, upside down, mirrored, both."""
    ways = (line, line[::-1, ::-1], line[:, ::-1], line[::-1])
    return dict(zip(WAYS, _read(ways, networks), strict=True))


def _read(pictures: Sequence[Picture], networks: Networks) -> list[Reading]:
    grey = np.stack(pictures).astype(np.float32) / 127.5 - 1.0
    networks.recognition.setInput(np.ascontiguousarray(np.repeat(grey[:, None], 3, axis=1)))
    return [_decoded(np.asarray(each), networks.characters) for each in networks.recognition.forward()]


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
    return Reading(_spaced(text, starts), float(confidences.mean()) if len(confidences) else 0.0, legible)


def _spaced(text: str, columns: NDArray[np.int_]) -> str:
    """Insert blanks where letters are clearly farther apart, since the network reports few blanks."""
    steps = np.diff(columns, prepend=columns[:1])
    usual = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
    wide = steps >= max(_BLANK * usual, usual + _BLANK_COLUMNS)
    spaced = "".join(f" {letter}" if gap else letter for letter, gap in zip(text, wide, strict=True))
    return " ".join(spaced.split())

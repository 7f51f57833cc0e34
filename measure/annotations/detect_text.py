"""Writing by networks, those of PP-OCRv4 in ONNX run by OpenCV's DNN module: where in a picture there is some, and the
characters of a line in the ways in which it may lie.

The networks come in the package rapidocr-onnxruntime (Apache-2.0), of which nothing but these files is used. Where it
is not installed nothing is read.
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
_METADATA, _KEY, _VALUE = 14, 1, 2  # fields of an ONNX ModelProto, and of an entry of its metadata
_BYTES = 2  # the wire type of a field that is a string or a message; the others at the top are whole numbers
_MULTIPLE_PX = 32  # that the network asks of a picture's sides
_WRITTEN = 0.3  # probability of a pixel to be writing
_SURE = 0.5  # the least mean probability of a place
_LEAST_PX = 4.0  # of what the network draws of a line's height, which is less than half of it
_UNSHRUNK = 1.6  # times area over circumference: by so much the network draws less than the line
_TILT_DEG = 30.0  # what runs more steeply belongs to another side of the frame
_LONG = 1.2  # times its height: what is shorter is no word
WAYS = ("0", "180", "0m", "180m")  # in which a line may lie that runs from left to right
HEIGHT_PX = 48  # of a line, as the network reads it
_CERTAIN = 0.5  # a character of this confidence counts nothing, one of 1 as a whole
_BLANK, _BLANK_COLUMNS = 1.5, 1.5  # times the usual step from letter to letter, and columns more than it
_PLAIN = str.maketrans("′’‘´`″“”：，。．（）－—–／", "'''''\"\"\":,..()---/")  # signs for which the network knows many


@dataclass(frozen=True, eq=False)
class Networks:
    """detection: where there is writing, a probability a pixel; recognition: the characters of one line, column by
    column. characters: by the numbers that the recognition gives them, the first being none."""

    detection: cv2.dnn.Net
    recognition: cv2.dnn.Net
    characters: tuple[str, ...]


@cache
def networks() -> Networks | None:
    """The networks, loaded when they are first asked for and kept in this process; None where they are missing."""
    files = _files()
    if not files:
        return None
    detection, recognition = (file.read_bytes() for file in files)
    written = _metadata(recognition)["character"]
    return Networks(_net(detection), _net(recognition), ("", *written.split("\n"), " "))


def _files() -> tuple[Traversable, ...]:
    """The files of both networks, none where one is missing. The package is not imported: it would ask for a runtime
    of its own."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None:
        return ()
    models = resources.files(importlib.util.module_from_spec(spec)) / "models"
    files = (models / _DETECTION, models / _RECOGNITION)
    return files if all(file.is_file() for file in files) else ()


def _net(model: bytes) -> cv2.dnn.Net:
    return cv2.dnn.readNetFromONNX(np.frombuffer(model, np.uint8))


def _metadata(model: bytes) -> dict[str, str]:
    """The metadata of an ONNX file: OpenCV does not hand them out."""
    entries = [dict(_fields(value)) for field, value in _fields(model) if field == _METADATA]
    return {entry[_KEY].decode(): entry[_VALUE].decode() for entry in entries}


def _fields(message: bytes) -> Iterator[tuple[int, bytes]]:
    """Numbers and contents of the fields of a protocol-buffer message that are strings or messages."""
    place = 0
    while place < len(message):
        tag, place = _number(message, place)
        value, place = _number(message, place)
        if tag & 7 == _BYTES:
            yield tag >> 3, message[place : place + value]
            place += value


def _number(message: bytes, place: int) -> tuple[int, int]:
    """A whole number of variable length, and the place behind it."""
    value = shift = 0
    while True:
        byte = message[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place


@dataclass(frozen=True)
class Place:
    """A rectangle about a line: centre (column, row), length and height in px; tilt_deg: from the rows, clockwise."""

    center_px: tuple[float, float]
    length_px: float
    height_px: float
    tilt_deg: float

    def outline_px(self) -> Array:
        """(4, 2) corners, clockwise from where it begins."""
        angle = np.deg2rad(self.tilt_deg)
        along, down = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2.0
        corners = half[:, :1] * self.length_px * along + half[:, 1:] * self.height_px * down
        return np.asarray(corners + self.center_px)

    def scaled(self, factor: float) -> "Place":
        """In a picture that is so many times as large."""
        col, row = ((place + 0.5) * factor - 0.5 for place in self.center_px)
        return Place((col, row), factor * self.length_px, factor * self.height_px, self.tilt_deg)

    def covers(self, other: "Place") -> bool:
        """Whether the middle of the other lies in it."""
        outline = self.outline_px().astype(np.float32)
        return cv2.pointPolygonTest(outline, other.center_px, False) >= 0


def find_writing(picture: Picture, networks: Networks) -> list[Place]:
    """The lines in a picture (rows, columns), in no order that means anything."""
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
    """The network draws a line narrower than it is, so that neighbours stay apart."""
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
    """A line's picture (HEIGHT_PX, width) as it reads upright, turned by half, mirrored, and both, by pose."""
    ways = (line, line[::-1, ::-1], line[:, ::-1], line[::-1])
    return dict(zip(WAYS, _read(ways, networks), strict=True))


def _read(pictures: Sequence[Picture], networks: Networks) -> list[Reading]:
    grey = np.stack(pictures).astype(np.float32) / 127.5 - 1.0
    networks.recognition.setInput(np.ascontiguousarray(np.repeat(grey[:, None], 3, axis=1)))
    return [_decoded(np.asarray(each), networks.characters) for each in networks.recognition.forward()]


def _decoded(probabilities: NDArray[np.float32], characters: Sequence[str]) -> Reading:
    """The likeliest character of each column (columns, characters): one that repeats at once is one, the first of all
    is none (connectionist temporal classification). What no Latin keyboard writes is not taken for writing."""
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
    """The text with blanks where letters stand plainly farther apart: the network sees few blanks itself."""
    steps = np.diff(columns, prepend=columns[:1])
    usual = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
    wide = steps >= max(_BLANK * usual, usual + _BLANK_COLUMNS)
    spaced = "".join(f" {letter}" if gap else letter for letter, gap in zip(text, wide, strict=True))
    return " ".join(spaced.split())

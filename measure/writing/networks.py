"""The networks that find and read writing: those of PP-OCRv4 in ONNX, run by OpenCV's DNN module.

They lie in the package rapidocr-onnxruntime (Apache-2.0), of which nothing but these files is used. Where it is not
installed nothing is read.
"""

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable

import cv2
import numpy as np

PACKAGE = "rapidocr_onnxruntime"
MISSING = (
    "what is written on the film is not read, for the networks that read are not installed: `pip install --no-deps "
    "rapidocr-onnxruntime` does that (without --no-deps it would replace OpenCV)"
)
_DETECTION, _RECOGNITION = "ch_PP-OCRv4_det_infer.onnx", "ch_PP-OCRv4_rec_infer.onnx"
_METADATA, _KEY, _VALUE = 14, 1, 2  # fields of an ONNX ModelProto, and of an entry of its metadata
_BYTES = 2  # the wire type of a field that is a string or a message; the others at the top are whole numbers


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

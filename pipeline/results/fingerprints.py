"""Fingerprints: of values, whatever file they came from, of whole files, and of scans, which are too large for that."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.text.text_file import read_bytes

_PLAIN = {str, int, bool, type(None)}  # most values by far
NO_FINGERPRINT = {"fingerprint": False}  # metadata of a field that tells nothing of a value
_PIECES, _PIECE = 8, 32768  # of a scan, spread evenly from its first byte to its last


def fingerprint(value: object) -> str:
    """SHA-256 of a value made of dataclasses, mappings, sequences, arrays, numbers and text."""
    return of_content(canonical_json(value).encode("utf-8", "surrogateescape"))


def canonical_json(value: object) -> str:
    """Such a value as JSON: equal values give equal text, and any other value gives another.

    The order of a mapping does not count, nor where a file stands: a project may be moved, and its files rewritten. Nor
    do fields of dataclasses that are NO_FINGERPRINT by their metadata.
    Arrays are told by their form and the SHA-256 of their numbers, numbers that are not finite by their names.
    """
    return json.dumps(_json(value), ensure_ascii=False, allow_nan=False, sort_keys=True, separators=(",", ":"))


def of_content(data: bytes) -> str:
    """SHA-256 of the content of a file."""
    return hashlib.sha256(data).hexdigest()


def of_file(path: Path) -> str:
    """The same, the file read here."""
    return of_content(read_bytes(path))


def of_scan(path: Path) -> str:
    """Its size, and SHA-256 of pieces of its file. "" where it cannot be read."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            pieces = []
            for number in range(_PIECES):
                file.seek(max(size - _PIECE, 0) * number // (_PIECES - 1))
                pieces.append(file.read(_PIECE))
    except OSError:
        return ""
    return fingerprint([size, *map(of_content, pieces)])


def _json(value: Any) -> Any:
    if value.__class__ in _PLAIN or (value.__class__ is float and math.isfinite(value)):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        told = {one.name: _json(getattr(value, one.name)) for one in fields(value) if one.metadata != NO_FINGERPRINT}
        return {"is": type(value).__name__, **told}
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value):
            return {str(key): _json(item) for key, item in value.items()}
        return {"pairs": sorted(([_json(key), _json(item)] for key, item in value.items()), key=json.dumps)}
    if isinstance(value, np.ndarray):
        return {"array": f"{value.dtype.str}{value.shape}", "sha256": of_content(np.ascontiguousarray(value).tobytes())}
    if isinstance(value, Set):
        return _json(sorted(value, key=str))
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_json(item) for item in value]
    if isinstance(value, np.generic):
        return _json(value.item())
    if isinstance(value, Path):
        return value.name
    if isinstance(value, float) and not math.isfinite(value):
        return {"number": repr(value)}
    if isinstance(value, str):
        return str(value)
    if value is None or isinstance(value, bool | int | float):
        return value
    raise TypeError(f"no fingerprint is known of {type(value).__name__}")

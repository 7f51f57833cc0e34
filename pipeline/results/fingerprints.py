"""Fingerprints: of values, whatever file they came from, of whole files, and of scans, which are too large for that."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.text.text_file import read_bytes

_PIECES, _PIECE = 8, 32768  # of a scan, spread evenly from its first byte to its last


def fingerprint(value: object) -> str:
    """SHA-256 of a value made of dataclasses, mappings, sequences, arrays, numbers and text.

    The order of a mapping does not count, nor where a file stands: a project may be moved, and its files rewritten.
    """
    digest = hashlib.sha256()
    for part in _parts(value):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


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


def _parts(value: Any) -> Iterator[bytes]:
    if is_dataclass(value) and not isinstance(value, type):
        yield from _parts({field.name: getattr(value, field.name) for field in fields(value)})
    elif isinstance(value, Mapping):
        yield b"{%d" % len(value)
        for key in sorted(value, key=str):
            yield from _parts(key)
            yield from _parts(value[key])
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, Set):
        yield from _parts(sorted(value, key=str))
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        yield b"[%d" % len(value)
        for item in value:
            yield from _parts(item)
    elif isinstance(value, np.generic):
        yield from _parts(value.item())
    elif isinstance(value, Path):
        yield value.name.encode("utf-8", "surrogateescape")
    elif isinstance(value, str):
        yield b"'" + str(value).encode("utf-8", "surrogateescape")
    elif value is None or isinstance(value, bool | int | float | complex):
        yield repr(value).encode()
    else:
        raise TypeError(f"no fingerprint is known of {type(value).__name__}")

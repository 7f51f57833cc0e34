"""Reading of whole files, regular ones of limited size, and of JSON with finite numbers."""

import json
import stat
from pathlib import Path
from typing import Any

from pipeline.errors import InputError

MOST_MB = 200  # MB; a comparator file of 50,000 scans has 50
SHOWN = 60  # characters of a wrong value quoted in a message

_KINDS = {
    stat.S_ISFIFO: "a pipe",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
    stat.S_ISSOCK: "a socket",
}
LARGEST = 1e15  # limit of coordinates, sizes and standard deviations, any unit: squares of larger ones lose precision
SMALLEST_SIGMA = 1e-9  # limit of standard deviations, mm, m or degrees: weights of smaller ones dominate all others


FINEST_PITCH_UM = 0.1  # µm; no scanner or sensor has smaller pixels, so that mm or m must have been meant


def read_bytes(path: Path, most_mb: int = MOST_MB) -> bytes:
    """Read the content of a file.

    Raises FileNotFoundError and IsADirectoryError, for which the caller has a better message, and InputError for a file
    that is not regular (a pipe would block, a device has no end), too large, or unreadable.
    """
    try:
        found = path.stat()
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(path)
        if not stat.S_ISREG(found.st_mode):
            kind = next((kind for is_kind, kind in _KINDS.items() if is_kind(found.st_mode)), "something else")
            raise InputError(f"{path}: is {kind}; a regular file is needed here. Copy its content into one.")
        with path.open("rb") as file:
            data = file.read(most_mb * 1_000_000 + 1)
    except (FileNotFoundError, IsADirectoryError):
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    if len(data) > most_mb * 1_000_000:
        raise InputError(
            f"{path}: has more than {most_mb} MB, the most that such a file may have. Is it the right one?"
        )
    return data


def parse_json(data: bytes, path: Path) -> Any:
    """Parse the content of a JSON file. path: for messages. Raises InputError, with the remedy, for invalid JSON, which
    includes NaN, infinite and overlong numbers, and excessive nesting."""
    try:
        return json.loads(data.decode("utf-8"), parse_constant=refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: is not valid JSON ({error}). It is a file of another kind, or damaged: then run its stage again."
        ) from None


def refuse_constant(text: str) -> float:
    """Refuse NaN and infinities, which are no JSON. Raises ValueError."""
    raise ValueError(f"{text} is no number of JSON")


def quote_value(value: object) -> str:
    """Quote a wrong value in a message, on one line and shortened."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "a number of thousands of digits" if isinstance(value, int) else "this"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."

"""Files that are read whole, regular ones of a stated size at most; numbers as JSON knows them."""

import json
import stat
from pathlib import Path
from typing import Any

from pipeline.errors import InputError

MOST_MB = 200  # a comparator file of 50,000 scans has 50
SHOWN = 60  # so many characters of a wrong value are quoted

_KINDS = {
    stat.S_ISFIFO: "a pipe",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
    stat.S_ISSOCK: "a socket",
}
LARGEST = 1e15  # of a coordinate, a size, a standard deviation, in whatever unit: squares of larger ones are lost
SMALLEST_SIGMA = 1e-9  # of a coordinate, in mm, m or degrees: weights of smaller ones swallow all others


FINEST_PITCH_UM = 0.1  # below it mm or m were meant: no scanner and no sensor has such pixels


def read_bytes(path: Path, most_mb: int = MOST_MB) -> bytes:
    """The content of a file.

    Raises FileNotFoundError and IsADirectoryError, for which the caller has the better words, and InputError for what
    is no regular file (a pipe would be waited for, a device has no end), is larger, or cannot be read.
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


def read_json(path: Path) -> Any:
    """The content of a JSON file; FileNotFoundError as above. Raises InputError, which says how to make the file anew,
    for what is no JSON: NaN, infinite and endless numbers, and tables nested beyond sense, too."""
    return parse_json(read_bytes(path), path)


def parse_json(data: bytes, path: Path) -> Any:
    """The same of its content. path: for messages."""
    try:
        return json.loads(data.decode("utf-8"), parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: is not valid JSON ({error}). It is a file of another kind, or damaged: then run its stage again."
        ) from None


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


def quote_value(value: object) -> str:
    """A wrong value as a message quotes it: of one line, and not longer than makes sense."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "a number of thousands of digits" if isinstance(value, int) else "this"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."

"""Provenance: fingerprints of values, files and scans, states of files, and keys of results."""

import hashlib
import json
import math
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from measure.errors import MissingError, UnreachableError
from measure.results import MEASURE_REVISION
from measure.scans.remote import Address, whole_file
from pipeline.text.files import regular_file

_PLAIN = {str, int, bool, type(None)}  # types of most values, tested first
NO_FINGERPRINT = {"fingerprint": False}  # metadata of a field that is not part of a value's fingerprint
Item = TypeVar("Item")

_CHEAP_BYTES = 64_000_000  # largest file that is hashed whole without a request: 40 ms
_PIECES, _PIECE = 8, 32768  # number and bytes of pieces of a file, spread evenly from its first byte to its last


def fingerprint(value: object) -> str:
    """SHA-256 of a value made of dataclasses, mappings, sequences, arrays, numbers and text."""
    return hash_text(canonical_json(value))


def canonical_json(value: object) -> str:
    """Canonical JSON of such a value: equal values give equal text, different values different text.

    Ignored are the order of mappings, the folders of files (a project may be moved, its files rewritten), and fields of
    dataclasses with NO_FINGERPRINT in their metadata. Arrays are represented by type, shape and the SHA-256 of their
    numbers, numbers that are not finite by name.
    """
    return json.dumps(_json(value), ensure_ascii=False, allow_nan=False, sort_keys=True, separators=(",", ":"))


def hash_content(data: bytes) -> str:
    """SHA-256 (hexadecimal) of a file's content."""
    return hashlib.sha256(data).hexdigest()


def hash_text(text: str) -> str:
    """SHA-256 (hexadecimal) of a text, such as a task's options."""
    return hash_content(text.encode("utf-8", "surrogateescape"))


def hash_file(path: Path) -> str:
    """SHA-256 of a file of any size. Raises as `regular_file` does."""
    with regular_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _json(value: Any) -> Any:
    if value.__class__ in _PLAIN or (value.__class__ is float and math.isfinite(value)):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        values = {one.name: _json(getattr(value, one.name)) for one in fields(value) if one.metadata != NO_FINGERPRINT}
        return {"is": type(value).__name__, **values}
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value):
            return {str(key): _json(item) for key, item in value.items()}
        return {"pairs": sorted(([_json(key), _json(item)] for key, item in value.items()), key=json.dumps)}
    if isinstance(value, np.ndarray):
        return {
            "array": f"{value.dtype.str}{value.shape}",
            "sha256": hash_content(np.ascontiguousarray(value).tobytes()),
        }
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


class FileState(NamedTuple):  # a tuple, since archives have many
    """What is known of a scan's file without reading it.

    Attributes
    ----------
    uri : path relative to the project's folder, with `/`, or address.
    bytes : size; -1 where it does not exist.
    mtime_ns : time of the last change, for local files.
    etag : version tag of an object, in place of the time.
    """

    uri: str
    bytes: int
    mtime_ns: int = 0
    etag: str = ""

    def is_touched(self, earlier: "FileState") -> bool:
        """Whether time alone tells it from an earlier state, and the content is cheap to compare."""
        is_alike = self._replace(mtime_ns=0) == earlier._replace(mtime_ns=0)
        return is_alike and self.mtime_ns != earlier.mtime_ns and self.is_cheap

    @property
    def is_cheap(self) -> bool:
        """Whether the whole file may be read to know its content."""
        return 0 <= self.bytes <= _CHEAP_BYTES and not self.etag


@dataclass(frozen=True)
class FileIdentity:
    """State of a file, and SHA-256 of parts of its content (`parts_hash`)."""

    state: FileState
    parts_hash: str


class FileStates:
    """States of the files of a project; each folder's relative path is computed once."""

    def __init__(self, folder: Path) -> None:
        """folder: that of the project, which may be moved as a whole."""
        self._folder = os.path.abspath(folder)
        self._below: dict[str, str] = {}  # by folder, prefix of its files' URIs

    def get(self, path: str | Path) -> FileState:
        """State of a file or an object; one that does not respond counts as missing."""
        uri = str(path)
        if not isinstance(path, Address):
            parent, sign, name = uri.rpartition(os.sep)
            if parent not in self._below:
                folder = os.path.abspath(parent + sign)
                with suppress(ValueError):  # on another drive
                    folder = os.path.relpath(folder, self._folder)
                self._below[parent] = "" if folder == os.curdir else f"{Path(folder).as_posix().removesuffix('/')}/"
            uri = self._below[parent] + name
        try:
            if isinstance(path, Address):
                return FileState(uri, path.stat().st_size, etag=path.etag)
            stat = os.stat(whole_file(str(path)))
        except (OSError, MissingError, UnreachableError):
            return FileState(uri, -1)
        return FileState(uri, stat.st_size, stat.st_mtime_ns)


def file_state(path: Path, folder: Path) -> FileState:
    """State of one file or object. folder: that of the project."""
    return FileStates(folder).get(path)


def parts_hash(path: Path) -> str:
    """SHA-256 (hexadecimal) of the size of a scan's file and of pieces spread over it; "" where it cannot be read.

    Scans of one scanner share their heads, and uncompressed ones their tables. For an object the store's own hash of
    its content is used, and nothing is read.
    """
    try:
        size = path.stat().st_size
        if isinstance(path, Address) and path.etag:
            return hash_text(f"{path.etag} {size}")
        with path.open("rb") as file:
            pieces = []
            for number in range(_PIECES):
                file.seek(max(size - _PIECE, 0) * number // (_PIECES - 1))
                pieces.append(hash_content(file.read(_PIECE)))
    except (OSError, MissingError, UnreachableError):
        return ""
    return fingerprint([size, *pieces, str(path).removeprefix(whole_file(str(path)))])  # parts of a file are two scans


def content_hash(path: Path) -> str:
    """SHA-256 (hexadecimal) of the whole file; "" where it cannot be read.

    It takes 0.6 s of CPU per GB, so it is computed only where needed.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, MissingError, UnreachableError):
        return ""


def alike_groups(items: Iterable[Item], *values: Callable[[Item], object]) -> list[list[Item]]:
    """Groups of two or more items for which all values agree. A value is computed only where those before it agree; an
    item with a false one (an empty or unreadable file) is in no group."""
    groups = [list(items)]
    for value in values:
        parts = defaultdict[tuple[int, object], list[Item]](list)
        for number, group in enumerate(groups):
            for item in group:
                parts[number, value(item)].append(item)
        groups = [group for (_, known), group in parts.items() if known and len(group) > 1]
    return groups


def result_key(identity: FileIdentity, options_hash: str, revision: int = MEASURE_REVISION) -> str:
    """SHA-256 (hexadecimal) of a scan's identity, the hash of its options, and the revision of `measure`. It is the
    same on every machine, so results can be merged."""
    return hash_text(json.dumps([*identity.state, identity.parts_hash, options_hash, revision]))


def shard_number(name: str, shards: int) -> int:
    """Number of the shard, 1 to N, that an image belongs to, from its name: the same on every machine and in every
    run."""
    return int.from_bytes(hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()[:8]) % shards + 1

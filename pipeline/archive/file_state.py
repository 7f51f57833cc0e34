"""What is known of scans' files without reading them: where they stand, how large and how old they are."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from measure.errors import MissingError, UnreachableError
from measure.scans.remote import Address, whole_file


class FileState(NamedTuple):  # archives have many
    """What is known of a scan's file without reading it.

    uri: its path relative to the project's folder with `/`, or its address. bytes: its size, -1 where it is not there.
    mtime_ns: when it was last changed, local files; etag: the same of objects.
    """

    uri: str
    bytes: int
    mtime_ns: int = 0
    etag: str = ""


@dataclass(frozen=True)
class Identity:
    """state: of the file. parts_hash: SHA-256 of its telling parts."""

    state: FileState
    parts_hash: str


class FileStates:
    """The states of the files of a project; where a folder stands is asked once for all files in it."""

    def __init__(self, folder: Path) -> None:
        """folder: that of the project, which may be moved as a whole."""
        self._folder = os.path.abspath(folder)
        self._below: dict[str, str] = {}  # by folder, what stands before the names of its files

    def of(self, path: str | Path) -> FileState:
        """Of a file or an object; one that does not answer is as one that is not there."""
        try:
            if isinstance(path, Address):
                stat = path.stat()
                return FileState(str(path), stat.st_size, etag=path.etag)
            stat = os.stat(whole_file(str(path)))
        except (OSError, MissingError, UnreachableError):
            return FileState(self.uri(path), -1)
        return FileState(self.uri(path), stat.st_size, stat.st_mtime_ns)

    def uri(self, path: str | Path) -> str:
        """Relative to the folder, where that is possible, with `/`; an address as it is."""
        if isinstance(path, Address):
            return str(path)
        parent, sign, name = str(path).rpartition(os.sep)
        below = self._below.get(parent)
        if below is None:
            below = self._below[parent] = self._before_names(os.path.abspath(parent + sign))
        return below + name

    def _before_names(self, parent: str) -> str:
        try:
            relative = os.path.relpath(parent, self._folder)
        except ValueError:  # on another drive
            relative = parent
        return "" if relative == os.curdir else f"{Path(relative).as_posix().removesuffix('/')}/"


def file_state(path: Path, folder: Path) -> FileState:
    """The state of one file or object. folder: that of the project."""
    return FileStates(folder).of(path)

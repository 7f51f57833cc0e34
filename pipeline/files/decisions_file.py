"""decisions.jsonl: what a person decided about marks and poses, one JSON object a line, the oldest first.

The last line about a mark counts; an `undo` takes back the last one before it. Nothing is ever changed in the file: it
only grows, so that who decided what, and when, can be seen for ever.
"""

import gc
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from pipeline.errors import InputError
from pipeline.files.decision import (
    LEARNED,
    About,
    Choice,
    Decision,
    LineError,
    decision_line,
    decisions_of_lines,
    is_cut_short,
)
from pipeline.text.atomic import write_atomically, writing
from pipeline.text.text_file import read_bytes

try:
    import fcntl
except ImportError:  # not every system has it
    fcntl = None  # type: ignore[assignment]

FILE = "decisions.jsonl"


_LONGEST_LINE = 4_000_000  # bytes
_BYTES_AT_A_TIME = 300_000
_MOST_MB = 2000


def read_decisions(path: Path) -> tuple[Decision, ...]:
    """All of them; none where there is no such file. A last line that was cut short does not count, and
    `cut_short_line` names it. Raises InputError naming the line."""
    return parse_decisions(path, decisions_bytes(path))


def decisions_bytes(path: Path, start: int = 0) -> bytes:
    """The file as it stands, from a byte on, without lines that a process was ended over before all of them were
    written; nothing where there is no file. Raises InputError for what is no file."""
    try:
        with _locked(path):
            data, confirmed = read_bytes(path, _MOST_MB), _confirmed_bytes(path)
    except FileNotFoundError:
        return b""
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; decisions are a file. Move the folder away.") from None
    return data[start:confirmed]


def parse_decisions(path: Path, data: bytes, first_line: int = 1) -> tuple[Decision, ...]:
    """The same of lines of the file, from one on. path: for messages."""
    decisions, start, number = list[Decision](), 0, first_line
    with _pause_garbage_collection():
        while start < len(data):
            end = data.find(b"\n", start + _BYTES_AT_A_TIME) + 1 or len(data)
            lines = data[start:end].split(b"\n")
            if end == len(data) and is_cut_short(lines[-1]):
                lines.pop()
            numbered = [(at, line) for at, line in enumerate(lines, number) if line and not line.isspace()]
            try:
                decisions += decisions_of_lines(numbered)
            except LineError as error:
                raise InputError(f"{path}, line {error.number}{error}") from None
            number, start = number + data.count(b"\n", start, end), end
    return tuple(decisions)


def cut_short_line(data: bytes) -> int:
    """The number of the last line of a file where that was cut short and does not count; else 0."""
    return data.count(b"\n") + 1 if is_cut_short(data[data.rfind(b"\n") + 1 :]) else 0


def append_decisions(path: Path, decisions: Iterable[Decision]) -> None:
    """Add lines, all or none of them, and return when they are on the disk.

    Raises InputError for a decision that would not be read again, before anything is written, and WriteError where
    the lines cannot be written; then the file is as it was.
    """
    text = "".join(decision_line(decision) for decision in decisions)
    with writing(path), path.open("a+b") as file, _locked(path, exclusive=True):
        confirmed = _confirmed_bytes(path)
        if confirmed is not None:  # a process was ended over its lines
            file.truncate(confirmed)
        _end_last_line(file, path)
        size, journal = file.seek(0, os.SEEK_END), _journal_path(path)
        write_atomically(journal, str(size))
        try:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        except BaseException:
            _truncate(path, size)
            raise
        finally:
            journal.unlink(missing_ok=True)


def standing(decisions: Sequence[Decision]) -> Mapping[About, Decision]:
    """The one that counts, by what it is about, the others and what was taken back left out."""
    stacks = dict[About, list[Decision]]()
    for decision in decisions:
        push_decision(stacks, decision)
    return {about: stack[-1] for about, stack in stacks.items() if stack}


def push_decision(stacks: dict[About, list[Decision]], decision: Decision) -> None:
    """Add one to those about the same, by what they are about, or take the last of these back."""
    stack = stacks.setdefault(decision.subject, [])
    if decision.decision is not Choice.UNDO:
        stack.append(decision)
    elif stack:
        stack.pop()


def learned_from(decisions: Sequence[Decision], images: Collection[str]) -> Decision | None:
    """By which the marks of a camera that has these images are learned: the last one that was made, and stands."""
    own = [one for one in decisions if one.subject[2] == LEARNED and one.image in images]
    left = standing(own).values()
    return max(left, key=own.index, default=None)


# --- writing: the size before the lines stands in a file beside them until all of them are on the disk


def _journal_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.size")


def _confirmed_bytes(path: Path) -> int | None:
    """How many bytes of the file count, where a process was ended over its lines; None: all."""
    try:
        return int(_journal_path(path).read_bytes())
    except (OSError, ValueError):
        return None


@contextmanager
def _locked(path: Path, exclusive: bool = False) -> Iterator[None]:
    """While nobody else writes the file; where the file system has no locks, at once."""
    with path.open("rb") as file:
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH)
        yield


def _truncate(path: Path, size: int) -> None:
    """To what stood there before. What a buffer still holds is not written any more: it would be an error again."""
    with suppress(OSError):
        os.truncate(path, size)


def _end_last_line(file: BinaryIO, path: Path) -> None:
    """A line that somebody wrote without its end gets it; half a line goes. Raises InputError for any other line that
    is none: with an end it would spoil all that is written behind it."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _LONGEST_LINE))
    data = file.read()
    last = data[data.rfind(b"\n") + 1 :]
    if is_cut_short(last):
        file.truncate(size - len(last))
    elif last.strip():
        try:
            decisions_of_lines([(0, last)])
        except LineError as error:
            raise InputError(f"{path}, its last line{error} Nothing was written.") from None
        file.write(b"\n")


@contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    """A million objects without any cycle are made in half the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()

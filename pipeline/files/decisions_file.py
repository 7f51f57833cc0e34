"""decisions.jsonl: a person's decisions about marks and poses, one JSON object per line, the oldest first.

The last line about a mark applies; an `undo` cancels the last one before it. Lines are only appended, never changed, so
that the file keeps a record of who decided what, and when.
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
except ImportError:  # not available on every system
    fcntl = None  # type: ignore[assignment]

FILE = "decisions.jsonl"


_LONGEST_LINE = 4_000_000  # bytes
_BYTES_AT_A_TIME = 300_000
_MOST_MB = 2000


def read_decisions(path: Path) -> tuple[Decision, ...]:
    """All decisions of a file; none where there is no file.

    A last line that was cut short is ignored; `cut_short_line` reports it. Raises InputError with the line that is
    wrong.
    """
    return parse_decisions(path, decisions_bytes(path))


def decisions_bytes(path: Path, start: int = 0) -> bytes:
    """Content of the file from byte `start` on, without lines of an unfinished write; empty where there is no file.
    Raises InputError for a folder."""
    try:
        with _locked(path):
            data, confirmed = read_bytes(path, _MOST_MB), _confirmed_bytes(path)
    except FileNotFoundError:
        return b""
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; decisions are a file. Move the folder away.") from None
    return data[start:confirmed]


def parse_decisions(path: Path, data: bytes, first_line: int = 1) -> tuple[Decision, ...]:
    """Decisions of lines of the file. path: for messages; first_line: number of the first line."""
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
    """Number of a last line that was cut short and is ignored; 0 if there is none."""
    return data.count(b"\n") + 1 if is_cut_short(data[data.rfind(b"\n") + 1 :]) else 0


def append_decisions(path: Path, decisions: Iterable[Decision]) -> None:
    """Append lines, all or none, and return when they are on the disk.

    Raises
    ------
    InputError
        A decision could not be read again; nothing is written.
    WriteError
        The lines cannot be written; the file is unchanged.
    """
    text = "".join(decision_line(decision) for decision in decisions)
    with writing(path), path.open("a+b") as file, _locked(path, exclusive=True):
        confirmed = _confirmed_bytes(path)
        if confirmed is not None:  # an earlier process ended before it had written all its lines
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
    """{subject: decision that applies}, without superseded and undone ones."""
    stacks = dict[About, list[Decision]]()
    for decision in decisions:
        push_decision(stacks, decision)
    return {about: stack[-1] for about, stack in stacks.items() if stack}


def push_decision(stacks: dict[About, list[Decision]], decision: Decision) -> None:
    """Push a decision onto the stack of its subject; an undo pops the last one."""
    stack = stacks.setdefault(decision.subject, [])
    if decision.decision is not Choice.UNDO:
        stack.append(decision)
    elif stack:
        stack.pop()


def learned_from(decisions: Sequence[Decision], images: Collection[str]) -> Decision | None:
    """Last standing decision by which the marks of the camera with these images are learned; None if there is none."""
    own = [one for one in decisions if one.subject[2] == LEARNED and one.image in images]
    left = standing(own).values()
    return max(left, key=own.index, default=None)


# --- writing: the file's size before the new lines is kept in a file beside it until all lines are on the disk


def _journal_path(path: Path) -> Path:
    return path.with_name(f".{path.name}.size")


def _confirmed_bytes(path: Path) -> int | None:
    """Number of valid bytes after an unfinished write; None: all."""
    try:
        return int(_journal_path(path).read_bytes())
    except (OSError, ValueError):
        return None


@contextmanager
def _locked(path: Path, exclusive: bool = False) -> Iterator[None]:
    """Lock the file; no lock where the file system has none."""
    with path.open("rb") as file:
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH)
        yield


def _truncate(path: Path, size: int) -> None:
    """Restore the earlier size, ignoring errors. Buffered data is not written: that would fail again."""
    with suppress(OSError):
        os.truncate(path, size)


def _end_last_line(file: BinaryIO, path: Path) -> None:
    """Complete the last line: add a missing line end, drop a line that was cut short.

    Raises InputError for any other invalid line, since appended text would become part of it.
    """
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
    """Disable the garbage collector, which doubles the time of creating a million objects without cycles."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()

"""decisions.jsonl: what a person decided about marks and poses, one JSON object a line, the oldest first.

The last line about a mark counts; an `undo` takes back the last one before it. Nothing is ever changed in the file: it
only grows, so that who decided what, and when, can be seen for ever.
"""

import gc
import json
import os
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from functools import lru_cache
from itertools import repeat
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

from measure.geometry import POSES
from pipeline.errors import InputError
from pipeline.provenance import NO_FINGERPRINT
from pipeline.text.atomic import write_atomically, writing
from pipeline.text.text_file import read_bytes, shown
from pipeline.text.wording import did_you_mean

try:
    import fcntl
except ImportError:  # not every system has it
    fcntl = None  # type: ignore[assignment]

FILE = "decisions.jsonl"
KINDS = ("fiducial", "target", "tie")
LEARNED = "learned"  # the kind of what is said of how a camera's marks look, and not of where they are


class Choice(StrEnum):
    """What can be decided."""

    ACCEPT = "accept"
    REJECT = "reject"
    ABSENT = "absent"
    PLACE = "place"
    POSE = "pose"
    LEARN = "learn"
    UNDO = "undo"


MEANING = {
    Choice.ACCEPT: "The mark is right as it was measured: it counts as `measured`.",
    Choice.REJECT: "What was measured is not this mark: it counts as `rejected`.",
    Choice.ABSENT: "The scan does not show this mark: it counts as `absent`.",
    Choice.PLACE: "The mark is here (`col_px`, `row_px`): matching starts there.",
    Choice.POSE: "The scan lies as `pose` says.",
    Choice.LEARN: "The camera's marks look as at these places of this scan (`px`, column and row by fiducial).",
    Choice.UNDO: "The last decision about this mark, or this pose, is taken back.",
}

About = tuple[str, str, str]  # image, point, kind; of a pose: image, "", ""; of marks to be learned: image, "", LEARNED


OF_SCANS = (Choice.POSE, Choice.LEARN, Choice.UNDO)  # and of no single mark
_LONGEST_LINE = 4_000_000  # bytes
_BYTES_AT_A_TIME = 300_000
_MOST_MB = 2000
_NO_PLACES: Mapping[str, tuple[float, float]] = {}


@dataclass(frozen=True, slots=True)
class Decision:
    """One line. point, kind: of the mark; "" for a pose. col_px, row_px: of `place`. fingerprint: of the result that
    was looked at, and of `learn` the SHA-256 of the scan's file; window: what of it was seen, first column, first row,
    width and height in px. px: of `learn`. when: ISO 8601. line: its number in the file, 0 of one that is in none."""

    image: str
    decision: Choice
    point: str = ""
    kind: str = ""
    col_px: float | None = None
    row_px: float | None = None
    pose: str = ""
    note: str = ""
    who: str = ""
    when: str = ""
    fingerprint: str = ""
    window: tuple[float, float, float, float] | None = None
    px: Mapping[str, tuple[float, float]] = field(default_factory=dict, hash=False)
    line: int = field(default=0, compare=False, metadata=NO_FINGERPRINT)

    @property
    def about(self) -> About:
        """What of which scan it is about. A line that names no kind is about the fiducial."""
        return self.image, self.point, self.kind or (KINDS[0] if self.point else "")


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
    with _without_search_for_cycles():
        while start < len(data):
            end = data.find(b"\n", start + _BYTES_AT_A_TIME) + 1 or len(data)
            lines = data[start:end].split(b"\n")
            if end == len(data) and _is_cut_short(lines[-1]):
                lines.pop()
            numbered = [(at, line) for at, line in enumerate(lines, number) if line and not line.isspace()]
            try:
                decisions += _decisions_of(numbered)
            except _LineError as error:
                raise InputError(f"{path}, line {error.number}{error}") from None
            number, start = number + data.count(b"\n", start, end), end
    return tuple(decisions)


def cut_short_line(data: bytes) -> int:
    """The number of the last line of a file where that was cut short and does not count; else 0."""
    return data.count(b"\n") + 1 if _is_cut_short(data[data.rfind(b"\n") + 1 :]) else 0


def append_decisions(path: Path, decisions: Iterable[Decision]) -> None:
    """Add lines, all or none of them, and return when they are on the disk.

    Raises InputError for a decision that would not be read again, before anything is written, and WriteError where
    the lines cannot be written; then the file is as it was.
    """
    text = "".join(_checked_line(decision) for decision in decisions)
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
        put_on(stacks, decision)
    return {about: stack[-1] for about, stack in stacks.items() if stack}


def put_on(stacks: dict[About, list[Decision]], decision: Decision) -> None:
    """Add one to those about the same, by what they are about, or take the last of these back."""
    stack = stacks.setdefault(decision.about, [])
    if decision.decision is not Choice.UNDO:
        stack.append(decision)
    elif stack:
        stack.pop()


def learned_from(decisions: Sequence[Decision], images: Collection[str]) -> Decision | None:
    """By which the marks of a camera that has these images are learned: the last one that was made, and stands."""
    own = [one for one in decisions if one.about[2] == LEARNED and one.image in images]
    left = standing(own).values()
    return max(left, key=own.index, default=None)


# --- writing: the size before the lines stands in a file beside them until all of them are on the disk


def _checked_line(decision: Decision) -> str:
    values = {key: getattr(decision, key) for key in _CHECKS}
    told = {key: value for key, value in values.items() if value not in (None, "", {})}
    try:
        line = json.dumps(told, ensure_ascii=False, allow_nan=False)
        _decisions_of([(0, line.encode())])
    except (_LineError, ValueError) as error:
        about = f"{decision.image}{f', {decision.point}' if decision.point else ''}"
        raise InputError(f"the decision about {about}{error}. Nothing was written.") from None
    return f"{line}\n"


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
    if _is_cut_short(last):
        file.truncate(size - len(last))
    elif last.strip():
        try:
            _decisions_of([(0, last)])
        except _LineError as error:
            raise InputError(f"{path}, its last line{error} Nothing was written.") from None
        file.write(b"\n")


# --- a line and its values


class _LineError(Exception):
    """What is wrong in a line, as it goes on behind the line's number."""

    number: int

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(f"{f', {key}' if key else ''}: {message}")


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


_read_json = json.JSONDecoder(parse_constant=_no_number).decode


def _is_cut_short(line: bytes) -> bool:
    """Whether a line ends before its object does, as after a crash; a line with a typing error does not."""
    try:
        _read_json(line.decode("utf-8", "replace"))
    except json.JSONDecodeError as error:
        ends = error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated string")
        return ends and line.lstrip().startswith(b"{")
    except (ValueError, RecursionError):
        pass
    return False


@contextmanager
def _without_search_for_cycles() -> Iterator[None]:
    """A million objects without any cycle are made in half the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _decisions_of(numbered: Sequence[tuple[int, bytes]]) -> list[Decision]:
    """The decisions of lines, all lines at once, and one by one only where that fails: to name the line."""
    numbers, lines = [number for number, _ in numbered], [line for _, line in numbered]
    if {line[:1] + line[-1:] for line in lines} == {b"{}"}:
        with suppress(ValueError, RecursionError, _LineError):
            objects = _read_json(f"[{b','.join(lines).decode()}]")
            if len(objects) == len(lines):
                return _decisions(objects, numbers)
    decisions = list[Decision]()
    for number, line in numbered:
        try:
            decisions += _decisions([_json_object(line)], [number])
        except _LineError as error:
            error.number = number
            raise
    return decisions


def _json_object(line: bytes) -> Any:
    try:
        return _read_json(line.decode())
    except (ValueError, RecursionError) as error:
        raise _LineError(f"is no JSON ({error}). Mend the line, or take it out.") from None


def _decisions(objects: Sequence[Any], numbers: Sequence[int]) -> list[Decision]:
    """Objects of lines, checked key by key, each key for all lines that have the same keys and decide the same."""
    groups = defaultdict[tuple[str, ...], list[tuple[int, dict[str, Any]]]](list)
    for number, told in zip(numbers, objects, strict=True):
        if not isinstance(told, dict):
            raise _LineError(f"must be a JSON object, not {shown(told)}.")
        groups[str(told.get("decision")), *told].append((number, told))
    decisions = [
        one for (_, *keys), group in groups.items() for one in _decisions_alike(keys, *zip(*group, strict=True))
    ]
    return decisions if len(groups) == 1 else sorted(decisions, key=attrgetter("line"))


def _decisions_alike(keys: Sequence[str], numbers: Sequence[int], objects: Sequence[dict[str, Any]]) -> list[Decision]:
    """Decisions of one choice whose objects have these keys."""
    for key in keys:
        if key not in _CHECKS:
            raise _LineError(f"there is no such key.{did_you_mean(key, _CHECKS)} Known: {', '.join(_CHECKS)}.", key)
    columns = zip(*map(dict.values, objects), strict=True)
    values = {key: _checked(key, column) for key, column in zip(keys, columns, strict=True)}
    if "decision" not in values:
        raise _LineError("is missing.", "decision")
    choice, needed = _RULES[values["decision"][0]]
    for key in needed:
        if key not in values or not all(value or value == 0.0 for value in values[key]):
            raise _LineError(f"must be {_MUST_BE[key]}, not None." if key in _MUST_BE else "is missing.", key)
    if choice in (_POSE, _LEARN) and any(values.get("point", ())):
        what = "a pose" if choice is _POSE else "what is learned"
        raise _LineError(f"is of no use: {what} is of the whole scan. Take it out.", "point")
    values["line"] = numbers
    fixed = {"decision": choice, **_FIXED.get(choice, {"pose": "", "px": _NO_PLACES})}
    decisions = [object.__new__(Decision) for _ in objects]  # the constructor takes most of the time of a million
    for key, default in {**_DEFAULTS, **fixed, "line": 0}.items():
        column = values[key] if key in values and key not in fixed else repeat(default)
        deque(map(getattr(Decision, key).__set__, decisions, column), maxlen=0)
    return decisions


def _checked(key: str, values: Sequence[Any]) -> Sequence[Any]:
    """The values of a key in many lines. Each text is checked once, and held once."""
    check = _CHECKS[key]
    if set(map(type, values)) != {str}:
        return [check(key, value) for value in values]
    texts = dict(zip(values, values, strict=True))
    if check is not _check_text:
        for text in texts:
            check(key, text)
    return values if len(texts) == len(values) else list(map(texts.__getitem__, values))


def _check_text(key: str, value: Any) -> str:
    if not isinstance(value, str):
        raise _LineError(f"must be text, not {shown(value)}.", key)
    return value


def _check_choice(key: str, value: Any) -> str:
    return value if value.__class__ is str and value in _RULES else _one_of(key, value, _RULES)


def _check_kind(key: str, value: Any) -> str:
    return value if value.__class__ is str and value in _KINDS_OR_NONE else _one_of(key, value, _KINDS_OR_NONE[1:])


def _check_pose(key: str, value: Any) -> str:
    return _one_of(key, value, POSES) if value != "" else value


def _one_of(key: str, value: Any, choices: Collection[str]) -> str:
    text = _check_text(key, value)
    if text not in choices:
        raise _LineError(f"must be one of {', '.join(choices)}, not {shown(value)}.{did_you_mean(text, choices)}", key)
    return text


def _is_pixel(value: Any) -> bool:
    return (value.__class__ is float or value.__class__ is int) and -1e9 < value < 1e9


def _check_pixels(key: str, value: Any) -> float | None:
    if value is None:
        return None
    if not _is_pixel(value):
        raise _LineError(f"must be {_MUST_BE[key]}, not {shown(value)}.", key)
    return float(value)


def _check_places(key: str, value: Any) -> dict[str, tuple[float, float]]:
    if not isinstance(value, dict) or not all(map(_is_place, value.values())):
        raise _LineError(f"must be {_MUST_BE[key]}, not {shown(value)}.", key)
    return {point: (float(col), float(row)) for point, (col, row) in value.items()}


def _is_place(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_pixel, value))


def _check_time(key: str, value: Any) -> str:
    text = _check_text(key, value)
    if not _is_time(text):
        raise _LineError(f"must be a time as 2026-01-31T12:00:00+00:00, not {shown(text)}.", key)
    return text


@lru_cache(maxsize=4096)
def _is_time(text: str) -> bool:
    try:
        return not text or bool(datetime.fromisoformat(text))
    except ValueError:
        return False


def _check_window(key: str, value: Any) -> tuple[float, float, float, float] | None:
    if value is None:
        return None
    if value.__class__ is not list or len(value) != 4 or not all(map(_is_pixel, value)):
        raise _LineError("must be four numbers of pixels: first column, first row, width, height.", key)
    col, row, width, height = map(float, value)
    return col, row, width, height


_KINDS_OR_NONE = ("", *KINDS, LEARNED)
_CHECKS: Mapping[str, Callable[[str, Any], Any]] = {
    "image": _check_text,
    "decision": _check_choice,
    "point": _check_text,
    "kind": _check_kind,
    "col_px": _check_pixels,
    "row_px": _check_pixels,
    "pose": _check_pose,
    "note": _check_text,
    "who": _check_text,
    "when": _check_time,
    "fingerprint": _check_text,
    "window": _check_window,
    "px": _check_places,
}
_DEFAULTS: Mapping[str, Any] = {
    **dict.fromkeys(_CHECKS, ""),
    **dict.fromkeys(("col_px", "row_px", "window")),
    "px": _NO_PLACES,
}
_POSE, _LEARN = Choice.POSE, Choice.LEARN
_FIXED: Mapping[Choice, Mapping[str, Any]] = {  # whatever a line says
    _POSE: {"kind": "", "px": _NO_PLACES},
    _LEARN: {"kind": LEARNED, "pose": ""},
}
_RULES: Mapping[str, tuple[Choice, tuple[str, ...]]] = {  # the choice, and the keys that it needs
    "accept": (Choice.ACCEPT, ("image", "point")),
    "reject": (Choice.REJECT, ("image", "point")),
    "absent": (Choice.ABSENT, ("image", "point")),
    "place": (Choice.PLACE, ("image", "point", "col_px", "row_px")),
    "pose": (Choice.POSE, ("image", "pose")),
    "learn": (Choice.LEARN, ("image", "px")),
    "undo": (Choice.UNDO, ("image",)),
}
_MUST_BE = {
    "col_px": "a number of pixels",
    "row_px": "a number of pixels",
    "pose": f"one of {', '.join(POSES)}",
    "px": 'columns and rows by fiducial: {"1": [1863, 1786], ...}',
}

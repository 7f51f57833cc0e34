"""decisions.jsonl: what a person decided about marks and poses, one JSON object a line, the oldest first.

The last line about a mark counts; an `undo` takes back the last one before it. Nothing is ever changed in the file: it
only grows, so that who decided what, and when, can be seen for ever.
"""

import json
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, BinaryIO

from measure.marks.poses import POSES
from pipeline.errors import InputError
from pipeline.text.atomic import writing
from pipeline.text.spelling import did_you_mean
from pipeline.text.text_file import read_bytes, shown

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


@dataclass(frozen=True)
class Decision:
    """One line. point, kind: of the mark; "" for a pose. col_px, row_px: of `place`. fingerprint: of the result that
    was looked at, and of `learn` the SHA-256 of the scan's file; window: what of it was seen, first column, first row,
    width and height in px. px: of `learn`. when: ISO 8601."""

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

    @property
    def about(self) -> About:
        """What of which scan it is about. A line that names no kind is about the fiducial."""
        return self.image, self.point, self.kind or (KINDS[0] if self.point else "")


def read_decisions(path: Path) -> tuple[Decision, ...]:
    """All of them; none where there is no such file. A last line that a crash cut short was never confirmed, and does
    not count. Raises InputError naming the line."""
    return parse_decisions(path, decisions_bytes(path))


def decisions_bytes(path: Path) -> bytes:
    """The file as it stands; nothing where there is none. Raises InputError for what is no file."""
    try:
        return read_bytes(path)
    except FileNotFoundError:
        return b""
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; decisions are a file. Move the folder away.") from None


def parse_decisions(path: Path, data: bytes, first_line: int = 1) -> tuple[Decision, ...]:
    """The same of lines of the file, from one on. path: for messages."""
    lines = data.split(b"\n")
    if lines[-1] and not _is_json(lines[-1]):
        lines.pop()
    return tuple(_decision(path, number, line) for number, line in enumerate(lines, first_line) if line.strip())


def append_decisions(path: Path, decisions: Iterable[Decision]) -> None:
    """Add lines, and return when they are on the disk. Raises WriteError where that cannot be done."""
    text = "".join(json.dumps(_told(decision), ensure_ascii=False) + "\n" for decision in decisions)
    with writing(path), path.open("a+b") as file:
        _end_last_line(file)
        file.write(text.encode())
        file.flush()
        os.fsync(file.fileno())


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


def _told(decision: Decision) -> Mapping[str, Any]:
    return {name: value for name, value in asdict(decision).items() if value not in (None, "", {})}


def _end_last_line(file: BinaryIO) -> None:
    """A line that somebody wrote without its end gets it; half a line, of a crash, goes."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _LONGEST_LINE))
    data = file.read()
    last = data[data.rfind(b"\n") + 1 :]
    if last and _is_json(last):
        file.write(b"\n")
    elif last:
        file.truncate(size - len(last))


def _is_place(value: Any) -> bool:
    is_two = isinstance(value, list) and len(value) == 2
    return is_two and all(isinstance(one, int | float) and abs(one) < 1e9 for one in value)


def _is_json(line: bytes) -> bool:
    try:
        json.loads(line)
    except (ValueError, RecursionError):
        return False
    return True


def _decision(path: Path, number: int, line: bytes) -> Decision:
    try:
        told = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}, line {number}: is no JSON ({error}). Mend the line, or take it out.") from None
    if not isinstance(told, dict):
        raise InputError(f"{path}, line {number}: must be a JSON object, not {shown(told)}.")
    line_of = _Line(path, number, told)
    choice = line_of.one_of("decision", [str(choice) for choice in Choice])
    decision = Decision(
        image=line_of.text("image", needed=True),
        decision=Choice(choice),
        point=line_of.text("point", needed=choice not in OF_SCANS),
        kind=_kind(line_of, choice),
        col_px=line_of.number("col_px", needed=choice == Choice.PLACE),
        row_px=line_of.number("row_px", needed=choice == Choice.PLACE),
        pose=line_of.one_of("pose", POSES) if choice == Choice.POSE else "",
        note=line_of.text("note"),
        who=line_of.text("who"),
        when=line_of.when(),
        fingerprint=line_of.text("fingerprint"),
        window=line_of.window(),
        px=line_of.places("px") if choice == Choice.LEARN else {},
    )
    if choice in (Choice.POSE, Choice.LEARN) and decision.point:
        what = "a pose" if choice == Choice.POSE else "what is learned"
        raise line_of.error("point", f"is of no use: {what} is of the whole scan. Take it out.")
    return decision


def _kind(line: "_Line", choice: str) -> str:
    if choice == Choice.POSE:
        return ""
    return LEARNED if choice == Choice.LEARN else line.one_of("kind", (*KINDS, LEARNED), needed=False)


class _Line:
    """A line of the file, its values checked."""

    def __init__(self, path: Path, number: int, told: Mapping[str, Any]) -> None:
        self._path, self._number, self._told = path, number, told

    def error(self, key: str, message: str) -> InputError:
        return InputError(f"{self._path}, line {self._number}, {key}: {message}")

    def text(self, key: str, needed: bool = False) -> str:
        value = self._told.get(key, "")
        if not isinstance(value, str):
            raise self.error(key, f"must be text, not {shown(value)}.")
        if needed and not value:
            raise self.error(key, "is missing.")
        return value

    def one_of(self, key: str, choices: Sequence[str], needed: bool = True) -> str:
        value = self.text(key, needed)
        if value not in choices and (needed or value):
            hint = did_you_mean(value, choices)
            raise self.error(key, f"must be one of {', '.join(choices)}, not {shown(value)}.{hint}")
        return value

    def number(self, key: str, needed: bool) -> float | None:
        value = self._told.get(key)
        if value is None and not needed:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
            raise self.error(key, f"must be a number of pixels, not {shown(value)}.")
        return float(value)

    def places(self, key: str) -> dict[str, tuple[float, float]]:
        value = self._told.get(key)
        if not isinstance(value, dict) or not value or not all(map(_is_place, value.values())):
            raise self.error(key, 'must be columns and rows by fiducial: {"1": [1863, 1786], ...}.')
        return {point: (float(col), float(row)) for point, (col, row) in value.items()}

    def when(self) -> str:
        value = self.text("when")
        try:
            if value:
                datetime.fromisoformat(value)
        except ValueError:
            raise self.error("when", f"must be a time as 2026-01-31T12:00:00+00:00, not {shown(value)}.") from None
        return value

    def window(self) -> tuple[float, float, float, float] | None:
        value = self._told.get("window")
        if value is None:
            return None
        is_four = isinstance(value, list) and len(value) == 4
        if not is_four or not all(isinstance(one, int | float) and abs(one) < 1e9 for one in value):
            raise self.error("window", "must be four numbers of pixels: first column, first row, width, height.")
        col, row, width, height = map(float, value)
        return col, row, width, height

"""decisions.jsonl: a person's decisions about marks and poses, one JSON object per line, the oldest first.

The last line about a mark applies; an `undo` cancels the last one before it. Lines are only added, never changed, so
that the file keeps a record of who decided what, and when. With the new lines it replaces the earlier file at once.
"""

import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field, Strict, TypeAdapter, ValidationError, with_config

from measure.flags import MeaningfulWord
from measure.geometry import POSES
from pipeline.errors import InputError
from pipeline.provenance import NO_FINGERPRINT
from pipeline.text.files import quote_value, read_bytes, write_atomically, writing
from pipeline.text.table_models import WrongKey
from pipeline.text.wording import did_you_mean

try:
    import fcntl
except ImportError:  # not available on every system
    fcntl = None  # type: ignore[assignment]

FILE = "decisions.jsonl"
_MOST_MB = 2000
KINDS = ("fiducial", "target", "tie")
LEARNED = "learned"  # kind of decisions about the appearance of a camera's marks, not about their places


class DecisionKind(MeaningfulWord):
    """Kinds of decisions."""

    ACCEPT = "accept", "The mark is right as it was measured: it counts as `measured`."
    REJECT = "reject", "What was measured is not this mark: it counts as `rejected`."
    ABSENT = "absent", "The scan does not show this mark: it counts as `absent`."
    PLACE = "place", "The mark is here (`col_px`, `row_px`): matching starts there."
    POSE = "pose", "The scan lies as `pose` says."
    LEARN = "learn", "The camera's marks look as at these places of this scan (`px`, column and row by fiducial)."
    UNDO = "undo", "The last decision about this mark, or this scan orientation, is taken back."


About = tuple[str, str, str]  # image, point, kind; of a pose: image, "", ""; of marks to be learned: image, "", LEARNED


def _word_validator(*words: str) -> AfterValidator:
    def check(word: str) -> str:
        if word and word not in words:
            raise ValueError(word)
        return word

    return AfterValidator(check)


@lru_cache(maxsize=4096)
def _checked_time(text: str) -> str:
    if text:
        datetime.fromisoformat(text)
    return text


Text = Annotated[str, Strict()]
Pixels = Annotated[float, Strict(), Field(gt=-1e9, lt=1e9)]


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, slots=True)
class Decision:
    """One decision.

    Attributes
    ----------
    point, kind : of the mark; "" for a pose.
    col_px, row_px : place of the mark (`place`).
    pose : of the scan (`pose`).
    when : ISO 8601.
    fingerprint : of the result that was reviewed; for `learn` SHA-256 of the scan's file.
    window : part of the scan that was visible: first column, first row, width, height, px.
    px : places of the marks by fiducial (`learn`).
    line : number of the line in the file; 0 outside a file.
    """

    image: Text
    decision: DecisionKind
    point: Text = ""
    kind: Annotated[Text, _word_validator(*KINDS, LEARNED)] = ""
    col_px: Pixels | None = None
    row_px: Pixels | None = None
    pose: Annotated[Text, _word_validator(*POSES)] = ""
    note: Text = ""
    who: Text = ""
    when: Annotated[Text, AfterValidator(_checked_time)] = ""
    fingerprint: Text = ""
    window: tuple[Pixels, Pixels, Pixels, Pixels] | None = None
    px: Mapping[str, tuple[Pixels, Pixels]] = field(default_factory=dict, hash=False)
    line: int = field(default=0, compare=False, metadata=NO_FINGERPRINT)

    @property
    def subject(self) -> About:
        """(image, point, kind) that the decision is about. The default kind is a fiducial."""
        return self.image, self.point, self.kind or (KINDS[0] if self.point else "")


_REQUIRED: Mapping[DecisionKind, tuple[str, ...]] = {
    **dict.fromkeys(DecisionKind, ("image", "point")),
    DecisionKind.PLACE: ("image", "point", "col_px", "row_px"),
    DecisionKind.POSE: ("image", "pose"),
    DecisionKind.LEARN: ("image", "px"),
    DecisionKind.UNDO: ("image",),
}
_KEYS = tuple(each.name for each in fields(Decision) if each.name != "line")
_WORDS: Mapping[str, tuple[str, ...]] = {
    "decision": tuple(map(str, DecisionKind)),
    "kind": (*KINDS, LEARNED),
    "pose": POSES,
}
_MUST_BE = {
    **dict.fromkeys(_KEYS, "text"),
    **{key: f"one of {', '.join(words)}" for key, words in _WORDS.items()},
    "col_px": "a number of pixels",
    "row_px": "a number of pixels",
    "when": "a time as 2026-01-31T12:00:00+00:00",
    "window": "four numbers of pixels: first column, first row, width, height",
    "px": 'columns and rows by fiducial: {"1": [1863, 1786], ...}',
}


def _check_decision(decision: Decision) -> Decision:
    """Decision of a line without what its kind has no use for. Raises WrongKey where a key is missing."""
    kind = decision.decision
    for key in _REQUIRED[kind]:
        value = getattr(decision, key)
        if not value and value != 0.0:
            message = f"must be {_MUST_BE[key]}, not None." if _MUST_BE[key] != "text" else "is missing."
            raise WrongKey(key, message)
    of_scan = kind in (DecisionKind.POSE, DecisionKind.LEARN)
    if of_scan and decision.point:
        what = "a scan orientation" if kind is DecisionKind.POSE else "what is learned"
        raise WrongKey("point", f"is of no use: {what} is of the whole scan. Take it out.")
    if of_scan and decision.kind != (own := LEARNED if kind is DecisionKind.LEARN else ""):
        decision = replace(decision, kind=own)
    if decision.px and kind is not DecisionKind.LEARN:
        decision = replace(decision, px={})
    return replace(decision, pose="") if decision.pose and kind is not DecisionKind.POSE else decision


_DECISION = TypeAdapter(Annotated[Decision, AfterValidator(_check_decision)])


class LineError(Exception):
    """Error in a line; its text follows the line's number."""

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(f"{f', {key}' if key else ''}: {message}")


def is_cut_short(line: bytes) -> bool:
    """Whether a line ends within its JSON object, as after a crash, rather than having a typing error."""
    try:
        json.loads(line.decode("utf-8", "replace"))
    except json.JSONDecodeError as error:
        ends = error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated string")
        return ends and line.lstrip().startswith(b"{")
    except (ValueError, RecursionError):
        pass
    return False


def parse_decision(line: bytes, number: int = 0) -> Decision:
    """Decision of a line of the file. number: of the line. Raises LineError."""
    try:
        decision = _DECISION.validate_json(line)
    except ValidationError as error:
        found = error.errors(include_url=False)
        raise LineError(*_problem(min(found, key=lambda each: each["type"] != "unexpected_keyword_argument"))) from None
    object.__setattr__(decision, "line", number)  # a copy would take as long as reading it
    return decision


def _problem(error: Any) -> tuple[str, str]:
    """Message on an error of pydantic, and the key."""
    cause = error.get("ctx", {}).get("error")
    if isinstance(cause, WrongKey):
        return str(cause), cause.key
    if error["type"] == "json_invalid":
        return f"is no JSON ({cause}). Mend the line, or take it out.", ""
    if not error["loc"]:
        return f"must be a JSON object, not {quote_value(error['input'])}.", ""
    key, value = str(error["loc"][0]), error["input"]
    if error["type"] == "unexpected_keyword_argument":
        return f"there is no such key.{did_you_mean(key, _KEYS)} Known: {', '.join(_KEYS)}.", key
    if error["type"] == "missing" and len(error["loc"]) == 1:
        return "is missing.", key
    hint = did_you_mean(value, _WORDS[key]) if key in _WORDS and isinstance(value, str) else ""
    return f"must be {_MUST_BE[key]}, not {quote_value(value)}.{hint}", key


def read_decisions(path: Path) -> tuple[Decision, ...]:
    """All decisions of a file; none where there is no file.

    A last line that was cut short is ignored; `cut_short_line` reports it. Raises InputError with the line that is
    wrong.
    """
    return parse_decisions(path, decisions_bytes(path))


def decisions_bytes(path: Path) -> bytes:
    """Content of the file; empty where there is no file. Raises InputError for a folder."""
    try:
        return read_bytes(path, _MOST_MB)
    except FileNotFoundError:
        return b""
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; decisions are a file. Move the folder away.") from None


def parse_decisions(path: Path, data: bytes) -> tuple[Decision, ...]:
    """Decisions of the content of the file. path: for messages."""
    lines, decisions = data.split(b"\n"), list[Decision]()
    if is_cut_short(lines[-1]):
        lines.pop()
    for number, line in enumerate(lines, 1):
        if line and not line.isspace():
            try:
                decisions.append(parse_decision(line, number))
            except LineError as error:
                raise InputError(f"{path}, line {number}{error}") from None
    return tuple(decisions)


def cut_short_line(data: bytes) -> int:
    """Number of a last line that was cut short and is ignored; 0 if there is none."""
    return data.count(b"\n") + 1 if is_cut_short(data[data.rfind(b"\n") + 1 :]) else 0


def append_decisions(path: Path, decisions: Iterable[Decision]) -> None:
    """Append lines, all or none, and return when they are on the disk.

    Raises
    ------
    InputError
        A decision could not be read again, or the last line there cannot be; nothing is written.
    WriteError
        The lines cannot be written; the file is unchanged.
    """
    lines = []
    for decision in decisions:
        values = {key: getattr(decision, key) for key in _KEYS}
        content = {key: value for key, value in values.items() if value not in (None, "", {})}
        try:
            lines.append(json.dumps(content, ensure_ascii=False, allow_nan=False) + "\n")
            parse_decision(lines[-1].encode())
        except (LineError, ValueError) as error:
            about = f"{decision.image}{f', {decision.point}' if decision.point else ''}"
            raise InputError(f"the decision about {about}{error}. Nothing was written.") from None
    with _lock_folder(path.parent):
        write_atomically(path.resolve(), _whole_lines(path) + "".join(lines).encode())


@contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder against other processes that append; no lock where the file system has none."""
    if fcntl is None:
        yield
        return
    with writing(folder):
        place = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(place, fcntl.LOCK_EX)
        yield
    finally:
        os.close(place)


def _whole_lines(path: Path) -> bytes:
    """Content of the file with a missing line end, without a last line that was cut short. Raises InputError for any
    other invalid last line."""
    data = decisions_bytes(path)
    before, last = data[: (start := data.rfind(b"\n") + 1)], data[start:]
    if not last.strip() or is_cut_short(last):
        return before
    try:
        parse_decision(last)
    except LineError as error:
        raise InputError(f"{path}, its last line{error} Nothing was written.") from None
    return data + b"\n"


def standing(decisions: Sequence[Decision]) -> Mapping[About, Decision]:
    """{subject: decision that applies}, without superseded and undone ones."""
    stacks = dict[About, list[Decision]]()
    for decision in decisions:
        push_decision(stacks, decision)
    return {about: stack[-1] for about, stack in stacks.items() if stack}


def push_decision(stacks: dict[About, list[Decision]], decision: Decision) -> None:
    """Push a decision onto the stack of its subject; an undo pops the last one."""
    stack = stacks.setdefault(decision.subject, [])
    if decision.decision is not DecisionKind.UNDO:
        stack.append(decision)
    elif stack:
        stack.pop()


def learned_from(decisions: Sequence[Decision], images: Collection[str]) -> Decision | None:
    """Last standing decision by which the marks of the camera with these images are learned; None if there is none."""
    own = [one for one in decisions if one.subject[2] == LEARNED and one.image in images]
    left = standing(own).values()
    return max(left, key=own.index, default=None)

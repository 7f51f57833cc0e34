"""Decision about a mark or a scan orientation, and its line in decisions.jsonl: one JSON object, checked key by key."""

import json
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from functools import lru_cache
from itertools import repeat
from operator import attrgetter
from typing import Any

from measure.geometry import POSES
from pipeline.errors import InputError
from pipeline.provenance import NO_FINGERPRINT
from pipeline.text.text_file import quote_value
from pipeline.text.wording import did_you_mean

KINDS = ("fiducial", "target", "tie")
LEARNED = "learned"  # kind of decisions about the appearance of a camera's marks, not about their places


class Choice(StrEnum):
    """Kinds of decisions."""

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
_NO_PLACES: Mapping[str, tuple[float, float]] = {}


@dataclass(frozen=True, slots=True)
class Decision:
    """One decision.

    Attributes
    ----------
    image : name of the image.
    decision : kind of decision.
    point, kind : of the mark; "" for a pose.
    col_px, row_px : place of the mark (`place`).
    pose : of the scan (`pose`).
    note, who : remark and person.
    when : ISO 8601.
    fingerprint : of the result that was reviewed; for `learn` SHA-256 of the scan's file.
    window : part of the scan that was visible: first column, first row, width, height, px.
    px : places of the marks by fiducial (`learn`).
    line : number of the line in the file; 0 outside a file.
    """

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
    def subject(self) -> About:
        """(image, point, kind) that the decision is about. The default kind is a fiducial."""
        return self.image, self.point, self.kind or (KINDS[0] if self.point else "")


def decision_line(decision: Decision) -> str:
    values = {key: getattr(decision, key) for key in _CHECKS}
    content = {key: value for key, value in values.items() if value not in (None, "", {})}
    try:
        line = json.dumps(content, ensure_ascii=False, allow_nan=False)
        decisions_of_lines([(0, line.encode())])
    except (LineError, ValueError) as error:
        about = f"{decision.image}{f', {decision.point}' if decision.point else ''}"
        raise InputError(f"the decision about {about}{error}. Nothing was written.") from None
    return f"{line}\n"


class LineError(Exception):
    """Error in a line; its text follows the line's number."""

    number: int

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(f"{f', {key}' if key else ''}: {message}")


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


_read_json = json.JSONDecoder(parse_constant=_no_number).decode


def is_cut_short(line: bytes) -> bool:
    """Whether a line ends within its JSON object, as after a crash, rather than having a typing error."""
    try:
        _read_json(line.decode("utf-8", "replace"))
    except json.JSONDecodeError as error:
        ends = error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated string")
        return ends and line.lstrip().startswith(b"{")
    except (ValueError, RecursionError):
        pass
    return False


def decisions_of_lines(numbered: Sequence[tuple[int, bytes]]) -> list[Decision]:
    """Decisions of lines, parsed all at once; one by one only after an error, to find its line."""
    numbers, lines = [number for number, _ in numbered], [line for _, line in numbered]
    if {line[:1] + line[-1:] for line in lines} == {b"{}"}:
        with suppress(ValueError, RecursionError, LineError):
            objects = _read_json(f"[{b','.join(lines).decode()}]")
            if len(objects) == len(lines):
                return _decisions(objects, numbers)
    decisions = list[Decision]()
    for number, line in numbered:
        try:
            decisions += _decisions([_json_object(line)], [number])
        except LineError as error:
            error.number = number
            raise
    return decisions


def _json_object(line: bytes) -> Any:
    try:
        return _read_json(line.decode())
    except (ValueError, RecursionError) as error:
        raise LineError(f"is no JSON ({error}). Mend the line, or take it out.") from None


def _decisions(objects: Sequence[Any], numbers: Sequence[int]) -> list[Decision]:
    """Decisions of JSON objects, checked by key for all objects with the same keys and kind of decision."""
    groups = defaultdict[tuple[str, ...], list[tuple[int, dict[str, Any]]]](list)
    for number, content in zip(numbers, objects, strict=True):
        if not isinstance(content, dict):
            raise LineError(f"must be a JSON object, not {quote_value(content)}.")
        groups[str(content.get("decision")), *content].append((number, content))
    decisions = [
        one for (_, *keys), group in groups.items() for one in _decisions_alike(keys, *zip(*group, strict=True))
    ]
    return decisions if len(groups) == 1 else sorted(decisions, key=attrgetter("line"))


def _decisions_alike(keys: Sequence[str], numbers: Sequence[int], objects: Sequence[dict[str, Any]]) -> list[Decision]:
    """Decisions of one kind whose objects have the same keys."""
    for key in keys:
        if key not in _CHECKS:
            raise LineError(f"there is no such key.{did_you_mean(key, _CHECKS)} Known: {', '.join(_CHECKS)}.", key)
    columns = zip(*map(dict.values, objects), strict=True)
    values = {key: _check_values(key, column) for key, column in zip(keys, columns, strict=True)}
    if "decision" not in values:
        raise LineError("is missing.", "decision")
    choice, needed = _RULES[values["decision"][0]]
    for key in needed:
        if key not in values or not all(value or value == 0.0 for value in values[key]):
            raise LineError(f"must be {_MUST_BE[key]}, not None." if key in _MUST_BE else "is missing.", key)
    if choice in (Choice.POSE, Choice.LEARN) and any(values.get("point", ())):
        what = "a pose" if choice is Choice.POSE else "what is learned"
        raise LineError(f"is of no use: {what} is of the whole scan. Take it out.", "point")
    values["line"] = numbers
    fixed = {"decision": choice, **_FIXED.get(choice, {"pose": "", "px": _NO_PLACES})}
    decisions = [object.__new__(Decision) for _ in objects]  # for a million, the constructor takes most of the time
    for key, default in {**_DEFAULTS, **fixed, "line": 0}.items():
        column = values[key] if key in values and key not in fixed else repeat(default)
        deque(map(getattr(Decision, key).__set__, decisions, column), maxlen=0)
    return decisions


def _check_values(key: str, values: Sequence[Any]) -> Sequence[Any]:
    """Values of a key in many lines. Equal texts are checked once and share one object."""
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
        raise LineError(f"must be text, not {quote_value(value)}.", key)
    return value


def _check_choice(key: str, value: Any) -> str:
    return value if value.__class__ is str and value in _RULES else _check_word(key, value, _RULES)


def _check_kind(key: str, value: Any) -> str:
    return value if value.__class__ is str and value in _KINDS_OR_NONE else _check_word(key, value, _KINDS_OR_NONE[1:])


def _check_pose(key: str, value: Any) -> str:
    return _check_word(key, value, POSES) if value != "" else value


def _check_word(key: str, value: Any, choices: Collection[str]) -> str:
    text = _check_text(key, value)
    if text not in choices:
        raise LineError(
            f"must be one of {', '.join(choices)}, not {quote_value(value)}.{did_you_mean(text, choices)}", key
        )
    return text


def _is_pixel(value: Any) -> bool:
    return (value.__class__ is float or value.__class__ is int) and -1e9 < value < 1e9


def _check_pixels(key: str, value: Any) -> float | None:
    if value is None:
        return None
    if not _is_pixel(value):
        raise LineError(f"must be {_MUST_BE[key]}, not {quote_value(value)}.", key)
    return float(value)


def _check_places(key: str, value: Any) -> dict[str, tuple[float, float]]:
    if not isinstance(value, dict) or not all(map(_is_place, value.values())):
        raise LineError(f"must be {_MUST_BE[key]}, not {quote_value(value)}.", key)
    return {point: (float(col), float(row)) for point, (col, row) in value.items()}


def _is_place(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_pixel, value))


def _check_time(key: str, value: Any) -> str:
    text = _check_text(key, value)
    if not _is_time(text):
        raise LineError(f"must be a time as 2026-01-31T12:00:00+00:00, not {quote_value(text)}.", key)
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
        raise LineError("must be four numbers of pixels: first column, first row, width, height.", key)
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
_FIXED: Mapping[Choice, Mapping[str, Any]] = {  # override the line's own values
    Choice.POSE: {"kind": "", "px": _NO_PLACES},
    Choice.LEARN: {"kind": LEARNED, "pose": ""},
}
_RULES: Mapping[str, tuple[Choice, tuple[str, ...]]] = {  # kind of decision, and the keys that it requires
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

"""Serialisation of records, dataclasses and named tuples, as JSON, for all result files.

The fields of a record are the keys of the file, in order. Readers check values against the annotations and ignore
unknown keys. `float` is a number, or null for NaN; `Finite` is never null. A field with default None is written only
if it is set. Metadata of a field: KEY, its name in the file if different; REST, for a mapping whose entries are
written among the other keys.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pipeline.errors import InputError
from pipeline.text.atomic import write_atomically
from pipeline.text.text_file import quote_value, read_json

Record = TypeVar("Record")
Read = Callable[[Any], Any]
Field = tuple[str, str, Any]  # name, key, default

FINITE, KEY, REST = "finite", "key", "rest"
Finite = Annotated[float, FINITE]

_AT_A_TIME = 10_000  # JSON tokens written at once
_NAMES: Mapping[type, str] = {str: "a text", bool: "true or false", int: "a whole number", float: "a number"}


class WrongForm(Exception):
    """Invalid value in a record. problem: what is wrong; place: path of the value within the record."""

    def __init__(self, problem: str, place: str = "") -> None:
        super().__init__(problem)
        self.problem, self.place = problem, place

    def nested_in_list(self, place: str) -> "WrongForm":
        return WrongForm(self.problem, place + self.place)


def json_text(record: object, ensure_ascii: bool = False) -> Iterator[str]:
    """Yield a record as JSON in pieces: a large result as one string takes several times as much memory."""
    encoder = json.JSONEncoder(indent=1, ensure_ascii=ensure_ascii, allow_nan=False, default=_content)
    parts = encoder.iterencode(_plain(record))
    while some := "".join(islice(parts, _AT_A_TIME)):
        yield some
    yield "\n"


def write_record(record: object, path: Path) -> None:
    """Write a record to a file. Raises WriteError if that fails."""
    write_atomically(path, "".join(json_text(record)))


def plain_json(record: object) -> Any:
    """Convert a record to dicts, lists, strings and numbers."""
    return json.loads("".join(json_text(record)))


def record_from(kind: type[Record], source: object, **changes: object) -> Record:
    """Record with an object's attributes of the same names as its fields, but for the changes."""
    key: Any = kind
    names = (name for name, _, _ in _fields(key) if name not in changes and hasattr(source, name))
    return kind(**{name: getattr(source, name) for name in names}, **changes)


def read_record(kind: type[Record], path: Path, remedy: str) -> Record:
    """Read a record from a file. remedy: sentence appended to the error message.

    Raises FileNotFoundError and IsADirectoryError, and InputError if the file is not JSON or has an invalid value; the
    message names the place and the expected value.
    """
    content = read_json(path)
    try:
        return parsed(kind, content)
    except WrongForm as wrong:
        place = wrong.place.removeprefix(".") or "the file"
        raise InputError(f"{path}: {place} {wrong.problem}. {remedy}") from None


def parsed(kind: type[Record], content: Any) -> Record:
    """Convert parsed JSON to a record. Raises WrongForm for invalid content."""
    key: Any = kind
    reader: Callable[[Any], Record] = _reader(key)
    return reader(content)


def _content(record: object) -> dict[str, Any]:
    """Keys and values of a record; nested records are not converted."""
    content: dict[str, Any] = {}
    kind: Any = type(record)
    for name, key, default in _fields(kind):
        value = getattr(record, name)
        if value is None and default is None:
            continue
        if key == REST:
            content |= _plain(value)
        else:
            content[key] = _plain(value)
    return content


def _plain(value: Any) -> Any:
    """Convert a value for JSON, non-finite numbers to null; dataclasses are left to the encoder."""
    if isinstance(value, str | int | None):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if hasattr(value, "_fields"):
        return _content(value)
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@cache
def _fields(kind: type) -> tuple[Field, ...]:
    if not is_dataclass(kind):  # a named tuple
        named: Any = kind
        return tuple((name, name, named._field_defaults.get(name, MISSING)) for name in named._fields)
    made = []
    for each in fields(kind):
        default = each.default if each.default_factory is MISSING else each.default_factory
        made.append((each.name, REST if REST in each.metadata else each.metadata.get(KEY, each.name), default))
    return tuple(made)


@cache
def _reader(kind: Any) -> Read:
    """Function that reads a value of a type or raises WrongForm."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _annotated(arguments[0], arguments[1])
    if origin in (Union, UnionType):
        inner = next(each for each in arguments if each is not NoneType)
        return _number if inner is float else _optional(_reader(inner))  # for numbers, null is NaN
    if origin is Literal:
        return _word(arguments)
    if origin is tuple:
        return _list(_reader(arguments[0]), None if arguments[1] is ... else len(arguments))
    if kind is Any:
        return lambda value: value
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(_reader(arguments[1]))
    return _plain_reader(kind) if kind in _NAMES else _record_reader(kind)


def _plain_reader(kind: type, is_finite: bool = False) -> Read:
    if kind is float:
        return _finite if is_finite else _number

    def read(value: Any) -> Any:
        if type(value) is not kind:
            raise _wrong(value, _NAMES[kind])
        return value

    return read


def _number(value: Any) -> float:
    return math.nan if value is None else _finite(value, " or null")


def _finite(value: Any, others: str = "") -> float:
    if type(value) is not float and type(value) is not int:
        raise _wrong(value, f"a number{others}")
    try:
        number = float(value)
    except OverflowError:  # a whole number of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise _wrong(value, "a finite number")
    return number


def _annotated(kind: Any, note: Any) -> Read:
    """Reader of an annotated type. note: FINITE, or a function that raises ValueError for invalid values."""
    if note == FINITE:
        return _plain_reader(kind, is_finite=True)
    read = _reader(kind)

    def read_checked(value: Any) -> Any:
        try:
            note(read(value))
        except ValueError as error:
            raise WrongForm(f"is not what it should be: {error}") from None
        return value

    return read_checked


def _optional(read: Read) -> Read:
    def read_value(value: Any) -> Any:
        try:
            return None if value is None else read(value)
        except WrongForm as wrong:
            raise wrong if wrong.place else WrongForm(f"{wrong.problem} or null") from None

    return read_value


def _word(words: tuple[str, ...]) -> Read:
    def read(value: Any) -> Any:
        if value not in words:
            raise _wrong(value, " or ".join(map(repr, words)))
        return value

    return read


def _list(read: Read, length: int | None) -> Read:
    def read_value(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or (length is not None and len(value) != length):
            raise _wrong(value, "a list" if length is None else f"a list of {length}")
        made: list[Any] = []
        try:
            for item in value:
                made.append(read(item))  # noqa: PERF401  # its length gives the index of the invalid item
        except WrongForm as wrong:
            raise wrong.nested_in_list(f"[{len(made)}]") from None
        return tuple(made)

    return read_value


def _mapping(read: Read) -> Read:
    def read_value(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise _wrong(value, "a table")
        made, key = {}, ""
        try:
            for key, item in value.items():
                made[key] = read(item)
        except WrongForm as wrong:
            raise wrong.nested_in_list(f"[{key!r}]") from None
        return made

    return read_value


def _record_reader(kind: type) -> Read:
    hints, known = get_type_hints(kind, include_extras=True), _fields(kind)
    readers = [(name, key, _reader(hints[name])) for name, key, _ in known]
    keys = {key for _, key, _ in known}
    needed = {key for _, key, default in known if default is MISSING and key != REST}

    def read(value: Any) -> Any:
        if not isinstance(value, dict):
            raise _wrong(value, "a table")
        if not needed <= value.keys():
            raise WrongForm(f"has no key {next(key for _, key, _ in known if key in needed - value.keys())!r}")
        made, key = {}, ""
        try:
            for name, key, of in readers:
                if key in value:
                    made[name] = of(value[key])
                elif key == REST:
                    made[name] = of({each: item for each, item in value.items() if each not in keys})
        except WrongForm as wrong:
            raise wrong.nested_in_list("" if key == REST else f".{key}") from None
        try:
            return kind(**made)
        except ValueError as error:  # from __post_init__: inconsistent fields
            raise WrongForm(str(error)) from None

    return read


def _wrong(value: Any, expected: str) -> WrongForm:
    return WrongForm(f"is {quote_value(value)}; it should be {expected}")

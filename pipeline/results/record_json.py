"""Serialisation of records, dataclasses and named tuples, as JSON, for all result files.

The fields of a record are the keys of the file, in order; an alias is the name of a key that is no name of a field.
Readers check values against the annotations and ignore unknown keys. `Number` is a number, or null for NaN; `Sigma`
such a number that is not negative; `Finite` is never null. A field with default None is written only if it is set.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass, make_dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import pydantic

from adjust.problem.parameter import Parameter, parameter_from_text
from pipeline.errors import InputError
from pipeline.text.files import RESULT_MB, parse_json, quote_value, read_bytes, write_atomically
from pipeline.text.table_models import MANY_KEYS, name_in_file
from pipeline.text.toml_tables import list_words
from pipeline.text.wording import LISTED

Record = TypeVar("Record")
_AT_A_TIME = 10_000  # JSON tokens written at once


def _number(value: Any) -> float:
    return math.nan if value is None else _finite(value, " or null")


def _sigma(value: Any) -> float:
    sigma = _number(value)
    if sigma < 0.0:
        raise ValueError(_wrong(value, "a number of at least 0, or null"))
    return sigma


def _finite(value: Any, others: str = "") -> float:
    if type(value) is not float and type(value) is not int:
        raise ValueError(_wrong(value, f"a number{others}"))
    try:
        number = float(value)
    except OverflowError:  # a whole number of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(_wrong(value, "a finite number"))
    return number


def _wrong(value: Any, expected: str) -> str:
    return f"is {quote_value(value)}; it should be {expected}"


def read_parameter(value: Any) -> Parameter:
    """Read a key of a quantity from its text. Raises ValueError."""
    if not isinstance(value, str):
        raise ValueError(_wrong(value, "a text"))
    try:
        return parameter_from_text(value)
    except ValueError as error:
        raise ValueError(f"is not what it should be: {error}") from None


Flag = Annotated[bool, pydantic.Strict()]
Whole = Annotated[int, pydantic.Strict()]
Number = Annotated[float, pydantic.PlainValidator(_number)]
Sigma = Annotated[float, pydantic.PlainValidator(_sigma)]
NumberOrNone = Annotated[float | None, pydantic.PlainValidator(_number)]
Finite = Annotated[float, pydantic.PlainValidator(_finite)]
_EXPECTED = {
    "string_type": "a text", "bool_type": "true or false", "int_type": "a whole number", "float_type": "a number",
    "dict_type": "a table", "dataclass_type": "a table",
}  # fmt: skip


class _Foreign:
    """Note on a record of another package: its numbers are read as those of the records here."""

    def __get_pydantic_core_schema__(self, source: Any, handler: pydantic.GetCoreSchemaHandler) -> Any:
        types: Any = {bool: Flag, int: Whole, float: Number, tuple[float, float]: tuple[Number, Number]}
        types[tuple[Parameter, ...]] = tuple[Annotated[Parameter, pydantic.PlainValidator(read_parameter)], ...]
        hints = {name: types.get(hint, hint) for name, hint in get_type_hints(source).items()}
        stand_in: Any = make_dataclass(source.__name__, hints.items())
        return handler.generate_schema(
            Annotated[stand_in, pydantic.AfterValidator(lambda value: source(**vars(value)))]
        )


FOREIGN = _Foreign()


class WithRest:
    """Base of records with a mapping, the field `rest`, whose entries stand among the other keys in the file."""

    __slots__ = ()
    rest: ClassVar[str]

    @pydantic.model_validator(mode="before")
    @classmethod
    def _gathered(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        kind: Any = cls
        known = {key for _, key, _ in _fields(kind)} - {cls.rest}
        own = {key: each for key, each in value.items() if key in known}
        return own | {cls.rest: {key: each for key, each in value.items() if key not in known}}


def json_text(record: object, ensure_ascii: bool = False) -> Iterator[str]:
    """Yield a record as JSON in pieces: a large result as one string takes several times as much memory."""
    encoder = json.JSONEncoder(indent=1, ensure_ascii=ensure_ascii, allow_nan=False, default=record_content)
    parts = encoder.iterencode(_plain(record))
    while some := "".join(islice(parts, _AT_A_TIME)):
        yield some
    yield "\n"


def write_record(record: object, path: Path) -> None:
    """Write a record to a file. Raises WriteError if that fails."""
    write_atomically(path, "".join(json_text(record)))


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
    data = read_bytes(path, RESULT_MB)
    try:
        record: Record = _adapter(kind).validate_json(data)
        return record
    except pydantic.ValidationError as error:
        parse_json(data, path)  # raises for a file that is no JSON
        errors = error.errors(include_url=False)
        lacked = [each["loc"][0] for each in errors if each["type"] == "missing" and len(each["loc"]) == 1]
        needed = getattr(kind, "file_name", path.name)
        if path.name != needed and len(lacked) > MANY_KEYS:
            keys = list_words(lacked[:LISTED])
            raise InputError(
                f"{path}: is a file of another kind: it lacks the keys {keys}. Name the {needed} that is meant."
            ) from None
        place, problem = _place_and_problem(kind, errors[0])
        raise InputError(f"{path}: {place or 'the file'} {problem}. {remedy}") from None


_adapter: Callable[[Any], pydantic.TypeAdapter[Any]] = cache(pydantic.TypeAdapter)


def _place_and_problem(kind: Any, error: Any) -> tuple[str, str]:
    """Path of a wrong value within a record, and what is wrong."""
    place, at = "", kind
    way = error["loc"][:-1] if error["type"] == "missing" else error["loc"]
    for step in way:
        at = _required_type(at)
        if isinstance(step, int):
            place, at = f"{place}[{step}]", get_args(at)[0]
        elif get_origin(at) is not None:
            place, at = f"{place}[{step!r}]", get_args(at)[1]
        else:
            name = next(name for name, key, _ in _fields(at) if step in (key, name))
            place = place if name == getattr(at, "rest", "") else f"{place}.{step}"
            at = get_type_hints(at, include_extras=True)[name]
    wrong, arguments, cause = error["type"], get_args(_required_type(at)), error.get("ctx", {}).get("error")
    if cause is not None or (wrong == "missing" and isinstance(error["loc"][-1], str)):
        return place.removeprefix("."), str(cause or f"has no key {error['loc'][-1]!r}")
    expected = _EXPECTED.get(wrong, error["msg"])
    if wrong in ("tuple_type", "missing", "too_long"):
        expected = "a list" if ... in arguments else f"a list of {len(arguments)}"
    elif wrong == "literal_error":
        expected = " or ".join(map(repr, arguments))
    null = " or null" if NoneType in get_args(at) else ""
    return place.removeprefix("."), _wrong(error["input"], expected + null)


def _required_type(kind: Any) -> Any:
    """Type without annotations and without None."""
    while get_origin(kind) is Annotated or NoneType in get_args(kind):
        kind = next(each for each in get_args(kind) if each is not NoneType)
    return kind


def record_content(record: object) -> dict[str, Any]:
    """Keys and values of a record; nested records are not converted."""
    content: dict[str, Any] = {}
    kind: Any = type(record)
    rest = getattr(kind, "rest", "")
    for name, key, default in _fields(kind):
        value = getattr(record, name)
        if value is None and default is None:
            continue
        if name == rest:
            content |= _plain(value)
        else:
            content[key] = _plain(value)
    return content


def _plain(value: Any) -> Any:
    """Convert a value for JSON, non-finite numbers to null, keys of quantities to their texts; dataclasses are left to
    the encoder."""
    if isinstance(value, str | int | None):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Parameter):
        return value.text
    if hasattr(value, "_fields"):
        return record_content(value)
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@cache
def _fields(kind: type) -> tuple[tuple[str, str, Any], ...]:
    """Name, key in the file and default of each field of a record."""
    if not is_dataclass(kind):  # a named tuple
        named: Any = kind
        return tuple((name, name, named._field_defaults.get(name, MISSING)) for name in named._fields)
    return tuple(
        (each.name, name_in_file(each), each.default if each.default_factory is MISSING else each.default_factory)
        for each in fields(kind)
    )

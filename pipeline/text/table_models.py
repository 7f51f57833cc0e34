"""TOML tables as pydantic dataclasses: each field is a key with its type, default and meaning.

A field is written as `radius_mm: Annotated[Positive, "Of the disk."] = 1.0`. Types have readers that raise ValueError;
`read_model` turns their messages into one with file, line and key.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from types import GenericAlias, NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import AfterValidator, ConfigDict, PlainValidator, TypeAdapter, ValidationError, ValidationInfo
from pydantic.dataclasses import dataclass as pydantic_dataclass
from pydantic.dataclasses import is_pydantic_dataclass
from pydantic.fields import FieldInfo

from pipeline.errors import InputError
from pipeline.text.files import LARGEST, quote_value
from pipeline.text.toml_tables import Table, list_words
from pipeline.text.wording import LISTED, did_you_mean, nearest

Model = TypeVar("Model")

FREE = "free"
_NO_TABLES = "must be written as [[{table}]], once for each."
MANY_KEYS = 3  # a file with more keys, and fewer that are known, is of another kind
_UNITS = {"mm": "mm", "um": "µm", "deg": "°", "px": "px", "ppm": "ppm", "urad": "µrad", "dm": "dm"}
_LONGEST_PATH, _LONGEST_NAME = 4000, 255  # bytes, limits of most file systems

# Types of keys.


@dataclasses.dataclass(frozen=True)
class Key:
    """Type of a key. words: its name in the documentation; read: returns the value, or raises ValueError; in its
    message {key} stands for the key."""

    words: str
    read: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return PlainValidator(self._validated).__get_pydantic_core_schema__(Any, handler)

    def _validated(self, value: Any, info: ValidationInfo) -> Any:
        """Value as read from a file; one given by a program is taken as it is."""
        return self.read(value) if info.context else value


def text(value: Any) -> str:
    """Read a text. Raises ValueError."""
    if not isinstance(value, str):
        raise ValueError(f'must be text in quotes, not {quote_value(value)}. Write {{key}} = "...".')
    return value


def texts(value: Any) -> tuple[str, ...]:
    """Read a list of texts. Raises ValueError."""
    if not isinstance(value, list | tuple) or not all(isinstance(item, str) for item in value):
        raise ValueError(f'must be a list of texts, ["...", "..."], not {quote_value(value)}.')
    return tuple(value)


def known_name(value: Any, find: Callable[[str], object], names: Collection[str]) -> str:
    """Read a text for which `find` raises no ValueError. names: those that it may resemble. Raises ValueError."""
    name = text(value)
    try:
        find(name)
    except ValueError as error:
        raise ValueError(f"{error}.{did_you_mean(name, names)}") from None
    return name


def _path(value: Any) -> str:
    name = text(value)
    longest = max((len(os.fsencode(part)) for part in Path(name).parts), default=0)
    if not name.isprintable() or len(os.fsencode(name)) > _LONGEST_PATH or longest > _LONGEST_NAME:
        raise ValueError(f"{quote_value(name)} can be no file's name: too long, or not all of it can be read.")
    return name


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"must be true or false, not {quote_value(value)}.")
    return value


def number(value: Any, above: float = -math.inf, least: float = -math.inf) -> float:
    """Read a finite number within limits. Raises ValueError."""
    try:
        known = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:
        known = math.inf
    if not math.isfinite(known):
        raise ValueError(f"must be a number, not {quote_value(value)}.")
    if abs(known) > LARGEST:
        raise ValueError(f"{quote_value(value)} is larger than anything that is measured. Correct it.")
    if not known > above:
        raise ValueError(f"must be greater than {above:g}, not {known:g}.")
    if not known >= least:
        raise ValueError(f"must be at least {least:g}, not {known:g}.")
    return known


def _whole(value: Any, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        limits = f"at least {least}" if isinstance(value, int) and value < least else f"{least} to {most}"
        raise ValueError(f"must be a whole number of {limits}, not {quote_value(value)}.")
    return value


def sigma(value: Any) -> float:
    """Read a standard deviation; 0: fixed, "free" (inf): no prior. Raises ValueError."""
    if value == FREE or value == math.inf:
        return math.inf
    if isinstance(value, str):
        raise ValueError(f'must be a standard deviation, 0 (fixed) or "{FREE}", not {quote_value(value)}.')
    known = number(value)
    if known < 0.0:
        raise ValueError(f'is a standard deviation and cannot be negative ({known:g}); 0 fixes, "{FREE}" frees.')
    return known


def _sigma_pair(value: Any) -> tuple[float, float]:
    if not isinstance(value, list | tuple):
        value = [value] * 2
    if len(value) != 2:
        raise ValueError(f"must be one standard deviation or two, [sx, sy], not {quote_value(value)}.")
    return sigma(value[0]), sigma(value[1])


def _several(value: Any, count: int, form: str) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or len(value) != count:
        raise ValueError(f"must be {form}, not {quote_value(value)}.")
    return tuple(map(number, value))


def pair(value: Any) -> tuple[float, float]:
    """Read [x, y]. Raises ValueError."""
    x, y = _several(value, 2, "two numbers, [x, y]")
    return x, y


def number_or_pair(value: Any) -> tuple[float, float]:
    """Read one number for both axes, or [x, y]. Raises ValueError."""
    return pair(value if isinstance(value, list | tuple) else (value, value))


def numbers(value: Any) -> tuple[float, ...]:
    """Read a list of numbers; integers remain integers. Raises ValueError."""
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(f"must be a list of numbers, [1.0, 2.0, ...], not {quote_value(value)}.")
    read = map(number, value)
    return tuple(item if type(item) is int else known for item, known in zip(value, read, strict=True))


def points(value: Any) -> tuple[tuple[float, float], ...]:
    """Read a list of points. Raises ValueError."""
    if not isinstance(value, list | tuple) or not all(
        isinstance(item, list | tuple) and len(item) == 2 for item in value
    ):
        raise ValueError(f"must be a list of points, [[x, y], [x, y], ...], not {quote_value(value)}.")
    return tuple((number(x), number(y)) for x, y in value)


def _values(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"must be a table, [{{table}}], not {quote_value(value)}.")
    return value


def _entries(value: Any) -> Sequence[Any]:
    if not isinstance(value, list | tuple) or not all(isinstance(item, dict) for item in value):
        raise ValueError(_NO_TABLES)
    return value


def whole(least: int = 0, most: int = 10**9) -> Key:
    """Type of a whole number within limits."""
    limits = f", {least} or more" if most == 10**9 else f" of {least} to {most}"
    return Key(f"whole number{limits}", partial(_whole, least=least, most=most))


def choice(*words: str | int) -> Key:
    """Type of a choice of words or numbers."""

    def read(value: Any) -> Any:
        word = text(value) if isinstance(words[0], str) else value
        if word not in words:
            hint = did_you_mean(str(word), map(str, words))
            raise ValueError(f"is {quote_value(word)}; possible are {list_words(words)}.{hint}")
        return word

    return Key(" or ".join(f'"{word}"' for word in words), read)


def number_or_word(*words: str) -> Key:
    """Type of a number above 0, or one of some words."""

    def read(value: Any) -> float | str:
        if isinstance(value, str) and value not in words:
            also = f"{did_you_mean(value, words)} A number above 0, without quotes, is possible, too."
            raise ValueError(f"is {quote_value(value)}; possible are {list_words(words)}.{also}")
        return value if isinstance(value, str) else number(value, above=0.0)

    return Key(", ".join([f'"{word}"' for word in words]) + " or a power", read)


FilePath = Annotated[str, Key("path", _path)]
FilePaths = Annotated[tuple[str, ...], Key("list of paths", lambda value: tuple(map(_path, texts(value))))]
Positive = Annotated[float, Key("number above 0", partial(number, above=0.0))]
NotNegative = Annotated[float, Key("number, 0 or more", partial(number, least=0.0))]
Sigma = Annotated[float, Key('standard deviation, 0 or "free"', sigma)]
SigmaPair = Annotated[tuple[float, float], Key('standard deviation or [sx, sy], 0 or "free"', _sigma_pair)]
NumberOrPair = Annotated[tuple[float, float], Key("number or [x, y]", number_or_pair)]
Values = Annotated[Mapping[str, Any], Key("table", _values)]
Entries = Annotated[Sequence[Mapping[str, Any]], Key("tables", _entries)]
_USUAL: Mapping[Any, Key] = {  # types of fields that state no other
    str: Key("text", text),
    bool: Key("true or false", _flag),
    int: whole(),
    float: Key("number", number),
    tuple[str, ...]: Key("list of texts", texts),
    tuple[float, float]: Key("[x, y]", pair),
    tuple[float, float, float]: Key("[x, y, z]", partial(_several, count=3, form="three numbers, [x, y, z]")),
}


# Models of tables.


class WrongKey(ValueError):
    """Wrong value of a key, found by `__post_init__` of a model."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(message)
        self.key = key


@dataclass_transform(kw_only_default=True, frozen_default=True)
def table_model(model: type[Model]) -> type[Model]:
    """Make a class a model of a table; fields without a `Key` get the usual one of their type."""
    hints, given = get_type_hints(model, include_extras=True), getattr(model, "__dataclass_fields__", {})
    for name, field in given.items():
        if name not in vars(model) and field.default_factory is not dataclasses.MISSING:
            setattr(model, name, dataclasses.field(default_factory=field.default_factory))
    model.__annotations__ = {name: _add_key(hint) for name, hint in hints.items()}
    config = ConfigDict(extra="forbid", arbitrary_types_allowed=True, validate_by_name=True, validate_by_alias=True)
    return cast(type[Model], pydantic_dataclass(frozen=True, kw_only=True, config=config)(model))


def _add_key(hint: Any) -> Any:
    """Annotation of a field, with the usual `Key` of its type if it has none."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        has_key = any(isinstance(each, Key) for each in arguments[1:])
        return hint if has_key else Annotated[_add_key(arguments[0]), *arguments[1:]]
    if origin in (Union, UnionType) and NoneType in arguments and len(arguments) == 2:
        return _add_key(next(each for each in arguments if each is not NoneType)) | None
    if origin is Literal:
        return Annotated[hint, choice(*arguments)]
    if hint in _USUAL:
        return Annotated[hint, _USUAL[hint]]
    if origin is tuple and arguments[1:] == (...,):
        return GenericAlias(tuple, (_add_key(arguments[0]), ...))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return GenericAlias(Mapping, (str, _add_key(arguments[1])))
    if isinstance(hint, type) and dataclasses.is_dataclass(hint) and not is_pydantic_dataclass(hint):
        own: Any = table_model(type(hint.__name__, (hint,), {"__module__": hint.__module__}))
        return Annotated[own, AfterValidator(lambda value: hint(**vars(value)))]
    return hint


def read_model(table: Table, model: type[Model]) -> Model:
    """Read a table as a model, or as another dataclass with the names of its keys.

    Raises
    ------
    InputError
        For a wrong value, a missing key or unknown keys (all in one message), with file, line and key.
    """
    try:
        read: Model = _adapter(model).validate_python(table.values, context=True)
        return read
    except ValidationError as error:
        raise InputError(_message(table, model, error)) from None


def read_kind(table: Table, models: Mapping[str, type[Model]], key: str = "kind", usual: str | None = None) -> Model:
    """Read a table as the model that the word of a key names. Raises InputError as `read_model` does."""
    if key not in table and usual is None:
        raise InputError(_missing(table, key, (key,)))
    try:
        word = choice(*models).read(table.values.get(key, usual))
    except ValueError as error:
        raise table.error(key, str(error).replace("{key}", key)) from None
    return read_model(table, models[word])


_adapter: Callable[[Any], TypeAdapter[Any]] = cache(lambda model: TypeAdapter(_add_key(model)))


def _message(root: Table, model: type, error: ValidationError) -> str:
    """Message of the first wrong or missing value; else of all unknown keys; of a file of another kind just that."""
    given, known = [key for key in root.values if key in _keys(model)], sorted(_keys(model))
    if not root.place and len(root.values) > MANY_KEYS > len(given):
        keys = list_words(list(root.values)[:LISTED])
        needed = getattr(model, "file_kind", "")
        needed = f"A {needed} is needed here; it has" if needed else "Here it has"
        return f"{root.file}: is a file of another kind, with the keys {keys}. {needed} {list_words(known)}."
    unknown: list[tuple[Table, type, str]] = []
    for each in error.errors(include_url=False, include_input=False):
        kind, (table, own, rest) = each["type"], _place(root, model, each["loc"])
        key = str(rest[0]) if rest else ""
        if kind == "unexpected_keyword_argument":
            unknown.append((table, own, key))
            continue
        if kind == "missing":
            return _missing(table, key, _keys(own))
        cause = each.get("ctx", {}).get("error")
        text = f"must be a table, [{{table}}], not {quote_value(table.values.get(key))}."
        if isinstance(cause, ValueError):
            text = str(cause)
        elif kind == "tuple_type" or isinstance(table.values.get(key), list):
            text = _NO_TABLES
        key = cause.key if isinstance(cause, WrongKey) else key
        text = text.replace("{key}", key).replace("{table}", table.inside(key))
        return str(table.error(key, text)) if key else f"{root.file}: {text}. Correct the file."
    # Only what is shown: each message searches the file for its line.
    lines = list[str]()
    for _, some in groupby(unknown[:LISTED], key=lambda each: each[0].place):
        (table, own, first), *others = some
        lines += table.unknown_keys(_keys(own), [first, *(key for _, _, key in others)])
    if len(unknown) > LISTED:
        lines.append(f"{root.file}: {len(unknown) - LISTED} more keys are not known.")
    return "\n".join(lines) or f"{root.file}: {error}"


def _missing(table: Table, key: str, known: Collection[str]) -> str:
    near = nearest(key, [name for name in table.values if name not in known])
    return str(table.error(key, "is missing. Add it" + (f", or rename {near!r} to it." if near else ".")))


def _place(table: Table, model: type, loc: tuple[int | str, ...]) -> tuple[Table, type, tuple[int | str, ...]]:
    """Innermost table on a path of keys and numbers, its model, and the rest of the path."""
    while loc:
        key, value = str(loc[0]), table.values.get(str(loc[0]))
        names = {name_in_file(field): field.name for field in _model_fields(model)}
        hint: Any = get_type_hints(model).get(names.get(key, ""))
        kinds = [each for each in (hint, *get_args(hint)) if isinstance(each, type) and dataclasses.is_dataclass(each)]
        inner = kinds[0] if kinds else None  # model of a sub-table, or of each of several
        if inner is not None and isinstance(value, dict):
            table, model, loc = table.table(key), inner, loc[1:]
        elif inner is not None and isinstance(value, list) and len(loc) > 1 and isinstance(value[int(loc[1])], dict):
            table, model, loc = table.tables(key)[int(loc[1])], inner, loc[2:]
        elif isinstance(value, dict) and len(loc) > 1:
            table, loc = table.table(key), loc[1:]
        else:
            break
    return table, model, loc


def _model_fields(model: type) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(model) if dataclasses.is_dataclass(model) else ()


def _keys(model: type) -> list[str]:
    return [name_in_file(field) for field in _model_fields(model)]


def name_in_file(field: dataclasses.Field[Any]) -> str:
    """Alias of a field, its name if it has none."""
    notes = get_args(field.type)[1:] if get_origin(field.type) is Annotated else ()
    return next((each.alias for each in notes if isinstance(each, FieldInfo) and each.alias), field.name)


# Documentation.


@dataclasses.dataclass(frozen=True)
class KeyRow:
    """Row of the table of keys in the documentation. default: as in TOML; "required" if the key must be given."""

    name: str
    type: str
    unit: str
    default: str
    meaning: str


def key_rows(model: type) -> Iterator[KeyRow]:
    """Yield the rows of the keys of a model, in order."""
    for field in _model_fields(model):
        notes = list(_notes(field.type))
        words = next((each.words for each in notes if isinstance(each, Key)), None)
        meaning = next((each for each in notes if isinstance(each, str)), "")
        unit = _UNITS.get(field.name.rpartition("_")[2], "")
        is_array = "tuple" in str(field.type)
        form = words or ("tables" if is_array else "table")
        yield KeyRow(name_in_file(field), form, unit, _default_text(field), meaning)


def _notes(hint: Any) -> Iterator[Any]:
    """Yield the notes of an annotation, also of the type in an optional one."""
    if get_origin(hint) is Annotated:
        yield from get_args(hint)[1:]
    if get_origin(hint) in (Annotated, Union, UnionType):
        for each in get_args(hint)[: 1 if get_origin(hint) is Annotated else None]:
            yield from _notes(each)


def _default_text(field: dataclasses.Field[Any]) -> str:
    default = field.default
    if default is dataclasses.MISSING:
        return "required" if field.default_factory is dataclasses.MISSING else ""
    if default is None or default == () or dataclasses.is_dataclass(default):  # absent, or a sub-table
        return ""
    if isinstance(default, tuple):
        return f"[{', '.join(f'{each:g}' for each in default)}]"
    if default == math.inf:
        return '"free"'
    if isinstance(default, bool):
        return str(default).lower()
    return f'"{default}"' if isinstance(default, str) else f"{default:g}"

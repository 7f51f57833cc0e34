"""TOML tables as pydantic models: each field is a key with its type, default and meaning.

Pydantic handles names, defaults and unknown keys; `Table` reads the values, so that errors name file, line and key.
"""

from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, GetCoreSchemaHandler, PlainValidator, TypeAdapter, ValidationError, ValidationInfo
from pydantic.fields import FieldInfo

from pipeline.errors import InputError
from pipeline.text.tables import Table

Model = TypeVar("Model")

TABLE = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
_UNITS = {"mm": "mm", "um": "µm", "deg": "°", "px": "px", "ppm": "ppm", "urad": "µrad", "dm": "dm"}


@dataclass(frozen=True)
class Key:
    """Type of a key. words: name of the type; read: reads the value from its table; model: of a sub-table, else
    None."""

    words: str
    read: Callable[[Table, str], Any]
    model: type | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> Any:
        return PlainValidator(self._validated).__get_pydantic_core_schema__(Any, handler)  # `Table` checks the type

    def _validated(self, value: Any, info: ValidationInfo) -> Any:
        """Read a value of a file from its table; a value given by a program is taken as it is."""
        if not isinstance(info.context, Table):
            return value
        assert info.field_name is not None
        return self.read(info.context, info.field_name)


TEXT = Key("text", Table.text)
TEXTS = Key("list of texts", Table.texts)
PATH = Key("path", Table.path_text)
PATHS = Key("list of paths", Table.path_texts)
FLAG = Key("true or false", lambda table, key: table.flag(key, False))
NUMBER = Key("number", Table.number)
POSITIVE = Key("number above 0", lambda table, key: table.number(key, above=0.0))
NOT_NEGATIVE = Key("number, 0 or more", lambda table, key: table.number(key, least=0.0))
SIGMA = Key('standard deviation, 0 or "free"', Table.sigma)
SIGMA_PAIR = Key('standard deviation or [sx, sy], 0 or "free"', Table.sigma_pair)
PAIR = Key("[x, y]", Table.pair)
NUMBER_OR_PAIR = Key("number or [x, y]", Table.number_or_pair)
TRIPLE = Key("[x, y, z]", Table.triple)


def whole(least: int = 0, most: int = 10**9) -> Key:
    """Key of a whole number within limits."""
    limits = f", {least} or more" if most == 10**9 else f" of {least} to {most}"
    return Key(f"whole number{limits}", lambda table, key: table.whole(key, least=least, most=most))


def choice(*words: str) -> Key:
    """Key of a choice of words."""
    return Key(" or ".join(f'"{word}"' for word in words), lambda table, key: table.text(key, choices=words))


def subtable(model: type) -> Key:
    """Key of a sub-table."""
    return Key("table", lambda table, key: read_model(table.table(key), model), model)


def subtables(model: type) -> Key:
    """Key of an array of sub-tables."""
    return Key("tables", lambda table, key: tuple(read_model(each, model) for each in table.tables(key)), model)


def read_model(table: Table, model: type[Model]) -> Model:
    """Read a table as a model.

    Raises
    ------
    InputError
        For a wrong value, a missing key or unknown keys (all in one message), with file, line and key.
    """
    try:
        given: Model = _adapter(model).validate_python(dict(table.values), context=table)
        return given
    except ValidationError as error:
        raise _input_error(table, model, error) from None


_adapter: Callable[[type], TypeAdapter[Any]] = cache(TypeAdapter)


def _input_error(table: Table, model: type, error: ValidationError) -> InputError:
    known = {one.name for one in fields(model)}
    for each in error.errors(include_url=False, include_context=False, include_input=False):
        if each["type"] == "missing":
            return table.missing_key(str(each["loc"][0]), known)
    return table.unknown_keys(known) or InputError(f"{table.file}: {error}")


@dataclass(frozen=True)
class KeyRow:
    """Row of the table of keys in the documentation. default: "required" if the key must be given."""

    name: str
    type: str
    unit: str
    default: str
    meaning: str


def key_rows(model: type) -> Iterator[KeyRow]:
    """Yield the rows of the keys of a model, in order."""
    hints = get_type_hints(model, include_extras=True)
    for field in fields(model):
        key, hint = (
            next((each for each in _annotations(hints[field.name]) if isinstance(each, Key)), None),
            field.default,
        )
        default, meaning = hint, ""
        if isinstance(hint, FieldInfo):
            default, meaning = (MISSING if hint.is_required() else hint.get_default()), hint.description or ""
        unit = _UNITS.get(field.name.rpartition("_")[2], "")
        yield KeyRow(field.name, key.words if key else "", unit, _default_text(default, field), meaning)


def _annotations(hint: Any) -> tuple[Any, ...]:
    return get_args(hint)[1:] if get_origin(hint) is Annotated else ()


def _default_text(default: Any, field: Field[Any]) -> str:
    if default is MISSING:
        return "required" if field.default_factory is MISSING else ""
    if default is None or default == ():
        return "none"
    if is_dataclass(default):  # a sub-table
        return ""
    if isinstance(default, bool):
        return str(default).lower()
    return (
        f'"{default}"' if isinstance(default, str) else f"{default:g}" if isinstance(default, float) else str(default)
    )

"""TOML files with checked keys: wrong types, missing and misspelt keys give helpful messages."""

import math
import os
import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.text.text_file import LARGEST, quote_value, read_bytes
from pipeline.text.wording import LISTED, did_you_mean, nearest

FREE = "free"
MOST_MB = 4  # size of a camera file with marks learned from 12,000 scans

_DEEP = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++\s*+\.\s*+){30}""")
_BARE = re.compile(
    r"""\s*(?P<key>[\w."'-]+)\s*=\s*(?:(?P<word>[A-Za-z][\w./-]*)|(?P<number>[+-]?\d[\d.]*)\s*[A-Za-zµμ°%]+)\s*(?:\#.*)?$"""
)
_LONGEST_PATH, _LONGEST_NAME = 4000, 255  # bytes, limits of most file systems


def read_toml(path: Path) -> "Table":
    """Read the root table of a TOML file. Raises InputError for a missing file, invalid UTF-8, or a syntax error."""
    return Table(_parse(path), path, "")


def _parse(path: Path) -> dict[str, Any]:
    try:
        text = read_bytes(path, MOST_MB).decode("utf-8-sig")
        if deep := _DEEP.search(text):
            line = text.count("\n", 0, deep.start()) + 1
            raise InputError(f"{path}, line {line}: joins more names by points than any table here. Mend that line.")
        return tomllib.loads(text)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file. Looked for {path.resolve()}.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; a TOML file is needed here. {_toml_files_sentence(path)}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not text in UTF-8; a TOML file, saved as such, is needed here.") from None
    except RecursionError:
        raise InputError(f"{path}: is not valid TOML here: lists or tables stand in one another too deep.") from None
    except ValueError as error:  # a syntax error, or a number of thousands of digits
        raise InputError(f"{path}: is not valid TOML: {error}. {_mending(text, str(error))}") from None


def _mending(text: str, error: str) -> str:
    """Remedy of a syntax error; with the corrected line if it is known."""
    if re.search("Unescaped|hex value", error):
        return "Mend that line (a path has / in the place of \\)."
    place = re.search(r"at line (\d+)", error)
    found = _BARE.match(text.splitlines()[int(place[1]) - 1]) if place else None
    if found and found["word"]:
        return f'Text stands in quotes: {found["key"]} = "{found["word"]}".'
    if found:
        return f"A number stands without its unit, which the key names: {found['key']} = {found['number']}."
    return "Mend that line."


def _toml_files_sentence(folder: Path) -> str:
    files = sorted(folder.glob("*.toml"))
    if not files:
        return "It holds none; `reseau template` prints one to start from."
    return f"Name one that it holds: {', '.join(map(str, files))}."


class Table:
    """Table of a TOML file. place: its path in the file ("" for the root, "distortion.sigma", "fiducial[2]").

    Keys that were read or tested are recorded; `done` refuses all others. All readers raise InputError for a wrong type
    or a missing key.
    """

    def __init__(self, values: Mapping[str, Any], file: Path, place: str) -> None:
        self.values = values
        self.file = file
        self.place = place
        self._known: set[str] = set()

    def __contains__(self, key: str) -> bool:
        self._known.add(key)
        return key in self.values

    def error(self, key: str, message: str) -> InputError:
        """InputError with file, line (that of the table if the key is missing) and key."""
        line = self._line_number(key)
        at = f"{self.file}, line {line}" if line else f"{self.file}"
        table = f"[{self.place}] " if self.place else ""
        return InputError(f"{at}: {table}{key}: {message}")

    def text(self, key: str, default: str | None = None, choices: Sequence[str] = ()) -> str:
        value = self._get(key, default)
        if not isinstance(value, str):
            raise self.error(key, f'must be text in quotes, not {quote_value(value)}. Write {key} = "...".')
        if choices and value not in choices:
            raise self.error(
                key, f"is {quote_value(value)}; possible are {list_words(choices)}.{did_you_mean(value, choices)}"
            )
        return value

    def path_value(self, key: str, default: str | None = None) -> Path:
        """Path relative to the folder of this file."""
        return self.file.parent / self.path_text(key, default)

    def path_text(self, key: str, default: str | None = None) -> str:
        """Text that is a valid path."""
        return self._path(key, self.text(key, default))

    def path_texts(self, key: str) -> tuple[str, ...]:
        return tuple(self._path(key, text) for text in self.texts(key))

    def is_flag(self, key: str) -> bool:
        """Whether a key holds true or false. Raises InputError if it is missing."""
        return isinstance(self._get(key, None), bool)

    def is_list(self, key: str) -> bool:
        """Whether a key exists and holds a list."""
        return isinstance(self.values.get(key), list)

    def flag(self, key: str, default: bool) -> bool:
        value = self._get(key, default)
        if not isinstance(value, bool):
            raise self.error(key, f"must be true or false, not {quote_value(value)}.")
        return value

    def number(
        self, key: str, default: float | None = None, *, above: float = -math.inf, least: float = -math.inf
    ) -> float:
        value = self._number(key, self._get(key, default))
        if not value > above:
            raise self.error(key, f"must be greater than {above:g}, not {value:g}.")
        if not value >= least:
            raise self.error(key, f"must be at least {least:g}, not {value:g}.")
        return value

    def number_or_text(self, key: str, default: float | str, choices: Sequence[str], *, above: float) -> float | str:
        """Number above a limit, or one of the choices."""
        value = self._get(key, default)
        if isinstance(value, str) and value not in choices:
            also = f"{did_you_mean(value, choices)} A number above {above:g}, without quotes, is possible, too."
            raise self.error(key, f"is {quote_value(value)}; possible are {list_words(choices)}.{also}")
        if isinstance(value, str):
            return value
        return self.number(key, default if isinstance(default, float) else None, above=above)

    def whole(self, key: str, default: int | None = None, *, least: int = 0, most: int = 10**9) -> int:
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            limits = f"at least {least}" if isinstance(value, int) and value < least else f"{least} to {most}"
            raise self.error(key, f"must be a whole number of {limits}, not {quote_value(value)}.")
        return value

    def pair(self, key: str, default: tuple[float, float] | None = None) -> tuple[float, float]:
        x, y = self._several(key, self._get(key, default), 2, "two numbers, [x, y]")
        return (x, y)

    def number_or_pair(self, key: str, default: tuple[float, float] | None = None) -> tuple[float, float]:
        """Pair, given as one number for both axes or [x, y]."""
        value = self._get(key, default)
        if isinstance(value, list | tuple):
            return self.pair(key, default)
        number = self._number(key, value)
        return (number, number)

    def triple(self, key: str, default: tuple[float, float, float] | None = None) -> tuple[float, float, float]:
        x, y, z = self._several(key, self._get(key, default), 3, "three numbers, [x, y, z]")
        return (x, y, z)

    def _several(self, key: str, value: Any, count: int, form: str) -> list[float]:
        if not isinstance(value, list | tuple) or len(value) != count:
            raise self.error(key, f"must be {form}, not {quote_value(value)}.")
        return [self._number(key, item) for item in value]

    def pairs(self, key: str) -> tuple[tuple[float, float], ...]:
        value = self._get(key, None)
        if not isinstance(value, list) or not all(isinstance(item, list) and len(item) == 2 for item in value):
            raise self.error(key, f"must be a list of points, [[x, y], [x, y], ...], not {quote_value(value)}.")
        return tuple((self._number(key, x), self._number(key, y)) for x, y in value)

    def sigma(self, key: str, default: float | None = None) -> float:
        """Standard deviation; 0: fixed, "free" (inf): no prior."""
        return self._sigma(key, self._get(key, default))

    def sigma_pair(self, key: str, default: tuple[float, float] | None = None) -> tuple[float, float]:
        """Pair of standard deviations, given as one for both axes or [sx, sy]; each a number or "free"."""
        value = self._get(key, default)
        if isinstance(value, Sequence) and not isinstance(value, str):
            if len(value) != 2:
                raise self.error(key, f"must be one standard deviation or two, [sx, sy], not {quote_value(value)}.")
            return (self._sigma(key, value[0]), self._sigma(key, value[1]))
        sigma = self._sigma(key, value)
        return (sigma, sigma)

    def texts(self, key: str) -> tuple[str, ...]:
        value = self._get(key, None)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.error(key, f'must be a list of texts, ["...", "..."], not {quote_value(value)}.')
        return tuple(value)

    def numbers(self, key: str) -> tuple[float, ...]:
        """List of numbers; integers remain integers."""
        value = self._get(key, None)
        if not isinstance(value, list) or not value:
            raise self.error(key, f"must be a list of numbers, [1.0, 2.0, ...], not {quote_value(value)}.")
        numbers = [self._number(key, item) for item in value]
        return tuple(item if type(item) is int else number for item, number in zip(value, numbers, strict=True))

    def table(self, key: str) -> "Table":
        """Sub-table; empty if it is absent."""
        value = self._get(key, {})
        if not isinstance(value, dict):
            raise self.error(key, f"must be a table, [{self._inside(key)}], not {quote_value(value)}.")
        return Table(value, self.file, self._inside(key))

    def tables(self, key: str) -> tuple["Table", ...]:
        """Array of sub-tables; empty if it is absent."""
        value = self._get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error(key, f"must be written as [[{self._inside(key)}]], once for each.")
        return tuple(Table(item, self.file, f"{self._inside(key)}[{i}]") for i, item in enumerate(value, 1))

    def names(self) -> tuple[str, ...]:
        return tuple(self.values)

    def done(self) -> None:
        """Raise InputError for the keys that were not read or tested, all in one message."""
        if unknown := self.unknown_keys(self._known):
            raise unknown

    def unknown_keys(self, known: Collection[str]) -> InputError | None:
        """InputError for unknown keys; None if there are none."""
        names, unknown = sorted(known), [key for key in self.values if key not in known]
        messages = [
            str(self.error(key, f"is no key of this table.{did_you_mean(key, names)} Known here: {list_words(names)}."))
            for key in unknown[:LISTED]
        ]
        if len(unknown) > LISTED:
            messages.append(f"{self.file}: {len(unknown) - LISTED} more keys are not known.")
        return InputError("\n".join(messages)) if messages else None

    def missing_key(self, key: str, known: Collection[str]) -> InputError:
        """InputError for a missing key."""
        near = nearest(key, [name for name in self.values if name not in known])
        return self.error(key, "is missing. Add it" + (f", or rename {near!r} to it." if near else "."))

    def _get(self, key: str, default: Any) -> Any:
        self._known.add(key)
        value = self.values.get(key, default)
        if value is None:
            raise self.missing_key(key, self._known)
        return value

    def _path(self, key: str, text: str) -> str:
        longest = max((len(os.fsencode(name)) for name in Path(text).parts), default=0)
        if not text.isprintable() or len(os.fsencode(text)) > _LONGEST_PATH or longest > _LONGEST_NAME:
            raise self.error(key, f"{quote_value(text)} can be no file's name: too long, or not all of it can be read.")
        return text

    def _number(self, key: str, value: Any) -> float:
        try:
            number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.error(key, f"must be a number, not {quote_value(value)}.")
        if abs(number) > LARGEST:
            raise self.error(key, f"{quote_value(value)} is larger than anything that is measured. Correct it.")
        return number

    def _sigma(self, key: str, value: Any) -> float:
        if value == FREE or value == math.inf:
            return math.inf
        if isinstance(value, str):
            raise self.error(key, f'must be a standard deviation, 0 (fixed) or "{FREE}", not {quote_value(value)}.')
        sigma = self._number(key, value)
        if sigma < 0.0:
            raise self.error(
                key, f'is a standard deviation and cannot be negative ({sigma:g}); 0 fixes, "{FREE}" frees.'
            )
        return sigma

    def _inside(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else key

    def _line_number(self, key: str) -> int | None:
        """Line of the key or sub-table of that name in this table; line of this table if it is missing."""
        try:
            lines = self.file.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError):
            return None
        name, _, count = self.place.partition("[")
        own = re.compile(rf"^\s*\[+\s*{re.escape(name)}\s*\]+")
        starts = [number for number, line in enumerate(lines) if own.match(line)] if name else [-1]
        which = int(count.rstrip("]")) - 1 if count.rstrip("]").isdigit() else 0
        if which >= len(starts):
            return None
        key_line = re.compile(rf'^\s*"?{re.escape(key)}"?\s*[=.]')
        inside = re.compile(rf"^\s*\[+\s*{re.escape(f'{name}.' if name else '')}{re.escape(key)}\s*[\].]")
        own_keys = True
        for number in range(starts[which] + 1, starts[which + 1] if which + 1 < len(starts) else len(lines)):
            if inside.match(lines[number]) or (own_keys and key_line.match(lines[number])):
                return number + 1
            own_keys = own_keys and not lines[number].lstrip().startswith("[")
        return starts[which] + 1 or None


def list_words(words: Sequence[str]) -> str:
    """Quoted words, separated by commas."""
    return ", ".join(repr(word) for word in words) or "none"

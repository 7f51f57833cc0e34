"""TOML files: their tables, the places of keys for messages, and unknown keys with "did you mean"."""

import re
import shlex
import tomllib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.text.files import SCAN_ENDINGS, FilePath, no_such_file, read_bytes, split_lines
from pipeline.text.wording import did_you_mean

MOST_MB = 4  # size of a camera file with marks learned from 12,000 scans

_USUAL_NAMES = ("project.toml", "camera.toml", "scene.toml")
_OTHER_KINDS = {".csv": "a CSV table", ".yaml": "a YAML file", ".yml": "a YAML file", ".json": "a JSON file"}
_DEEP = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++\s*+\.\s*+){30}""")
_BARE = re.compile(
    r"""\s*(?P<key>[\w."'-]+)\s*=\s*(?:(?P<word>[A-Za-z][\w./-]*)|(?P<number>[+-]?\d[\d.]*)\s*[A-Za-zµμ°%]+)\s*(?:\#.*)?$"""
)


def read_toml(path: FilePath, needed: str = "") -> "Table":
    """Read the root table of a TOML file.

    needed: usual name of the file, suggested where a folder is given. Raises InputError for a missing file, a file of
    another kind, invalid UTF-8, or a syntax error.
    """
    path = Path(path)
    try:
        if path.is_file() and (other_kind := _other_kind(path)):
            raise InputError(f"{path}: {other_kind}")
        text = read_bytes(path, MOST_MB).decode("utf-8-sig")
        if deep := _DEEP.search(text):
            line = text.count("\n", 0, deep.start()) + 1
            raise InputError(f"{path}, line {line}: joins more names by points than any table here. Mend that line.")
        return Table(tomllib.loads(text), path, "")
    except FileNotFoundError:
        raise InputError(no_such_file(path)) from None
    except IsADirectoryError:
        files = sorted(path.glob("*.toml"))
        usual = [file for file in files if file.name == needed]
        possible = usual or [file for file in files if file.name not in _USUAL_NAMES]
        hint = f"It holds no {needed or 'TOML file'}; `reseau template` prints one to start from."
        if possible:
            hint = f"Name one that it holds: {', '.join(map(str, possible))}."
        raise InputError(f"{path}: is a folder; a TOML file is needed here. {hint}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not text in UTF-8; a TOML file, saved as such, is needed here.") from None
    except RecursionError:
        raise InputError(f"{path}: is not valid TOML here: lists or tables stand in one another too deep.") from None
    except ValueError as error:  # a syntax error, or a number of thousands of digits
        raise InputError(f"{path}: is not valid TOML: {error}. {_mending(text, str(error))}") from None


def _other_kind(path: Path) -> str:
    """What a file is by its ending, and what is needed; "" for a file that may be TOML."""
    ending = path.suffix.lower()
    if ending in SCAN_ENDINGS:
        folder = shlex.quote(str(path.parent))
        return f"is a scan; a TOML file is needed here. To measure scans, give their folder: `reseau run {folder}`."
    if ending in _OTHER_KINDS:
        return (
            f"is {_OTHER_KINDS[ending]}; a TOML file is needed here: a project, a camera or a scene, NAME.toml. "
            "`reseau template` prints one to start from."
        )
    return ""


def _mending(text: str, error: str) -> str:
    """Remedy of a syntax error; with the corrected line if it is known."""
    if re.search("Unescaped|hex value", error):
        return "Mend that line (a path has / in the place of \\)."
    place = re.search(r"at line (\d+)", error)
    line = split_lines(text)[int(place[1]) - 1] if place else ""
    found = _BARE.match(line)
    if re.search("[“”„’]", line):
        return 'Quotes are straight here: "...".'
    if "overwrite" in error:
        return "This key or table is given twice: remove one."
    if re.search(r"=\s*-?\d+,\d", line):
        return "Numbers have a decimal point: 60.5, not 60,5."
    if found and found["word"]:
        return f'Text stands in quotes: {found["key"]} = "{found["word"]}".'
    if found:
        return f"A number stands without its unit, which the key names: {found['key']} = {found['number']}."
    return "Mend that line."


class Table:
    """Table of a TOML file. place: its path in the file ("" for the root, "distortion.sigma", "fiducial[2]")."""

    def __init__(self, values: Mapping[str, Any], file: Path, place: str) -> None:
        self.values = values
        self.file = file
        self.place = place

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def error(self, key: str, message: str) -> InputError:
        """InputError with file, line (that of the table if the key is missing) and key."""
        line = self._line_number(key)
        at = f"{self.file}, line {line}" if line else f"{self.file}"
        table = f"[{self.place}] " if self.place else ""
        return InputError(f"{at}: {table}{key}: {message}")

    def table(self, key: str) -> "Table":
        """Sub-table; empty if it is absent."""
        return Table(self.values.get(key, {}), self.file, self.inside(key))

    def tables(self, key: str) -> tuple["Table", ...]:
        """Array of sub-tables; empty if it is absent."""
        entries = enumerate(self.values.get(key, ()), 1)
        return tuple(Table(item, self.file, f"{self.inside(key)}[{i}]") for i, item in entries)

    def inside(self, key: str) -> str:
        """Path of a sub-table in the file."""
        return f"{self.place}.{key}" if self.place else key

    def unknown_keys(self, known: Collection[str], others: Collection[str] | None = None) -> list[str]:
        """Messages on unknown keys: the given ones, or all that are not known; the last one lists the known keys."""
        unknown = [key for key in (self.values if others is None else others) if key not in known]
        lines = [str(self.error(key, f"is no key of this table.{did_you_mean(key, known)}")) for key in unknown]
        return [*lines[:-1], *(f"{line} Known here: {list_words(sorted(known))}." for line in lines[-1:])]

    def _line_number(self, key: str) -> int | None:
        """Line of the key or sub-table of that name in this table; line of this table if it is missing."""
        try:
            lines = split_lines(self.file.read_text(encoding="utf-8-sig"))
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


def list_words(words: Sequence[object]) -> str:
    """Words, in quotes, or numbers, separated by commas."""
    return ", ".join(repr(word) for word in words) or "none"

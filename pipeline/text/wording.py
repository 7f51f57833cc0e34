"""Wording of lists, counts and suggestions in messages, and values as TOML text."""

import difflib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

_BARE_KEY = re.compile("[A-Za-z0-9_-]+")
LISTED = 8  # largest number of names listed; the rest are counted


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Known word most similar to a word; None if none is similar."""
    words = list(known)
    alike = [each for each in words if each.casefold() == word.casefold()]
    return next(iter(alike or difflib.get_close_matches(word, words, n=1)), None)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Question " Did you mean '...'?", with a leading blank; "" if no known word is similar."""
    near = nearest(word, known)
    return "" if near is None else f" Did you mean {near!r}?"


def listed(names: Sequence[str]) -> str:
    """List the first names, and count the rest."""
    more = len(names) - LISTED
    return ", ".join(names[:LISTED]) + (f" and {more} more" if more > 0 else "")


def listed_by_reason(reasons: Mapping[str, str]) -> str:
    """List names with the reason of each, names of one reason together."""
    alike = {why: [name for name, its in reasons.items() if its == why] for why in dict.fromkeys(reasons.values())}
    return "; ".join(f"{listed(names)} ({why})" for why, names in alike.items())


def counted(number: int, one: str, many: str = "") -> str:
    """Number with its noun, singular or plural."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def count_sentence(what: str, done: int, of: int, rest: Mapping[str, int]) -> str:
    """State how many of all scans are done, in the form common to all commands. rest: numbers of the others by word."""
    others = ", ".join(f"{number} {word}" for word, number in rest.items() if number)
    return f"{done} of {counted(of, 'scan')} {what}" + (f" ({others})" if others else "")


def capitalised(sentence: str) -> str:
    """Capitalise the first letter of a sentence; the rest is unchanged."""
    return sentence[:1].upper() + sentence[1:]


def drop_file_name(sentence: str, file: str) -> str:
    """Remove the leading file name from a sentence."""
    name = f"{PurePosixPath(file.replace(chr(92), '/')).name}: "
    head, found, rest = sentence.partition(name)
    return rest if found and ": " not in head else sentence


def gathered(messages: Iterable[tuple[str, str, str]]) -> list[str]:
    """Merge equal messages of images, given as image, file and message; returns one sentence for each different
    message, with the number of scans if there are several."""
    alike: dict[str, list[tuple[str, str]]] = {}
    for image, file, sentence in messages:
        alike.setdefault(drop_file_name(sentence, file), []).append((image, sentence))
    return [
        f"{len(own)} scans ({listed([image for image, _ in own])}): {same}" if len(own) > 1 else own[0][1]
        for same, own in alike.items()
    ]


def quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def table_lines(values: Mapping[str, Any], name: str = "", is_inner: bool = False) -> list[str]:
    """Lines of a TOML table below its header; values of None are left out, sub-tables come last.

    name: of the table; is_inner: it has a header of its own, and its sub-tables follow without a blank line.
    """
    values = {key: value for key, value in values.items() if value is not None}
    inside = {key: value for key, value in values.items() if isinstance(value, Mapping) or _is_tables(value)}
    lines = [f"{_key(key)} = {_value(value)}" for key, value in values.items() if key not in inside]
    for key, value in inside.items():
        path = f"{name}.{_key(key)}" if name else _key(key)
        for one in [value] if isinstance(value, Mapping) else value:
            head = f"[{path}]" if isinstance(value, Mapping) else f"[[{path}]]"
            has_keys = not one or any(not isinstance(each, Mapping) for each in one.values())
            if has_keys:
                lines += [head] if is_inner else ["", head]
            lines += table_lines(one, path, has_keys)
    return lines


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, Mapping) for one in value)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _value(key)


def _value(value: Any) -> str:
    """Value as TOML: strings, integers, lists and booleans as in JSON; floats keep their decimal point; inf: "free"."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float):
        return '"free"' if math.isinf(value) else repr(float(value))
    return json.dumps(value, ensure_ascii=False)

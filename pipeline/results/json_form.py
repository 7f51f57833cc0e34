"""The form that a result file's JSON has to have where readers rely on it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from pipeline.text.text_file import shown

NUMBER = (float, int, type(None))  # null: a number that has no meaning here


@dataclass(frozen=True)
class Each:
    """A table from names, or a list, whose every entry has the same form."""

    container: type
    form: object


def check_form(content: Any, form: Any, path: Path, again: str, place: str = "") -> None:
    """Refuse content that has not the form; keys beyond it are welcome. again: what to do; place: of it in the file."""
    if isinstance(form, Each):
        check_form(content, form.container, path, again, place)
        entries = content.items() if isinstance(content, dict) else enumerate(content)
        for key, item in entries:
            check_form(item, form.form, path, again, f"{place}[{key!r}]")
    elif isinstance(form, dict):
        check_form(content, dict, path, again, place)
        for key, inner in form.items():
            if key not in content:
                raise InputError(f"{path}: {place or 'the file'} has no key {key!r}. {again}")
            check_form(content[key], inner, path, again, f"{place}.{key}" if place else key)
    elif not isinstance(content, form) or (isinstance(content, bool) and form is not bool):
        expected = " or ".join(_JSON_NAMES[kind] for kind in (form if isinstance(form, tuple) else (form,)))
        raise InputError(f"{path}: {place or 'the file'} is {shown(content)}; it should be {expected}. {again}")
    elif isinstance(content, int | float) and not _is_finite(content):
        raise InputError(f"{path}: {place} is {shown(content)}; it should be a finite number. {again}")


def _is_finite(number: float) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:  # a whole number of hundreds of digits
        return False


_JSON_NAMES = {
    dict: "a table",
    list: "a list",
    str: "a text",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    type(None): "null",
}

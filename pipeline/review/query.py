"""The values of a request's query."""

import json
from collections.abc import Mapping
from typing import Any

from pipeline.errors import InputError


class Query:
    """The values of a request's query."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, name: str) -> str:
        return self._values.get(name, "")

    def whole(self, name: str, least: int, most: int) -> int:
        """Raises InputError for what is no such number."""
        try:
            value = round(float(self._values.get(name, "0")))
        except (ValueError, OverflowError):
            value = least - 1
        if not least <= value <= most:
            raise InputError(f"{name} must be a whole number from {least} to {most}.")
        return value

    def table(self, name: str) -> Any:
        """A value that is JSON. Raises InputError for what is none."""
        return parse_json(self.text(name))


def parse_json(text: str | bytes) -> Any:
    """JSON with finite numbers alone. Raises InputError for what is none."""
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise InputError("that is no JSON.") from None


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")

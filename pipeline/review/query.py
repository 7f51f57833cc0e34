"""Parsing of the values of a request."""

import json
from collections.abc import Mapping
from typing import Any

from pipeline.errors import InputError

_MOST_PX = 1e7  # px, limit of coordinates, larger than any scan


class Query:
    """Query parameters of a request."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, name: str) -> str:
        return self._values.get(name, "")

    def whole(self, name: str, least: int, most: int) -> int:
        """Whole number between least and most. Raises InputError otherwise."""
        try:
            value = round(float(self._values.get(name, "0")))
        except (ValueError, OverflowError):
            value = least - 1
        if not least <= value <= most:
            raise InputError(f"{name} must be a whole number from {least} to {most}.")
        return value

    def table(self, name: str) -> Any:
        """Value parsed as JSON. Raises InputError if it is not JSON."""
        return parse_json(self.text(name))


def parse_json(text: str | bytes) -> Any:
    """Parse JSON with finite numbers only. Raises InputError otherwise."""
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise InputError("that is no JSON.") from None


def parse_places(given: Any) -> dict[str, tuple[float, float]]:
    """Parse columns and rows by fiducial. Raises InputError for invalid content."""
    if not isinstance(given, dict) or not all(isinstance(one, list) and len(one) == 2 for one in given.values()):
        raise InputError("px is column and row by fiducial.")
    return {str(point): (parse_pixels(col), parse_pixels(row)) for point, (col, row) in given.items()}


def parse_pixels(given: Any) -> float:
    """Parse a column, row or size, px. Raises InputError for invalid content."""
    if isinstance(given, bool) or not isinstance(given, int | float) or not abs(given) < _MOST_PX:
        raise InputError(f"a column or row is a number of pixels, not {str(given)[:40]!r}.")
    return float(given)


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")

"""Values as the text of a TOML file."""

import math
from collections.abc import Iterable


def quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def numbers(values: Iterable[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def sigma(value: float) -> str:
    return '"free"' if math.isinf(value) else repr(float(value))


def sigmas(values: tuple[float, float]) -> str:
    return f"[{sigma(values[0])}, {sigma(values[1])}]"

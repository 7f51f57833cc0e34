"""Numbers as JSON knows them, and as large or small as anything that is measured."""

import math
from collections.abc import Mapping
from typing import Any

LARGEST = 1e15  # of a coordinate, a size, a standard deviation, in whatever unit: squares of larger ones are lost
SMALLEST_SIGMA = 1e-9  # of a coordinate, in mm, m or degrees: weights of smaller ones swallow all others


def without_nan(value: Any) -> Any:
    """The same with null for every number that is not finite: JSON knows no others.

    What holds none is handed back as it is: a copy of a large result would take as much memory again.
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        cleaned = {key: without_nan(item) for key, item in value.items()}
        return cleaned if any(cleaned[key] is not item for key, item in value.items()) else value
    if isinstance(value, list | tuple):
        items = [without_nan(item) for item in value]
        return items if any(new is not old for new, old in zip(items, value, strict=True)) else value
    return value

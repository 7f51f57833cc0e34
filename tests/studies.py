"""Parameters of tests of which a few are enough every day."""

from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def parametrize_with_studies(
    names: str | Sequence[str], values: Iterable[Any], quick: Sequence[int] = (0,), ids: Sequence[str] | None = None
) -> pytest.MarkDecorator:
    """As `pytest.mark.parametrize`, with all values marked as studies but those at the places of `quick`."""
    marked = []
    for place, value in enumerate(values):
        one = value if isinstance(names, str) or isinstance(value, type(pytest.param())) else pytest.param(*value)
        one = one if isinstance(one, type(pytest.param())) else pytest.param(one)
        marks = one.marks if place in quick else (*one.marks, pytest.mark.study)
        marked.append(pytest.param(*one.values, id=one.id, marks=marks))
    return pytest.mark.parametrize(names, marked, ids=ids)

"""Work shared among processes, or done here where there are none."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from typing import TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")


def mapped(
    workers: Executor | None, function: Callable[[Item], Made], items: Sequence[Item], chunk: int = 1
) -> Iterator[Made]:
    """The function of every item, in their order. chunk: how many items a worker gets at a time."""
    return map(function, items) if workers is None else workers.map(function, items, chunksize=chunk)

"""Parallel mapping over processes or threads, with a serial fallback."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2

Item = TypeVar("Item")
Made = TypeVar("Made")


def map_items(workers: Executor | None, function: Callable[[Item], Made], items: Sequence[Item]) -> Iterator[Made]:
    """Map a function over items, in their order."""
    return map(function, items) if workers is None else workers.map(function, items)


def map_or_replace(
    workers: Executor | None,
    function: Callable[[Item], Made],
    items: Sequence[Item],
    lost: Callable[[Item, str], Made],
    chunk: int = 1,
) -> Iterator[Made]:
    """Map a function over items, in their order; an item that kills its worker does not affect the others.

    lost: makes the result of such an item from it and the reason.
    """
    if workers is None:
        yield from map(function, items)
        return
    parts = [items[first : first + chunk] for first in range(0, len(items), chunk)]
    futures = list[Future[list[Made]]]()
    for part in parts:
        try:
            futures.append(workers.submit(_each, function, part))
        except BrokenExecutor as error:
            futures.append(Future())
            futures[-1].set_exception(error)
    for part, future in zip(parts, futures, strict=True):
        try:
            yield from future.result()
        except BrokenExecutor as error:
            if len(part) == 1:
                yield lost(part[0], str(error))
            else:  # one of them killed the worker: find out which
                yield from map_or_replace(workers, function, part, lost)


def _each(function: Callable[[Item], Made], part: Sequence[Item]) -> list[Made]:
    return [function(item) for item in part]


def map_in_threads(function: Callable[[Item], Made], items: Iterable[Item]) -> list[Made]:
    """Map a function over items, in their order, in as many threads as OpenCV may use. OpenCV's own threads are
    switched off meanwhile, since both would compete for the cores."""
    threads = cv2.getNumThreads()
    if threads <= 1:
        return [function(item) for item in items]
    with one_opencv_thread(), ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Limit OpenCV to the calling thread, and restore its number of threads afterwards."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)

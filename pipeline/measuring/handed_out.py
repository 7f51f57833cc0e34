"""Tasks handed out to an executor, never many more at a time than it works on."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from itertools import islice
from typing import Any, Protocol, TypeVar

Task = TypeVar("Task")
Made = TypeVar("Made")

TASKS_A_CORE = 4  # handed out ahead: enough that no process waits, few enough that little is lost


class Submits(Protocol):
    """What shares work out: an executor of `concurrent.futures`, or one like it."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        """Have `fn` called with these, some time."""


def results_of(
    function: Callable[[Task], Made],
    tasks: Iterable[Task],
    executor: Submits | None = None,
    in_flight: int | None = None,
) -> Iterator[tuple[Task, Made | Exception]]:
    """Each task with what the function makes of it, or with why the executor has lost it. in_flight: as above."""
    if executor is None:
        yield from ((task, function(task)) for task in tasks)
        return
    window = in_flight or TASKS_A_CORE * (os.cpu_count() or 1)
    left, running = iter(tasks), dict[Future[Made], Task]()
    try:
        while True:
            for task in islice(left, window - len(running)):
                running[_submitted(executor, function, task)] = task
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task, result = running.pop(future), _result(future)
                yield task, result
    finally:
        for future in running:
            future.cancel()


def _submitted(executor: Submits, function: Callable[[Task], Made], task: Task) -> "Future[Made]":
    try:
        return executor.submit(function, task)
    except BrokenExecutor as error:
        future: Future[Made] = Future()
        future.set_exception(error)
        return future


def _result(future: "Future[Made]") -> Made | Exception:
    """What is measured raises nothing: what comes here is of the executor, whose process is gone or out of reach."""
    try:
        return future.result()
    except Exception as error:
        return error

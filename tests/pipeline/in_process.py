"""Work without processes, and waiting for some."""

import pickle
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import pytest

from pipeline.workers import WorkerKilled

_POOLS = (
    "pipeline.archive.measure_archive.worker_pool",
    "pipeline.archive.new_project.worker_pool",
    "pipeline.resampling.resample_stage.worker_pool",
)


@contextmanager
def pools(made: Callable[..., AbstractContextManager[Executor]]) -> Iterator[None]:
    """Whatever asks for processes gets these."""
    with pytest.MonkeyPatch.context() as patched:
        for pool in _POOLS:
            patched.setattr(pool, made)
        yield


class Here(Executor):
    """Does its work at once in this process, pickled on its way there and back as if there were another one."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        work = pickle.loads(pickle.dumps((fn, args, kwargs)))
        try:
            future.set_result(pickle.loads(pickle.dumps(work[0](*work[1], **work[2]))))
        except Exception as error:
            future.set_exception(pickle.loads(pickle.dumps(error)))
        return future


class Loses(Here):
    """The same, but ends its process over what it is asked of, each time."""

    def __init__(self, is_deadly: Callable[[Callable[..., Any], tuple[Any, ...]], bool]) -> None:
        self._is_deadly = is_deadly

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if not self._is_deadly(fn, args):
            return super().submit(fn, *args, **kwargs)
        future: Future[Any] = Future()
        future.set_exception(WorkerKilled())
        return future


def wait_until(holds: Callable[[], bool], most_s: float) -> bool:
    """Whether it came to hold within so many seconds."""
    end = time.monotonic() + most_s
    while not holds():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True

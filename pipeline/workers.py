"""The processes that scans are shared among, on this machine: a pool that survives the death of any of them."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, Protocol, TypeVar

import cv2

from adjust.least_squares.malloc_tuning import keep_freed_memory

KILLS = 2  # of its process, after which a task is given up: once may be chance, or another program's doing
STARTS = 6  # of processes that are killed before they stand, one after another: then none will
CHECKED_AGAIN_S = 0.05  # whether a pool that is ended has come to rest
TASKS_A_CORE = 4  # handed out ahead: enough that no process waits, few enough that little is lost

Task = TypeVar("Task")
Made = TypeVar("Made")


class WorkerKilled(BrokenExecutor):
    """The process of a task was ended from outside, each time that it was tried."""

    def __init__(self, what: str = "its process was ended, most likely because the memory was full") -> None:
        super().__init__(what)


def processes(scans: int) -> int:
    """How many scans are measured at a time: one a core."""
    return min(scans, os.cpu_count() or 1)


@contextmanager
def worker_pool(scans: int, workers: int | None = None) -> Iterator[Executor]:
    """A process a core, of one thread: a scan is measured alone, so the result does not depend on their number.

    Whatever ends the block early ends the processes too: nobody waits for scans whose results are not wanted any more.
    workers: how many processes, if not one a core.
    """
    pool = LocalPool(min(max(scans, 1), workers) if workers else processes(max(scans, 1)))
    try:
        yield pool
    except BaseException:
        pool.end()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


class LocalPool(ThreadPoolExecutor):
    """Threads that hand their own process one task at a time, so that it is known whose process was killed: that task
    alone is begun again, in a new process, and given up when it kills that too."""

    def __init__(self, workers: int) -> None:
        super().__init__(workers)
        self._own = threading.local()
        self._all: list[ProcessPoolExecutor] = []
        self._ended = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(self._call, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        super().shutdown(wait, cancel_futures=cancel_futures)
        for process in self._all:
            process.shutdown(wait, cancel_futures=cancel_futures)

    def end(self) -> None:
        """End the processes, whatever they have in hand."""
        self._ended = True
        super().shutdown(wait=False, cancel_futures=True)
        while any(thread.is_alive() for thread in self._threads):  # one may just have begun to start its process
            for process in multiprocessing.active_children():
                process.terminate()
            time.sleep(CHECKED_AGAIN_S)

    def _call(self, call: Callable[[], Any]) -> Any:
        for _ in range(KILLS):
            process = self._process()
            with suppress(BrokenProcessPool):
                return process.submit(call).result()
        raise WorkerKilled

    def _process(self) -> ProcessPoolExecutor:
        """This thread's process, once it stands: one that is killed on its way there says nothing of the task."""
        for _ in range(STARTS if not self._ended else 0):
            process = getattr(self._own, "process", None) or self._start()
            with suppress(BrokenProcessPool):
                process.submit(os.getpid).result()
                return process
            self._own.process = None
        raise WorkerKilled

    def _start(self) -> ProcessPoolExecutor:
        process = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=prepare)
        self._own.process = process
        self._all.append(process)
        return process


def prepare() -> None:
    """An interrupt from the terminal reaches every process; the one that started this one answers it for all, and when
    it ends, however that is, so does this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    work_alone()


def work_alone() -> None:
    """One thread for a scan: as many are measured at a time as there are cores."""
    cv2.setNumThreads(1)
    keep_freed_memory()  # one mark asks for arrays as large as the last one's: a twentieth of a scan's time


def _end_with_parent() -> None:
    """Wait until the process that started this one is no more; then nobody wants what is in hand here."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class Submits(Protocol):
    """What shares work out: an executor of `concurrent.futures`, or one like it."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        """Have `fn` called with these, some time."""


def iterate_results(
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


@dataclass(frozen=True)
class WorkOptions:
    """How the work is shared. shard: (K, N), only the scans of the K-th of N parts. cluster: a scheduler's address, or
    `local`. retry: measure again what failed. moved: keep results of files whose content is the same elsewhere.
    workers: processes, if not one a core. only_kept: nothing is measured; what is missing stays so."""

    shard: tuple[int, int] | None = None
    cluster: str | None = None
    retry: bool = False
    moved: bool = False
    workers: int | None = None
    only_kept: bool = False


class NotMeasured(Exception):
    """Something is missing, and nothing is to be measured now."""

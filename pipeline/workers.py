"""Local process pool for measuring scans, which survives the death of any process."""

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

KILLS = 2  # losses of its process after which a task is given up: one may be due to chance or another program
STARTS = 6  # consecutive processes killed while starting, after which no more are started
CHECKED_AGAIN_S = 0.05  # interval of the test whether a pool has stopped
TASKS_A_CORE = 4  # submitted ahead: enough to keep every process busy, few enough that little is lost

Task = TypeVar("Task")
Made = TypeVar("Made")


class WorkerKilled(BrokenExecutor):
    """The process of a task was killed on each attempt."""

    def __init__(self, what: str = "its process was ended, most likely because the memory was full") -> None:
        super().__init__(what)


def processes(scans: int) -> int:
    """Number of scans measured in parallel: one per core."""
    return min(scans, os.cpu_count() or 1)


@contextmanager
def worker_pool(scans: int, workers: int | None = None) -> Iterator[Executor]:
    """Pool of single-threaded processes, one per core or `workers`.

    Each scan is measured by one process, so the result does not depend on their number. If the block ends early, the
    processes are ended.
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
    """Threads with a process each, which get one task at a time.

    It is therefore known which task a killed process had: only that one is repeated, in a new process, and given up
    after KILLS losses.
    """

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
        """End the processes, even with unfinished tasks."""
        self._ended = True
        super().shutdown(wait=False, cancel_futures=True)
        while any(thread.is_alive() for thread in self._threads):  # a thread may be starting its process
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
        """This thread's process, once it runs: one that is killed while starting does not count against the task."""
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
    """Prepare a process: ignore terminal interrupts, which the parent handles for all, and end when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    work_alone()


def work_alone() -> None:
    """Use one thread per scan: the cores are shared among scans."""
    cv2.setNumThreads(1)
    keep_freed_memory()  # each mark allocates arrays as large as the last one's: saves a twentieth of a scan's time


def _end_with_parent() -> None:
    """Exit when the parent process has ended: nobody needs the result then."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class Submits(Protocol):
    """Executor of `concurrent.futures`, or one with the same `submit`."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        """Schedule a call of `fn`."""


def iterate_results(
    function: Callable[[Task], Made],
    tasks: Iterable[Task],
    executor: Submits | None = None,
    in_flight: int | None = None,
) -> Iterator[tuple[Task, Made | Exception]]:
    """Yield each task with its result, or with the exception of an executor that lost it, in order of completion.

    in_flight: number of tasks submitted at a time; None: TASKS_A_CORE per core.
    """
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
    """Result of a future. Tasks themselves raise nothing: an exception means that the executor lost its process."""
    try:
        return future.result()
    except Exception as error:
        return error


@dataclass(frozen=True)
class WorkOptions:
    """Options of the measurement.

    Attributes
    ----------
    shard : (K, N): only the scans of the K-th of N parts.
    cluster : address of a scheduler, or `local`.
    retry : measure failed scans again.
    moved : keep results of files with the same content elsewhere.
    workers : number of processes; None: one per core.
    only_kept : measure nothing; what is missing stays missing.
    """

    shard: tuple[int, int] | None = None
    cluster: str | None = None
    retry: bool = False
    moved: bool = False
    workers: int | None = None
    only_kept: bool = False


class NotMeasured(Exception):
    """A result is missing, and nothing is to be measured."""

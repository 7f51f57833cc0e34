"""The processes that scans are shared among, on this machine: a pool that survives the death of any of them."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any, Protocol, TypeVar

import cv2

from adjust.least_squares.malloc_tuning import keep_freed_memory

KILLS = 2  # of its process, after which a task is given up: once may be chance, or another program's doing
STARTS = 5  # of processes that are killed before they stand, one after another: then none will

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


@dataclass(eq=False)
class _Task:
    call: Callable[[], Any]
    future: Future[Any] = field(default_factory=Future)
    kills: int = 0


class LocalPool(Executor):
    """Processes with one task each at a time. Each is a pool of its own, so that it is known in whose hand a task was
    whose process was killed: that one alone is begun again, in a new process, and given up when it kills that too."""

    def __init__(self, workers: int) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[_Task] = deque()
        self._idle = [_process() for _ in range(workers)]
        self._pools = set(self._idle)
        self._ended = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        task = _Task(partial(fn, *args, **kwargs))
        with self._lock:
            if self._ended:
                raise RuntimeError("the pool has been shut down")
            self._waiting.append(task)
        self._feed()
        return task.future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        with self._lock:
            self._ended = self._ended or cancel_futures
            left = list(self._waiting) if cancel_futures else []
            self._waiting = self._waiting if not cancel_futures else deque()
        for task in left:
            task.future.cancel()
        for pool in list(self._pools):
            pool.shutdown(wait, cancel_futures=cancel_futures)

    def end(self) -> None:
        """End the processes, whatever they have in hand."""
        with self._lock:
            self._ended = True
        for process in multiprocessing.active_children():
            process.terminate()

    def _feed(self) -> None:
        """Give waiting tasks to idle processes."""
        while True:
            with self._lock:
                if not (self._waiting and self._idle):
                    return
                task, pool = self._waiting.popleft(), self._idle.pop()
            if task.future.set_running_or_notify_cancel():
                self._start(pool, task)
            else:
                self._is_idle(pool)

    def _start(self, pool: ProcessPoolExecutor, task: _Task) -> None:
        try:
            working = pool.submit(task.call)
        except BrokenProcessPool:  # killed while it had nothing in hand
            self._start_anew(pool, task)
        except RuntimeError as error:  # shut down meanwhile
            task.future.set_exception(error)
        else:
            working.add_done_callback(partial(self._done, pool, task))

    def _start_anew(self, broken: ProcessPoolExecutor, task: _Task, starts: int = STARTS) -> None:
        """In a new process, once that stands: one that is killed on its way there says nothing of the task."""
        pool = self._replaced(broken)

        def stands(ready: Future[int]) -> None:
            if ready.cancelled() or not isinstance(ready.exception(), BrokenProcessPool):
                self._start(pool, task)
            elif starts and not self._ended:
                self._start_anew(pool, task, starts - 1)
            else:
                self._give_up(pool, task)

        pool.submit(os.getpid).add_done_callback(stands)

    def _done(self, pool: ProcessPoolExecutor, task: _Task, done: Future[Any]) -> None:
        error = CancelledBeforeStart() if done.cancelled() else done.exception()
        if isinstance(error, BrokenProcessPool):
            task.kills += 1
            if not self._ended and task.kills < KILLS:
                self._start_anew(pool, task)
            else:
                self._give_up(pool, task)
            return
        self._is_idle(pool)
        if error is None:
            task.future.set_result(done.result())
        else:
            task.future.set_exception(error)
        self._feed()

    def _give_up(self, broken: ProcessPoolExecutor, task: _Task) -> None:
        self._is_idle(self._replaced(broken))
        task.future.set_exception(WorkerKilled())
        self._feed()

    def _is_idle(self, pool: ProcessPoolExecutor) -> None:
        with self._lock:
            self._idle.append(pool)

    def _replaced(self, broken: ProcessPoolExecutor) -> ProcessPoolExecutor:
        pool = _process()  # a broken one has ended itself, and may hold its lock while it tells of that
        with self._lock:
            self._pools.discard(broken)
            self._pools.add(pool)
        return pool


class CancelledBeforeStart(Exception):
    """The pool was shut down before the task was begun."""


def _process() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=prepare)


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

"""Executors for measuring scans: a local process pool that survives the death of any process, or a Dask cluster whose
workers are checked first."""

import multiprocessing
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from itertools import islice
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import cv2

from adjust.least_squares.malloc_tuning import keep_freed_memory
from measure.errors import MeasurementError
from measure.results import MEASURE_REVISION
from measure.scans.remote import is_address, scan_path
from pipeline.errors import InputError, missing_extra

if TYPE_CHECKING:
    from distributed import Client

KILLS = 2  # losses of its process after which a task is given up: one may be due to chance or another program
STARTS = 6  # consecutive processes killed while starting, after which no more are started
CHECKED_AGAIN_S = 0.05  # interval of the test whether a pool has stopped
TASKS_A_CORE = 4  # submitted ahead: enough to keep every process busy, few enough that little is lost

LOCAL = "local"
_RETRIES = 2
_ANSWER_S = 30.0
_LIBRARIES = ("reseau", "numpy", "scipy", "opencv-contrib-python-headless", "tifffile", "imagecodecs", "scikit-image")
_NAMED = 3

Task = TypeVar("Task")
Made = TypeVar("Made")


class WorkerKilled(futures.BrokenExecutor):
    """The process of a task was killed on each attempt."""

    def __init__(self) -> None:
        super().__init__("its process was ended, most likely because the memory was full")


@contextmanager
def worker_pool(scans: int, workers: int | None = None) -> Iterator[futures.Executor]:
    """Pool of single-threaded processes, one per core or `workers`.

    Each scan is measured by one process, so the result does not depend on their number. If the block ends early, the
    processes are ended.
    """
    pool = LocalPool(max(min(scans, workers or os.cpu_count() or 1), 1))
    try:
        yield pool
    except BaseException:
        pool.end()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


class ScriptlessProcess(SpawnProcess):
    """Spawned process that does not run the main module again: a user's script would start another measurement."""

    starting = threading.Lock()

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        main = sys.modules["__main__"]
        with ScriptlessProcess.starting:
            sys.modules["__main__"] = ModuleType("__main__")
            try:
                return SpawnProcess._Popen(process_obj)
            finally:
                sys.modules["__main__"] = main


class ScriptlessContext(SpawnContext):
    Process = ScriptlessProcess


class LocalPool(futures.ThreadPoolExecutor):
    """Threads with a process each, which get one task at a time.

    It is therefore known which task a killed process had: only that one is repeated, in a new process, and given up
    after KILLS losses.
    """

    def __init__(self, workers: int) -> None:
        super().__init__(workers)
        self._own = threading.local()
        self._all: list[futures.ProcessPoolExecutor] = []
        self._ended = False

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> futures.Future[Any]:
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
            for executor in tuple(self._all):  # not all children: the calling program may have its own
                for process in tuple((executor._processes or {}).values()):
                    process.terminate()
            time.sleep(CHECKED_AGAIN_S)

    def _call(self, call: Callable[[], Any]) -> Any:
        for _ in range(KILLS):
            process = self._process()
            with suppress(BrokenProcessPool):
                return process.submit(call).result()
        raise WorkerKilled

    def _process(self) -> futures.ProcessPoolExecutor:
        """This thread's process, once it runs: one that is killed while starting does not count against the task."""
        for _ in range(STARTS if not self._ended else 0):
            process = getattr(self._own, "process", None) or self._start()
            with suppress(BrokenProcessPool):
                process.submit(os.getpid).result()
                # With the last open end in the process itself, its death in the middle of a result ends the reading.
                process._result_queue._writer.close()  # type: ignore[union-attr]
                return process
            self._own.process = None
        raise WorkerKilled

    def _start(self) -> futures.ProcessPoolExecutor:
        process = futures.ProcessPoolExecutor(1, ScriptlessContext(), initializer=prepare)
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


def iterate_results(
    function: Callable[[Task], Made],
    tasks: Iterable[Task],
    executor: futures.Executor | None = None,
    in_flight: int | None = None,
) -> Iterator[tuple[Task, Made | Exception]]:
    """Yield each task with its result, or with the exception of an executor that lost it, in order of completion.

    in_flight: number of tasks submitted at a time; None: TASKS_A_CORE per core.
    """
    if executor is None:
        yield from ((task, function(task)) for task in tasks)
        return
    window = in_flight or TASKS_A_CORE * (os.cpu_count() or 1)
    left, running = iter(tasks), dict[futures.Future[Made], Task]()
    try:
        while True:
            running |= {executor.submit(function, task): task for task in islice(left, window - len(running))}
            if not running:
                return
            for future in wait(running, return_when=futures.FIRST_COMPLETED).done:
                task = running.pop(future)
                try:  # tasks themselves raise nothing
                    result: Made | Exception = future.result()
                except Exception as error:
                    result = error
                yield task, result
    finally:
        for future in running:
            future.cancel()


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


@contextmanager
def cluster_executor(address: str, scans: Sequence[str], workers: int | None = None) -> Iterator[futures.Executor]:
    """Executor of a running scheduler, or of a local one that lives as long as the block.

    Parameters
    ----------
    address : address such as tcp://host:8786, or `local`.
    scans : paths and addresses of the scans; every worker must be able to read one of each folder.
    workers : number of local workers.

    Raises
    ------
    InputError
        Dask is not installed, no scheduler answers, or a worker has other versions or cannot read the scans.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise missing_extra("--cluster", "Dask", "cluster") from None
    with ExitStack() as stack:
        if address == LOCAL:
            count = workers or max(min(len(scans), os.cpu_count() or 1), 1)
            cluster = LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
            )
            stack.callback(cluster.close)
        try:
            client = Client(cluster if address == LOCAL else address, timeout=_ANSWER_S)
        except (OSError, ValueError) as error:
            raise InputError(
                f"--cluster {address}: no scheduler answers there ({' '.join(str(error).split())}). Start one, such as "
                "`dask scheduler` with `dask worker`s, and give its address, such as tcp://host:8786."
            ) from None
        stack.callback(client.close)
        _check_workers(client, address, _one_a_folder(scans))
        from distributed.diagnostics.plugin import WorkerPlugin

        class WorkAlone(WorkerPlugin):  # type: ignore[misc]
            """Limits every worker, including replacements, to one thread."""

            def setup(self, worker: Any) -> None:
                work_alone()

        client.register_plugin(WorkAlone(), name="reseau")
        yield SubmittedAgain(client.get_executor(retries=_RETRIES, pure=False))


class SubmittedAgain(futures.Executor):
    """Executor that resubmits lost tasks to another executor.

    Tasks raise nothing themselves, so an exception means that the worker is gone. A task lost KILLS times is given up.
    """

    def __init__(self, executor: futures.Executor) -> None:
        self._executor = executor

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> futures.Future[Any]:
        outer: futures.Future[Any] = futures.Future()
        self._begin(outer, partial(fn, *args, **kwargs), KILLS)
        return outer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._executor.shutdown(wait, cancel_futures=cancel_futures)

    def _begin(self, outer: futures.Future[Any], call: Callable[[], Any], left: int) -> None:
        try:
            inner = self._executor.submit(call)
        except Exception as error:  # lost connection to the scheduler
            outer.set_exception(futures.BrokenExecutor(str(error)))
            return
        inner.add_done_callback(partial(self._done, outer, call, left - 1))

    def _done(self, outer: futures.Future[Any], call: Callable[[], Any], left: int, inner: futures.Future[Any]) -> None:
        if outer.cancelled():
            return
        if not inner.cancelled() and inner.exception() is None:
            outer.set_result(inner.result())
        elif left:
            self._begin(outer, call, left)
        else:
            outer.set_exception(WorkerKilled())


def _check_workers(client: "Client", address: str, scans: Sequence[str]) -> None:
    """Check versions and access to the scans on every worker before the first task."""
    try:
        client.wait_for_workers(1, timeout=_ANSWER_S)
    except TimeoutError:
        raise InputError(f"--cluster {address}: the scheduler has no workers. Start `dask worker {address}`.") from None
    answers: Mapping[str, Any] = client.run(_versions_and_unreachable, list(scans), on_error="return")
    here = versions()
    complaints = []
    for worker, answer in sorted(answers.items()):
        if isinstance(answer, BaseException):
            complaints.append(f"{worker}: does not answer ({answer}): is reseau installed there?")
            continue
        there, missing = answer
        other = [f"{key} {there.get(key, 'none')}, here {own}" for key, own in here.items() if there.get(key) != own]
        if other:
            complaints.append(f"{worker}: has {'; '.join(other)}. Install the same there.")
        if missing:
            what = "; ".join(f"{scan} ({why})" for scan, why in missing[:_NAMED])
            remedy = "the same path to the scans"
            if any(is_address(scan) for scan, _ in missing):
                remedy = "the extra, the credentials and the network that reach the scans, as they are here"
            complaints.append(f"{worker}: cannot read {what}. Give it {remedy}.")
    if complaints:
        more = f"\n... and {len(complaints) - _NAMED} more workers" if len(complaints) > _NAMED else ""
        raise InputError(
            "--cluster: not every worker can measure these scans.\n" + "\n".join(complaints[:_NAMED]) + more
        )


def versions() -> dict[str, str]:
    """Versions that a result depends on in addition to scan and options; they must agree on all machines."""
    libraries = {name: version(name) for name in _LIBRARIES}
    return {"Python": platform.python_version(), **libraries, "the revision of measuring": str(MEASURE_REVISION)}


def _versions_and_unreachable(scans: Sequence[str]) -> tuple[dict[str, str], list[tuple[str, str]]]:
    """Run on a worker: return its versions and the scans that it cannot read, each with the reason."""
    return versions(), [(scan, why) for scan in scans if (why := _why_unreadable(scan))]


def _why_unreadable(scan: str) -> str:
    """Reason why a file or address cannot be read; "" if it can."""
    try:
        with scan_path(scan).open("rb") as file:
            file.read(1)
            return ""
    except OSError as error:
        return error.strerror or str(error)
    except MeasurementError as error:
        return str(error)


def _one_a_folder(scans: Sequence[str]) -> list[str]:
    """First scan of each folder that is readable here."""
    # An unresponsive address costs four attempts, so only the first address of a folder is tried.
    firsts: dict[str, str] = {}
    for scan in filter(None, scans):
        folder = scan.rpartition("/")[0] if is_address(scan) else os.path.dirname(scan)
        if folder not in firsts and (is_there := not _why_unreadable(scan)) | is_address(scan):
            firsts[folder] = (scan if is_address(scan) else os.path.abspath(scan)) if is_there else ""
    return [first for first in firsts.values() if first]

"""Measurement on a cluster: Dask's scheduler as an ordinary executor, after a check of its workers."""

import os
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from measure.errors import MeasurementError
from measure.results import MEASURE_REVISION
from measure.scans.remote import is_address, scan_path
from pipeline.errors import InputError, missing_extra
from pipeline.workers import KILLS, WorkerKilled, processes, work_alone

if TYPE_CHECKING:
    from distributed import Client

LOCAL = "local"
_RETRIES = 2
_ANSWER_S = 30.0
_LIBRARIES = ("reseau", "numpy", "scipy", "opencv-contrib-python-headless", "tifffile", "imagecodecs", "scikit-image")
_NAMED = 3


@contextmanager
def cluster_executor(address: str, scans: Sequence[str], workers: int | None = None) -> Iterator[Executor]:
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
            count = workers or processes(len(scans) or 1)
            cluster = LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
            )
            stack.callback(cluster.close)
            client = Client(cluster, timeout=_ANSWER_S)
        else:
            client = _client(Client, address)
        stack.callback(client.close)
        _check_workers(client, address, _one_a_folder(scans))
        client.register_plugin(_alone_plugin(), name="reseau")
        executor = client.get_executor(retries=_RETRIES, pure=False)
        yield SubmittedAgain(executor)


class SubmittedAgain(Executor):
    """Executor that resubmits lost tasks to another executor.

    Tasks raise nothing themselves, so an exception means that the worker is gone. A task lost KILLS times is given up.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        outer: Future[Any] = Future()
        self._begin(outer, partial(fn, *args, **kwargs), 0)
        return outer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._executor.shutdown(wait, cancel_futures=cancel_futures)

    def _begin(self, outer: Future[Any], call: Callable[[], Any], losses: int) -> None:
        try:
            inner = self._executor.submit(call)
        except Exception as error:  # lost connection to the scheduler
            outer.set_exception(BrokenExecutor(str(error)))
            return
        inner.add_done_callback(partial(self._done, outer, call, losses))

    def _done(self, outer: Future[Any], call: Callable[[], Any], losses: int, inner: Future[Any]) -> None:
        if outer.cancelled():
            return
        error = None if inner.cancelled() else inner.exception()
        if error is None and not inner.cancelled():
            outer.set_result(inner.result())
        elif losses + 1 < KILLS:
            self._begin(outer, call, losses + 1)
        else:
            outer.set_exception(WorkerKilled())


def _client(client: "type[Client]", address: str) -> "Client":
    try:
        return client(address, timeout=_ANSWER_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--cluster {address}: no scheduler answers there ({' '.join(str(error).split())}). Start one, such as "
            "`dask scheduler` with `dask worker`s, and give its address, such as tcp://host:8786."
        ) from None


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
        other = [
            f"{name} {there.get(name, 'none')}, here {own}" for name, own in here.items() if there.get(name) != own
        ]
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
    return {
        "Python": platform.python_version(),
        **{name: version(name) for name in _LIBRARIES if _is_installed(name)},
        "the revision of measuring": str(MEASURE_REVISION),
    }


def _is_installed(name: str) -> bool:
    try:
        version(name)
    except ModuleNotFoundError:
        return False
    return True


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
    """First scan of each folder that is readable here.

    A scan that nobody can read does not disqualify a worker. An unresponsive address costs four attempts, so only the
    first address of a folder is tried.
    """
    firsts: dict[str, str] = {}
    for scan in filter(None, scans):
        folder = scan.rpartition("/")[0] if is_address(scan) else os.path.dirname(scan)
        if folder not in firsts and (is_there := not _why_unreadable(scan)) | is_address(scan):
            firsts[folder] = (scan if is_address(scan) else os.path.abspath(scan)) if is_there else ""
    return [first for first in firsts.values() if first]


def _alone_plugin() -> Any:
    """Dask plugin that limits every worker, including replacements, to one thread."""
    from distributed.diagnostics.plugin import WorkerPlugin

    class WorkAlone(WorkerPlugin):  # type: ignore[misc]
        def setup(self, worker: Any) -> None:
            work_alone()

    return WorkAlone()

"""The processes that scans are shared among."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager

import cv2

from adjust.least_squares.kept_memory import keep_freed_memory


def processes(scans: int) -> int:
    """How many scans are measured at a time: one a core."""
    return min(scans, os.cpu_count() or 1)


@contextmanager
def worker_pool(scans: int) -> Iterator[Executor]:
    """A process a core, of one thread: a scan is measured alone, so the result does not depend on their number.

    Whatever ends the block early ends the processes too: nobody waits for scans whose results are not wanted any more.
    """
    pool = ProcessPoolExecutor(processes(scans), multiprocessing.get_context("spawn"), initializer=_prepare)
    try:
        yield pool
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    """An interrupt from the terminal reaches every process; the one that started this one answers it for all, and when
    it ends, however that is, so does this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    keep_freed_memory()  # one mark asks for arrays as large as the last one's: a twentieth of a scan's time


def _end_with_parent() -> None:
    """Wait until the process that started this one is no more; then nobody wants what is in hand here."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

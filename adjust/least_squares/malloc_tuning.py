"""Memory management: let the C library keep freed memory for the next step, and pause Python's garbage collector."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

LARGEST_FOLLOWED = 31 << 20  # bytes; glibc's threshold follows freed blocks of up to 32 MiB


def keep_freed_memory() -> None:
    """Make glibc keep tens of MiB of freed memory instead of returning every array to the system.

    Each step of an adjustment allocates the same arrays, and each mark arrays of the same size. Memory returned to the
    system comes back page by page and zeroed, which took a fifth of the time of an adjustment of 20,000 points. glibc
    adapts its thresholds to the largest block freed so far (mallopt(3), M_MMAP_THRESHOLD and M_TRIM_THRESHOLD); the
    block freed here is never touched and uses no memory. With other C libraries this has no effect.
    """
    np.empty(LARGEST_FOLLOWED, dtype=np.uint8)


@contextmanager
def pause_cycle_search() -> Iterator[None]:
    """Pause Python's cyclic garbage collector.

    An adjustment creates no cycles, but so many keys and small arrays that all names of a large network would be
    scanned several times: a tenth of its time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()

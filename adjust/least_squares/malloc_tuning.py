"""Memory: what the C library keeps when it is freed, for the arrays of the next step, and when Python seeks cycles."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

LARGEST_FOLLOWED = 31 << 20  # bytes; glibc's threshold follows freed blocks of up to 32 MiB


def keep_freed_memory() -> None:
    """Have glibc keep tens of MiB of freed memory instead of giving every array back to the system.

    An adjustment asks for the same arrays in every step, and one mark for arrays as large as the last one's. Memory
    that was given back comes again page by page, zeroed, which took a fifth of the time of an adjustment of 20,000
    points. What is kept follows the largest block that was ever freed (mallopt(3), M_MMAP_THRESHOLD and
    M_TRIM_THRESHOLD): this one is never touched and takes no memory. Other C libraries have rules of their own, and
    nothing happens.
    """
    np.empty(LARGEST_FOLLOWED, dtype=np.uint8)


@contextmanager
def pause_cycle_search() -> Iterator[None]:
    """Leave out Python's search for unused cycles of objects for a time.

    An adjustment makes no cycles, but so many keys and small arrays that all names of a large network would be searched
    several times: a tenth of its time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()

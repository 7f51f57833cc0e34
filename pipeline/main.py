"""Entry point of the command `reseau`."""

import gc
import importlib
import os
import signal
import sys

_INTERRUPTED = 130
_OBJECTS = 10_000  # allocations between garbage collections, each of which rescans an archive's many lasting objects


def main() -> None:
    """Run the command line with one BLAS thread: two threads on two cores made the adjustment several times slower.

    The variables must be set before numpy is imported, hence before the command line is.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    gc.set_threshold(_OBJECTS)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as on an interrupt, so that worker processes end, too
    try:
        importlib.import_module("pipeline.terminal").outlive_readers()
        sys.exit(importlib.import_module("pipeline.cli").run())
    except KeyboardInterrupt:  # during the import of modules; later the command line handles it
        sys.exit(_INTERRUPTED)

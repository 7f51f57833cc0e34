"""The command `reseau`."""

import gc
import importlib
import os
import signal
import sys

_INTERRUPTED = 130
_OBJECTS = 10_000  # made between searches for cycles: most of an archive's live to the end, and each search sees them


def main() -> None:
    """Run the command line. One BLAS thread: two on two cores made the adjustment several times slower.

    The variables must be set before numpy is imported, and so before the command line is.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    gc.set_threshold(_OBJECTS)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as an interrupt does, worker processes with it
    try:
        importlib.import_module("pipeline.terminal").outlive_readers()
        sys.exit(importlib.import_module("pipeline.cli").run())
    except KeyboardInterrupt:  # while the modules are imported: later the command line answers for it
        sys.exit(_INTERRUPTED)

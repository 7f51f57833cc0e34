"""Time and memory of the catalogue made by `reseau init`: headers of many files, in folders of 500.

Tiled TIFF files of 64 x 64 px that differ in one tile, a tenth of them copies of others, a hundredth damaged. All have
the same size, so that each must be distinguished from all others by content.
"""

import io
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile

from benchmarks.harness import Row
from pipeline.archive.scan_groups import catalogue

OWN_PROCESS = True
A_FOLDER = 500
COLUMNS = {
    "files": "d", "catalogue_s": ".1f", "ms_a_file": ".2f", "mib": ".0f", "groups": "d", "copies": "d", "broken": "d",
}  # fmt: skip


def cells() -> Iterator[Row]:
    yield from ({"files": files} for files in (1000, 10_000, 50_000))


def case(files: int, seed: int) -> Row:
    with TemporaryDirectory() as folder:
        write(Path(folder), files, seed)
        start_s = time.process_time()
        found = catalogue([Path(folder)], lambda *_: None)
        cpu_s = time.process_time() - start_s
    mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    counts = {"groups": len(found.groups), "copies": len(found.copies), "broken": len(found.unread)}
    return {"catalogue_s": cpu_s, "ms_a_file": 1000 * cpu_s / files, "mib": mib, **counts}


def write(folder: Path, files: int, seed: int) -> None:
    """Write the files: one file with pixels changed in place."""
    picture = np.random.default_rng(seed).integers(0, 255, (64, 64)).astype(np.uint8)
    memory = io.BytesIO()
    tifffile.imwrite(memory, picture, tile=(32, 32), resolution=(500, 500), resolutionunit="CENTIMETER")
    data = bytearray(memory.getvalue())
    for index in range(files):
        own = folder / f"{index // A_FOLDER:04d}"
        own.mkdir(exist_ok=True)
        which = index - 1 if index % 10 == 9 else index
        data[-8:] = which.to_bytes(8, "big")
        (own / f"{index:06d}.tif").write_bytes(b"II*\0" if index % 100 == 50 else data)

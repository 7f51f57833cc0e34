"""Time and memory of the catalogue that `reseau init` makes: heads of many files, in folders of 500.

python benchmarks/catalogue.py [FILES...]

Tiled TIFF files of 64 x 64 px whose bytes differ in one tile, a tenth of them copies of others, a hundredth broken. All
have one size, so each has to be told from all others. Each number of files is catalogued in a process of its own.
"""

import io
import multiprocessing
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile

from pipeline.archive.catalogue import catalogue

SEED = 17
FOLDER = 500


def main() -> None:
    """Print the table."""
    print("files | wall s | CPU s | CPU ms a file | peak MB | groups | copies | broken")
    for files in [int(text) for text in sys.argv[1:]] or [1000, 10_000, 50_000]:
        folder = Path(tempfile.mkdtemp())
        try:
            write(folder, files)
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                print(pool.apply(row, (folder, files)), flush=True)
        finally:
            shutil.rmtree(folder)


def write(folder: Path, files: int) -> None:
    """The files, from one whose pixels are changed in place."""
    rng = np.random.default_rng(SEED)
    memory = io.BytesIO()
    picture = rng.integers(0, 255, (64, 64)).astype(np.uint8)
    tifffile.imwrite(memory, picture, tile=(32, 32), resolution=(500, 500), resolutionunit="CENTIMETER")
    data = bytearray(memory.getvalue())
    for index in range(files):
        own = folder / f"{index // FOLDER:04d}"
        own.mkdir(exist_ok=True)
        which = index - 1 if index % 10 == 9 else index
        data[-8:] = which.to_bytes(8, "big")
        (own / f"{index:06d}.tif").write_bytes(b"II*\0" if index % 100 == 50 else data)


def row(folder: Path, files: int) -> str:
    """Of the table."""
    start, before = time.perf_counter(), time.process_time()
    found = catalogue([folder], lambda *_: None)
    wall_s, cpu_s = time.perf_counter() - start, time.process_time() - before
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (
        f"{files} | {wall_s:.1f} | {cpu_s:.1f} | {1000 * cpu_s / files:.2f} | {peak_mb:.0f} | {len(found.groups)} | "
        f"{len(found.copies)} | {len(found.broken)}"
    )


if __name__ == "__main__":
    main()

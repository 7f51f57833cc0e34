"""Real measurings of many scans by `reseau measure`: scans an hour, CPU and memory a scan.

    python -m benchmarks archive_real [SCANS] [--workers 2] [--side 2400] [--folder DIR]

The scans are drawn anew, each with a place and grain of its own: tiled TIFF files of grainy film with eight
ring-crosses, some 3 MB each at 2400 px. They are drawn first, and a line tells how many there are; then the command's
own lines tell how many are measured, and how long the others will take. Given a folder, what is there already is
neither drawn nor measured again: a run that was stopped goes on.
"""

import argparse
import os
import resource
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile

from benchmarks.object_measuring import PITCH_UM, camera_text, drawn_frame
from pipeline.files.camera_file import read_camera

_A_FOLDER = 500
_BEYOND_MM = 2.0  # of the marks, to the scan's edge
_TOLD_S = 20.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scans", type=int, nargs="?", default=2000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--side", type=int, default=2400, help="of a scan, px")
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    if options.folder is not None:
        measured(options.folder, options.scans, options.side, options.workers)
        return
    with tempfile.TemporaryDirectory() as place:
        measured(Path(place), options.scans, options.side, options.workers)


def measured(folder: Path, scans: int, side: int, workers: int) -> None:
    draw(folder, scans, side)
    before = results(folder)
    start_s = time.monotonic()
    command = [
        sys.executable,
        "-c",
        "from pipeline.main import main; main()",
        "measure",
        str(folder / "project.toml"),
        "--workers",
        str(workers),
    ]
    subprocess.run(command, check=False, stdout=subprocess.DEVNULL, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"})
    clock_s, used = time.monotonic() - start_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    with sqlite3.connect(folder / "out" / "measurement.db") as db:
        told = dict(db.execute("select verdict, count(*) from result group by verdict"))
    count, cpu_s = results(folder) - before, used.ru_utime + used.ru_stime
    print(f"{count} scans of {side} x {side} px, {workers} processes: {told}")
    print(f"{'scans an hour':>16}{'clock s a scan':>16}{'CPU s a scan':>14}{'MB at most of a process':>25}")
    print(
        f"{3600 * count / clock_s:16.0f}{clock_s / max(count, 1):16.2f}{cpu_s / max(count, 1):14.2f}"
        f"{used.ru_maxrss / 1024:25.0f}"
    )


def draw(folder: Path, scans: int, side: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    edge_mm = side * PITCH_UM / 2000 - _BEYOND_MM
    (folder / "camera.toml").write_text(camera_text(edge_mm), encoding="utf-8")
    (folder / "project.toml").write_text(
        f'camera = "camera.toml"\nscans = ["scans/**/*.tif"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\n',
        encoding="utf-8",
    )
    layout, said_s = read_camera(folder / "camera.toml").layout(), time.monotonic()
    for number in range(scans):
        file = folder / "scans" / f"box{number // _A_FOLDER:02d}" / f"{number % _A_FOLDER:04d}.tif"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            grey = drawn_frame(layout, side, np.random.default_rng(number))
            tifffile.imwrite(file, grey, tile=(256, 256), compression="zlib", metadata=None)
        if time.monotonic() - said_s > _TOLD_S:
            said_s = time.monotonic()
            print(f"{number + 1} of {scans} drawn", flush=True)


def results(folder: Path) -> int:
    path = folder / "out" / "measurement.db"
    if not path.exists():
        return 0
    with sqlite3.connect(path) as db:
        is_made = db.execute("select count(*) from sqlite_master where name = 'result'").fetchone()[0]
        return int(db.execute("select count(*) from result").fetchone()[0]) if is_made else 0


if __name__ == "__main__":
    main()

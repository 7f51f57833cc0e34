"""Measurement of many scans by `reseau measure`: scans per hour, CPU time and memory per scan.

The scans are rendered, each with its own position and grain: tiled TIFF files of grainy film with eight ring-crosses,
about 3 MB each at 2400 px. They are rendered first, with progress lines; then the command prints its own progress.
Given a folder, existing scans and results are used again, so that a stopped run continues.
"""

import sqlite3
import time
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile

from benchmarks.harness import Row, reseau
from benchmarks.object_measuring import PITCH_UM, camera_text, drawn_frame
from pipeline.files.camera_file import read_camera

_A_FOLDER = 500
_BEYOND_MM = 2.0  # mm, distance of the marks from the scan's edge
_TOLD_S = 20.0
COLUMNS = {
    "verdicts": "", "scans an hour": ".0f", "seconds a scan": ".2f", "CPU s a scan": ".2f", "MB of a process": ".0f"
}  # fmt: skip


def case(scans: int = 2000, workers: int = 2, side: int = 2400, folder: Path | None = None) -> Row:
    with nullcontext(folder) if folder else TemporaryDirectory() as place:
        folder = Path(place)
        draw(folder, scans, side)
        before = results(folder)
        used = reseau("measure", folder / "project.toml", "--workers", workers)
        with sqlite3.connect(folder / "out" / "measurement.db") as db:
            verdicts = dict(db.execute("select verdict, count(*) from result group by verdict"))
        count = results(folder) - before
    each = max(count, 1)
    return {
        "verdicts": str(verdicts), "scans an hour": 3600 * count / used.seconds, "seconds a scan": used.seconds / each,
        "CPU s a scan": used.cpu_seconds / each, "MB of a process": used.mib,
    }  # fmt: skip


def draw(folder: Path, scans: int, side: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    edge_mm = side * PITCH_UM / 2000 - _BEYOND_MM
    (folder / "camera.toml").write_text(camera_text(edge_mm), encoding="utf-8")
    (folder / "project.toml").write_text(
        f'camera = "camera.toml"\nscans = ["scans/**/*.tif"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\n',
        encoding="utf-8",
    )
    layout, begin_s = read_camera(folder / "camera.toml").layout(), time.monotonic()
    for number in range(scans):
        file = folder / "scans" / f"box{number // _A_FOLDER:02d}" / f"{number % _A_FOLDER:04d}.tif"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            grey = drawn_frame(layout, side, np.random.default_rng(number))
            tifffile.imwrite(file, grey, tile=(256, 256), compression="zlib", metadata=None)
        if time.monotonic() - begin_s > _TOLD_S:
            begin_s = time.monotonic()
            print(f"{number + 1} of {scans} drawn", flush=True)


def results(folder: Path) -> int:
    path = folder / "out" / "measurement.db"
    if not path.exists():
        return 0
    with sqlite3.connect(path) as db:
        is_made = db.execute("select count(*) from sqlite_master where name = 'result'").fetchone()[0]
        return int(db.execute("select count(*) from result").fetchone()[0]) if is_made else 0

"""Archive of fifty thousand scans: time, memory and file sizes of each command, in its own process.

The measurement of a scan is replaced by a stand-in, so that only the rest is timed; two processes. `report` uses
results in which every hundredth frame lacks a fiducial. `adjust` uses 10,000 frames with eight fiducials only: these
are up to 10 µm off their given places, each frame has its own affine film transformation, and the noise is 2 µm.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.archive_stand_ins import CAMERA, FIDUCIALS, USE, keep_results, write_project
from benchmarks.harness import Row, reseau, table
from pipeline.files.project_file import read_project

OFF_MM, SCATTER_MM, STRETCH = 0.01, 0.002, 3e-4
A_FOLDER = 500
FILES = ("comparator.csv", "out/measurement.db", "out/adjustment.json", "out/adjustment.npz", "out/report.html")
_COLUMNS = {"command": "", "seconds": ".1f", "cpu_seconds": ".1f", "ms_a_scan": ".2f", "mib": ".0f"}


def cells(scans: int = 50_000, frames: int = 10_000) -> Iterator[Row]:
    yield from ({"work": work, "scans": scans} for work in ("measure", "report"))
    yield {"work": "adjust", "scans": frames}


def case(work: str, scans: int, seed: int) -> Row:
    with TemporaryDirectory() as place:
        folder = Path(place)
        rows = list(WORKS[work](folder, scans, seed))
        sizes = {name: (folder / name).stat().st_size / 1e6 for name in FILES if (folder / name).exists()}
    return {"rows": rows, "sizes_mb": sizes}


def report(rows: list[Row]) -> Iterator[str]:
    for row in rows:
        yield f"{row['work']}, {row['scans']} scans of eight marks; " + ", ".join(
            f"{name} {size:.1f} MB" for name, size in row["sizes_mb"].items()
        )
        yield from table(_COLUMNS, row["rows"])


def _measuring(folder: Path, scans: int, _seed: int) -> Iterator[Row]:
    project = write_project(folder, scans)
    measure = ("measure", project, "--workers", 2)
    yield _row("measure", scans, *measure)
    yield _row("measure, nothing to do", scans, *measure)
    yield _row("status", scans, "status", project)
    yield _row("status --json", scans, "status", "--json", project)
    (folder / "scans" / "box00" / "one more.tif").write_bytes(b"one more")
    yield _row("measure, one scan more", scans, *measure)


def _reporting(folder: Path, scans: int, _seed: int) -> Iterator[Row]:
    project = read_project(write_project(folder, scans))
    keep_results(project)
    yield _row("report", scans, "report", project.path)
    yield _row("report --frames NAME", scans, "report", project.path, "--frames", sorted(project.scans)[1])


def _adjusting(folder: Path, scans: int, seed: int) -> Iterator[Row]:
    project = write_comparator(folder, scans, np.random.default_rng(seed))
    yield from (_row(command, scans, command, project) for command in ("adjust", "report"))


def _row(title: str, scans: int, *arguments: object) -> Row:
    figures = reseau(*arguments, before=USE).figures
    return {"command": title, **figures, "ms_a_scan": 1e3 * figures["cpu_seconds"] / scans}


def write_comparator(folder: Path, frames: int, rng: np.random.Generator) -> Path:
    """Write a project of measured frames."""
    (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
    (folder / "project.toml").write_text('camera = "camera.toml"\n', encoding="utf-8")
    true_mm = np.array(FIDUCIALS) + rng.uniform(-OFF_MM, OFF_MM, (len(FIDUCIALS), 2))
    with (folder / "comparator.csv").open("w", encoding="utf-8") as file:
        file.write("image,point,kind,x_mm,y_mm,sx_mm,sy_mm\n")
        for number in range(frames):
            film = np.eye(2) + rng.normal(0, STRETCH, (2, 2))
            places_mm = true_mm @ film.T + rng.uniform(100, 120, 2) + rng.normal(0, SCATTER_MM, true_mm.shape)
            image = f"box{number // A_FOLDER:02d}/{number % A_FOLDER:04d}"
            file.writelines(
                f"{image},{point},fiducial,{x:.7f},{y:.7f},{SCATTER_MM},{SCATTER_MM}\n"
                for point, (x, y) in enumerate(places_mm, 1)
            )
    return folder / "project.toml"


WORKS = {"measure": _measuring, "report": _reporting, "adjust": _adjusting}

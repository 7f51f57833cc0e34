"""Stand-in scans of an archive, measured without images: random results, determined by the content of the file.

All else is as usual: files, tasks, keys, processes, results database, cross-scan checks, comparator.csv. Only the
function that measures a scan is replaced.
"""

import hashlib
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from pipeline.archive.checked_results import CheckedResult, store_checks
from pipeline.archive.made_from import measured_from
from pipeline.archive.results_database import Kept, ResultsDatabase
from pipeline.files.project_file import Project
from pipeline.measuring.scan_measurement import MeasuredFile
from pipeline.measuring.scan_task import ScanTask, scan_tasks
from pipeline.provenance import FileIdentity, file_state, parts_hash
from pipeline.results.comparator_file import write_comparator
from pipeline.results.measured_record import MeasuredScan

FIDUCIALS = ((-106, -106), (106, -106), (106, 106), (-106, 106), (0, -110), (110, 0), (0, 110), (-110, 0))
_PITCH_UM = 20.0
_SIGMA_PX = 0.02
_LOSES = 100  # one frame in this number lacks a fiducial
_COVERED = Reason("a part of it is covered", Code.COVERED)
CAMERA = 'name = "stand-in"\nframe_mm = [228.0, 228.0]\n' + "".join(
    f'[[fiducial]]\nid = "{number}"\nxy_mm = [{x}.0, {y}.0]\nsigma_mm = 0.01\nmark = "m"\n'
    for number, (x, y) in enumerate(FIDUCIALS, 1)
) + '[mark.m]\nkind = "cross"\narm_mm = 0.8\nline_mm = 0.1\n'  # fmt: skip
PROJECT = f'camera = "camera.toml"\nscans = ["scans/**/*.tif"]\npitch_um = {_PITCH_UM}\n[measure]\npose = "0"\n'


def write_project(folder: Path, scans: int, a_folder: int = 1000) -> Path:
    """Write a project of stand-in scans, files of a few bytes, in folders of a_folder files."""
    (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
    (folder / "project.toml").write_text(PROJECT, encoding="utf-8")
    for number in range(scans):
        file = folder / "scans" / f"box{number // a_folder:02d}" / f"{number % a_folder:04d}.tif"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(f"scan {number}".encode())
    return folder / "project.toml"


def stand_in(task: ScanTask) -> MeasuredFile:
    """Measure a stand-in scan. Environment: RESEAU_STAND_IN_S: duration, s, 0 by default; RESEAU_STAND_IN_LOG: file to
    which its start is logged; RESEAU_STAND_IN_WEAK: number of weak marks."""
    if result := os.environ.get("RESEAU_STAND_IN_LOG"):
        with Path(result).open("a", encoding="utf-8") as file:
            file.write(f"{task.name}\n")
    time.sleep(float(os.environ.get("RESEAU_STAND_IN_S", "0")))
    digest = hashlib.sha256(Path(task.scan).read_bytes()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "little"))
    matrix = np.array([[50.0, 0.0, 5750.0], [0.0, -50.0, 5750.0]]) + rng.normal(0, [[1e-3, 1e-3, 30.0]] * 2)
    marks = tuple(_mark(str(number), xy, matrix, rng) for number, xy in enumerate(FIDUCIALS, 1))
    weak = int(os.environ.get("RESEAU_STAND_IN_WEAK", "0"))
    marks = tuple(replace(one, status=Status.WEAK, reason=_COVERED) if k < weak else one for k, one in enumerate(marks))
    pose = ScanOrientation("0", True, ("set in the project.",))
    frame = FrameMeasurement(task.name, marks, pose, matrix)
    scan = MeasuredScan(task.scan, 11500, 11500, (_PITCH_UM, _PITCH_UM), frame, ("It is a stand-in.",))
    return MeasuredFile(replace(scan, seconds=0.5), digest.hex(), len(digest))


def _mark(point: str, xy: tuple[int, int], matrix: np.ndarray, rng: np.random.Generator) -> MarkMeasurement:
    center = matrix @ [*xy, 1.0] + rng.normal(0, _SIGMA_PX, 2)
    noise, film = np.eye(2) * _SIGMA_PX**2, np.eye(2) * 0.15**2
    names = ("snr", "contrast_dn", "blur_px", "noise_dn", "damaged_fraction", "size_px", "likeness")
    quality = {name: float(value) for name, value in zip(names, rng.uniform(0, 50, len(names)), strict=True)}
    covariance = Covariance({Cause.NOISE: noise, Cause.FILM: film})
    return MarkMeasurement(point, "fiducial", center, covariance, Status.MEASURED, quality=quality)


def keep_results(project: Project) -> None:
    """Store results as `reseau measure` would; every hundredth frame lacks a fiducial."""
    home = project.path.resolve().parent
    with ResultsDatabase(project.measurement_path) as database:
        database.set_project_folder(home)
        check_run = store_checks(database, measured_from(project), "kept", _frames(project, database, home))
        write_comparator(project.comparator, check_run.points(), check_run.pitches_um(), check_run.digest)
        check_run.remember_written(project.comparator)


def _frames(project: Project, database: ResultsDatabase, home: Path) -> Iterator[CheckedResult]:
    for number, task in enumerate(scan_tasks(project, tuple(project.scans))):
        scan = stand_in(task).scan
        scan, path = _lose_marks(scan) if number % _LOSES == 1 else scan, Path(task.scan)
        identity = FileIdentity(file_state(path, home), parts_hash(path))
        yield CheckedResult(database.keep(Kept(identity, "{}", scan), task.name), scan)


def _lose_marks(scan: MeasuredScan) -> MeasuredScan:
    first, *others = scan.frame.marks
    lost = MarkMeasurement(first.point, first.kind, None, None, Status.ABSENT, Reason("it is covered", Code.COVERED))
    return replace(scan, frame=replace(scan.frame, marks=(lost, *others)))


def use() -> None:
    """Replace the measuring function of this process by the stand-in."""
    from pipeline.archive import work

    vars(work)["measure_file"] = stand_in


USE = "from benchmarks.archive_stand_ins import use; use()"  # for another process

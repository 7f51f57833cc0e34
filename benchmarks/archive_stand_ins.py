"""Scans of an archive that are measured without pictures: what one of each gives, drawn by chance from its file's name.

Everything about them is as ever: files, tasks, keys, processes, the store, the judging, comparator.csv. Only the
measuring of a scan is another function.
"""

import hashlib
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose
from pipeline.measuring.scan_measurement import MeasuredFile
from pipeline.measuring.scan_task import ScanTask
from pipeline.results.measured_scan import MeasuredScan

FIDUCIALS = ((-106, -106), (106, -106), (106, 106), (-106, 106), (0, -110), (110, 0), (0, 110), (-110, 0))
_PITCH_UM = 20.0
_SIGMA_PX = 0.02
_COVERED = Reason("a part of it is covered", Code.COVERED)
CAMERA = 'name = "stand-in"\nframe_mm = [228.0, 228.0]\n' + "".join(
    f'[[fiducial]]\nid = "{number}"\nxy_mm = [{x}.0, {y}.0]\nsigma_mm = 0.01\nmark = "m"\n'
    for number, (x, y) in enumerate(FIDUCIALS, 1)
) + '[mark.m]\nkind = "cross"\narm_mm = 0.8\nline_mm = 0.1\n'  # fmt: skip
PROJECT = f'camera = "camera.toml"\nscans = ["scans/**/*.tif"]\npitch_um = {_PITCH_UM}\n[measure]\npose = "0"\n'


def write_project(folder: Path, scans: int, a_folder: int = 1000) -> Path:
    """A project of so many empty-handed scans, in boxes of a thousand: files of some bytes."""
    (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
    (folder / "project.toml").write_text(PROJECT, encoding="utf-8")
    for number in range(scans):
        file = folder / "scans" / f"box{number // a_folder:02d}" / f"{number % a_folder:04d}.tif"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(f"scan {number}".encode())
    return folder / "project.toml"


def stand_in(task: ScanTask) -> MeasuredFile:
    """Measured in the time that RESEAU_STAND_IN_S says, 0 by default; RESEAU_STAND_IN_LOG: where its begin is told;
    RESEAU_STAND_IN_WEAK: how many of its marks are weak."""
    if told := os.environ.get("RESEAU_STAND_IN_LOG"):
        with Path(told).open("a", encoding="utf-8") as file:
            file.write(f"{task.name}\n")
    time.sleep(float(os.environ.get("RESEAU_STAND_IN_S", "0")))
    digest = hashlib.sha256(Path(task.scan).read_bytes()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "little"))
    matrix = np.array([[50.0, 0.0, 5750.0], [0.0, -50.0, 5750.0]]) + rng.normal(0, [[1e-3, 1e-3, 30.0]] * 2)
    marks = tuple(_mark(str(number), xy, matrix, rng) for number, xy in enumerate(FIDUCIALS, 1))
    weak = int(os.environ.get("RESEAU_STAND_IN_WEAK", "0"))
    marks = tuple(replace(one, status=Status.WEAK, reason=_COVERED) if k < weak else one for k, one in enumerate(marks))
    pose = Pose("0", True, ("set in the project.",))
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


def use() -> None:
    """From now on this process hands out stand-ins."""
    from pipeline.archive import work

    vars(work)["measure_file"] = stand_in

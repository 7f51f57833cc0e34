"""Points of a board seen by several pictures of an own pinhole with distortion: what one picture alone shows off its
place is told from what lies off on the board."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from single_scans import measure_scan

from measure.flags import Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement
from pipeline.files.project_file import Project, read_project
from pipeline.measuring.coded_targets import check_sheet
from pipeline.results.measured_record import MeasuredScan

Array = NDArray[np.float64]
COLUMNS, ROWS, WIDTH, HEIGHT, NOISE_PX = 9, 8, 2200, 1700, 0.05
BUCKLED, MISPRINTED = "r2c3", "r5c6"


def board(folder: Path) -> Project:
    (folder / "camera.toml").write_text('name = "c"\nframe_mm = [11.0, 8.5]\n', encoding="utf-8")
    (folder / "comparator.csv").touch()
    (folder / "points.csv").write_text("point,X,Y,Z\nr0c0,,,\n", encoding="utf-8")  # a board has places without any
    (folder / "project.toml").write_text(
        f'camera = "camera.toml"\n[targets]\nkind = "chessboard"\ncolumns = {COLUMNS}\nrows = {ROWS}\n'
        'square_mm = 20.0\n[object]\npoints = "points.csv"\n',
        encoding="utf-8",
    )
    return read_project(folder / "project.toml")


def rotation(axis: int, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.roll(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), axis, (0, 1))


def view_points(rng: np.random.Generator, xyz: Array) -> Array:
    """(n, 2) px: up to 40 degrees oblique, rolled, with 8 % of barrel distortion, not about the picture's middle."""
    turned = rotation(2, rng.uniform(0.0, 6.28)) @ rotation(0, np.pi - rng.uniform(0.3, 0.7))
    camera = (xyz - xyz.mean(axis=0)) @ (turned @ rotation(2, rng.uniform(0.0, 6.28))).T + (0.0, 0.0, 260.0)
    ideal = camera[:, :2] / camera[:, 2:]
    bent = ideal * (1.0 - 0.3 * ((ideal - (0.02, -0.01)) ** 2).sum(axis=1, keepdims=True))
    return np.asarray(bent * 2000.0 + (WIDTH / 2, HEIGHT / 2) + rng.normal(0.0, NOISE_PX, ideal.shape))


def measure_picture(rng: np.random.Generator, project: Project, name: str, wrong: dict[str, float]) -> MeasuredScan:
    """One picture, some of its points so many px off in some direction."""
    assert project.targets is not None
    assert project.targets.board is not None
    xyz = {id: np.array(place) for id, place in project.targets.board.object_points().items()}
    xyz[BUCKLED] = xyz[BUCKLED] + (0.0, 0.0, 1.0)
    xyz[MISPRINTED] = xyz[MISPRINTED] + (0.4, -0.3, 0.0)
    marks = []
    for id, place in zip(xyz, view_points(rng, np.array(list(xyz.values()))), strict=True):
        angle = rng.uniform(0.0, 6.28)
        off = wrong.get(id, 0.0) * np.array([np.cos(angle), np.sin(angle)])
        marks.append(
            MarkMeasurement(id, "target", place + off, Covariance.from_noise(NOISE_PX**2 * np.eye(2)), Status.MEASURED)
        )
    fiducial = MarkMeasurement("r4c4", "fiducial", np.zeros(2), Covariance.from_noise(np.eye(2)), Status.MEASURED)
    return MeasuredScan(name, WIDTH, HEIGHT, (5.0, 5.0), FrameMeasurement(name, (fiducial, *marks)))


def status(scans: tuple[MeasuredScan, ...], wanted: Status) -> set[tuple[str, str]]:
    return {(scan.frame.image, mark.point) for scan in scans for mark in scan.frame.marks if mark.status is wanted}


def test_what_one_picture_alone_shows_off_its_place_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    project = board(tmp_path)
    wrong = {"p0": {"r0c0": 1.5, "r3c4": 0.8}, "p2": {"r7c8": 2.0, BUCKLED: 1.0}, "p4": {"r4c4": 40.0, "r6c1": 0.6}}
    names = [f"p{number}" for number in range(5)]
    checked = check_sheet(project, [measure_picture(rng, project, name, wrong.get(name, {})) for name in names])
    assert all(scan.frame.marks[0].status is Status.MEASURED for scan in checked)  # a fiducial of a point's name
    assert status(checked, Status.REJECTED) == {(name, id) for name, ids in wrong.items() for id in ids}
    assert not status(checked, Status.WEAK)
    assert check_sheet(project, []) == ()
    alone = check_sheet(project, [measure_picture(rng, project, "p0", {"r3c4": 3.0, "r1c1": 400.0})])
    doubted = status(alone, Status.WEAK)
    assert status(alone, Status.REJECTED) == {("p0", "r1c1")}
    assert ("p0", "r3c4") in doubted
    assert {id for _, id in doubted} <= {"r3c4", BUCKLED, MISPRINTED}
    reason = next(mark.reason for mark in alone[0].frame.marks if mark.point == "r3c4")
    assert "no other picture tells" in reason


@pytest.mark.parametrize("drawn_before", [12, 19, 120])
def test_a_scan_of_two_like_boards_says_so(tmp_path: Path, drawn_before: int) -> None:
    """And none of their points is an observation. OpenCV's detector draws random numbers: going on from these, it
    misses the second board."""
    cv2.setRNGSeed(drawn_before)
    (tmp_path / "camera.toml").write_text('name = "c"\nframe_mm = [4.2, 1.8]\n', encoding="utf-8")
    (tmp_path / "project.toml").write_text(
        'camera = "camera.toml"\nscans = ["two.png"]\npitch_um = 10.0\n'
        '[targets]\nkind = "chessboard"\ncolumns = 4\nrows = 3\nsquare_mm = 25.0\n',
        encoding="utf-8",
    )
    board = np.kron(np.indices((4, 5)).sum(axis=0) % 2, np.ones((32, 32)))
    sheet = np.pad(255 * board, 24, constant_values=255)
    two = cv2.GaussianBlur(np.hstack([sheet, sheet]), (0, 0), 0.8)
    cv2.imwrite(str(tmp_path / "two.png"), (20 + 0.8 * two).astype(np.uint8))
    frame = measure_scan(read_project(tmp_path / "project.toml"), "two").frame
    assert {mark.status for mark in frame.marks} == {Status.REJECTED}
    words = "No point of the board is used: the scan shows 2 boards of 4 x 3 inner corners"
    assert frame.problems[-1].startswith(words)

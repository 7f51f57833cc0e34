"""Crosses and ring-coded disks in space, rendered: named with no orientation, measured to their standard deviations."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from single_scans import measure_scan

from measure.flags import Status
from measure.results import MarkMeasurement
from pipeline.errors import InputError
from pipeline.files.project_file import read_project
from pipeline.files.target_table import read_targets
from pipeline.measuring.scan_task import scan_tasks
from pipeline.rendered.scene_file import render_project
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.tables import read_toml

Array = NDArray[np.float64]

SCENE = """seed = 3
[camera]
name = "c"
frame_mm = [24.0, 16.0]
principal_distance_mm = 20.0
[scan]
pitch_um = 20.0
margin_mm = 0.1
noise = 0.01
[[image]]
name = "a"
position = [0.9, -0.4, 2.3]
angles_deg = [10.0, 22.0, 130.0]
[field]
surround = 1.5
{field}
[[field.scatter]]
first = 5001
points = 20
right = [2.2, 0.0, 0.0]
up = [0.0, 1.5, 0.0]
relief = 0.35
"""
CROSSES = 'kind = "crosses"\narm_mm = 45.0\nline_mm = 12.0'
RINGS = 'kind = "coded-rings"\ndiameter_mm = 36.0\nevery = 2'


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folder of each field's picture. Tests copy it before they change anything."""
    folders = {field: tmp_path_factory.mktemp("scene") for field in (CROSSES, RINGS)}
    for field, folder in folders.items():
        (folder / "scene.toml").write_text(SCENE.format(field=field), encoding="utf-8")
        render_project(folder / "scene.toml", folder)
    return folders


def rendered(scene: Path, folder: Path) -> tuple[Path, dict[str, Array]]:
    """The project without its orientations, and the true places of the figures that are wholly seen."""
    shutil.copytree(scene, folder, dirs_exist_ok=True)
    project = folder / "project.toml"
    lines = project.read_text(encoding="utf-8").splitlines()
    project.write_text("\n".join(line for line in lines if not line.startswith("images")), encoding="utf-8")
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))["images"]["a"]["targets"]
    places = {id: np.array([t["ellipse_col_px"], t["ellipse_row_px"]]) for id, t in truth.items() if t["visible"]}
    return project, places


def errors(scan: MeasuredScan, places: dict[str, Array]) -> dict[str, Array]:
    marks = {mark.point: mark for mark in scan.frame.marks if mark.status.is_observation}
    return {id: error(marks[id], place) for id, place in places.items() if id in marks}


def error(mark: MarkMeasurement, place: Array) -> Array:
    assert mark.center_px is not None
    return mark.center_px - place


@pytest.mark.study
def test_crosses_in_space_with_no_principal_distance(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, places = rendered(scenes[CROSSES], tmp_path)
    camera = tmp_path / "camera.toml"
    lines = camera.read_text(encoding="utf-8").splitlines()
    camera.write_text("\n".join(line for line in lines if "principal_distance" not in line), encoding="utf-8")
    scan = measure_scan(read_project(project), "a")
    off = errors(scan, places)
    assert len(off) == len(places) > 12
    assert max(np.abs(one).max() for one in off.values()) < 0.03


@pytest.mark.study
def test_an_orientation_that_does_not_fit_is_not_used(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, places = rendered(scenes[CROSSES], tmp_path)
    turned = "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg\na,-1.2,0.9,2.0,-25.0,-30.0,-90.0\n"
    (tmp_path / "images.csv").write_text(turned, encoding="utf-8")
    text = project.read_text(encoding="utf-8")
    project.write_text(text.replace("[object]", '[object]\nimages = "images.csv"'), encoding="utf-8")
    scan = measure_scan(read_project(project), "a")
    assert len(errors(scan, places)) == len(places)
    assert any("orientation in images.csv was not used" in problem for problem in scan.frame.problems)


@pytest.mark.study
def test_ring_codes_in_space_and_two_that_are_confused(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, places = rendered(scenes[RINGS], tmp_path)
    off = errors(measure_scan(read_project(project), "a"), places)
    assert len(off) == len(places) > 12
    assert max(np.abs(one).max() for one in off.values()) < 0.08
    first, second = [id for id in places if int(id) < 4096][:2]
    points = tmp_path / "points.csv"
    swap = {first: second, second: first}
    rows = [row.split(",", 1) for row in points.read_text(encoding="utf-8").splitlines()]
    points.write_text("\n".join(f"{swap.get(id, id)},{rest}" for id, rest in rows), encoding="utf-8")
    scan = measure_scan(read_project(project), "a")
    assert any("lie where the field has another point" in problem for problem in scan.frame.problems)
    confused = errors(scan, places)
    assert set(confused) & {first, second} == set()
    assert len(confused) >= len(places) - 4


def test_a_ring_read_twice_is_the_one_at_its_place(scenes: dict[str, Path], tmp_path: Path) -> None:
    """A ring copied over another one: that dot has the place of one point, the code of the other, the name of none."""
    project, places = rendered(scenes[RINGS], tmp_path)
    first, second = [id for id in places if int(id) < 4096][:2]
    scan_file = read_project(project).scans["a"]
    picture = tifffile.imread(scan_file)
    (from_col, from_row), (col, row) = (np.round(places[id]).astype(int) for id in (first, second))
    half = 30
    chip = picture[from_row - half : from_row + half, from_col - half : from_col + half].copy()
    picture[row - half : row + half, col - half : col + half] = chip
    tifffile.imwrite(scan_file, picture)
    scan = measure_scan(read_project(project), "a")
    marks = {mark.point: mark for mark in scan.frame.marks}
    assert set(errors(scan, places)) == set(places) - {second}
    assert marks[second].status is Status.REJECTED
    assert marks[second].reason == f"the ring at its place reads as {first}"


@pytest.mark.parametrize(
    ("targets", "message"),
    [('kind = "cross"\narm_mm = 5.0\nline_mm = 6.0', "a line of 6 mm is no line for arms of 5 mm"),
     ('kind = "cross"\nline_mm = 6.0', "arm_mm")],
)  # fmt: skip
def test_what_a_cross_cannot_be(tmp_path: Path, targets: str, message: str) -> None:
    (tmp_path / "t.toml").write_text(targets, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_targets(read_toml(tmp_path / "t.toml"))


def test_coordinates_in_another_unit_than_the_project_says(scenes: dict[str, Path], tmp_path: Path) -> None:
    project, _ = rendered(scenes[CROSSES], tmp_path)
    text = project.read_text(encoding="utf-8")
    project.write_text(text.replace('unit = "m"', 'unit = "mm"'), encoding="utf-8")
    with pytest.raises(InputError, match=r"nine of ten points .* if their coordinates are in mm"):
        scan_tasks(read_project(project), ["a"])
    project.write_text(text, encoding="utf-8")
    points = tmp_path / "points.csv"
    header, *rows = (row.split(",") for row in points.read_text(encoding="utf-8").splitlines())
    in_mm = [[row[0], *(f"{1000.0 * float(value):.3f}" for value in row[1:4]), *row[4:]] for row in rows]
    points.write_text("\n".join(",".join(row) for row in (header, *in_mm)), encoding="utf-8")
    scan = measure_scan(read_project(project), "a")
    assert any("unit the one of the coordinates?" in problem for problem in scan.frame.problems)

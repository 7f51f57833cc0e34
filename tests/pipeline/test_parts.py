"""Frames scanned in overlapping halves, from rendered scans to one adjustment and one resampled frame."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import tifffile
from foreign_readers import opencv_px
from projects import fiducial_tables, result_file

from measure.tie_points.features import TieFrame
from measure.tie_points.joins import measure_joins
from pipeline import read_comparator, read_images, read_measurement
from pipeline.cli import run
from pipeline.files.project_file import read_project
from pipeline.measuring.tie_stage import add_joins

MARKS = """
[camera]
name = "K"
frame_mm = [44.0, 44.0]
principal_distance_mm = 60.0
[camera.sigma]
principal_distance_mm = 0.1
principal_point_mm = 0.1
[camera.mark.m]
kind = "ring-cross"
polarity = "light"
ring_mm = 0.7
ring_line_mm = 0.14
arm_mm = 0.5
line_mm = 0.14
""" + fiducial_tables(
    {"1": (19, -19), "2": (-19, -19), "3": (-19, 19), "4": (19, 19)},
    'sigma_mm = 0.003\nmark = "m"\n',
    "camera.fiducial",
)
SCENE = f"""
name = "halves"
seed = 4
{MARKS}
[field]
kind = "disks"
unit = "m"
diameter_mm = 40.0
surround = 2.0
[[field.grid]]
first = 101
columns = 5
rows = 5
center = [0.0, 0.0, 0.0]
right = [0.5, 0.0, 0.0]
up = [0.0, 0.5, 0.0]
jitter = 0.1
relief = 0.4
[picture]
background = "wall"
pad_mm = 1.9
[picture.tones]
contrast = 0.1
[film]
scale_sigma_ppm = 300.0
shear_sigma_urad = 100.0
grain = 0.01
[scan]
pitch_um = 60.0
margin_mm = 3.0
turn_sigma_deg = 0.3
offset_sigma_mm = 0.2
noise = 0.005
[given]
fiducial_error_mm = 0.003
""" + "".join(
    f'[[image]]\nname = "f{half}"\nposition = [0.1, -0.1, 4.0]\nangles_deg = [1.0, -2.0, 3.0]\n'
    f'part_of = "f"\npart = [{first}, {end}]\n'
    for half, first, end in (("a", 0.0, 0.6), ("b", 0.4, 1.0))
)


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the project, measured and adjusted."""
    folder = tmp_path_factory.mktemp("halves")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    assert run(["render", str(folder / "scene.toml"), str(folder)]) == 0
    for command in ("measure", "adjust", "report"):
        assert run([command, str(folder / "project.toml")]) in (0, 1)
    return folder


def read_truth(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    return dict(content["images"])


def image_camera(image: dict[str, Any], pixels: np.ndarray) -> np.ndarray:
    """Camera mm of pixels (n, 2), by the truth."""
    x, y = (pixels * [0.06, -0.06]).T
    t = {name: value["value"] for name, value in image["transformation"].items() if name != "kind"}
    return np.stack([t["a1"] + t["a2"] * x + t["a3"] * y, t["b1"] + t["b2"] * x + t["b3"] * y], axis=1)


@pytest.mark.study
def test_one_adjustment_knows_both_films_one_orientation_and_all_marks_in_one_frame(halves: Path) -> None:
    truth, result = read_truth(halves), result_file(halves)
    assert result["converged"]
    assert result["images"]["fa"]["exterior"] == result["images"]["fb"]["exterior"]
    assert result["groups"]["join"]["redundancy"] > 60.0
    frame = result["frames"]["f"]
    assert set(frame["parts"]) == {"fa", "fb"}
    assert len(frame["joins"]) >= 40
    for name, part in frame["parts"].items():
        corners = np.array([[0.0, 0.0], [0.0, 832.0], [499.0, 0.0], [499.0, 832.0]])
        own = {key: value for key, value in result["images"][name]["transformation"].items() if key != "mirrored"}
        adjusted = image_camera({"transformation": own}, corners)
        off_um = 1000.0 * np.hypot(*(adjusted - image_camera(truth[name], corners)).T)
        assert off_um.max() < 5.0 * part["corner_sigma_um"]
    errors = []
    for mark in frame["marks"]:
        if mark["kind"] == "target":
            true = truth[mark["image"]]["targets"][mark["point"]]
            place = image_camera(truth[mark["image"]], np.array([[true["ellipse_col_px"], true["ellipse_row_px"]]]))[0]
            errors += [(mark["x_mm"] - place[0]) / mark["sx_mm"], (mark["y_mm"] - place[1]) / mark["sy_mm"]]
    assert len(errors) > 40
    assert np.sqrt(np.mean(np.square(errors))) < 2.0


@pytest.fixture(scope="module")
def whole(halves: Path) -> Path:
    """The frame, resampled from both of its scans."""
    assert run(["resample", str(halves / "project.toml"), str(halves / "frames")]) in (0, 1)
    return halves / "frames" / "f.tif"


@pytest.mark.study
def test_formats_of_resampled_frames_are_of_the_whole(halves: Path, whole: Path, tmp_path: Path) -> None:
    """Given points, projected by OpenCV, lie in the whole frame where the truth has the targets of its scans."""
    assert run(["export", str(halves / "project.toml"), "opencv", str(tmp_path / "out")]) == 0
    with tifffile.TiffFile(whole) as file:
        description, shape = json.loads(file.pages.first.description), file.pages.first.shape
    storage = cv2.FileStorage(str(tmp_path / "out" / "f.yml"), cv2.FILE_STORAGE_READ)
    assert [storage.getNode(f"image_{side}").real() for side in ("height", "width")] == list(shape[:2])
    truth = read_truth(halves)
    rows = list(csv.DictReader((halves / "points.csv").read_text(encoding="utf-8").splitlines()))
    projected = opencv_px(tmp_path / "out", "f", np.array([[float(row[axis]) for axis in "XYZ"] for row in rows]))
    corner_mm, to_px = (description["x_mm"], description["y_mm"]), np.array([1.0, -1.0]) / description["pitch_mm"]
    for image in ("fa", "fb"):
        for row, place in zip(rows, projected, strict=True):
            true = truth[image]["targets"].get(row["point"])
            if true is not None and true["visible"]:
                view = np.array([[true["ellipse_col_px"], true["ellipse_row_px"]]])
                there = (image_camera(truth[image], view)[0] - corner_mm) * to_px
                assert np.hypot(*(place - there)) < 0.5, (image, row["point"])


@pytest.mark.study
def test_a_point_that_both_scans_show_goes_out_once(halves: Path, tmp_path: Path) -> None:
    comparator = read_comparator(halves / "comparator.csv")
    measured_marks = [mark.point for mark in comparator if mark.kind == "target" and mark.status.is_observation]
    assert len(measured_marks) > len(set(measured_marks))  # in the overlap
    assert run(["export", str(halves / "project.toml"), "colmap", str(tmp_path / "colmap")]) == 0
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse"))
    (image,) = model.images.values()
    assert (image.name, len(image.points2D), model.num_points3D()) == (
        "f.tif",
        len(set(measured_marks)),
        len(set(measured_marks)),
    )
    assert run(["export", str(halves / "project.toml"), "bingo", str(tmp_path / "bingo")]) == 0
    lines = (tmp_path / "bingo" / "bingo.txt").read_text(encoding="utf-8").split("\n")
    assert lines[0] == "f K"
    assert len(lines) == 1 + len(set(measured_marks)) + 1
    assert run(["export", str(halves / "project.toml"), "mmvii", str(tmp_path / "mmvii")]) == 0  # the scans themselves
    assert len(list(tmp_path.glob("mmvii/**/MesIm-*.xml"))) == 4


def test_scans_that_have_nothing_in_common_are_reported(tmp_path: Path) -> None:
    parts = []
    for seed, name in enumerate(("a", "b")):
        noise = np.random.default_rng(seed).normal(30000.0, 3000.0, (300, 300))
        tifffile.imwrite(tmp_path / f"{name}.tif", noise.astype(np.uint16))
        parts.append(TieFrame(name, tmp_path / f"{name}.tif", np.eye(2, 3), None, np.zeros((0, 3))))
    joins = measure_joins(parts)
    assert not joins.marks["a"]
    assert not joins.marks["b"]
    assert "Nothing joins it to the other scans of its frame: with b" in joins.problems["a"]


@pytest.mark.study
def test_fiducials_that_contradict_the_joins_are_rejected(halves: Path) -> None:
    """As if the frame of the right half had been found one mark too far to the right."""
    project = read_project(halves / "project.toml")
    scans = []
    for scan, shift_px in zip(read_measurement(halves / "out" / "measurement.db"), (0.0, 50.0), strict=True):
        marks = tuple(mark for mark in scan.frame.marks if mark.kind != "join")
        place = np.array(scan.frame.pixel_from_camera) + np.array([[0.0, 0.0, shift_px], [0.0, 0.0, 0.0]])
        scans.append(replace(scan, frame=replace(scan.frame, marks=marks, problems=(), pixel_from_camera=place)))
    result = add_joins(project, scans, lambda *_: None, None)
    assert all("contradict those of" in " ".join(scan.frame.problems) for scan in result)
    assert not any(mark.kind == "fiducial" and mark.status.is_observation for mark in result[1].frame.marks)


def test_one_part_tells_the_orientation_of_all(tmp_path: Path) -> None:
    path = tmp_path / "images.csv"
    path.write_text(
        "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,part_of\na,,,,,,,f\nb,1,0,9,0,0,0,f\n", encoding="utf-8"
    )
    given = read_images(path)
    assert given.part_of == {"a": "f", "b": "f"}
    assert given.exterior["a"] is given.exterior["b"] is not None

"""Frames scanned in overlapping halves, from rendered scans to one adjustment and one resampled frame."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import tifffile
from foreign_readers import asp_px, colmap_px, opencv_px

from measure.tie_points.features import TieFrame
from measure.tie_points.joins import measure_joins
from pipeline import InputError, read_comparator, read_images, read_measurement
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
""" + "".join(
    f'[[camera.fiducial]]\nid = "{id}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0.003\nmark = "m"\n'
    for id, (x, y) in {"1": (19.0, -19.0), "2": (-19.0, -19.0), "3": (-19.0, 19.0), "4": (19.0, 19.0)}.items()
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
def test_half_of_the_marks_lie_outside_and_the_others_are_found(halves: Path) -> None:
    truth = read_truth(halves)
    for scan in read_measurement(halves / "out" / "measurement.db"):
        for mark in scan.frame.marks:
            if mark.kind != "fiducial":
                continue
            true = truth[scan.frame.image]["fiducials"][mark.point]
            if true["visible"]:
                assert mark.status.is_observation
                assert mark.center_px is not None
                assert np.hypot(*(mark.center_px - [true["col_px"], true["row_px"]])) < 0.1
            else:
                assert "another scan of its frame" in mark.reason


@pytest.mark.study
def test_joins_are_the_same_places_of_the_film(halves: Path) -> None:
    """Their errors are as large as their standard deviations say."""
    truth = read_truth(halves)
    first, second = (
        {mark.point: mark for mark in scan.frame.marks if mark.kind == "join"}
        for scan in read_measurement(halves / "out" / "measurement.db")
    )
    assert len(first) >= 40
    assert first.keys() == second.keys()
    places = [
        image_camera(truth[image], np.array([mark.center_px for mark in of.values()]))
        for image, of in (("fa", first), ("fb", second))
    ]
    sigma = np.array(
        [
            np.sqrt(np.trace(first[point].covariance_px2 + second[point].covariance_px2) / 2)  # type: ignore[operator]
            for point in first
        ]
    )
    off = (places[0] - places[1]) / 0.06 / sigma[:, None]
    assert 0.8 < np.sqrt(np.mean(off**2)) < 1.25


@pytest.mark.study
def test_one_adjustment_knows_both_films_one_orientation_and_all_marks_in_one_frame(halves: Path) -> None:
    truth, result = read_truth(halves), json.loads((halves / "out" / "adjustment.json").read_text(encoding="utf-8"))
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


@pytest.mark.study
def test_the_report_shows_the_joins(halves: Path) -> None:
    page = (halves / "out" / "report.html").read_text(encoding="utf-8")
    assert "Frames scanned in parts" in page
    assert "from where one scan puts each join" in page
    assert "fiducial marks not measured" not in page


@pytest.fixture(scope="module")
def whole(halves: Path) -> Path:
    """The frame, resampled from both of its scans."""
    assert run(["resample", str(halves / "project.toml"), str(halves / "frames")]) in (0, 1)
    return halves / "frames" / "f.tif"


@pytest.mark.study
@pytest.mark.parametrize(("format", "reader"), [("opencv", opencv_px), ("colmap", colmap_px), ("asp", asp_px)])
def test_formats_of_resampled_frames_are_of_the_whole(
    format: str, reader: Callable[[Path, str, np.ndarray], np.ndarray], halves: Path, whole: Path, tmp_path: Path
) -> None:
    """Given points, projected by another program, lie in the whole frame where the truth has the targets of its
    scans."""
    out = tmp_path / format
    assert run(["export", str(halves / "project.toml"), format, str(out)]) == 0
    with tifffile.TiffFile(whole) as file:
        description, shape = json.loads(file.pages.first.description), file.pages.first.shape
    if format == "opencv":
        storage = cv2.FileStorage(str(out / "f.yml"), cv2.FILE_STORAGE_READ)
        assert [storage.getNode(f"image_{side}").real() for side in ("height", "width")] == list(shape[:2])
    truth = read_truth(halves)
    rows = list(csv.DictReader((halves / "points.csv").read_text(encoding="utf-8").splitlines()))
    points = np.array([[float(row[axis]) for axis in "XYZ"] for row in rows])
    projected = reader(out, "f", points)
    for image in ("fa", "fb"):
        for row, place in zip(rows, projected, strict=True):
            true = truth[image]["targets"].get(row["point"])
            if true is not None and true["visible"]:
                view = np.array([[true["ellipse_col_px"], true["ellipse_row_px"]]])
                at_mm = image_camera(truth[image], view)[0]
                there = (
                    np.array([at_mm[0] - description["x_mm"], description["y_mm"] - at_mm[1]]) / description["pitch_mm"]
                )
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


@pytest.mark.study
def test_the_whole_frame_is_resampled_from_both(halves: Path, whole: Path) -> None:
    """Targets lie where the truth has them, on either side of the seam, which the file states."""
    with tifffile.TiffFile(whole) as file:
        description = json.loads(file.pages.first.description)
        grey, mask = file.pages[0].asarray().astype(float), file.pages[1].asarray()
    assert description["image"] == "f"
    assert description["parts"] == ["fa", "fb"]
    (seam,) = description["seams_mm"]
    assert np.ptp([y for _, y in seam]) > 40.0
    assert np.abs([x for x, _ in seam]).max() < 4.0
    assert mask.mean() > 0.97
    offs: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for image, true in read_truth(halves).items():
        for place in true["targets"].values():
            if not place["visible"]:
                continue
            at_mm = image_camera(true, np.array([[place["ellipse_col_px"], place["ellipse_row_px"]]]))[0]
            col, row = (at_mm[0] - description["x_mm"]) / 0.06, (description["y_mm"] - at_mm[1]) / 0.06
            window = grey[round(row) - 6 : round(row) + 7, round(col) - 6 : round(col) + 7]
            light = np.clip(window - np.quantile(window, 0.7), 0.0, None)
            rows, cols = np.indices(window.shape)
            middle = np.array([(light * cols).sum(), (light * rows).sum()]) / light.sum()
            off = middle - 6.0 - (col - round(col), row - round(row))
            assert np.hypot(*off) < 0.6, (image, at_mm)
            offs[bool(at_mm[0] > 0.0)].append(off)
    for side in offs.values():
        assert len(side) > 8
        assert np.abs(np.mean(side, axis=0)).max() < 0.12


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


@pytest.mark.study
def test_a_scan_that_nothing_joins_costs_the_other_nothing(halves: Path, tmp_path: Path) -> None:
    """Its marks are left out with a sentence, and the other scan is adjusted alone."""
    for name in ("project.toml", "camera.toml", "points.csv", "images.csv"):
        shutil.copy(halves / name, tmp_path / name)
    rows = (halves / "comparator.csv").read_text(encoding="utf-8").splitlines()
    kept = [row for row in rows if ",join," not in row and not (row.startswith("fb") and ",target," in row)]
    (tmp_path / "comparator.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    project = (tmp_path / "project.toml").read_text(encoding="utf-8")
    project = project.replace('"affine"', '"similarity"')  # which the two marks of one half determine
    without = "\n".join(line for line in project.splitlines() if not line.startswith("scans"))
    (tmp_path / "project.toml").write_text(without, encoding="utf-8")
    code = run(["adjust", str(tmp_path / "project.toml")])
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    assert set(result["images"]) == {"fa"}
    assert code == 1
    assert any("'fb' has no part in the adjustment" in warning for warning in result["warnings"])


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ("a,,,,,,,f\n", "'a' is the only part of 'f'"),
        ("a,,,,,,,f\nf,,,,,,,f\nb,,,,,,,b\nc,,,,,,,b\n", "part_of 'b' is an image itself"),
        ("a,0,0,9,0,0,0,f\nb,1,0,9,0,0,0,f\n", "have different orientations"),
    ],
)
def test_parts_that_cannot_be_are_refused(lines: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "images.csv"
    path.write_text(f"image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,part_of\n{lines}", encoding="utf-8")
    with pytest.raises(InputError, match=told):
        read_images(path)


def test_one_part_tells_the_orientation_of_all(tmp_path: Path) -> None:
    path = tmp_path / "images.csv"
    path.write_text(
        "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,part_of\na,,,,,,,f\nb,1,0,9,0,0,0,f\n", encoding="utf-8"
    )
    given = read_images(path)
    assert given.part_of == {"a": "f", "b": "f"}
    assert given.exterior["a"] is given.exterior["b"] is not None

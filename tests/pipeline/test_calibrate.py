"""`reseau calibrate`: drawn pictures of a chessboard to intrinsics in pixels."""

import io
import json
import re
import sys
import tomllib
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image
from rich.console import Console
from test_check_corners import CENTER_PX, FOCAL_PX, SIZE_PX, TURNS, picture

import reseau
from pipeline.adjusting.turned_pictures import turned_back
from pipeline.calibration import calibrate_stage
from pipeline.calibration.board_options import board_options
from pipeline.calibration.calibrate_stage import Calibration
from pipeline.calibration.lens_choice import LensChoice, LensScore
from pipeline.calibration.pictures import find_pictures
from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.files.target_table import read_targets
from pipeline.text.tables import Table

TOO_FEW = (
    "the board is in 1 picture of 440 x 360 px, and 3 or more with different tilts are needed. Pictures that were "
    "cut are taken for another camera's: give them as they were taken."
)
BOARD = ("--board", "7x5", "--square", "2cm")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("pictures")
    for number in range(len(TURNS)):
        shown = np.rot90(picture(number)) if number == 4 else picture(number)  # of the same camera, held upright
        Image.fromarray(shown).save(made / f"p{number}.png")
    Image.fromarray(np.full((SIZE_PX[1], SIZE_PX[0]), 128, np.uint8)).save(made / "grey.png")
    Image.fromarray(np.pad(picture(1), 20, constant_values=210)).save(made / "wider.png")
    (made / "torn.png").write_bytes((made / "p0.png").read_bytes()[:100])
    return made


@pytest.fixture(scope="module")
def calibrations() -> list[Calibration]:
    """What `result` was made of, behind it."""
    return []


@pytest.fixture(scope="module")
def result(folder: Path, calibrations: list[Calibration]) -> dict[str, Any]:
    """What the command prints; its files stand in the folder `calibration`."""
    out, printed, calibrate = folder / "calibration", io.StringIO(), calibrate_stage.calibrate

    def keep(*arguments: Any, **options: Any) -> Calibration:
        calibrations.append(calibrate(*arguments, **options))
        return calibrations[-1]

    with redirect_stdout(printed), pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrate_stage, "calibrate", keep)
        code = run(["calibrate", str(folder), *BOARD, "--lens", "opencv4", "--out", str(out), "--ros", "--json"])
    assert code == 1  # two pictures are left out
    return dict(json.loads(printed.getvalue()))


def test_a_folder_of_pictures_gives_intrinsics_in_pixels(result: dict[str, Any], folder: Path) -> None:
    (camera,), out = result["cameras"], folder / "calibration"
    assert list(result["unreadable"]) == ["torn"]
    assert result["not_calibrated"] == {"camera-440x360": TOO_FEW}  # and costs the other camera nothing
    assert (camera["name"], camera["image_size_px"], camera["images_used"]) == ("camera-400x320", list(SIZE_PX), 5)
    assert (camera["images_turned_deg"], camera["unsure_turns"]) == ({"p4": 90}, [])
    assert camera["images_left_out"] == {"grey": "the scan has no contrast: its grey values span 0.0 % of the scale"}
    for name, truth in (("fx", FOCAL_PX), ("fy", FOCAL_PX), ("cx", CENTER_PX[0]), ("cy", CENTER_PX[1])):
        each = camera[f"{name}_px"]
        assert abs(each["value"] - truth) < 4.0 * each["sigma"]
        assert each["sigma"] == max(each["sigma_model"], each["sigma_clusters"]) < 1.0
    assert camera["distortion"]["family"] == "opencv"
    assert abs(camera["distortion"]["k1"]["value"]) < 4.0 * camera["distortion"]["k1"]["sigma"]
    assert 0.0 < camera["rms_px"] < 0.1
    assert 0.5 < camera["known_share"] < 1.0  # no picture shows the board in a corner
    assert camera["opencv"]["verdict"] == "agrees"
    assert camera["opencv"]["fx_px"] == pytest.approx(camera["fx_px"]["value"], abs=0.2)
    storage = cv2.FileStorage(str(out / "camera.yaml"), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    np.testing.assert_allclose(
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]], [camera[f"{k}_px"]["value"] for k in ("fx", "fy", "cx", "cy")]
    )
    assert storage.getNode("distortion_coefficients").mat().shape == (1, 4)
    covariance = storage.getNode("intrinsics_covariance").mat()
    sigmas = [camera[f"{k}_px"]["sigma"] for k in ("fx", "fy", "cx", "cy")]
    sigmas += [camera["distortion"][k]["sigma"] for k in ("k1", "k2", "p1", "p2")]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigmas)
    assert covariance[4, 5] < -0.5 * sigmas[4] * sigmas[5]  # k1 and k2 take one another's place
    assert "distortion_model: plumb_bob" in (out / "camera-ros.yaml").read_text(encoding="utf-8")
    assert re.search(r"fx = 520\.\d+ ± 0\.\d+ px", (out / "out" / "report.html").read_text(encoding="utf-8"))


def test_the_lens_that_was_chosen_is_printed_with_what_it_was_chosen_from(
    result: dict[str, Any], calibrations: list[Calibration]
) -> None:
    (camera,) = calibrations[0].cameras
    scores = (LensScore("opencv4", 0.1624), LensScore("opencv5", 0.158), LensScore("fisheye", None))
    text = io.StringIO()
    replace(camera, lens=LensChoice("opencv5", scores)).print(Console(file=text, width=200))
    line = next(line for line in text.getvalue().splitlines() if line.startswith("Lens opencv5"))
    assert line.endswith("rms 0.158 px in pictures left out (opencv4 0.162 px, fisheye no solution).")


@pytest.mark.study
def test_square_pixels_join_fx_and_fy_and_the_project_goes_on(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = [str(folder / f"p{number}.png") for number in range(len(TURNS))]
    assert run(["calibrate", *pictures, *BOARD, "--square-pixels", "--out", str(tmp_path), "--json"]) in (0, 1)
    (camera,) = json.loads(capsys.readouterr().out)["cameras"]
    assert camera["fx_px"] == camera["fy_px"]
    assert run(["run", str(tmp_path / "project.toml")]) in (0, 1)
    adjusted = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    pitch_mm = tomllib.loads((tmp_path / "project.toml").read_text(encoding="utf-8"))["pitch_um"] / 1000.0
    (interior,) = adjusted["cameras"].values()
    assert interior["principal_distance_mm"]["value"] / pitch_mm == pytest.approx(camera["fy_px"]["value"], rel=1e-6)


def test_in_python_it_can_be_plotted_in_pixels_and_shown_in_a_notebook(
    result: dict[str, Any], calibrations: list[Calibration], monkeypatch: pytest.MonkeyPatch
) -> None:
    (calibration,) = calibrations
    mpl.use("Agg")
    axes = calibration.plot_residuals()
    assert axes.get_xlabel() == "column (px)"
    assert (
        axes.get_title(loc="left") == f"camera-400x320: residuals, rms {result['cameras'][0]['rms_px']:.3g} px a point"
    )
    assert max(axes.dataLim.intervalx) < SIZE_PX[0] + 30
    assert calibration._repr_html_().count("<tr>") == 9  # fx, fy, cx, cy, k1, k2, p1, p2
    assert repr(calibration).startswith("Calibration(camera-400x320: fx 520.")
    with pytest.raises(InputError, match="Name one of: camera-400x320"):
        calibration.plots("x")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        calibration.to_pandas()


def test_a_folder_is_given_by_its_name_in_python(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no picture"):
        reseau.calibrate(str(tmp_path), "9x6", "25mm")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--board", "7by5", "--square", "20mm"), "--board 7by5: must be two counts"),
        (("--board", "7x5", "--square", "20"), "--square 20: must be a length with its unit"),
        (("--board", "7x5", "--square", "20mm", "--kind", "charuco"), "--marker is missing"),
        (("--board", "7x5", "--square", "20mm", "--kind", "chess"), "possible are chessboard"),
        (("--board", "7x5", "--square", "20mm", "--lens", "fishey"), "Did you mean 'fisheye'?"),
    ],
)
def test_a_wrong_option_is_named(options: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", "nowhere", *options]) == 2
    assert said in capsys.readouterr().err


def test_pictures_are_sorted_by_size_and_results_are_no_pictures(tmp_path: Path) -> None:
    for name, size in (("a", (40, 30)), ("b", (40, 30)), ("c", (20, 30)), ("out/d", (40, 30))):
        path = tmp_path / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        Image.new("L", size).save(path)
    found = find_pictures([tmp_path], tmp_path / "out")
    assert [(camera.name, camera.images) for camera in found.cameras] == [
        ("camera-40x30", ("a", "b")),
        ("camera-20x30", ("c",)),
    ]
    with pytest.raises(InputError, match="there is no picture"):
        find_pictures([tmp_path / "out"], tmp_path / "out")


def test_a_picture_turned_by_a_quarter_is_of_the_same_camera(tmp_path: Path) -> None:
    """By the tag where it has one; else it is left to what the pictures show."""
    for name, size, tag in (("a", (40, 30), 6), ("b", (40, 30), 1), ("c", (30, 40), 8), ("d", (30, 40), 1)):
        exif = Image.Exif()
        exif[0x0112] = tag
        Image.new("L", size).save(tmp_path / f"{name}.jpg", exif=exif)
    Image.new("L", (40, 30)).save(tmp_path / "e.png")
    (camera,) = find_pictures([tmp_path], tmp_path / "out").cameras
    assert (camera.name, camera.images) == ("camera", ("a", "b", "e", "c", "d"))
    assert (camera.width_px, camera.height_px) == (40, 30)
    assert camera.turned_deg == {"c": 270, "d": None}


@pytest.mark.parametrize("turned_deg", [0, 90, 180, 270])
def test_marks_of_a_turned_picture_are_turned_back(turned_deg: int) -> None:
    """A pixel of a drawn picture, whose middle is where it was."""
    drawn = np.zeros((3, 5))
    drawn[1, 3] = 1.0
    (row,), (column,) = np.nonzero(np.rot90(drawn, turned_deg // 90))
    place = turned_back(np.array([0.01 * column, -0.01 * row]), turned_deg, (0.04, 0.02))
    np.testing.assert_allclose(place, [0.03, -0.01])


def test_pictures_of_other_focal_lengths_are_of_other_cameras(tmp_path: Path) -> None:
    for name, focal in (("a", 24.0), ("b", 50.0)):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x920A] = focal
        Image.new("L", (40, 30)).save(tmp_path / f"{name}.jpg", exif=exif)
    assert {camera.name for camera in find_pictures([tmp_path], tmp_path / "out").cameras} == {
        "camera-24mm",
        "camera-50mm",
    }


def test_boards_as_project_files_have_them() -> None:
    """OpenCV's asymmetric grid of 4 x 11; Kalibr's sizes, the gap three tenths of a tag where nobody says it."""

    def board(*given: Any, **options: Any) -> Any:
        table = tomllib.loads(board_options(*given, **options).table)["targets"]
        return read_targets(Table(table, Path("project.toml"), "targets")).board

    circles = board("asymmetric-circle-grid", "4x11", "1in", "10mm")
    steps = np.array(list(circles.object_points().values()))[:, :2] / 25.4
    of_opencv = [(2 * column + row % 2, 10 - row) for row in range(11) for column in range(4)]
    np.testing.assert_allclose(steps, of_opencv)
    aruco = board("aruco", "3x2", "40mm", "30mm", "4X4_50", first_id=6)
    assert (aruco.marker_mm, aruco.gap_mm, aruco.first_marker) == (30.0, 10.0, 6)
    april = board("aprilgrid", "6x6", "114.4mm", first_id=3)
    assert (april.marker_mm, april.gap_mm, april.first_marker) == pytest.approx((88.0, 26.4, 3))
    assert april.object_points()["3.3"] == pytest.approx((0.0, 0.0, 0.0))  # lower left corner of the lower left tag
    charuco = board("charuco", "5x7", "30mm", "22mm", "4X4_250", first_id=20)
    assert (charuco.legacy, charuco.first_id) == (None, 20)


def test_a_count_that_is_wrong_is_named_with_the_one_that_fits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.fromarray(picture(0)).save(tmp_path / "p0.png")
    assert run(["calibrate", str(tmp_path), "--board", "6x5", "--square", "20mm", "--out", str(tmp_path / "out")]) == 2
    assert "one of 7 x 5 is" in capsys.readouterr().err

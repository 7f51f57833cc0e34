"""`reseau calibrate` on drawn pictures of a chessboard, OpenCV's own corners, the lens by cross-validation."""

import io
import json
import math
import re
import sys
import tomllib
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import drawn as draw
import matplotlib as mpl
import numpy as np
import pytest
from networks import board_network, equidistant_network
from numpy.typing import NDArray
from PIL import Image
from projects import Refusal, command, made_record, present
from rich.console import Console
from scipy.spatial.distance import cdist

from adjust import Approximations, Network, adjust
from measure import Scan, open_scan
from measure.boards.measure import recognise_dots
from measure.boards.specs import ArucoSpec, BoardSpec, CharucoSpec, ChessboardSpec, CircleGridSpec, aruco_dictionary
from measure.errors import MissingError
from measure.flags import Status
from pipeline import InputError
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.adjusting.picture_turn import turned_back
from pipeline.archive.cross_scan_checks import check_repeated_views
from pipeline.calibration import calibrate_stage, intrinsics
from pipeline.calibration.calibrate_stage import CalibrationResult
from pipeline.calibration.intrinsics import LensChoice, LensModel, choose_lens
from pipeline.calibration.pictures import BoardPictureFiles, CameraPictures, find_pictures, name_parts
from pipeline.calibration.project_files import CalibrationOptions, board_options, check_folder, write_project
from pipeline.files.project_file import Project
from pipeline.files.project_tables import AdjustSettings
from pipeline.files.target_table import read_targets
from pipeline.opencv_check.check import BoardPictures, compare_corners, detector_name, find_points
from pipeline.opencv_check.opencv_calibration import NAMES, Freedom, OpenCvCalibration, OpenCVPoints, calibrate
from pipeline.results.comparator_file import ComparatorPoint
from pipeline.results.measured_record import MeasuredScan
from pipeline.text.toml_tables import Table

Array = NDArray[np.float64]

BOARD = ChessboardSpec(7, 5, 20.0)
CHESSBOARD = board_options("chessboard", "7x5", "20mm")
CHESSBOARD_PIXEL_MM = CalibrationOptions(CHESSBOARD).pixel_mm
SIZE_PX, FOCAL_PX, CENTER_PX = (400, 320), 520.0, (203.0, 157.0)
PITCH_MM = 0.01
MATRIX = np.array([[FOCAL_PX, 0.0, CENTER_PX[0]], [0.0, FOCAL_PX, CENTER_PX[1]], [0.0, 0.0, 1.0]])
POINTS = np.array(list(BOARD.object_points().values()))
FINENESS = 4
CHARUCO = cv2.aruco.CharucoBoard((6, 5), 32.0, 24.0, aruco_dictionary("4X4_50"))
ARUCO = cv2.aruco.GridBoard((3, 2), 30.0, 10.0, aruco_dictionary("4X4_50"))
TURNS = [(0.5, 0.0, 0.1), (-0.5, 0.1, 0.0), (0.0, 0.55, -0.1), (0.1, -0.5, 0.2), (0.35, 0.35, 0.0)]


def pose(number: int) -> tuple[Array, Array]:
    """Rotation (3, 3) from the board, whose y is up, to a camera whose y is down, and shift (3,)."""
    rotation = np.asarray(cv2.Rodrigues(np.array(TURNS[number]))[0], float) @ np.diag([1.0, -1.0, -1.0])
    shift = np.array([4.0 * number - 8.0, 6.0 - 3.0 * number, 290.0 + 10.0 * number])
    return rotation, np.asarray(shift - rotation @ POINTS.mean(axis=0), float)


def corners_px(number: int) -> Array:
    rotation, shift = pose(number)
    places = cv2.projectPoints(POINTS, cv2.Rodrigues(rotation)[0], shift, MATRIX, np.zeros(5))[0]
    return np.asarray(places, float).reshape(-1, 2)


@cache
def picture(number: int) -> NDArray[np.uint8]:
    """Grey values by the squares that parts of each pixel show, with noise."""
    rotation, shift = pose(number)
    board_from_pixel = np.linalg.inv(MATRIX @ np.column_stack([rotation[:, :2], shift]))
    col, row = (((np.arange(size * FINENESS) + 0.5) / FINENESS - 0.5) for size in SIZE_PX)
    x, y, w = np.tensordot(board_from_pixel, np.stack([*np.meshgrid(col, row), np.ones((len(row), len(col)))]), axes=1)
    column, line = np.floor(x / w / BOARD.square_mm), np.floor(y / w / BOARD.square_mm)
    inside = (column >= -1) & (column < BOARD.columns) & (line >= -1) & (line < BOARD.rows)
    light = np.where(inside & ((column + line) % 2 == 0), 40.0, 210.0)
    pixels = light.reshape(SIZE_PX[1], FINENESS, SIZE_PX[0], FINENESS).mean(axis=(1, 3))
    noise = np.random.default_rng(number).normal(0.0, 2.0, pixels.shape)
    return np.asarray(np.clip(np.rint(pixels + noise), 0, 255), np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("board")
    for number in range(len(TURNS)):
        Image.fromarray(picture(number)).save(made / f"p{number}.png")
    return made


def images() -> list[OpenCVPoints]:
    """The exact places of all corners, as if they had been measured."""
    return [OpenCVPoints(f"p{k}", POINTS, corners_px(k) * [PITCH_MM, -PITCH_MM]) for k in range(len(TURNS))]


def calibrated(given: Sequence[OpenCVPoints]) -> OpenCvCalibration:
    start = np.zeros(len(NAMES))
    start[:4] = PITCH_MM * np.array([FOCAL_PX, FOCAL_PX, CENTER_PX[0], -CENTER_PX[1]])
    return calibrate(given, Freedom(("fx", "fy", "cx", "cy")), start)


def test_both_figures_are_of_the_points_that_both_have(folder: Path) -> None:
    def opened(image: str) -> Scan:
        if image == "p4":
            raise MissingError("not at hand")
        return open_scan(folder / f"{image}.png")

    pictures = BoardPictures(BOARD, opened, {f"p{number}": (10.0, 10.0) for number in range(len(TURNS))})
    found = present(compare_corners(images(), pictures, calibrated))
    assert (found.images, found.points, found.not_found) == (4, 4 * 35, ("p4",))
    truth = np.array([FOCAL_PX, FOCAL_PX, *CENTER_PX])
    exact, own = (np.array([each.fx, each.fy, each.cx, each.cy]) for each in (found.reseau, found.opencv))
    np.testing.assert_allclose(exact, truth, atol=2e-3)
    assert found.reseau.rms < 1e-3
    np.testing.assert_allclose(own, truth, atol=3.0)
    # The rms per point as cv2.calibrateCamera itself says it, of the same corners.
    view = [find_points(picture(number), BOARD) for number in range(4)]
    objects = [POINTS.astype(np.float32)] * 4
    nearest = [cdist(corners_px(number), each).argmin(axis=1) for number, each in enumerate(view)]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    points = [each[order].astype(np.float32) for each, order in zip(view, nearest, strict=True)]
    rms, matrix, *_ = cv2.calibrateCamera(objects, points, SIZE_PX, MATRIX.copy(), np.zeros(5), flags=flags)
    assert found.opencv.rms == pytest.approx(rms, rel=1e-3)
    np.testing.assert_allclose(own, matrix[[0, 1, 0, 1], [0, 1, 2, 2]], atol=0.01)
    assert compare_corners(images()[:2], pictures, calibrated) is None


def circles() -> NDArray[np.uint8]:
    drawing = np.full((300, 400), 255, np.uint8)
    for col in range(6):
        for row in range(5):
            cv2.circle(drawing, (60 + 50 * col, 50 + 50 * row), 14, (0,), -1, cv2.LINE_AA)
    return drawing


@pytest.mark.parametrize(
    ("board", "drawing", "count"),
    [
        (CharucoSpec("4X4_50", 6, 5, 32.0, 24.0), CHARUCO.generateImage((600, 500), marginSize=20), 20),
        (ArucoSpec("4X4_50", 3, 2, 30.0, 10.0), ARUCO.generateImage((600, 400), marginSize=20), 24),
        (CircleGridSpec(6, 5, 30.0, 16.8), circles(), 30),
    ],
)
def test_opencvs_own_detectors_find_other_boards(board: BoardSpec, drawing: NDArray[np.uint8], count: int) -> None:
    assert detector_name(board)
    assert len(find_points(drawing, board)) == count


CALIBRATED_BOARD = ("--board", "7x5", "--square", "2cm")


@pytest.fixture(scope="module")
def calibrated_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("pictures")
    for folder in ("own", "other", "torn"):
        (made / folder).mkdir()
    for number in range(len(TURNS)):
        shown = np.rot90(picture(number)) if number == 4 else picture(number)  # of the same camera, held upright
        Image.fromarray(shown).save(made / "own" / f"p{number}.png")
    Image.fromarray(np.full((SIZE_PX[1], SIZE_PX[0]), 128, np.uint8)).save(made / "own" / "grey.png")
    Image.fromarray(np.pad(picture(1), 20, constant_values=210)).save(made / "other" / "wider.png")
    (made / "torn" / "torn.png").write_bytes((made / "own" / "p0.png").read_bytes()[:100])
    return made


@pytest.fixture(scope="module")
def calibrations() -> list[CalibrationResult]:
    """What `result` was made of, behind it."""
    return []


@pytest.fixture(scope="module")
def result(calibrated_folder: Path, calibrations: list[CalibrationResult]) -> dict[str, Any]:
    """What the command prints; its files stand in the folder `calibration`."""
    out, printed, calibrate = calibrated_folder / "calibration", io.StringIO(), calibrate_stage.calibrate

    def keep(*arguments: Any, **options: Any) -> CalibrationResult:
        calibrations.append(calibrate(*arguments, **options))
        return calibrations[-1]

    with redirect_stdout(printed), pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibrate_stage, "calibrate", keep)
        options = ("--lens", "opencv4", "--out", str(out), "--ros", "--json")
        code = command("calibrate", calibrated_folder, *CALIBRATED_BOARD, *options)
    assert code == 1  # two pictures are left out
    return dict(json.loads(printed.getvalue()))


def test_a_folder_of_pictures_gives_intrinsics_in_pixels(result: dict[str, Any], calibrated_folder: Path) -> None:
    (camera,), out = result["cameras"], calibrated_folder / "calibration"
    assert list(result["unreadable"]) == ["torn/torn"]
    assert not any("targets was measured" in problem for problem in result["problems"])  # each has its own reason
    assert list(result["not_calibrated"]) == ["camera-440x360"]  # and costs the other camera nothing
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
    enlarged = np.sqrt(np.diag(covariance)) / sigmas  # in each direction, not only along the parameters
    assert (enlarged > 1.0 - 1e-6).all()
    assert (enlarged < 1.5).all()
    assert covariance[4, 5] < -0.5 * sigmas[4] * sigmas[5]  # k1 and k2 take one another's place
    assert "distortion_model: plumb_bob" in (out / "camera-ros.yaml").read_text()
    check_folder(out, find_pictures([calibrated_folder], out))  # the command may write over its own files
    report = (out / "out" / "report.html").read_text()
    assert re.search(r"fx = 520\.\d+ ± 0\.\d+ px", report)
    checked_cy = re.search(r"<td>cy</td><td[^>]*>px</td><td[^>]*>([^<]*)</td>", report)
    assert abs(float(present(checked_cy)[1]) - CENTER_PX[1]) < 2.0  # rows count downward here, too
    assert "µm rms" not in report  # the pixels have no size
    assert "fiducial marks in the images" not in report


def test_the_chosen_lens_is_printed(result: dict[str, Any], calibrations: list[CalibrationResult]) -> None:
    (camera,) = calibrations[0].cameras
    scores: dict[LensModel, float | None] = {"opencv4": 0.1624, "opencv5": 0.158, "fisheye": None}
    text = io.StringIO()
    left_out = {"p5": "no board", "p6": "blurred", "p7": "no board"}
    replace(camera, lens=LensChoice("opencv5", scores), left_out=left_out).print(Console(file=text, width=200))
    assert text.getvalue().endswith("Left out: p5, p7 (no board); p6 (blurred).\n")
    line = next(line for line in text.getvalue().splitlines() if line.startswith("Lens opencv5"))
    assert line.endswith("rms 0.158 px in pictures left out (opencv4 0.162 px, fisheye no solution).")


@pytest.mark.parametrize("used", [8, 9])
def test_too_few_pictures_for_the_parameters_are_named(used: int, calibrations: list[CalibrationResult]) -> None:
    """fx, fy, cx, cy, k1, k2, p1 and p2."""
    (camera,) = calibrations[0].cameras
    text = io.StringIO()
    replace(camera, used=used).print(Console(file=text, width=200))
    assert ("8 pictures are few for the 8 parameters of the camera" in text.getvalue()) == (used == 8)


def test_a_calibration_is_plotted_and_shown_in_a_notebook(
    result: dict[str, Any], calibrations: list[CalibrationResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    (calibration,) = calibrations
    mpl.use("Agg")
    axes = calibration.plot_residuals()
    assert axes.get_xlabel() == "column (px)"
    before, by_axis = axes.get_title(loc="left").removesuffix(" px").split(", rms ")
    assert before == "camera-400x320: residuals"
    assert math.hypot(*map(float, by_axis.split(" × "))) == pytest.approx(result["cameras"][0]["rms_px"], rel=0.01)
    assert max(axes.dataLim.intervalx) < SIZE_PX[0] + 30
    assert calibration._repr_html_().count("<tr>") == 9  # fx, fy, cx, cy, k1, k2, p1, p2
    assert repr(calibration).startswith("Calibration(camera-400x320: fx 520.")
    with pytest.raises(InputError, match="Name one of: camera-400x320"):
        calibration.plots("x")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        calibration.to_pandas()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--board", "7by5", "--square", "20mm"), "--board 7by5: must be two counts"),
        (("--board", "7x5", "--square", "20"), "--square 20: must be a length with its unit"),
        (("--board", "7x5", "--square", "20mm", "--kind", "charuco"), "--marker is missing"),
        (("--board", "7x5", "--square", "20mm", "--kind", "chess"), "possible are chessboard"),
        (("--board", "7x5", "--square", "20mm", "--lens", "fishey"), "Did you mean 'fisheye'?"),
        (("--board", "7x5", "--square", "20mm", "--dictionary", "4X4_50"), "--dictionary: a chessboard has none"),
        (
            ("--board", "7x5", "--square", "20mm", "--kind", "charuco", "--marker", "1cm", "--dictionary", "36h11"),
            "dictionary is '36h11'; one of 4X4_100",
        ),
        (
            ("--board", "20x6", "--square", "2cm", "--kind", "charuco", "--marker", "1cm", "--dictionary", "4X4_50"),
            "--board 20x6: the board needs markers 0 to 59",
        ),
    ],
)
def test_a_wrong_option_is_named(options: tuple[str, ...], said: str, refusal: Refusal) -> None:
    assert said in refusal("calibrate", "nowhere", *options)


def save_picture(path: Path, size: tuple[int, int], tag: int = 1, focal_mm: float | None = None) -> None:
    exif = Image.Exif()
    exif[0x0112] = tag
    if focal_mm is not None:
        exif.get_ifd(0x8769)[0x920A] = focal_mm
    path.parent.mkdir(exist_ok=True, parents=True)
    Image.new("L", size).save(path, exif=exif)


def test_pictures_are_sorted_by_size_and_focal_length_and_results_are_no_pictures(tmp_path: Path) -> None:
    for name, size in (("a", (40, 30)), ("b", (40, 30)), ("c", (20, 30)), ("out/d", (40, 30))):
        save_picture(tmp_path / f"{name}.png", size)
    cameras = find_pictures([tmp_path], tmp_path / "out").cameras
    assert {camera.name: camera.images for camera in cameras} == {"camera-40x30": ("a", "b"), "camera-20x30": ("c",)}
    with pytest.raises(InputError, match="there is no picture"):
        find_pictures([tmp_path / "out"], tmp_path / "out")
    for ending in ("jpg", "tif"):
        save_picture(tmp_path / f"a.{ending}", (40, 30))
    with pytest.raises(InputError, match=r"a\.jpg and .*a\.png and .*a\.tif are called 'a'"):
        find_pictures([tmp_path], tmp_path / "out")
    for name, focal_mm in (("a", 24.0), ("b", 50.0)):
        save_picture(tmp_path / "focal" / f"{name}.jpg", (40, 30), focal_mm=focal_mm)
    cameras = find_pictures([tmp_path / "focal"], tmp_path / "out").cameras
    assert {camera.name for camera in cameras} == {"camera-24mm", "camera-50mm"}
    save_picture(tmp_path / "parts" / "own" / "e.png", (40, 30))
    (tmp_path / "parts" / "torn.png").write_bytes(b"")
    found = find_pictures([tmp_path / "parts"], tmp_path / "out")
    assert (list(found.files), list(found.unreadable)) == (["e"], ["torn"])  # as the project names what it lists


def test_a_picture_turned_by_a_quarter_is_of_the_same_camera(tmp_path: Path) -> None:
    """By the tag where it has one; else it is left to what the pictures show."""
    for name, size, tag in (("a", (40, 30), 6), ("b", (40, 30), 1), ("c", (30, 40), 8), ("d", (30, 40), 1)):
        save_picture(tmp_path / f"{name}.jpg", size, tag)
    (camera,) = find_pictures([tmp_path], tmp_path / "out").cameras
    assert (camera.name, camera.images) == ("camera", ("a", "b", "c", "d"))
    assert (camera.width_px, camera.height_px) == (40, 30)
    assert camera.turned_deg == {"c": 270, "d": None}


@pytest.mark.parametrize("turned_deg", [0, 90, 180, 270])
def test_marks_of_a_turned_picture_are_turned_back(turned_deg: int) -> None:
    drawn = np.zeros((3, 5))
    drawn[1, 3] = 1.0
    (row,), (column,) = np.nonzero(np.rot90(drawn, turned_deg // 90))
    place = turned_back(np.array([0.01 * column, -0.01 * row]), turned_deg, (0.04, 0.02))
    np.testing.assert_allclose(place, [0.03, -0.01])


def named_scan(name: str, **changes: Any) -> MeasuredScan:
    """Marks of its own, alike in all."""
    made = made_record(1, 8)
    marks = tuple(replace(mark, center_px=np.array(mark.center_px)) for mark in made.frame.marks)
    return replace(made, frame=replace(made.frame, **{"image": name, "marks": marks, **changes}))


def move_marks(scan: MeasuredScan, shift: Any, matrix: Any = ((1, 0), (0, 1))) -> MeasuredScan:
    marks = tuple(replace(each, center_px=np.array(matrix) @ each.center_px + shift) for each in scan.frame.marks)
    return replace(scan, frame=replace(scan.frame, marks=marks))


def counting(scans: Sequence[MeasuredScan]) -> set[str]:
    """The images of which any mark counts."""
    return {each.frame.image for each in scans if any(mark.status.is_observation for mark in each.frame.marks)}


def test_a_board_at_the_same_place_counts_once() -> None:
    """Errors of lens and board repeat there: ten exposures without a movement had passed as ten pictures."""
    targets = tuple(replace(mark, kind="target") for mark in named_scan("").frame.marks)
    shifts_px = {"few": 1.0, "first": 0.0, "again": 10.0, "next": 18.0}  # 0.5 % of a side is 25 px
    scans = [move_marks(named_scan(name, marks=targets[name == "few" :]), px) for name, px in shifts_px.items()]
    checked = check_repeated_views(scans, True, lambda scan: None)
    assert counting(checked) == {"first", "next"}
    assert "it shows the board where first does to within 14.1 px" in checked[2].frame.problems[0]


def drawn_picture(seed: int) -> Array:
    """(400, 500) px of a landscape, darker towards the corners as all of the camera, with edge and marks."""
    rng = np.random.default_rng(seed)
    sides = np.stack(np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in (500, 400))), axis=-1)
    land = cv2.GaussianBlur(rng.normal(0.0, 1.0, (400, 500)), (0, 0), 3.0)
    picture = (160.0 + 20.0 * land / land.std()) * (1.0 - 0.4 * (sides**2).sum(axis=-1) / 2)
    places = np.array([present(mark.center_px) / 10.0 for mark in named_scan("").frame.marks]).round().astype(int)
    inside = np.zeros(picture.shape, dtype=bool)
    (left, upper), (right, lower) = places.min(axis=0) + 8, places.max(axis=0) - 8
    inside[upper:lower, left:right] = True
    picture[~inside] = 1.0  # film beyond the frame, whose edge lies alike in all scans
    for col, row in places:
        picture[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2] = 255.0
    return np.asarray(np.clip(picture, 1.0, None))


@pytest.mark.parametrize("has_target", [True, False])
def test_a_scan_stored_twice_is_none_rectified_alike(has_target: bool) -> None:
    """In another format, and at twice the size and turned by a quarter; the next frame lies half a pixel elsewhere.

    Where targets do not tell them apart the pictures do: darker as a negative, and with another tone curve.
    """
    marks = named_scan("").frame.marks
    target = replace(marks[0], kind="target", center_px=np.array([500.0, 800.0]))
    given = (*marks, *[target] * has_target)
    names = ("first", "again", "turned", "other", "rectified", "and its copy")
    first, again, turned, other, rectified, copy = (named_scan(name, marks=given) for name in names)
    drawn, land = drawn_picture(1), drawn_picture(2)
    pictures = {"first": drawn, "again": 200.0 - 0.7 * drawn, "turned": (np.rot90(drawn) / 99.0) ** 3}
    pictures |= {"rectified": land, "and its copy": np.round(land / 30.0)}
    assert present(first.frame.pose).name == "90m"
    quarter = replace(present(first.frame.pose), name="180m")  # (column, row) becomes (row, width - 1 - column)
    turned = replace(turned, frame=replace(turned.frame, pose=quarter), width_px=8000, height_px=10000)
    turned = move_marks(turned, (0.5, 2 * first.width_px - 1.5), 2 * np.array([[0.0, 1.0], [-1.0, 0.0]]))
    scans = [first, move_marks(again, 0.05), turned, move_marks(other, (0.5, 0.0))]
    scans += [] if has_target else [move_marks(rectified, 0.02), copy]
    checked = check_repeated_views(scans, False, lambda scan: pictures[scan.frame.image])
    assert counting(checked) == ({"first", "other"} if has_target else {*names})
    named = {each.frame.image: each.frame.problems[0] for each in checked if each.frame.problems}
    assert {*named} == {"again", "turned"} | (set() if has_target else {"and its copy"})
    message = "count once. To use this one, name first in `exclude`" if has_target else "count twice. Name one of both"
    assert message in named["turned"]
    assert has_target or "those of rectified do" in named["and its copy"]
    targets = (replace(target, point="9", center_px=np.array(at)) for at in ((50.0, 80.0), (90.0, 80.0)))
    apart = [named_scan(name, marks=(*given, one)) for name, one in zip(("a", "b"), targets, strict=True)]
    assert not any(each.frame.problems for each in check_repeated_views(apart, False, lambda scan: drawn))


def simulated_marks(
    folder: Path, odd: tuple[str, ...] = (), noise_px: float = 0.02
) -> tuple[Project, list[ComparatorPoint]]:
    """A project of pictures of a board, and marks of it; the squares of the odd pictures are 4 % wider."""
    options = CalibrationOptions(board_options("chessboard", "7x5", "20mm"))
    images = tuple(f"p{number}" for number in range(len(TURNS)))
    camera = CameraPictures("camera", *SIZE_PX, None, images)
    for name in images:
        (folder / f"{name}.png").touch()
    files = BoardPictureFiles({name: folder / f"{name}.png" for name in images}, (camera,), {})
    rng, marks = np.random.default_rng(3), list[ComparatorPoint]()
    for number, image in enumerate(images):
        rotation, shift = pose(number)
        shown = POINTS * (1.04 if image in odd else 1.0, 1.0, 1.0)
        places = cv2.projectPoints(shown, cv2.Rodrigues(rotation)[0], shift, MATRIX, np.zeros(5))[0].reshape(-1, 2)
        for point, place in zip(BOARD.object_points(), places + rng.normal(0.0, noise_px, places.shape), strict=True):
            xy_mm, sigma_mm = place * [options.pixel_mm, -options.pixel_mm], np.full(2, 0.02 * options.pixel_mm)
            marks.append(ComparatorPoint(image, point, "target", xy_mm, sigma_mm, 0.0, Status.MEASURED, ""))
    return write_project(folder, files, options, {"camera": "opencv4"}), marks


@pytest.mark.parametrize("odd", [(), ("p3",)])
def test_a_picture_of_another_print_is_named_and_no_other(odd: tuple[str, ...], tmp_path: Path) -> None:
    """A lens, a drift and a bend of the board would have taken a part of that."""
    project, marks = simulated_marks(tmp_path, odd)
    found = adjust_marks(project, marks).left_out
    assert tuple(found) == odd
    assert all("another print of the board" in why for why in found.values())


def test_what_is_wrong_with_pictures_is_given_in_pixels(tmp_path: Path) -> None:
    """The µm were those of a pixel that nobody had given. Right of 150 px marks lie 0.3 px right and 0.2 px lower."""
    project, marks = simulated_marks(tmp_path)
    shift_mm = 0.005 * np.array([0.3, -0.2])
    places = [(mark, present(mark.xy_mm)) for mark in marks]
    moved = [replace(mark, xy_mm=xy_mm + (xy_mm[0] > 0.75) * shift_mm) for mark, xy_mm in places]
    (found,) = adjust_marks(project, moved).explanations
    assert re.search(
        r"right of x = 1[45][\d.]* px are displaced .* by \(\+0\.3\d*, \+0\.(18|19|2)\d*\) .* px", found.cause
    )


@pytest.mark.parametrize("apart_px", [0.0, 12.0])
def test_pictures_of_two_cameras_are_distinguished_by_their_names(apart_px: float, tmp_path: Path) -> None:
    """They had been called distorted each in its own way. The second camera's principal point lies 12 px to the left;
    names that differ where cameras do not are nothing to speak of."""
    _, marks = simulated_marks(tmp_path)
    shift_mm = np.array([apart_px * CHESSBOARD_PIXEL_MM, 0.0])
    both = [replace(mark, image=f"left{mark.image}") for mark in marks]
    both += [replace(mark, image=f"right{mark.image}", xy_mm=present(mark.xy_mm) - shift_mm) for mark in marks]
    lines = [replace(mark, image=f"side{mark.image}") for mark in marks if mark.point < "r1"]  # have no solution
    images = tuple(dict.fromkeys(mark.image for mark in (*both, *lines)))
    files = {}
    for name in images:
        files[name] = tmp_path / f"{name}.png"
        files[name].touch()
    camera = CameraPictures("camera", *SIZE_PX, None, images)
    written = calibrate_stage._CalibrationProject(
        BoardPictureFiles(files, (camera,), {}), tmp_path, CalibrationOptions(CHESSBOARD), {"camera": "opencv4"}
    )
    sentence = written.cameras_by_name(camera, [*both, *lines])
    assert bool(sentence) == bool(apart_px)
    assert not written.cameras_by_name(camera, [mark for mark in both if mark.point < "r1"])
    assert not sentence or re.search(r"\*leftp\*: .* cx 20[23]\.\d.*\*rightp\*: .* cx 19[01]\.\d", sentence)


def test_pictures_of_kinds_that_are_not_read_are_named(tmp_path: Path) -> None:
    """HEIC of a telephone had been passed over without a word; black and white ones had been cameras of their own."""
    for name in ("a.HEIC", "b.webp", "p0.NEF"):
        (tmp_path / name).write_bytes(b"no picture")
    Image.fromarray(picture(0)).save(tmp_path / "p0.png")
    Image.fromarray(picture(0)).convert("1").save(tmp_path / "q.png")
    found = find_pictures([tmp_path], tmp_path / "o")
    assert (*found.files,) == ("p0",)
    assert sorted(found.unreadable) == ["a.HEIC", "b.webp", "q"]
    assert "convert it to JPEG, PNG or TIFF" in found.unreadable["b.webp"]
    assert "black and white pixels only" in found.unreadable["q"]


def test_parts_of_names_that_make_groups() -> None:
    """Folders, sides and numbers of cameras; numbers of pictures and single ones make none."""
    pairs = [f"{side}{number:02}" for number in range(8) for side in ("left", "right")]
    assert [list(each) for each in name_parts(pairs)] == [["left", "right"]]
    folders = [f"cam{camera}/shot{number}_{camera}" for camera in (0, 1) for number in range(9)]
    assert [list(each) for each in name_parts(folders)] == [["0", "1"]]
    assert not list(name_parts([*(f"p{number}" for number in range(20)), "q1"]))
    assert not list(name_parts(pairs[:8]))  # four of each
    assert not list(name_parts([]))


def test_a_lens_that_does_not_suit_at_all_is_adjusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its errors of more than 2 % of the marks' extent were refused as a wrong unit, before a fisheye was tried."""
    monkeypatch.setattr("adjust.solution.adjustment._drop_contradicting", lambda network, first, *_: first)
    project, marks = simulated_marks(tmp_path, noise_px=8.0)
    found = adjust_marks(project, [mark for mark in marks if mark.image < "p4"])
    assert found.converged
    assert any("px are not modelled" in remark for remark in found.remarks)


def test_a_picture_of_three_corners_does_not_spoil_the_others(tmp_path: Path) -> None:
    """Three points leave several orientations, or none: one picture of a real folder refused all others."""
    project, marks = simulated_marks(tmp_path)
    others, own = [mark for mark in marks if mark.image != "p3"], [mark for mark in marks if mark.image == "p3"]
    wrong = [replace(mark, point=point) for mark, point in zip(own, ("r0c0", "r0c6", "r4c0"), strict=False)]
    found = adjust_marks(project, [*others, *wrong])
    assert found.converged
    assert "Image 'p3' has no part in the adjustment: it shows 3 targets and needs 4." in found.remarks[0]


def test_where_no_board_is_found_the_message_names_what_the_first_picture_shows(folder: Path, tmp_path: Path) -> None:
    pictures = find_pictures([folder], tmp_path)
    images = [name for camera in pictures.cameras for name in camera.images]
    given = board_options("chessboard", "9x6", "20mm")
    message = calibrate_stage._nothing(pictures, dict.fromkeys(images, "no board"), {}, given)
    assert message.endswith("that the board is in the picture: what p0 shows fits --board 7x5.")


def test_the_given_board_is_not_proposed() -> None:
    """Of pictures that two cameras share, which show it twice."""
    given = [f"--board {size}" for size in ("7x5", "5x7")]
    assert [*CHESSBOARD.chessboards] == given
    assert not board_options("circle-grid", "7x5", "20mm", "9mm").chessboards


def test_a_few_of_many_spots_are_no_grid_of_dots() -> None:
    """Among 119 spots about a chessboard on a court 15 lay on some grid."""
    rng = np.random.default_rng(1)
    picture = np.full((480, 640), 220.0)
    for row, column in np.ndindex(4, 5):
        cv2.circle(picture, (140 + 40 * column, 160 + 40 * row), 11, (30,), -1)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 1.5), np.float64)
    with_spots = picture.copy()
    for x, y in rng.uniform((10, 10), (630, 470), (220, 2)).astype(int):
        if not (100 < x < 340 and 120 < y < 320):
            cv2.circle(with_spots, (int(x), int(y)), int(rng.integers(3, 7)), (90,), -1)
    assert recognise_dots(draw.make_scan(picture, 255)) == "--kind circle-grid --board 5x4 --marker DIAMETER"
    assert not recognise_dots(draw.make_scan(with_spots, 255))


@pytest.mark.parametrize(
    ("width", "staggered", "given"),
    [
        (8, True, "--kind asymmetric-circle-grid --board 4x7"),
        (9, True, "--kind asymmetric-circle-grid --board 4.5x7"),
        (8, False, "--kind circle-grid --board 8x7"),
    ],
)
def test_dots_are_named_whichever_picture_shows_them(width: int, staggered: bool, given: str, tmp_path: Path) -> None:
    """Dots had been named as a chessboard of some count, and pictures after one without a board were not looked at."""
    Image.new("L", (480, 360), 200).save(tmp_path / "p0.png")
    board = np.full((720, 960), 220, np.uint8)
    for row, column in np.ndindex(7, width):
        if not staggered or (row + column) % 2 == 0:
            cv2.circle(board, (120 + 80 * column, 120 + 80 * row), 46 if staggered else 26, (30,), -1)
    tilt = np.array([[0.5, 0.03, 0.0], [0.0, 0.5, 0.0], [0.0, 1e-4, 1.0]])
    picture = cv2.warpPerspective(cv2.GaussianBlur(board, (0, 0), 2.0), tilt, (480, 360), borderValue=(220,))
    Image.fromarray(picture).save(tmp_path / "p1.png")
    pictures = find_pictures([tmp_path], tmp_path / "o")
    message = calibrate_stage._nothing(pictures, dict.fromkeys(("p0", "p1"), "no board"), {}, CHESSBOARD)
    assert message.endswith(f"what p1 shows fits {given} --marker DIAMETER.")


@pytest.mark.parametrize(
    ("kind", "given", "wanted"),
    [
        ("charuco", ("5x6", 0), "--board 6x5 --first-id 9"),
        ("aruco", ("3x4", 0), "--board 4x3 --first-id 5"),
        ("aprilgrid", ("4x3", 5), "--kind aruco"),
    ],
)
def test_the_options_of_the_board_in_the_picture_are_named(
    kind: str, given: tuple[str, int], wanted: str, tmp_path: Path
) -> None:
    """By OpenCV's own drawings; the keys of the project file, which measure names, are not the user's."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    grid = cv2.aruco.GridBoard((4, 3), 20.0, 8.0, dictionary, np.arange(5, 17))
    charuco = cv2.aruco.CharucoBoard((6, 5), 28.0, 20.0, dictionary, np.arange(9, 24))
    drawing = (charuco if kind == "charuco" else grid).generateImage((560, 420), marginSize=20)
    Image.fromarray(cv2.GaussianBlur(drawing, (0, 0), 0.7)).save(tmp_path / "p0.png")
    counts, first_id = given
    options = board_options(kind, counts, "28mm", "20mm", "APRILTAG_36h11", first_id=first_id)
    pictures, reason = find_pictures([tmp_path], tmp_path / "o"), "as with columns = 6, first_marker = 5"
    message = calibrate_stage._nothing(pictures, {"p0": reason}, {}, options)
    place = "the board was found in none of 1 picture: the markers of p0 lie as with"
    assert message == f"{place} {wanted}. Give that if it is the board's."


def test_pictures_that_were_all_cut_are_refused_in_one_sentence() -> None:
    cameras = tuple(CameraPictures(f"camera-{k}", 640 + k, 480, None, (f"p{k}",)) for k in range(3))
    pictures = BoardPictureFiles({f"p{k}": Path(f"p{k}.png") for k in range(3)}, cameras, {})
    message = calibrate_stage._nothing(
        pictures, {}, {each.name: "the board is in 1 picture" for each in cameras}, CHESSBOARD
    )
    assert message.startswith("the 3 pictures have 3 sizes or focal lengths (640 x 480 px, 641 x 480 px, 642 x 480 px)")
    assert "cut or reduced" in message
    assert "in 1 picture" not in message


def test_boards_as_project_files_have_them() -> None:
    """OpenCV's asymmetric grid of 4 x 11; Kalibr's sizes, the gap three tenths of a tag where nobody says it."""

    def board(*given: Any, **options: Any) -> Any:
        table = tomllib.loads(board_options(*given, **options).table)["targets"]
        return read_targets(Table(table, Path("project.toml"), "targets")).board

    circles = board("asymmetric-circle-grid", "4x11", "1in", "10mm")
    steps = np.array(list(circles.object_points().values()))[:, :2] / 25.4
    of_opencv = [(2 * column + row % 2, 10 - row) for row in range(11) for column in range(4)]
    np.testing.assert_allclose(steps, of_opencv)
    rows = board("asymmetric-circle-grid", "2.5x3", "1in", "10mm")
    assert [name for name in rows.object_points() if name.startswith("r1")] == ["r1c1", "r1c3"]
    assert len(rows.object_points()) == 3 + 2 + 3
    hexagonal = board("asymmetric-circle-grid", "2.5x3", "10 x 17.3mm", "9mm").object_points()
    assert [hexagonal[name][:2] for name in ("r2c0", "r2c2", "r1c1")] == [(0.0, 0.0), (20.0, 0.0), (10.0, 17.3)]
    aruco = board("aruco", "3x2", "40mm", "30mm", "4X4_50", first_id=6)
    assert (aruco.marker_mm, aruco.gap_mm, aruco.first_marker) == (30.0, 10.0, 6)
    april = board("aprilgrid", "6x6", "114.4mm", first_id=3)
    assert (april.marker_mm, april.gap_mm, april.first_marker) == pytest.approx((88.0, 26.4, 3))
    assert april.object_points()["3.3"] == pytest.approx((0.0, 0.0, 0.0))  # lower left corner of the lower left tag
    charuco = board("charuco", "5x7", "30mm", "22mm", "4X4_250", first_id=20)
    assert (charuco.legacy, charuco.first_id) == (None, 20)


@pytest.mark.parametrize("square_pixels", [False, True])
def test_focal_lengths_of_square_pixels_are_one_unknown(square_pixels: bool) -> None:
    network = board_network(np.random.default_rng(4), 6, ERROR_PX * PIXEL_MM)
    camera = replace(network.cameras[0], distortion=intrinsics.free_lens("opencv4", square_pixels))
    pictures = CameraPictures(camera.name, 640, 480, None, tuple(image.name for image in network.images))
    result = adjust(replace(network, cameras=(camera,)))
    found = intrinsics.camera_intrinsics(result, pictures, PIXEL_MM, {}, None, None, None)
    assert (found.values["fx"] == found.values["fy"]) == square_pixels
    assert not square_pixels or ("fx", "fy") not in {(one, other) for one, other, _ in found.correlations}


def test_a_count_that_is_wrong_is_named_with_the_one_that_fits(tmp_path: Path, refusal: Refusal) -> None:
    Image.fromarray(picture(0)).save(tmp_path / "p0.png")
    assert "7 x 5 is" in refusal("calibrate", tmp_path, "--board", "6x5", "--square", "2cm", "--out", tmp_path / "o")
    (tmp_path / "o.txt").touch()
    message = refusal("calibrate", tmp_path, "--board", "6x5", "--square", "2cm", "--out", tmp_path / "o.txt")
    assert "o.txt is a file, and a folder is needed there" in message


PIXEL_MM = 0.005
ERROR_PX = 0.1  # in x and y


@pytest.mark.parametrize(("k3", "wanted"), [(0.0, "opencv4"), (-1.5, "opencv5")])
def test_the_better_lens_is_taken(k3: float, wanted: LensModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the third radial term that the lens has."""
    monkeypatch.delitem(intrinsics.PARAMETERS, "opencv8")  # as slow as both others together
    network = board_network(np.random.default_rng(4), 6, ERROR_PX * PIXEL_MM, k3=k3)
    choice = choose_lens(network, True, PIXEL_MM, adjust)
    assert choice.model == wanted
    assert set(choice.rms_px) == {"opencv4", "opencv5"}
    assert choice.rms_px[wanted] == pytest.approx(np.sqrt(2.0) * ERROR_PX, rel=0.15)


def test_a_fisheye_is_tried_where_the_field_is_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half the diagonal of these pictures is 0.74 of the principal distance."""
    monkeypatch.delitem(intrinsics.PARAMETERS, "opencv5")
    monkeypatch.delitem(intrinsics.PARAMETERS, "opencv8")
    network = board_network(np.random.default_rng(4), 6, ERROR_PX * PIXEL_MM)
    for limit, tried in ((1.0, {"opencv4"}), (0.7, {"opencv4", "fisheye"})):
        monkeypatch.setattr(intrinsics, "WIDE", limit)
        choice = choose_lens(network, True, PIXEL_MM, adjust)
        assert set(choice.rms_px) == tried


def choose_wide_lens(network: Network, unmodelled_mm: float | None, monkeypatch: pytest.MonkeyPatch) -> LensChoice:
    """Lens, opencv4 or fisheye, after a first adjustment with so large errors that are not modelled, or without one."""
    monkeypatch.delitem(intrinsics.PARAMETERS, "opencv5")
    monkeypatch.delitem(intrinsics.PARAMETERS, "opencv8")
    first: Any = unmodelled_mm and SimpleNamespace(unmodelled_mm={"wide": unmodelled_mm}, start=None)
    project: Any = SimpleNamespace(adjust=AdjustSettings())
    options: Any = SimpleNamespace(square_pixels=True, pixel_mm=PIXEL_MM)
    return calibrate_stage._chosen_lens(network, first, project, options)


@pytest.mark.parametrize(("images", "unmodelled_mm"), [(4, 0.006), (9, 0.006), (4, None)])
def test_a_fisheye_is_taken_where_the_first_lens_does_not_suit_at_all(
    images: int, unmodelled_mm: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors not modelled are so large that twice as much would be refused as of another unit."""
    network = equidistant_network(np.random.default_rng(3), 1.1, 200.0, images)
    choice = choose_wide_lens(network, unmodelled_mm, monkeypatch)
    assert choice.model == "fisheye"
    assert choice.rms_px["fisheye"] == pytest.approx(np.sqrt(2.0) * 1e-4 / PIXEL_MM, rel=0.2)


@pytest.mark.parametrize(("count", "better"), [(3, False), (12, True)])
def test_few_pictures_need_a_larger_gain(count: int, better: bool) -> None:
    """Logarithms that fall by -0.5, 1 and 2 do by 1.15 standard errors of three (1.32 needed), 2.6 of twelve."""
    richer, simpler = ({f"i{k}": np.exp(each[k % 3]) for k in range(count)} for each in ((0.0,) * 3, (-0.5, 1.0, 2.0)))
    assert intrinsics._is_better(richer, simpler) == better


def test_a_lens_that_suits_every_picture_is_better_though_errors_differ_a_thousandfold() -> None:
    """Mean difference of 98 with a standard error of 91; the smallest ratio is 180."""
    assert intrinsics._is_better(
        dict.fromkeys("abcde", 0.005), dict(zip("abcde", (2.9, 1.1, 0.9, 460.0, 25.0), strict=True))
    )


@pytest.mark.parametrize(
    ("errors", "wanted"),
    [
        ({4: 1.0, 5: 1.0, 8: 1.0, "fisheye": 1.0}, "opencv4"),
        ({4: 9.0, 5: 3.0, 8: 1.0, "fisheye": 1.0}, "fisheye"),
        ({4: 9.0, 5: 3.0, 8: 1.0, "fisheye": 2.0}, "opencv8"),
        ({4: 3.0, 5: 3.0, 8: 3.0, "fisheye": 1.0}, "fisheye"),
    ],
)
def test_of_lenses_as_good_the_simplest_is_taken(errors: dict[int | str, float], wanted: LensModel) -> None:
    network = board_network(np.random.default_rng(4), 6, ERROR_PX * PIXEL_MM)
    scatter = np.random.default_rng(1).uniform(0.9, 1.1, (9, len(network.images)))

    def fake_adjust(network: Network, _: Approximations | None) -> Any:
        distortion = network.cameras[0].distortion
        count = len(distortion.parameters)
        squares = errors["fisheye" if "fisheye" in distortion.family else count] * scatter[count]
        return SimpleNamespace(
            converged=True, network=network, start=None, value=lambda _: 1.0, prediction_errors=lambda _: squares
        )

    assert choose_lens(network, True, PIXEL_MM, fake_adjust).model == wanted

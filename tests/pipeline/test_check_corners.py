"""OpenCV's own corners beside those that were measured, in drawn pictures of a chessboard with a known camera."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.distance import cdist

from measure.boards.specs import (
    ArucoSpec,
    BoardSpec,
    CharucoSpec,
    ChessboardSpec,
    CircleGridSpec,
    SquareGridSpec,
    aruco_dictionary,
)
from measure.errors import MissingError
from measure.scans.opening import open_scan
from measure.scans.scan import Scan
from pipeline.cli import run
from pipeline.opencv_check.opencv_calibration import NAMES, Freedom, ImagePoints, OpenCvCalibration, calibrate
from pipeline.opencv_check.opencv_corners import BoardPictures, compare_corners, detector_name, find_points

Array = NDArray[np.float64]

BOARD = ChessboardSpec(7, 5, 20.0)
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


def images() -> list[ImagePoints]:
    """The exact places of all corners, as if they had been measured."""
    return [
        ImagePoints(f"p{number}", POINTS, corners_px(number) * [PITCH_MM, -PITCH_MM]) for number in range(len(TURNS))
    ]


def calibrated(given: Sequence[ImagePoints]) -> OpenCvCalibration:
    start = np.zeros(len(NAMES))
    start[:4] = PITCH_MM * np.array([FOCAL_PX, FOCAL_PX, CENTER_PX[0], -CENTER_PX[1]])
    return calibrate(given, Freedom(("fx", "fy", "cx", "cy")), start)


def test_both_figures_are_of_the_points_that_both_have(folder: Path) -> None:
    def opened(image: str) -> Scan:
        if image == "p4":
            raise MissingError("not at hand")
        return open_scan(folder / f"{image}.png")

    pictures = BoardPictures(BOARD, opened, {f"p{number}": (10.0, 10.0) for number in range(len(TURNS))})
    found = compare_corners(images(), pictures, calibrated)
    assert found is not None
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
def test_boards_of_other_kinds_are_found_by_opencvs_own_detectors(
    board: BoardSpec, drawing: NDArray[np.uint8], count: int
) -> None:
    assert detector_name(board)
    assert len(find_points(drawing, board)) == count


def test_without_scans_or_a_detector_it_is_left_out(folder: Path) -> None:
    def missing(image: str) -> Scan:
        raise MissingError("not at hand")

    assert compare_corners(images(), BoardPictures(BOARD, missing, {}), calibrated) is None
    assert len(find_points(picture(0), SquareGridSpec(3, 3, 20.0, 20.0))) == 0


def write_project(folder: Path) -> Path:
    lens = '[distortion]\nfamily = "opencv"\n[distortion.sigma]\nk1 = "free"\n'
    (folder / "camera.toml").write_text(f'name = "D"\nprincipal_distance_mm = 5.0\n{lens}', encoding="utf-8")
    (folder / "project.toml").write_text(
        'camera = "camera.toml"\nscans = ["*.png"]\npitch_um = 10.0\n'
        '[targets]\nkind = "chessboard"\ncolumns = 7\nrows = 5\nsquare_mm = 20.0\n[object]\nunit = "mm"\n',
        encoding="utf-8",
    )
    return folder / "project.toml"


def test_both_figures_stand_in_file_terminal_and_report(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    project, rng = str(write_project(tmp_path)), np.random.default_rng(1)
    rows = ["# comparator coordinates, reseau", "image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    for image in images():
        noisy = image.xy_mm + rng.normal(0.0, 2e-4, image.xy_mm.shape)
        for name, (x, y) in zip(BOARD.object_points(), noisy.tolist(), strict=True):
            rows.append(f"{image.image},{name},target,{x:.6f},{y:.6f},0.0002,0.0002")
    (tmp_path / "comparator.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    assert run(["adjust", project]) in (0, 1)
    assert run(["check", project]) in (0, 1)
    output = " ".join(capsys.readouterr().out.split())
    corners = json.loads((tmp_path / "out" / "check.json").read_text(encoding="utf-8"))["cameras"]["D"]["corners_px"]
    assert (corners["images"], corners["points"], corners["not_found"]) == (5, 175, [])
    assert corners["reseau"]["fx"] == pytest.approx(FOCAL_PX, abs=1.0)
    assert corners["opencv"]["fx"] == pytest.approx(FOCAL_PX, abs=3.0)
    assert run(["report", project]) in (0, 1)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for figures in (corners["reseau"], corners["opencv"]):
        assert f"rms {figures['rms']:.3f} px a point" in output
        assert f"<td>{figures['fx']:.2f}</td>" in page
    assert "OpenCV's own (findChessboardCorners and cornerSubPix, half a window of 11 px)" in output


@pytest.mark.study
def test_a_digital_camera_has_the_frame_of_its_pictures(folder: Path) -> None:
    assert run(["run", str(write_project(folder))]) in (0, 1)
    adjusted = json.loads((folder / "out" / "adjustment.json").read_text(encoding="utf-8"))["cameras"]["D"]
    point = np.array([adjusted["principal_point_mm"][axis]["value"] for axis in "xy"])
    corners = [np.array([x, y]) for x in (0.0, 4.0) for y in (0.0, -3.2)]
    farthest = max(float(np.linalg.norm(corner - point)) for corner in corners)
    assert adjusted["lens_known"]["corner_mm"] == pytest.approx(farthest, rel=1e-9)
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    assert f"{100.0 * adjusted['lens_known']['share']:.0f} % of the way to the corner of the picture" in page

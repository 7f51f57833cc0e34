"""Boards of nine kinds, drawn by OpenCV's generators and imaged by a known lens: corners compared with OpenCV's.

Three tilted images of 640 x 480 px per kind, with 5 % radial distortion at the corner, a blur of 0.7 px and noise of 2
grey values. OpenCV's function for each kind is used with its customary settings, as in `reseau check`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from benchmarks.harness import Row, rms
from measure.boards.measure import measure_board
from measure.boards.specs import (
    AprilGridSpec,
    ArucoSpec,
    BoardSpec,
    CharucoSpec,
    ChessboardSpec,
    CircleGridSpec,
    aruco_dictionary,
)
from measure.scans.cache import WholePicture
from measure.scans.metadata import Pitch
from measure.scans.scan import Scan
from pipeline.opencv_check.check import find_points

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

WIDTH, HEIGHT, FINENESS, PX_PER_MM = 640, 480, 3, 6
MATRIX = np.array([[700.0, 0.0, 325.0], [0.0, 700.0, 236.0], [0.0, 0.0, 1.0]])
LENS = np.array([-0.16, 0.03, 1e-3, -5e-4])
TURNS = [(0.35, 0.1, 0.05), (-0.3, 0.3, -0.1), (0.1, -0.4, 0.15)]
NEAR_PX = 3.0  # px, largest distance of a point of OpenCV from its true place


@dataclass(frozen=True, eq=False)
class BoardCase:
    """Board and its drawing. drawing: with PX_PER_MM, its upper left corner at corner_mm; is_mirrored, cut_px: whether
    the image is mirrored, and columns cut off at its left."""

    name: str
    spec: BoardSpec
    drawing: Bytes
    corner_mm: tuple[float, float]
    is_mirrored: bool = False
    cut_px: int = 0


def drawings() -> Iterator[BoardCase]:
    chess = ChessboardSpec(9, 6, 20.0)
    yield BoardCase("chessboard 9 x 6", chess, _squares(chess), (-20.0, 120.0))
    yield BoardCase("the same, two columns outside of the picture", chess, _squares(chess), (-20.0, 120.0), cut_px=150)
    for name, spec in (
        ("ChArUco 8 x 6", CharucoSpec("4X4_50", 8, 6, 25.0, 18.0)),
        ("ChArUco 8 x 6, older layout, first marker 20", CharucoSpec("4X4_250", 8, 6, 25.0, 18.0, None, 20)),
    ):
        numbers = np.arange(spec.first_id, spec.first_id + 24)
        board = cv2.aruco.CharucoBoard((8, 6), 25.0, 18.0, aruco_dictionary(spec.dictionary), numbers)
        board.setLegacyPattern(bool(spec.first_id))
        sheet = board.generateImage((200 * PX_PER_MM, 150 * PX_PER_MM), marginSize=0, borderBits=1)
        yield BoardCase(name, spec, np.asarray(sheet, np.uint8), (-25.0, 125.0))
    aruco = ArucoSpec("5X5_100", 5, 4, 30.0, 10.0)
    grid = cv2.aruco.GridBoard((5, 4), 30.0, 10.0, aruco_dictionary("5X5_100"))
    drawing: Bytes = np.asarray(
        grid.generateImage((190 * PX_PER_MM, 150 * PX_PER_MM), marginSize=0, borderBits=1), np.uint8
    )
    yield BoardCase("ArUco 5 x 4", aruco, drawing, (0.0, 150.0))
    yield BoardCase("ArUco 5 x 4, mirrored", aruco, drawing, (0.0, 150.0), is_mirrored=True)
    april = AprilGridSpec("APRILTAG_36h11", 5, 4, 30.0, 9.0)
    yield BoardCase("AprilGrid 5 x 4 (Kalibr)", april, _april_grid(april), (-9.0, 156.0))
    circles = CircleGridSpec(8, 6, 25.0, 14.0)
    yield BoardCase("circle grid 8 x 6", circles, _circles(circles), (-25.0, 150.0))
    staggered = CircleGridSpec(8, 11, 18.0, 14.0, asymmetric=True)
    yield BoardCase("asymmetric circle grid 4 x 11", staggered, _circles(staggered), (-18.0, 198.0))


COLUMNS = {
    "board": "", "points": "d", "this program": "d", "rms_px": ".3f", "largest_px": ".3f", "OpenCV": "d",
    "opencv_rms_px": ".3f", "opencv_largest_px": ".3f",
}  # fmt: skip


def cells() -> Iterator[Row]:
    yield from ({"board": each.name} for each in drawings())


def case(board: str) -> Row:
    drawing = next(each for each in drawings() if each.name == board)
    own, other, shown = [], [], 0
    for number in range(len(TURNS)):
        picture, truth = photographed(drawing, number)
        height, width = picture.shape
        visible = {name: at for name, at in truth.items() if 3 < at[0] < width - 4 and 3 < at[1] < height - 4}
        shown += len(visible)
        scan = Scan(Path("drawn"), WholePicture(picture[:, :, None], 1.0), Pitch(None))
        marks = measure_board(scan, drawing.spec).marks
        own += [np.asarray(mark.center_px) - truth[mark.point] for mark in marks if mark.status.is_observation]
        places = np.array(list(visible.values()))
        found = found_by_opencv(picture, drawing.spec)
        if len(found):
            far, nearest = KDTree(places).query(found)
            other += list((found - places[nearest])[np.asarray(far) < NEAR_PX])
    row: dict[str, float] = {"points": shown, "this program": len(own), "OpenCV": len(other)}
    for name, errors in (("", own), ("opencv_", other)):
        if errors:
            far = np.hypot(*np.array(errors).T)
            row |= {f"{name}rms_px": rms(far), f"{name}largest_px": far.max()}
    return row


def photographed(case: BoardCase, number: int) -> tuple[Bytes, dict[str, Array]]:
    """Image of a board, and the true places of its points."""
    rotation = np.asarray(cv2.Rodrigues(np.array(TURNS[number]))[0]) @ np.diag([1.0, -1.0, -1.0])
    points = case.spec.object_points()
    xyz = np.array(list(points.values()))
    shift = np.array([-4.0, 3.0, 1.05 * 700.0 * max(np.ptp(xyz[:, 0]) / 500.0, np.ptp(xyz[:, 1]) / 370.0)])
    shift = shift - rotation @ ((xyz.min(axis=0) + xyz.max(axis=0)) / 2.0)
    places = cv2.projectPoints(xyz, cv2.Rodrigues(rotation)[0], shift, MATRIX, LENS)[0].reshape(-1, 2)
    rays = _rays()
    board_from_ray = np.linalg.inv(np.column_stack([rotation[:, :2], shift]))
    x, y, w = board_from_ray @ np.column_stack([rays, np.ones(len(rays))]).T
    left, top = case.corner_mm
    across = ((x / w - left) * PX_PER_MM - 0.5).reshape(HEIGHT * FINENESS, -1).astype(np.float32)
    down = ((top - y / w) * PX_PER_MM - 0.5).reshape(HEIGHT * FINENESS, -1).astype(np.float32)
    fine = cv2.remap(case.drawing, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(255,))
    grey = 40.0 + 170.0 / 255.0 * fine.reshape(HEIGHT, FINENESS, WIDTH, FINENESS).mean(axis=(1, 3))
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7) + np.random.default_rng(number).normal(0.0, 2.0, grey.shape)
    picture = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    if case.is_mirrored:
        picture, places = picture[:, ::-1].copy(), np.array([WIDTH - 1, 0]) + places * [-1, 1]
    picture, places = picture[:, case.cut_px :].copy(), places - [case.cut_px, 0]
    return picture, dict(zip(points, places, strict=True))


@cache
def _rays() -> Array:
    """(n, 2) ray directions of all sub-pixels, by inversion of OpenCV's projection."""
    col, row = (((np.arange(size * FINENESS) + 0.5) / FINENESS - 0.5) for size in (WIDTH, HEIGHT))
    pixels = np.stack(np.meshgrid(col, row), axis=-1).reshape(-1, 2)
    rays = (pixels - MATRIX[:2, 2]) / 700.0
    for _ in range(8):
        projected = cv2.projectPoints(
            np.column_stack([rays, np.ones(len(rays))]), np.zeros(3), np.zeros(3), MATRIX, LENS
        )[0]
        rays = rays + (pixels - projected.reshape(-1, 2)) / 700.0
    return np.asarray(rays)


def found_by_opencv(picture: Bytes, spec: BoardSpec) -> Array:
    """(n, 2) points found by OpenCV; the asymmetric grid, not included in the check, by findCirclesGrid; for ChArUco
    the better of both layouts."""
    if isinstance(spec, CircleGridSpec) and spec.asymmetric:
        size = (spec.columns // 2, spec.rows)
        found, points = cv2.findCirclesGrid(picture, size, flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
        return np.asarray(points, float).reshape(-1, 2) if found else np.zeros((0, 2))
    if isinstance(spec, CharucoSpec):
        return max((find_points(picture, replace(spec, legacy=legacy)) for legacy in (False, True)), key=len)
    return find_points(picture, spec)


def _squares(spec: ChessboardSpec) -> Bytes:
    places = np.indices((spec.rows + 1, spec.columns + 1)).sum(axis=0) % 2
    side = round(spec.square_mm * PX_PER_MM)
    return np.kron(255 * places, np.ones((side, side))).astype(np.uint8)


def _circles(spec: CircleGridSpec) -> Bytes:
    step, radius = spec.spacing_mm * PX_PER_MM, spec.diameter_mm * PX_PER_MM / 2.0
    size = round((spec.rows + 1) * step), round((spec.columns + 1) * step)
    drawing = np.full(size, 255, np.uint8)
    for row, column in spec.places():
        middle = round(16 * ((column + 1) * step - 0.5)), round(16 * ((row + 1) * step - 0.5))
        cv2.circle(drawing, middle, round(16 * radius), (0,), -1, cv2.LINE_AA, 4)
    return drawing


def _april_grid(spec: AprilGridSpec) -> Bytes:
    side, gap = round(spec.marker_mm * PX_PER_MM), round(spec.gap_mm * PX_PER_MM)
    drawing = np.full((spec.rows * (side + gap) + gap, spec.columns * (side + gap) + gap), 255, np.uint8)
    for row, column in np.ndindex(spec.rows + 1, spec.columns + 1):
        top, left = row * (side + gap), column * (side + gap)
        drawing[top : top + gap, left : left + gap] = 0
        if row < spec.rows and column < spec.columns:
            number = spec.marker(row, column)
            marker = cv2.aruco.generateImageMarker(aruco_dictionary(spec.dictionary), number, side, borderBits=2)
            drawing[top + gap : top + gap + side, left + gap : left + gap + side] = marker
    return drawing

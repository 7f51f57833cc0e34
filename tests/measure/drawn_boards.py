"""Pictures of boards whose points lie where a homography puts them, and what measuring came to."""

from typing import Any

import cv2
import numpy as np
from drawn import drawn
from numpy.typing import NDArray

from measure.boards.measure import BoardMeasurement
from measure.boards.specs import (
    AprilGridSpec,
    BoardSpec,
    CharucoSpec,
    ChessboardSpec,
    CircleGridSpec,
    SquareGridSpec,
    aruco_dictionary,
)

Array = NDArray[np.float64]
WIDTH, HEIGHT = 320, 260  # px


def board_from_pixel(turn_deg: float = 7.0, tilt: float = 4e-4) -> Array:
    """A homography from pixels to mm of the board, y up: about 1 mm a pixel, turned and seen at an angle."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    back: Array = np.array([[1.0, 0, WIDTH / 2], [0, 1.0, HEIGHT / 2], [0, 0, 1]])
    tilted = np.array([[1.0, 0, 0], [0, 1.0, 0], [tilt, -tilt / 2, 1]])
    turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.diag([1.0, -1.0, 1.0])
    return np.asarray(np.linalg.inv(back @ tilted @ turned))


def mapped(homography: Array, points: Array) -> Array:
    """(n, 2) points through a homography."""
    x, y, w = homography @ np.vstack([points.T, np.ones(len(points))])
    return np.asarray(np.stack([x / w, y / w], axis=-1))


def take_picture(spec: BoardSpec, homography: Array, is_dark: Any, seed: int = 1) -> Array:
    """A board whose middle lies on the homography's origin; is_dark says so of board coordinates in mm."""
    middle = np.mean([point[:2] for point in spec.object_points().values()], axis=0)

    def light(col: Array, row: Array) -> Array:
        x, y, w = (line[0] * col + line[1] * row + line[2] for line in homography)
        return np.asarray(1.0 - is_dark(x / w + middle[0], y / w + middle[1]))

    rng = np.random.default_rng(seed)
    clean = drawn(light, WIDTH, HEIGHT, 0.8, fineness=6)
    return 8000 + 30000 * clean + rng.normal(0, 300, clean.shape)


def read_truth(spec: BoardSpec, homography: Array) -> dict[str, Array]:
    points = spec.object_points()
    flat = np.array([point[:2] for point in points.values()])
    places = mapped(np.asarray(np.linalg.inv(homography)), np.asarray(flat - flat.mean(axis=0)))
    return dict(zip(points, places, strict=True))


def errors_px(board: BoardMeasurement, truth: dict[str, Array]) -> Array:
    """(n, 2) of the points that were measured."""
    measured_marks = [mark for mark in board.marks if mark.status.is_observation]
    return np.asarray([np.asarray(mark.center_px) - truth[mark.point] for mark in measured_marks], float)


def chessboard_dark(spec: ChessboardSpec) -> Any:
    """Dark is the square whose upper left corner is r0c0, and every other one."""

    def dark(x: Array, y: Array) -> Array:
        column, row = np.floor(x / spec.square_mm), np.floor((spec.rows - 1) - y / spec.square_mm)
        inside = (column >= -1) & (column < spec.columns) & (row >= -1) & (row < spec.rows)
        return np.asarray(inside & ((column + row) % 2 == 0))

    return dark


def circles_dark(spec: CircleGridSpec) -> Any:
    places = np.array([point[:2] for point in spec.object_points().values()])

    def dark(x: Array, y: Array) -> Array:
        inside = np.zeros(x.shape, bool)
        for place in places:
            inside |= (x - place[0]) ** 2 + (y - place[1]) ** 2 < (spec.diameter_mm / 2) ** 2
        return inside

    return dark


def printed(board: Any, spec: BoardSpec, size_mm: tuple[float, float], corner_mm: Array) -> Any:
    """Darkness from OpenCV's own drawing of a board, 4 px a mm, whose upper left corner lies at corner_mm."""
    drawing = board.generateImage((round(size_mm[0] * 4), round(size_mm[1] * 4)), marginSize=0, borderBits=1)
    return darkness(drawing, corner_mm)


def darkness(drawing: Any, corner_mm: Array) -> Any:
    """Darkness from a drawing, 4 px a mm, whose upper left corner lies at corner_mm."""

    def dark(x: Array, y: Array) -> Array:
        col, row = np.floor((x - corner_mm[0]) * 4).astype(int), np.floor((corner_mm[1] - y) * 4).astype(int)
        inside = (col >= 0) & (row >= 0) & (col < drawing.shape[1]) & (row < drawing.shape[0])
        clipped = drawing[np.clip(row, 0, drawing.shape[0] - 1), np.clip(col, 0, drawing.shape[1] - 1)]
        return np.asarray(inside & (clipped < 128))

    return dark


def charuco_picture(spec: CharucoSpec, homography: Array) -> Array:
    """OpenCV's own drawing of a board, photographed."""
    count = spec.columns * spec.rows // 2
    numbers = np.arange(spec.first_id, spec.first_id + count)
    size, dictionary = (spec.columns, spec.rows), aruco_dictionary(spec.dictionary)
    drawing = cv2.aruco.CharucoBoard(size, spec.square_mm, spec.marker_mm, dictionary, numbers)
    drawing.setLegacyPattern(bool(spec.legacy))
    width, height = spec.columns * spec.square_mm, spec.rows * spec.square_mm
    corner = np.array([-spec.square_mm, height - spec.square_mm])
    return take_picture(spec, homography, printed(drawing, spec, (width, height), corner))


def april_grid_dark(spec: AprilGridSpec, quarter_turns: int = 0) -> Any:
    """Kalibr's board of OpenCV's markers, each turned so often: squares at all corners, the first at the lower left."""
    side, gap = round(4 * spec.marker_mm), round(4 * spec.gap_mm)
    drawing = np.full((spec.rows * (side + gap) + gap, spec.columns * (side + gap) + gap), 255, np.uint8)
    for row, column in np.ndindex(spec.rows + 1, spec.columns + 1):
        top, left = row * (side + gap), column * (side + gap)
        drawing[top : top + gap, left : left + gap] = 0
        if row < spec.rows and column < spec.columns:
            number = spec.first_marker + (spec.rows - 1 - row) * spec.columns + column
            marker = cv2.aruco.generateImageMarker(aruco_dictionary(spec.dictionary), number, side, borderBits=2)
            where = np.s_[top + gap : top + gap + side, left + gap : left + gap + side]
            drawing[where] = np.rot90(marker, quarter_turns)
    corner = np.array([-spec.gap_mm, spec.rows * (spec.marker_mm + spec.gap_mm)])
    return darkness(drawing, corner)


def squares_dark(spec: SquareGridSpec) -> Any:
    """Dark where both coordinates, from the lower left square's corner, lie in a square."""
    step = spec.square_mm + spec.gap_mm

    def dark(x: Array, y: Array) -> Array:
        inside = (x > 0) & (x < spec.columns * step) & (y > 0) & (y < spec.rows * step)
        return np.asarray(inside & (x % step < spec.square_mm) & (y % step < spec.square_mm))

    return dark


def tile_boards(spec: BoardSpec, is_dark: Any, shown: tuple[float, ...], fineness: int = 4) -> Array:
    """Boards of one kind side by side, upright, at 1 mm a pixel times the scale in which each is shown."""
    extent = np.ptp([point[:2] for point in spec.object_points().values()], axis=0) + 60.0
    width, height = int(extent[0]), int(extent[1])

    def light(col: Array, row: Array) -> Array:
        col, row = np.broadcast_arrays(col, row)
        which = np.clip(col // width, 0, len(shown) - 1).astype(int)
        scale = np.array(shown)[which]
        x, y = (col - which * width - 30.0) / scale, (height - row - 30.0) / scale
        return np.asarray(1.0 - is_dark(x, y))

    clean = drawn(light, width * len(shown), height, 0.8, fineness=fineness)
    return 8000 + 30000 * clean + np.random.default_rng(4).normal(0, 300, clean.shape)

"""CPU time of `reseau calibrate` compared with OpenCV's corner detection and calibration, in one process and thread.

Synthetic images of a chessboard of 9 x 6 corners and of OpenCV's circle grid of 44 dots. OpenCV: corners (`classic`:
findChessboardCorners and cornerSubPix; `sector`: findChessboardCornersSB) and calibrateCamera. This program:
measurement, and selection of the lens model with adjustment, for which the ratio is given; and the whole command, which
also starts a process, checks against OpenCV, and writes project and report.
"""

import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from adjust.least_squares.malloc_tuning import keep_freed_memory
from measure.boards.measure import measure_board
from measure.boards.specs import ChessboardSpec, CircleGridSpec
from measure.scans.opening import open_scan
from pipeline.calibration.calibrate_stage import calibrate
from pipeline.terminal import Reporter, TimedCount

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
COLUMNS = {
    "board": "s",
    "width": "d",
    "pictures": "d",
    "opencv": "s",
    "opencv_corners_s": ".2f",
    "opencv_s": ".2f",
    "measuring_s": ".2f",
    "calibrating_s": ".2f",
    "command_s": ".2f",
    "a_picture_s": ".3f",
    "ratio": ".1f",
}
SEED = 1
Grid = ChessboardSpec | CircleGridSpec
BOARDS: dict[str, tuple[Grid, tuple[str, str, str, str | None, None, bool]]] = {
    "chessboard": (ChessboardSpec(9, 6, 25.0), ("chessboard", "9x6", "25mm", None, None, False)),
    "circles": (
        CircleGridSpec(8, 11, 18.0, 20.0, asymmetric=True),
        ("asymmetric-circle-grid", "4x11", "18mm", "20mm", None, False),
    ),
}
DOT_PX = 4  # px per mm of the painted board
DISTORTION = np.array([-0.12, 0.05, 0.0, 0.0])


def cells() -> Iterator[dict[str, Any]]:
    for opencv in ("classic", "sector"):
        yield {"board": "chessboard", "width": 1280, "pictures": 36, "opencv": opencv}
    yield {"board": "chessboard", "width": 600, "pictures": 20, "opencv": "classic"}
    yield {"board": "circles", "width": 1280, "pictures": 12, "opencv": "classic"}


def case(board: str, width: int, pictures: int, opencv: str, seed: int) -> dict[str, Any]:
    """Calibrate one set of images by both programs."""
    cv2.setNumThreads(1)
    spec, options = BOARDS[board]
    size_px = width, round(0.75 * width) if width > 600 else round(width / 1.5)
    reporter = CpuReporter()
    with tempfile.TemporaryDirectory() as folder:
        for number, grey in enumerate(drawn_pictures(spec, size_px, pictures, seed)):
            cv2.imwrite(f"{folder}/p{number:02}.png", grey)
        found = calibrated_by_opencv(sorted(Path(folder).glob("*.png")), spec, opencv)
        keep_freed_memory()  # as the program does where it measures
        begun = time.process_time()
        for path in sorted(Path(folder).glob("*.png")):
            with open_scan(path) as scan:
                measure_board(scan, spec)
        measuring_s = time.process_time() - begun
        begun = sum(os.times()[:4])  # child processes included
        kind, size, square, marker, _, legacy = options
        out = f"{folder}/out"
        calibrate(folder, size, square, kind=kind, marker=marker, legacy=legacy, out=out, workers=1, reporter=reporter)
        command_s = sum(os.times()[:4]) - begun
    spent_s = measuring_s + reporter.cpu_s["calibrating"]
    return found | {
        "measuring_s": measuring_s,
        "calibrating_s": reporter.cpu_s["calibrating"],
        "command_s": command_s,
        "a_picture_s": measuring_s / pictures,
        "ratio": spent_s / found["opencv_s"],
    }


class CpuReporter(Reporter):
    """Reporter that adds up the CPU time of each stage."""

    def __init__(self) -> None:
        super().__init__(Console(quiet=True))
        self.cpu_s = defaultdict[str, float](float)

    @contextmanager
    def stage(self, title: str) -> Iterator[TimedCount]:
        begun = time.process_time()
        with super().stage(title) as count:
            yield count
        self.cpu_s[title] += time.process_time() - begun


def drawn_pictures(spec: Grid, size_px: tuple[int, int], count: int, seed: int) -> Iterator[Bytes]:
    """Yield count images of a board in random poses, with lens distortion, a blur of 0.7 px and noise of 1.5."""
    rng = np.random.default_rng(seed)
    paper, paper_from_board = painted_board(spec)
    points = np.array(list(spec.object_points().values()))
    fine = 2 * np.array(size_px)
    matrix = np.array([[0.8 * size_px[0], 0, size_px[0] / 2], [0, 0.8 * size_px[0], size_px[1] / 2], [0, 0, 1.0]])
    col, row = np.meshgrid((np.arange(fine[0]) + 0.5) / 2 - 0.5, (np.arange(fine[1]) + 0.5) / 2 - 0.5)
    rays = cv2.undistortPoints(np.stack([col.ravel(), row.ravel()], axis=1)[:, None], matrix, DISTORTION)[:, 0]
    for _ in range(count):
        turn = rng.uniform(-0.55, 0.55, 3) * (1.0, 1.0, 0.6)
        rotation = np.asarray(cv2.Rodrigues(turn)[0]) @ np.diag([1.0, -1.0, -1.0])
        extent_mm = float(np.ptp(points, axis=0).max())
        distance = extent_mm * rng.uniform(1.2, 1.7)
        middle = np.append(rng.uniform(-0.18, 0.18, 2) * distance * (1.0, size_px[1] / size_px[0]), distance)
        shift = middle - rotation @ points.mean(axis=0)
        board_from_ray = np.linalg.inv(np.column_stack([rotation[:, :2], shift]))
        places = cv2.perspectiveTransform(rays[:, None], paper_from_board @ board_from_ray)[:, 0].astype(np.float32)
        maps = [places[:, axis].reshape(fine[::-1]) for axis in (0, 1)]
        light = cv2.remap(paper, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=170)
        small = cv2.resize(cv2.GaussianBlur(light, (0, 0), 1.4), size_px, interpolation=cv2.INTER_AREA)
        yield np.clip(small + rng.normal(0.0, 1.5, small.shape), 0, 255).astype(np.uint8)


def painted_board(spec: Grid) -> tuple[Bytes, Array]:
    """Paint the board with DOT_PX pixels per mm; returns it and the transformation (3, 3) from board to pixels."""
    points = np.array(list(spec.object_points().values()))[:, :2]
    margin_mm = 60.0
    width, height = (np.ptp(points, axis=0) + 2 * margin_mm) * DOT_PX
    top_mm = float(points[:, 1].max()) + margin_mm
    paper_from_board = np.array([[DOT_PX, 0, DOT_PX * margin_mm], [0, -DOT_PX, DOT_PX * top_mm], [0, 0, 1.0]])
    paper_from_board[:2, 2] -= 0.5
    paper = np.full((round(height), round(width)), 225, np.uint8)
    if isinstance(spec, CircleGridSpec):
        for x, y in cv2.perspectiveTransform(points[:, None], paper_from_board)[:, 0]:
            center = (round(16 * x), round(16 * y))
            cv2.circle(paper, center, round(8 * DOT_PX * spec.diameter_mm), 30, cv2.FILLED, cv2.LINE_AA, 4)
        return paper, paper_from_board
    y, x = np.indices(paper.shape)
    column = np.floor((x + 0.5) / DOT_PX / spec.square_mm - margin_mm / spec.square_mm)
    row = np.floor((y + 0.5) / DOT_PX / spec.square_mm - margin_mm / spec.square_mm)
    inside = (column >= -1) & (column < spec.columns) & (row >= -1) & (row < spec.rows)
    paper[inside & ((column + row) % 2 == 0)] = 30
    return paper, paper_from_board


def calibrated_by_opencv(paths: Sequence[Path], spec: Grid, kind: str) -> dict[str, float]:
    begun = time.process_time()
    pictures = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8) for path in paths]
    corners = [found for picture in pictures if (found := opencv_points(picture, spec, kind)) is not None]
    corners_s = time.process_time() - begun
    points = np.array([(x, y, 0.0) for x, y, _ in spec.object_points().values()], np.float32)
    if isinstance(spec, CircleGridSpec):
        points = np.array(
            [[(2 * j + i % 2) * spec.spacing_mm, i * spec.spacing_mm, 0] for i in range(11) for j in range(4)]
        )
    size_px = pictures[0].shape[::-1]
    cv2.calibrateCamera(
        [points.astype(np.float32)] * len(corners), corners, size_px, None, None, flags=cv2.CALIB_FIX_K3
    )
    return {"opencv_corners_s": corners_s, "opencv_s": time.process_time() - begun}


def opencv_points(picture: Bytes, spec: Grid, kind: str) -> NDArray[np.float32] | None:
    if isinstance(spec, CircleGridSpec):
        found, places = cv2.findCirclesGrid(picture, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    elif kind == "classic":
        found, places = cv2.findChessboardCorners(picture, (spec.columns, spec.rows))
        if found:
            places = cv2.cornerSubPix(picture, places, (9, 9), (-1, -1), (3, 30, 1e-3))
    else:
        found, places = cv2.findChessboardCornersSB(picture, (spec.columns, spec.rows))
    return np.asarray(places, np.float32) if found else None

"""Traps seen in comparable programs that no test of a single part covers, each by its name."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from brute_marks import brute_picture, placed

from measure.boards.measure import measure_board
from measure.boards.specs import ChessboardSpec
from measure.marks.shapes import MarkShape, ring_cross
from measure.matching.match import match
from measure.matching.window import ScanWindow
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from pipeline.results.comparator_file import read_comparator

RING_CROSS = MarkShape(ring_cross(0.8, 0.12, 0.6, 0.08))


def errors_over_a_pixel() -> np.ndarray:
    """Matched less true columns of one mark at 25 phases, clean but for the rounding to 16 bits."""
    errors = []
    for phase in np.arange(25) / 25.0:
        true = placed(12.0, (24.0 + phase, 24.3))
        grey = np.rint(8000.0 + 30000.0 * brute_picture(RING_CROSS, true, 49, 49, 0.8))
        start = placed(12.0, (24.5, 24.5))
        errors.append(match(ScanWindow(grey), RING_CROSS, start).center_px[0] - (24.0 + phase))
    return np.array(errors)


def test_trap_half_pixel_lost_and_a_grid_of_a_tenth_of_a_pixel_left() -> None:
    errors = errors_over_a_pixel()
    assert abs(errors.mean()) < 0.003
    assert np.ptp(errors) < 0.01


def test_trap_a_failed_scan_is_dropped_from_the_table(finished: tuple[Path, int]) -> None:
    """Every mark of every scan has its row, found or not, with a reason unless it was measured."""
    folder, _ = finished
    points = read_comparator(folder / "comparator.csv")
    assert {point.image for point in points} == {path.stem for path in (folder / "scans").iterdir()}
    for image in {point.image for point in points}:
        assert sum(point.image == image and point.kind == "fiducial" for point in points) == 8
    assert all(point.reason for point in points if point.status != "measured")


def test_trap_a_frame_is_cut_to_the_bounding_box_of_its_marks(finished: tuple[Path, int]) -> None:
    """Pixels are counted from the file's own corner: the picture is never cut before it is measured."""
    folder, _ = finished
    first = next(p for p in read_comparator(folder / "comparator.csv") if p.kind == "fiducial")
    assert first.xy_mm is not None
    assert np.abs(first.xy_mm).min() > 3.0  # the scan has a margin of 3 mm about the frame


def test_trap_opencv_5_drops_dimensions_and_takes_single_precision_only() -> None:
    spec = ChessboardSpec(4, 3, 10.0)
    squares = (np.indices((4, 5)).sum(axis=0) % 2).astype(np.float64)
    board = np.pad(np.kron(squares, np.ones((60, 60))), 40, constant_values=1.0)
    grey = cv2.GaussianBlur(board * 40000.0 + 5000.0, (0, 0), 1.0).astype(np.uint16)
    marks = measure_board(Scan(Path("board.tif"), WholePicture(grey[:, :, None]), NO_TAGS), spec).marks
    assert all(mark.center_px is not None and mark.center_px.shape == (2,) for mark in marks)
    found = np.array([mark.center_px for mark in marks])
    inner = np.array([(40 + 60 * c - 0.5, 40 + 60 * r - 0.5) for r in (1, 2, 3) for c in (1, 2, 3, 4)])
    nearest = np.abs(found[:, None] - inner).max(axis=2).min(axis=1)
    assert nearest.max() < 0.002  # single precision would round 1e-5 here, a lost half pixel 0.5


def test_trap_two_blas_threads_a_worker() -> None:
    """The command sets one BLAS thread before numpy is loaded, and the workers inherit it."""
    program = (
        "import os, sys, types\n"
        "from pipeline.main import main\n"
        "def run():\n"
        "    assert 'numpy' not in sys.modules\n"
        "    print(os.environ['OPENBLAS_NUM_THREADS'])\n"
        "sys.modules['pipeline.cli'] = types.SimpleNamespace(run=run)\n"
        "main()\n"
    )
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    text = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert text.stdout.split() == ["1"]

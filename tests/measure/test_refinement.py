"""Marks fitted with another stretch than the film's, against what that is said to move them by."""

import numpy as np
import pytest
from brute_marks import brute_picture

from measure.fitting.matching import MatchOptions, match
from measure.fitting.scan_window import ScanWindow
from measure.frames.refinement import strained_px
from measure.marks.shapes import MarkShape, cross, polygon

WING = MarkShape(polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35))))
START = np.array([[36.0, 0.0, 30.3], [0.0, -36.0, 39.6]])


@pytest.mark.parametrize("mark", [WING, MarkShape(cross(0.5, 0.1))])
def test_a_stretch_moves_what_lies_to_one_side_of_its_centre(mark: MarkShape) -> None:
    true = START.copy()
    true[:, :2] = np.diag([1.003, 0.997]) @ true[:, :2]
    grey = 100.0 + 100.0 * brute_picture(mark, true, 81, 81, 1.0)
    grey += np.random.default_rng(1).normal(0.0, 2.0, grey.shape)
    off = match(ScanWindow(grey), mark, START, MatchOptions(freedom="shift")).center_px - true[:, 2]
    assert strained_px(mark, START[:, :2], true[:, :2]) == pytest.approx(np.hypot(*off), abs=0.025)
    assert (np.hypot(*off) > 0.05) == (mark is WING)
    assert strained_px(mark, 1.02 * true[:, :2], true[:, :2]) == pytest.approx(0.0, abs=1e-12)

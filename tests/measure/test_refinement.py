"""Marks fitted with another stretch than the film's, against what that is said to move them by."""

from dataclasses import replace

import numpy as np
import pytest
from brute_marks import brute_picture

from measure.fiducials.mark_fit import options_for, strain_error_px
from measure.marks.shapes import MarkShape, cross, polygon
from measure.matching.match import MatchOptions, match
from measure.matching.window import ScanWindow

WING = MarkShape(polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35))))
START = np.array([[36.0, 0.0, 30.3], [0.0, -36.0, 39.6]])


@pytest.mark.parametrize("mark", [WING, MarkShape(cross(0.5, 0.1))])
def test_a_stretch_moves_what_lies_to_one_side_of_its_centre(mark: MarkShape) -> None:
    true = START.copy()
    true[:, :2] = np.diag([1.003, 0.997]) @ true[:, :2]
    grey = 100.0 + 100.0 * brute_picture(mark, true, 81, 81, 1.0)
    grey += np.random.default_rng(1).normal(0.0, 2.0, grey.shape)
    off = match(ScanWindow(grey), mark, START, MatchOptions(freedom="shift")).center_px - true[:, 2]
    assert strain_error_px(mark, START[:, :2], true[:, :2], 0.0) == pytest.approx(np.hypot(*off), abs=0.025)
    assert (np.hypot(*off) > 0.05) == (mark is WING)
    assert strain_error_px(mark, 1.02 * true[:, :2], true[:, :2], 0.0) == pytest.approx(0.0, abs=1e-12)


def test_the_flanks_of_a_drawing_that_is_true_in_part_lie_as_the_film_shows_them() -> None:
    """Real notches of one camera are turned by two degrees against one another, however well the frame lies."""
    turn = np.array([[np.cos(0.04), -np.sin(0.04)], [np.sin(0.04), np.cos(0.04)]])
    true = np.column_stack([turn @ START[:, :2], START[:, 2]])
    grey = 100.0 + 100.0 * brute_picture(WING, true, 81, 81, 1.0)
    grey += np.random.default_rng(1).normal(0.0, 2.0, grey.shape)
    in_part = replace(WING, true_mm=((-1.0, -1.0), (0.75, 1.0)))
    off = {}
    for mark in (WING, in_part):
        fit = match(ScanWindow(grey), mark, START, options_for(mark, MatchOptions(), 1e-4))
        error = fit.center_px - true[:, 2]
        off[mark] = float(np.sqrt(error @ np.linalg.solve(fit.covariance_px2, error)))
    assert off[WING] > 10.0
    assert off[in_part] < 3.0

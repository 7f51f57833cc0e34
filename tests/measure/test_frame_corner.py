"""Corners of the exposed frame on pictures drawn pixel by pixel: sharp and rounded, light and dark, beside stamps."""

from pathlib import Path

import numpy as np
import pytest
from brute_marks import written_scan
from drawn import drawn, scan_of, transformed
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import FiducialLayout, LayoutMark, frame_corner
from measure.matching.frame_edge import fit_frame_corner
from measure.results import MarkFit
from measure.tone.curve import Tone, power

Array = NDArray[np.float64]

PX_PER_MM, SIZE, FINE = 20.0, 520, 4
HALF_MM = 10.0
CORNERS = {"1": (10.0, -10.0), "2": (-10.0, -10.0), "3": (-10.0, 10.0), "4": (10.0, 10.0)}
TURN, CENTER = 0.007, (262.3, 257.6)
MATRIX = np.column_stack(
    [
        PX_PER_MM * np.array([[np.cos(TURN), -np.sin(TURN)], [-np.sin(TURN), -np.cos(TURN)]]),
        CENTER,
    ]
)


def picture(seed: int, radius_mm: float = 0.0, neighbour: bool = False, negative: bool = False) -> Array:
    """A landscape in the frame, whose corners may be rounded, on a dark border with a white stamp across one edge."""
    rng = np.random.default_rng(seed)

    def exposed(x: Array, y: Array) -> NDArray[np.bool_]:
        beyond_x, beyond_y = np.abs(x) - HALF_MM + radius_mm, np.abs(y) - HALF_MM + radius_mm
        outside = np.hypot(np.maximum(beyond_x, 0.0), np.maximum(beyond_y, 0.0)) - radius_mm
        return np.asarray(np.where(radius_mm > 0, outside, np.maximum(beyond_x, beyond_y)) < 0.0)

    def inside(col: Array, row: Array) -> Array:
        x, y = transformed(np.linalg.inv(MATRIX[:, :2]), col - CENTER[0], row - CENTER[1])
        return np.asarray(exposed(x, y) | exposed(x - 2 * HALF_MM - 1.2, y) if neighbour else exposed(x, y))

    share = drawn(inside, SIZE, SIZE, 0.0, FINE)
    land = 15000 + 3000 * gaussian_filter(rng.normal(0, 1, (SIZE, SIZE)), 3.0) / 0.09
    grey = 2000 + share * (np.clip(land, 6000, None) - 2000)
    grey = gaussian_filter(grey, 0.8)
    grey[40:75, 140:180] = 40000  # a stamp over the upper edge
    grey += rng.normal(0, 250, grey.shape)
    return np.asarray(60000 - grey if negative else grey)


def layout(radius_mm: float = 0.0) -> FiducialLayout:
    marks = [LayoutMark(id, xy, (0.02, 0.02), frame_corner(xy, 5.0, radius_mm)) for id, xy in CORNERS.items()]
    return FiducialLayout(tuple(marks), (2 * HALF_MM, 2 * HALF_MM))


@parametrize_with_studies(
    ("radius_mm", "neighbour", "negative"), [(0.0, False, True), (1.0, False, False), (0.0, True, False)]
)
def test_corners_of_the_frame_are_where_its_edges_meet(
    tmp_path: Path, radius_mm: float, neighbour: bool, negative: bool
) -> None:
    grey = picture(1, radius_mm, neighbour, negative)
    with written_scan(grey, tmp_path) as scan:
        frame = measure_fiducials(scan, layout(radius_mm), (50.0, 50.0), FiducialOptions(pose="0"))
    scores = []
    for mark in frame.marks:
        true = MATRIX @ (*CORNERS[mark.point], 1.0)
        assert mark.status in (Status.MEASURED, Status.WEAK), mark.reason
        assert mark.center_px is not None
        assert mark.covariance_px2 is not None
        assert np.hypot(*(mark.center_px - true)) < 0.6
        scores += list((mark.center_px - true) / np.sqrt(np.diag(mark.covariance_px2)))
    assert np.sqrt(np.mean(np.square(scores))) < 2.0


def test_no_corner_is_visible_in_a_landscape(tmp_path: Path) -> None:
    land = 15000 + 3000 * gaussian_filter(np.random.default_rng(3).normal(0, 1, (400, 400)), 3.0) / 0.09
    start = np.column_stack([MATRIX[:, :2], (200.0, 200.0)])
    with written_scan(np.asarray(land), tmp_path) as scan:
        corner = frame_corner((-10.0, 10.0), 5.0)
        fit = fit_frame_corner(scan, corner, start, 10.0, 1)
    assert not fit.converged
    assert "edge of the frame" in fit.reason


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_a_corner_moves_with_the_tone_curve_as_its_edges_say(gamma: float) -> None:
    corner = frame_corner((-10.0, 10.0), 5.0)
    start = np.column_stack([MATRIX[:, :2], MATRIX @ (-10.0, 10.0, 1.0)])
    scan = scan_of(65535 * (picture(4) / 65535) ** (1 / gamma))
    tone = Tone(power(gamma), covariance=np.eye(5))

    def fit_mark(tone: Tone) -> MarkFit:
        fit = fit_frame_corner(scan.replace_tone(tone), corner, start, 6.0, 1)
        assert fit.converged
        return fit

    estimate = fit_mark(tone).tone
    assert estimate is not None
    for k in range(2):
        more, less = (fit_mark(tone.replace_departures(way * 0.1 * np.eye(5)[k])).center_px for way in (1, -1))
        np.testing.assert_allclose((more - less) / 0.2, estimate.on_place[:, k], atol=0.1)
    assert np.hypot(*estimate.on_place[:, 0]) > 0.15
    assert estimate.information.sum_of_squares < 25  # of 5 figures, by the true curve
    assert fit_mark(Tone(power(gamma))).tone is None

"""Marks that touch the frame's edge, or dust, which are far stronger than they are: against their drawn places."""

import numpy as np
from brute_marks import brute_picture, placed
from drawn import scan_of
from drawn_frames import layout_of, paint
from scipy.ndimage import gaussian_filter

from measure.detection.correlation import CLOSE
from measure.detection.localisation import MarkPrediction
from measure.fiducials.mark_fit import detect_mark
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import MarkShape, cross, polygon
from measure.matching.models import MatchOptions
from measure.matching.window import pixels_beyond_edge

PX_PER_MM = 30.0
GROUND, EDGE, NOISE = 55000.0, 5000.0, 600.0
WING = MarkShape(polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35))))


def test_a_wing_is_measured_whose_base_is_the_frames_edge() -> None:
    place = placed(PX_PER_MM, (60.3, 59.7))
    grey = GROUND + 5500.0 * brute_picture(WING, place, 121, 121, 1.0)
    grey[:, 84:] = EDGE
    grey += np.random.default_rng(1).normal(0.0, NOISE, grey.shape)
    detection = detect_mark(scan_of(grey), MarkPrediction(WING, place, 4.0, 1, surroundings=CLOSE), MatchOptions())
    assert detection.fit is not None
    assert np.hypot(*(detection.fit.center_px - place[:, 2])) < 0.2


def test_a_faint_light_cross_is_measured_whose_dark_pad_ends_next_to_it_in_a_light_landscape() -> None:
    mark, place = MarkShape(cross(0.5, 0.05, 0.07, 45.0), "light"), placed(PX_PER_MM, (60.3, 59.7))
    rng = np.random.default_rng(4)
    row, col = np.mgrid[:121, :121]
    landscape = 30000.0 + 6000.0 * gaussian_filter(rng.normal(size=(121, 121)), 3.0) * 10.0
    grey = np.where(np.hypot(col - 60.3, row - 59.7) < 20.0, 4000.0, landscape)
    grey += 3500.0 * brute_picture(mark, place, 121, 121, 0.7) + rng.normal(0.0, 900.0, grey.shape)
    detection = detect_mark(scan_of(grey), MarkPrediction(mark, place, 4.0, 1, surroundings=CLOSE), MatchOptions())
    assert detection.fit is not None, detection.reason
    assert np.hypot(*(detection.fit.center_px - place[:, 2])) < 0.3


def test_the_marks_own_ground_is_never_beyond_an_edge() -> None:
    place = placed(PX_PER_MM, (60.3, 59.7))
    mark = brute_picture(WING, place, 121, 121, 1.0)
    for contrast in (30000.0, -30000.0):  # the mark itself is the strongest edge of its window
        grey = 30000.0 + contrast * mark + np.random.default_rng(2).normal(0.0, NOISE, mark.shape)
        assert not pixels_beyond_edge(grey, WING, place).any()


def test_a_cross_that_dust_touches_is_visible_where_the_others_put_it() -> None:
    mark, size, rng = MarkShape(cross(0.5, 0.1)), 440, np.random.default_rng(5)
    corners = [(x, y) for x in (-4.4, 4.4) for y in (-4.4, 4.4)]
    layout, matrix = layout_of([mark] * 4, corners, (11.0, 11.0)), placed(PX_PER_MM, (220.3, 220.3))
    grey = np.full((size, size), GROUND)
    for corner in corners:
        paint(grey, mark, corner, matrix, 6000.0, blur_px=1.0)
    row, col = np.mgrid[:size, :size]
    dusty = matrix @ (*corners[3], 1.0)
    grey[np.hypot(col - dusty[0] + 13, row - dusty[1]) < 5] = EDGE
    grey += rng.normal(0.0, 1200.0, grey.shape)
    result = measure_fiducials(
        scan_of(grey), layout, (1000 / PX_PER_MM,) * 2, FiducialOptions(pose="0", pitch_is_right=True)
    )
    for found, corner in zip(result.marks, corners, strict=True):
        assert found.center_px is not None
        assert found.status.is_observation, found
        assert np.hypot(*(found.center_px - matrix @ (*corner, 1.0))) < 0.3

"""Scans whose pixels are not as given: what is found nevertheless, and what is not believed."""

from pathlib import Path

import numpy as np
from brute_marks import Array, written_scan
from drawn_frames import (
    ALIKE,
    FRAME_PX,
    PITCH_UM,
    assert_right,
    frame_picture,
    measured,
    paint,
    pixel_from_camera,
)
from scipy.ndimage import gaussian_filter

from measure.fiducial_options import FiducialOptions
from measure.fiducials import measure_fiducials

# A frame of 20 mm with a hundredth of the usual tolerances bends as little as one of 200 mm.
STIFF = FiducialOptions(pose="0", misfit_mm=0.03, affinity=1e-4, gate_mm=0.03)


def test_pixels_longer_one_way_are_found_out(tmp_path: Path) -> None:
    matrix = pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.012, 0.988]) @ matrix[:, :2]
    result = measured(frame_picture(ALIKE, matrix), ALIKE, tmp_path, STIFF)
    assert_right(result, ALIKE, matrix)
    assert any("film is never stretched so much" in problem for problem in result.problems)


def test_pixels_given_as_longer_one_way_need_no_look(tmp_path: Path) -> None:
    matrix = pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.012, 0.988]) @ matrix[:, :2]
    with written_scan(frame_picture(ALIKE, matrix), tmp_path) as scan:
        result = measure_fiducials(scan, ALIKE, (PITCH_UM / 1.012, PITCH_UM / 0.988), STIFF)
    assert_right(result, ALIKE, matrix)
    assert not any("film is never stretched so much" in problem for problem in result.problems)


def test_three_of_many_marks_that_lie_as_the_cameras_are_no_frame(tmp_path: Path) -> None:
    """With pixels longer one way three of sixty strewn marks fit, which is no wonder; three of three are a frame."""
    matrix = pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.012, 0.988]) @ matrix[:, :2]
    alone = ground_with_three(matrix)
    result = measured(alone, ALIKE, tmp_path, STIFF)
    assert [mark.status.is_observation for mark in result.marks] == [True, True, True, False]
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-11.5, 11.5, (60, 2)).tolist():
        paint(alone, ALIKE.marks[0].mark, (x, y), matrix, 9000.0)
    result = measured(alone, ALIKE, tmp_path, STIFF)
    assert not any(mark.status.is_observation for mark in result.marks)


def ground_with_three(matrix: Array) -> Array:
    rng = np.random.default_rng(5)
    grey = 8000 + 1000 * gaussian_filter(rng.normal(0, 1, (FRAME_PX, FRAME_PX)), 2.0) / 0.14
    for mark in ALIKE.marks[:3]:
        paint(grey, mark.mark, mark.xy_mm, matrix, 9000.0)
    return np.asarray(grey + rng.normal(0, 100.0, grey.shape))

"""Marks that a person points at: three of them find the frame in any pose, and one that nothing looks like stays."""

from pathlib import Path

import numpy as np
import pytest
from brute_marks import Array
from drawn_frames import (
    ALIKE,
    CORNERS,
    NOISE_DN,
    RING_CROSS,
    assert_right,
    frame_picture,
    layout_of,
    measured,
    pixel_from_camera,
)

from measure.fiducials.options import CLICK_SIGMA_PX, Click, FiducialOptions
from measure.flags import Cause, Status
from measure.geometry import POSES
from measure.marks.shapes import MarkShape
from measure.results import FrameMeasurement, MarkMeasurement

FAR_TURN_RAD = 0.35  # twenty degrees: no search looks for a frame that is laid so


def make_clicks(matrix: Array, points: str, off_px: tuple[float, float] = (1.2, -0.9)) -> tuple[Click, ...]:
    """As a person clicks, a pixel or so off."""
    return tuple(Click(point, *(matrix @ (*CORNERS[int(point) - 1], 1.0) + off_px)) for point in points)


@pytest.mark.parametrize("pose", POSES)
def test_three_clicks_find_a_frame_in_any_pose_that_no_search_finds(pose: str, tmp_path: Path) -> None:
    matrix = pixel_from_camera(pose, FAR_TURN_RAD)
    grey = frame_picture(ALIKE, matrix)
    result = measured(grey, ALIKE, tmp_path, FiducialOptions(clicks=make_clicks(matrix, "124")))
    assert result.pose is not None
    assert (result.pose.name, result.pose.decided) == (pose, True)
    assert_right(result, ALIKE, matrix)


@pytest.mark.study
def test_no_search_finds_a_frame_that_lies_so(tmp_path: Path) -> None:
    grey = frame_picture(ALIKE, pixel_from_camera("0", FAR_TURN_RAD))
    assert not any(mark.status.is_observation for mark in measured(grey, ALIKE, tmp_path).marks)


def test_clicks_that_contradict_the_set_pose_give_no_observation(tmp_path: Path) -> None:
    """As in a viewer that turns the picture: the names would be those of other marks."""
    matrix = pixel_from_camera("180")
    grey = frame_picture(ALIKE, matrix)
    result = measured(grey, ALIKE, tmp_path, FiducialOptions("0", clicks=make_clicks(matrix, "124")))
    assert {mark.status for mark in result.marks} == {Status.REJECTED}
    assert "show the scan orientation 180, and 0 is set" in result.problems[0]
    assert_right(
        measured(grey, ALIKE, tmp_path, FiducialOptions("180", clicks=make_clicks(matrix, "124"))), ALIKE, matrix
    )


def test_clicks_tell_the_pitch_where_nothing_else_does(tmp_path: Path) -> None:
    matrix = pixel_from_camera("0", FAR_TURN_RAD)
    options = FiducialOptions(clicks=make_clicks(matrix, "123"))
    result = measured(frame_picture(ALIKE, matrix), ALIKE, tmp_path, options, pitch=False)
    assert result.px_per_mm == pytest.approx(20.0, rel=1e-3)
    assert_right(result, ALIKE, matrix)


def test_marks_on_a_line_do_not_tell_the_pose(tmp_path: Path) -> None:
    places = (*CORNERS, (0.0, 0.0))
    layout = layout_of([MarkShape(RING_CROSS)] * 5, places)
    matrix = pixel_from_camera("0")
    clicks = tuple(Click(str(k), *(matrix @ (*places[k - 1], 1.0))) for k in (1, 3, 5))
    result = measured(frame_picture(layout, matrix), layout, tmp_path, FiducialOptions(clicks=clicks))
    assert result.pose is not None
    assert not result.pose.decided


@pytest.mark.study
def test_a_click_where_nothing_is_matched_counts_as_well_as_one_points(tmp_path: Path) -> None:
    """The mark's corner is bare ground: with the others' frame alone it would only be predicted."""
    matrix = pixel_from_camera("0")
    result = bare_corner(matrix, tmp_path, ())
    assert row(result, "3").status is Status.PREDICTED
    (click,) = make_clicks(matrix, "3", (0.0, 0.0))
    mark = row(bare_corner(matrix, tmp_path, (click,)), "3")
    assert mark.status is Status.WEAK
    assert mark.center_px is not None
    np.testing.assert_array_equal(mark.center_px, (click.col_px, click.row_px))
    assert mark.covariance is not None
    np.testing.assert_array_equal(mark.covariance.parts[Cause.CLICK], CLICK_SIGMA_PX**2 * np.eye(2))


def test_a_click_says_which_of_two_marks_is_meant(tmp_path: Path) -> None:
    """A mark as good as any lies a millimetre and a half from where the others put it."""
    matrix = pixel_from_camera("0")
    grey = frame_picture(ALIKE, matrix)
    meant = matrix.copy()
    meant[:, 2] += (30.0, 0.0)
    grey_neighbour = frame_picture(ALIKE, meant)
    col, line = np.rint(meant @ (*CORNERS[3], 1.0)).astype(int)
    grey[line - 25 : line + 26, col - 10 : col + 26] = grey_neighbour[line - 25 : line + 26, col - 10 : col + 26]
    click = Click("4", *(meant @ (*CORNERS[3], 1.0)))
    mark = row(measured(grey, ALIKE, tmp_path, FiducialOptions(clicks=(click,))), "4")
    assert mark.center_px is not None
    assert mark.status.is_observation, mark.reason
    np.testing.assert_allclose(mark.center_px, (click.col_px, click.row_px), atol=0.1)


def bare_corner(matrix: Array, folder: Path, clicks: tuple[Click, ...]) -> FrameMeasurement:
    grey = frame_picture(ALIKE, matrix)
    col, line = np.rint(matrix @ (*CORNERS[2], 1.0)).astype(int)
    rng = np.random.default_rng(4)
    grey[line - 40 : line + 41, col - 40 : col + 41] = 3000 + rng.normal(0, NOISE_DN, (81, 81))
    return measured(grey, ALIKE, folder, FiducialOptions(clicks=clicks))


def row(result: FrameMeasurement, point: str) -> MarkMeasurement:
    return next(mark for mark in result.marks if mark.point == point)

"""Boards drawn from their specification, and boards photographed by others with a calibration that was published."""

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import cv2
import drawn as draw
import numpy as np
import pytest
from numpy.typing import NDArray
from real_data import DATA, needs
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import Status, open_scan
from measure.boards import find, specs
from measure.boards.corner_fit import edge_curvatures
from measure.boards.find import has_squares, is_even, recognise_board, whole_pattern
from measure.boards.lattice import grid_of_any_count
from measure.boards.markers import (
    MarkerReadings,
    ReadMarkers,
    charuco_board,
    find_aruco,
    find_charuco,
    off_corners,
    placed_markers,
)
from measure.boards.measure import BoardMeasurement, measure_board, one_definition
from measure.flags import Cause, Code
from measure.results import Covariance, MarkMeasurement
from measure.scans.opening import crop_scan

Array = NDArray[np.float64]
CHESSBOARD = specs.ChessboardSpec(6, 5, 24.0)
SMALL_DOTS = specs.CircleGridSpec(6, 5, 28.0, 13.0)
SMALL_SQUARES = specs.SquareGridSpec(6, 5, 16.0, 12.0)
STAGGERED = specs.CircleGridSpec(8, 6, 20.0, 13.0, asymmetric=True)


@pytest.fixture(autouse=True)
def few_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boards of other counts are tried as far as any board here goes: each count takes as long as a whole reading."""
    monkeypatch.setattr("measure.boards.markers._MOST_COLUMNS", 8)


def measure_picture(spec: specs.BoardSpec, dark: Any, homography: Array) -> tuple[BoardMeasurement, Array]:
    """And the errors of what is measured."""
    board = measure_board(draw.make_scan(draw.take_picture(spec, homography, dark)), spec)
    return board, draw.errors_px(board, draw.read_truth(spec, homography))


@pytest.mark.parametrize(
    "turn_deg", [*(pytest.param(turn, marks=pytest.mark.study) for turn in (4.0, 100.0, 275.0)), 187.0]
)
def test_a_chessboard_in_any_direction_keeps_its_names(turn_deg: float) -> None:
    board, errors = measure_picture(CHESSBOARD, draw.chessboard_dark(CHESSBOARD), draw.board_from_pixel(turn_deg))
    assert board.reason == ""
    assert all(mark.status is Status.MEASURED for mark in board.marks)
    assert len(errors) == 30
    assert np.sqrt(np.mean(errors**2)) < 0.012
    assert np.abs(errors.mean(axis=0)).max() < 0.006


def test_trap_half_a_pixel_lost_in_a_search_at_a_reduced_size() -> None:
    homography = draw.board_from_pixel(3.0)
    picture = draw.take_picture(CHESSBOARD, homography, draw.chessboard_dark(CHESSBOARD))
    large = np.pad(np.kron(picture, np.ones((4, 4))), ((0, 0), (0, 1100)), constant_values=38000.0)
    board = measure_board(draw.make_scan(large), CHESSBOARD)
    truth = {name: 4 * place + 1.5 for name, place in draw.read_truth(CHESSBOARD, homography).items()}
    assert np.abs(draw.errors_px(board, truth).mean(axis=0)).max() < 0.04


def test_a_board_that_a_half_turn_does_not_change_is_taken_as_upright_and_says_so() -> None:
    spec = specs.ChessboardSpec(6, 4, 24.0)
    board, errors = measure_picture(spec, draw.chessboard_dark(spec), draw.board_from_pixel(10.0))
    assert "looks the same after a half turn" in board.notes[0]
    assert np.abs(errors).max() < 0.05


@pytest.mark.parametrize(
    ("spec", "dark"),
    [
        (specs.CircleGridSpec(6, 5, 30.0, 14.0), draw.circles_dark),
        (specs.SquareGridSpec(5, 4, 20.0, 16.0), draw.squares_dark),
    ],
)
def test_a_reflection_that_clips_the_light_side_of_edges_moves_no_point(spec: specs.BoardSpec, dark: Any) -> None:
    """Dark parts are lighter there as well, and fits of clipped values as of ordinary ones lay up to 1 px off."""
    homography = draw.board_from_pixel(tilt=5e-5)
    col, row = np.meshgrid(np.arange(draw.WIDTH), np.arange(draw.HEIGHT))
    glare = 45000 * np.exp(-((col - draw.WIDTH / 2) ** 2 + (row - draw.HEIGHT / 2) ** 2) / (2 * 30.0**2))
    board = measure_board(draw.make_scan(draw.take_picture(spec, homography, dark(spec)) + glare), spec)
    errors = draw.errors_px(board, draw.read_truth(spec, homography))
    assert len(errors) >= 0.9 * len(spec.object_points())
    assert np.abs(errors).max() < 0.13


@parametrize_with_studies("gamma", [2.2, 1.0])
def test_a_tone_curve_moves_no_corner_of_separate_squares(gamma: float) -> None:
    """It shifts all edges by the same share of their blur, which the distances between squares show."""
    spec, homography = specs.SquareGridSpec(5, 4, 20.0, 16.0), draw.board_from_pixel(tilt=5e-5)
    light = draw.take_picture(spec, homography, draw.squares_dark(spec)) / 65535
    board = measure_board(draw.make_scan(65535 * np.maximum(light, 0.0) ** (1 / gamma)), spec)
    errors = draw.errors_px(board, draw.read_truth(spec, homography))
    assert len(errors) == len(spec.object_points())
    assert np.sqrt(np.mean(errors**2)) < 0.03
    claims = [mark.covariance.sigmas_px for mark in board.marks if mark.covariance is not None]
    assert all(0.0 < each[Cause.TONE] < 0.02 for each in claims)


@parametrize_with_studies(("left_px", "cut"), [(10, 2), (-3, 1)])
def test_dots_that_the_edge_of_the_picture_cuts_are_not_measured(left_px: int, cut: int) -> None:
    """left_px: edge beside the centre of the first dot, whose radius is 7 px."""
    spec, homography = specs.CircleGridSpec(6, 5, 30.0, 14.0), draw.board_from_pixel(20.0, tilt=5e-5)
    truth = draw.read_truth(spec, homography)
    left = round(truth["r0c0"][0]) + left_px
    board = measure_board(draw.make_scan(draw.take_picture(spec, homography, draw.circles_dark(spec))[:, left:]), spec)
    outside = [mark for mark in board.marks if mark.reason.codes == (Code.OUTSIDE,)]
    assert [(mark.point, mark.status) for mark in outside] == [(f"r{row}c0", Status.ABSENT) for row in range(cut)]
    errors = draw.errors_px(board, {name: place - [left, 0] for name, place in truth.items()})
    assert len(errors) == 30 - cut
    assert np.abs(errors).max() < 0.06


def test_dots_of_another_width_than_given_are_named() -> None:
    """As where the spacing is the distance of the columns of one row, twice that of an asymmetric grid."""
    spec = specs.CircleGridSpec(8, 6, 20.0, 15.0, asymmetric=True)
    picture = draw.make_scan(draw.take_picture(spec, draw.board_from_pixel(tilt=5e-5), draw.circles_dark(spec)))
    twice = measure_board(picture, replace(spec, spacing_mm=40.0))
    assert not twice.reason
    assert "dots are 30 mm wide at a spacing of 40 mm, but 15 mm are given" in twice.contradiction
    assert not measure_board(picture, replace(spec, diameter_mm=13.5)).contradiction


@parametrize_with_studies("is_mirrored", [True, False])
def test_an_asymmetric_grid_in_a_mirror_keeps_its_names(is_mirrored: bool) -> None:
    spec, homography = specs.CircleGridSpec(8, 6, 20.0, 15.0, asymmetric=True), draw.board_from_pixel(tilt=5e-5)
    picture, truth = draw.take_picture(spec, homography, draw.circles_dark(spec)), draw.read_truth(spec, homography)
    if is_mirrored:
        picture = picture[:, ::-1]
        truth = {name: np.array([picture.shape[1] - 1, 0]) + place * (-1, 1) for name, place in truth.items()}
    board = measure_board(draw.make_scan(picture), spec)
    assert (board.reason, board.is_mirrored) == ("", is_mirrored)
    errors = draw.errors_px(board, truth)
    half_turned = dict(zip(truth, reversed(truth.values()), strict=True))
    assert min(np.abs(errors).max(), np.abs(draw.errors_px(board, half_turned)).max()) < 0.06


@parametrize_with_studies(
    ("columns", "rows", "words"),
    [
        (5, 5, "one of 6 x 5 is. Correct the count"),
        (6, 4, "one of 6 x 5 is. Correct the count"),
        (4, 3, "one of 6 x 5 is. Correct the count"),
        (7, 5, "one of 6 x 5 is. Correct the count"),
        (7, 6, "one of 6 x 5 is: squares may have been counted"),
    ],
    quick=(2,),
)
def test_a_chessboard_of_another_count_is_refused_with_its_own(columns: int, rows: int, words: str) -> None:
    picture = draw.take_picture(CHESSBOARD, draw.board_from_pixel(8.0, 6e-4), draw.chessboard_dark(CHESSBOARD))
    board = measure_board(draw.make_scan(picture), specs.ChessboardSpec(columns, rows, 24.0))
    assert words in board.reason
    assert {mark.status for mark in board.marks} == {Status.ABSENT}


@pytest.mark.parametrize("kind", ["chessboard", "aprilgrid"])
def test_edges_that_a_lens_bends_move_no_corner(kind: str) -> None:
    """Barrel distortion of 15 % at the outer corners: straight edges would move them 0.01 to 0.02 px inwards."""
    is_chessboard = kind == "chessboard"
    spec = CHESSBOARD if is_chessboard else APRIL_GRID
    straight = draw.chessboard_dark(CHESSBOARD) if is_chessboard else draw.april_grid_dark(APRIL_GRID)
    homography, flat = draw.board_from_pixel(5.0, 0.0), np.array([place[:2] for place in spec.object_points().values()])
    middle = flat.mean(axis=0)
    k1 = 0.15 / np.sum((flat - middle) ** 2, axis=1).max()

    def dark(x: Array, y: Array) -> Any:
        wider = 1 + k1 * ((x - middle[0]) ** 2 + (y - middle[1]) ** 2)
        return straight(middle[0] + wider * (x - middle[0]), middle[1] + wider * (y - middle[1]))

    bent = flat - middle
    for _ in range(50):
        bent = (flat - middle) / (1 + k1 * (bent**2).sum(axis=1, keepdims=True))
    pixel_from_board = np.asarray(np.linalg.inv(homography), float)
    truth = dict(zip(spec.object_points(), draw.mapped(pixel_from_board, bent), strict=True))
    board = measure_board(draw.make_scan(draw.take_picture(spec, homography, dark)), spec)
    errors = draw.errors_px(board, truth)
    assert len(errors) == len(flat)
    away = list(truth.values()) - draw.mapped(pixel_from_board, np.zeros((1, 2)))
    outward = np.sum(errors * away, axis=1) / np.hypot(*away.T)
    assert abs(outward.mean()) < 0.004
    assert np.sqrt(np.mean(errors**2)) < 0.012


@pytest.mark.parametrize("edge", [0, 1])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_single_row_of_corners_shows_the_curvature_of_one_edge(axis: int, edge: int) -> None:
    place = np.arange(-3.0, 4.0)
    centers = np.stack([20.0 * place, 0.001 / 2 * (20.0 * place) ** 2], axis=1)
    board = np.zeros((7, 2))
    board[:, axis] = place
    normals = np.zeros((7, 2, 2))
    normals[:, edge] = (0.0, 1.0)
    normals[:, 1 - edge] = (1.0, 0.0)
    curvatures = edge_curvatures(centers, board, normals)
    np.testing.assert_allclose(curvatures[3, edge], 0.001, rtol=1e-6)
    np.testing.assert_array_equal(curvatures[:, 1 - edge], 0.0)


LARGE = specs.ChessboardSpec(9, 6, 24.0)


@pytest.fixture(scope="module")
def large_board() -> tuple[Array, dict[str, Array]]:
    homography = draw.board_from_pixel(8.0, 3e-4)
    return draw.take_picture(LARGE, homography, draw.chessboard_dark(LARGE)), draw.read_truth(LARGE, homography)


@parametrize_with_studies(
    ("shown", "count"),
    [(np.s_[:, 60:], 51), (np.s_[:, :250], 48), (np.s_[:190, :], 45), (np.s_[80:, 70:], 40), (np.s_[:180, :240], 39)],
    quick=(3,),
)
def test_a_part_is_named_as_the_whole(large_board: tuple[Array, dict[str, Array]], shown: Any, count: int) -> None:
    """Its light border is seen on two sides or more; the colours tell which end is which."""
    picture, truth = large_board
    board = measure_board(draw.make_scan(picture[shown]), LARGE)
    errors = draw.errors_px(
        board, {id: place - [shown[1].start or 0, shown[0].start or 0] for id, place in truth.items()}
    )
    assert len(errors) == count
    assert np.abs(errors).max() < 0.03
    hidden = {str(mark.reason) for mark in board.marks if not mark.status.is_observation}
    assert "covered, or outside of the picture" in hidden


def test_corners_at_the_edges_of_shadows_are_not_measured(large_board: tuple[Array, dict[str, Array]]) -> None:
    """Bars' shadows, as wide as half a square, over a third of the board."""
    picture, truth = large_board[0].copy(), large_board[1]
    row, col = np.indices(picture.shape, float)
    across = 0.8 * col + 0.6 * row
    shade = 0.5 + 0.5 * np.tanh(4.0 * np.sin(2 * np.pi * across / 24.0))
    board = measure_board(draw.make_scan(picture * np.where(col < 130, 1 - 0.6 * shade, 1.0)), LARGE)
    found = {mark.point: mark.center_px for mark in board.marks if mark.center_px is not None}
    off = {point: float(np.hypot(*(center_px - truth[point]))) for point, center_px in found.items()}
    measured = {mark.point for mark in board.marks if mark.status is Status.MEASURED}
    shaded = {point for point, (column, _) in truth.items() if column < 120}
    assert max(off[point] for point in shaded & off.keys()) > 0.3
    assert {point for point, (column, _) in truth.items() if column > 140} <= measured
    assert max(off[point] for point in measured) < 0.2
    assert any("a shadow" in mark.reason for mark in board.marks)


def test_strong_sharpening_makes_no_corner_weak(large_board: tuple[Array, dict[str, Array]]) -> None:
    """As much is left unexplained as by a shadow, but alike on both sides."""
    picture, truth = large_board
    board = measure_board(draw.make_scan(picture + 3.0 * (picture - gaussian_filter(picture, 1.5)) + 20000.0), LARGE)
    assert all(mark.status is Status.MEASURED for mark in board.marks)
    assert np.abs(draw.errors_px(board, truth)).max() < 0.1


def test_a_faint_board_on_a_warm_sheet_is_found(large_board: tuple[Array, dict[str, Array]]) -> None:
    """As a thermal camera sees one: its squares differ by 8 %, the sheet by ten times as much."""
    picture, truth = large_board
    row, col = np.indices(picture.shape, float)
    warm = np.exp(-(((col - 150.0) / 110.0) ** 2) - ((row - 130.0) / 110.0) ** 2)
    light = np.clip((picture - 8000.0) / 30000.0, 0.0, 1.0)
    board = measure_board(draw.make_scan(2000.0 + 50000.0 * (0.1 + warm) * (0.92 + 0.08 * light)), LARGE)
    assert sum(mark.status.is_observation for mark in board.marks) > 45
    assert np.abs(draw.errors_px(board, truth)).max() < 0.25


def test_a_board_of_another_count_is_not_searched_at_full_size(
    large_board: tuple[Array, dict[str, Array]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures of 12 megapixels took 13 s each where the count was wrong."""
    factors, search = list[int](), find._find_reduced

    def counted(*given: Any) -> Any:
        factors.append(given[2])
        return search(*given)

    monkeypatch.setattr(find, "_FIRST_SIZE_PX", draw.WIDTH)
    monkeypatch.setattr(find, "_find_reduced", counted)
    enlarged = large_board[0].repeat(2, axis=0).repeat(2, axis=1)
    reason = measure_board(draw.make_scan(enlarged), replace(LARGE, columns=8)).reason
    assert "one of 9 x 6 is. Correct the count" in reason
    assert factors == [2]


def test_the_clip_of_a_clipboard_is_no_further_column(large_board: tuple[Array, dict[str, Array]]) -> None:
    """It looks like three of six corners, and the board had been refused as one of 10 x 6."""
    square, longer = draw.chessboard_dark(LARGE), draw.chessboard_dark(replace(LARGE, columns=10))

    def dark(x: Array, y: Array) -> Array:
        return np.asarray(square(x, y) | (longer(x, y) & (np.abs(x - 223.0) < 5.0) & (np.abs(y - 60.0) < 36.0)))

    board = measure_board(draw.make_scan(draw.take_picture(LARGE, draw.board_from_pixel(8.0, 3e-4), dark)), LARGE)
    assert not board.reason
    assert np.abs(draw.errors_px(board, large_board[1])).max() < 0.05


@parametrize_with_studies("shown", [np.s_[80:, 150:], np.s_[:, 60:250], np.s_[80:, 60:250]])
def test_a_part_that_may_be_another_is_refused(large_board: tuple[Array, dict[str, Array]], shown: Any) -> None:
    """Of one corner's border with fewer squares than tell the longer side; and without an end of the longer side."""
    board = measure_board(draw.make_scan(large_board[0][shown]), LARGE)
    assert not any(mark.status.is_observation for mark in board.marks)
    assert "nothing shows which part it is" in board.reason


def test_all_corners_without_a_light_border_are_a_whole_board(
    large_board: tuple[Array, dict[str, Array]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a board with a narrow border, or in a fisheye, OpenCV finds a part; the pattern grows to the board's count."""
    picture, truth = large_board[0].copy(), large_board[1]
    corners = np.array(list(truth.values())).reshape(6, 9, 2)
    outline = np.concatenate([corners[0, :1], corners[0, -1:], corners[-1, -1:], corners[-1, :1]])
    inside = cv2.fillConvexPoly(np.zeros(picture.shape, np.uint8), np.round(outline).astype(np.int32), 1)
    inside = cv2.dilate(inside, np.ones((17, 17), np.uint8))
    picture[inside == 0] = picture.min()
    monkeypatch.setattr(find, "_grids", lambda *_: iter([(corners[1:5, 1:6], np.inf)]))
    board = measure_board(draw.make_scan(picture), LARGE)
    assert sum(mark.status.is_observation for mark in board.marks) > 50
    assert np.abs(draw.errors_px(board, truth)).max() < 0.05


def test_a_board_with_corners_outside_is_refused_in_fitting_words(large_board: tuple[Array, dict[str, Array]]) -> None:
    board = measure_board(draw.make_scan(large_board[0][:195, 52:256]), LARGE)
    assert not any(mark.status.is_observation for mark in board.marks)
    assert "9 x 6 inner corners is whole in the scan: some of its corners, or of the light border" in board.reason


def test_an_oblique_board_is_found_where_its_light_falls_off() -> None:
    """Seen at 67 degrees; the light grows seven times from the top to the bottom of the picture."""
    tilt, turn = (cv2.Rodrigues(np.deg2rad(axis))[0] for axis in ([49.0, -45.7, 0.0], [0.0, 0.0, 87.0]))
    camera = np.array([[390.0, 0, draw.WIDTH / 2], [0, 390.0, draw.HEIGHT / 2], [0, 0, 1]])
    homography = np.linalg.inv(
        camera @ np.column_stack([(tilt @ turn)[:, :2], [0, 0, 264.0]]) @ np.diag([1.0, -1.0, 1.0])
    )
    picture = draw.take_picture(CHESSBOARD, homography, draw.chessboard_dark(CHESSBOARD))
    lit = picture * np.exp(np.linspace(-2.0, 0.0, draw.HEIGHT))[:, None]
    board = measure_board(draw.make_scan(lit), CHESSBOARD)
    errors = draw.errors_px(board, draw.read_truth(CHESSBOARD, homography))
    assert len(errors) == 30
    assert np.abs(errors).max() < 0.2


@pytest.mark.parametrize("left_out", [None, 0, 1, 3])
def test_lines_of_a_board_are_evenly_spaced_under_one_homography(left_out: int | None) -> None:
    """Of a lens with 6 % of distortion at the corner, seen at an angle; one line left out shows, wherever it is."""
    column, row = np.meshgrid(np.arange(9.0), np.arange(7.0))
    x, y = draw.mapped(
        np.array([[60, 4, 60], [-3, 58, 50], [0.02, 0.03, 1]]), np.stack([column, row], -1).reshape(-1, 2)
    ).T
    about = np.stack([x - 320, y - 240], axis=-1)
    grid = np.array([320, 240]) + about * (1 - 0.06 * (about**2).sum(axis=1, keepdims=True) / 400**2)
    grid = grid.reshape(7, 9, 2)
    grid[0, 0] += 20.0  # as detectors put single corners, which the fit finds, or not
    if left_out is not None:
        grid = np.delete(grid, 1 + left_out, axis=0)
    assert is_even(grid, (640, 480)) == (left_out is None)


@pytest.mark.parametrize("left_out", [None, 1, 3])
@pytest.mark.parametrize("off_axis_deg", [50.0, 80.0])
def test_lines_of_a_board_are_evenly_spaced_in_a_fisheye(off_axis_deg: float, left_out: int | None) -> None:
    """Equidistant, r = f theta, of a board that reaches to 89 and to 119 degrees from the axis."""
    column, row = np.meshgrid(np.arange(9.0) - 4.0, np.arange(7.0) - 3.0)
    angle = np.deg2rad(off_axis_deg)
    x, y, z = 5.0 * np.sin(angle) + column * np.cos(angle), row, 5.0 * np.cos(angle) - column * np.sin(angle)
    away = np.arctan2(np.hypot(x, y), z) / np.hypot(x, y)
    grid = np.stack([400.0 + 200.0 * away * x, 400.0 + 200.0 * away * y], axis=-1)
    if left_out is not None:
        grid = np.delete(grid, 1 + left_out, axis=0)
        assert not is_even(grid, (801, 801))
    assert is_even(grid, (801, 801), farthest=0.1) == (left_out is None)


def test_a_pattern_grows_to_where_it_ends() -> None:
    """From a part of its lines; a line along its border is none of it, and one that the picture cuts is no end."""
    homography = draw.board_from_pixel(5.0, 4e-4)
    picture = (draw.take_picture(CHESSBOARD, homography, draw.chessboard_dark(CHESSBOARD)) / 256).astype(np.uint8)
    grid = np.array(list(draw.read_truth(CHESSBOARD, homography).values())).reshape(5, 6, 2)
    part = whole_pattern(picture, grid[1:4, :4])
    assert part is not None
    assert part.grid.shape == grid.shape
    assert part.is_bounded
    assert np.abs(part.grid - grid).max() < 0.5
    border = np.concatenate([3 * grid[:1] - 3 * grid[1:2] + grid[2:3], grid])
    assert whole_pattern(picture, border) is None
    cut = whole_pattern(picture[: int(grid[3, :, 1].min())], grid[:3])
    assert cut is not None
    assert not cut.is_bounded


@parametrize_with_studies(("turn_deg", "gap_mm"), [(-25.0, 18.0), (7.0, 9.0)], quick=(1,))
def test_corners_of_separate_squares(turn_deg: float, gap_mm: float) -> None:
    """Named by row, column and corner, to some hundredths of a pixel, their standard deviations honest."""
    spec = specs.SquareGridSpec(5, 4, 45.0 - gap_mm, gap_mm)
    board, errors = measure_picture(spec, draw.squares_dark(spec), draw.board_from_pixel(turn_deg, 2e-4))
    assert board.notes == ("the grid looks the same when turned: it was taken as upright in the scan",)
    assert len(errors) >= 78
    assert np.sqrt(np.mean(errors**2)) < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.006
    known = [mark.covariance for mark in board.marks if mark.covariance is not None]
    squares = [e @ np.linalg.solve(c.px2, e) for e, c in zip(errors, known, strict=True)]
    assert 0.6 < np.mean(squares) / 2.0 < 1.6


@parametrize_with_studies(
    ("spec", "dark", "words"),
    [
        (CHESSBOARD, draw.chessboard_dark(CHESSBOARD), "3 boards of 6 x 5 inner corners"),
        (SMALL_DOTS, draw.circles_dark(SMALL_DOTS), "3 grids of 6 x 5 dots"),
        (SMALL_SQUARES, draw.squares_dark(SMALL_SQUARES), "3 boards of 6 x 5 squares"),
        (STAGGERED, draw.circles_dark(STAGGERED), "3 grids of 24 dots in 6 rows"),
    ],
)
def test_of_boards_that_are_alike_none_is_observed(spec: specs.BoardSpec, dark: Any, words: str) -> None:
    """Neither by their size, for nobody knows how far away they are; the reason says how many, and where."""
    one = measure_board(draw.make_scan(draw.tile_boards(spec, dark, (1.0,))), spec)
    assert not one.ambiguous
    assert all(mark.status is Status.MEASURED for mark in one.marks)
    picture = draw.tile_boards(spec, dark, (1.0, 0.9, 1.0))
    file = draw.make_scan(np.pad(picture, ((0, 0), (1000, 0)), mode="edge"))
    three = measure_board(crop_scan(file, (1000, 0, picture.shape[1], len(picture))), spec)
    assert words in three.ambiguous
    places = [float(place) - 1000 for place in re.findall(r"\((\d+), \d+\)", three.ambiguous)]  # of the file
    width = np.ptp([point[:2] for point in spec.object_points().values()], axis=0)[0] + 60.0
    assert sorted(int(place // width) for place in places) == [0, 1, 2]
    assert {mark.status for mark in three.marks} == {Status.REJECTED}
    assert {mark.reason for mark in three.marks} == {three.ambiguous}


def test_a_board_of_less_than_half_the_size_is_another_one() -> None:
    """The larger one is found in a picture of 640 px, in which the squares of the other are 8 px large."""
    squares, rng = np.indices((7, 10)).sum(axis=0) % 2, np.random.default_rng(4)
    picture = np.full((700, 1300), 120.0)
    for side, left, top in ((70, 60, 40), (16, 960, 300)):
        dark = np.pad(np.kron(squares, np.ones((side, side))), side, constant_values=1)
        picture[top : top + dark.shape[0], left : left + dark.shape[1]] = 25 + 200 * dark
    blurred = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), float) + rng.normal(0, 2, picture.shape)
    board = measure_board(draw.make_scan(blurred, 255), specs.ChessboardSpec(9, 6, 30.0))
    assert "2 boards of 9 x 6 inner corners" in board.ambiguous
    assert {mark.status for mark in board.marks} == {Status.REJECTED}


def test_a_circle_grid_is_no_part_of_a_larger_one() -> None:
    larger = specs.CircleGridSpec(7, 5, 28.0, 13.0)
    board = measure_board(draw.make_scan(draw.tile_boards(larger, draw.circles_dark(larger), (1.0,))), SMALL_DOTS)
    assert "no grid of 6 x 5 dots is whole in the scan; one of 7 x 5 dots is. Correct the count" in board.reason
    assert {mark.status for mark in board.marks} == {Status.ABSENT}


@parametrize_with_studies(("columns", "rows"), [(8, 10), (8, 9), (7, 11), (6, 10), (8, 12), (10, 11)], quick=(0, 4))
def test_an_asymmetric_grid_of_another_count_is_refused_with_its_own(columns: int, rows: int) -> None:
    """8 x 10 places of 8 x 11 hold a grid in one way only: a row of dots had been left out unnoticed."""
    grid = specs.CircleGridSpec(8, 11, 14.0, 9.0, asymmetric=True)
    picture = draw.take_picture(grid, draw.board_from_pixel(4.0, 2e-4), draw.circles_dark(grid))
    board = measure_board(draw.make_scan(picture), replace(grid, columns=columns, rows=rows))
    assert "one of 44 dots in 11 rows of 4 is. Correct the count" in board.reason
    assert ("or show the whole grid" in board.reason) == (columns * rows > 88)
    assert {mark.status for mark in board.marks} == {Status.ABSENT}


def test_dots_are_no_squares_of_a_chessboard() -> None:
    """Halfway between 44 staggered dots lie 70 places about which light and dark alternate: they had been corners."""
    grid = specs.CircleGridSpec(8, 11, 14.0, 13.0, asymmetric=True)
    picture = draw.take_picture(grid, draw.board_from_pixel(8.0, 2e-4), draw.circles_dark(grid))
    board = measure_board(draw.make_scan(picture), specs.ChessboardSpec(7, 10, 14.0))
    assert {mark.status for mark in board.marks} == {Status.ABSENT}


def test_a_few_spots_are_no_circle_grid() -> None:
    """Four of them make no lattice at all."""
    places = np.array([(40.0, 50.0), (90.0, 52.0), (150.0, 140.0), (260.0, 200.0), (300.0, 90.0)])

    def light(col: Array, row: Array) -> Array:
        return np.asarray(np.min([np.hypot(col - x, row - y) for x, y in places], axis=0) > 8.0, float)

    scan = draw.make_scan(8000 + 30000 * draw.draw(light, 340, 250, 0.8, fineness=4))
    board = measure_board(scan, SMALL_DOTS)
    assert "no grid of 6 x 5 dots is whole in the scan; 5 spots are candidates for dots" in board.reason
    board = measure_board(scan, specs.CircleGridSpec(8, 11, 28.0, 12.0, asymmetric=True))
    assert "no grid of 44 dots in 11 rows of 4 is whole in the scan" in board.reason  # 4 x 11, as OpenCV counts


@pytest.mark.parametrize(
    "spec",
    [
        specs.ChessboardSpec(9, 6, 25.0),
        specs.CircleGridSpec(6, 5, 30.0, 14.0),
        specs.ArucoSpec("4X4_50", 3, 2, 30.0, 10.0),
        specs.AprilGridSpec("APRILTAG_36h11", 3, 2, 30.0, 9.0),
        specs.CharucoSpec("4X4_50", 6, 5, 32.0, 24.0),
        specs.SquareGridSpec(6, 5, 25.0, 15.0),
    ],
)
@pytest.mark.parametrize("level", [0.0, 30.0])
def test_why_a_board_was_not_found(spec: specs.BoardSpec, level: float) -> None:
    rng = np.random.default_rng(3)
    board = measure_board(draw.make_scan(level + rng.normal(0, level / 10, (480, 640))), spec)
    assert board.reason
    assert {mark.point for mark in board.marks} == set(spec.object_points())
    assert all(mark.status is Status.ABSENT and mark.reason for mark in board.marks)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: specs.ChessboardSpec(2, 6, 25.0), "columns is 2"),
        (lambda: specs.ChessboardSpec(9, 6, 0.0), "square_mm"),
        (lambda: specs.CircleGridSpec(6, 5, 10.0, 12.0), "dots less than"),
        (lambda: specs.CharucoSpec("4X4_50", 6, 5, 20.0, 24.0), "less than the square's"),
        (lambda: specs.SquareGridSpec(6, 5, 25.0, 0.0), "gap_mm"),
        (lambda: specs.ArucoSpec("4X4_49", 3, 2, 30.0, 10.0), "one of"),
        (lambda: specs.ArucoSpec("4X4_50", 3, 2, 30.0, 10.0, first_marker=47), "0 to 49"),
    ],
)
def test_bad_specifications_are_refused(make: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize(("coma_px", "moves"), [(0.0, False), (0.02, False), (0.1, True)])
def test_coma_is_distinguished_from_noise_by_what_neighbours_share(coma_px: float, moves: bool) -> None:
    rng = np.random.default_rng(8)
    marks = []
    for row, column in np.ndindex(8, 10):
        center = np.array([100.0 + 20 * column, 80.0 + 21 * row])
        col, row_px = center + coma_px * (center - [190, 150]) / 90 + rng.normal(0, 0.03, 2)
        quality = {"junction_col_px": col, "junction_row_px": row_px}
        known = Covariance.from_noise(1e-4 * np.eye(2))
        mark = MarkMeasurement(f"r{row}c{column}", "target", center, known, Status.MEASURED, quality=quality)
        marks.append(mark)
    (settled,) = one_definition([marks])
    assert all((new is not old) == moves for new, old in zip(settled, marks, strict=True))


PUBLISHED = np.array([657.64375, 658.04113, 303.19239, 242.55566, -0.256098, 0.130887, -0.000191, 0.000038])
THREE_SIGMA = np.array([0.402, 0.431, 0.819, 0.749, 0.00314, 0.0125, 0.000169, 0.000168])


def chessboards(numbers: Iterable[int]) -> tuple[list[Array], list[Array]]:
    """The points on the board, and where some of the published pictures show them."""
    spec = specs.ChessboardSpec(13, 12, 30.0)
    boards = []
    for number in numbers:
        with open_scan(DATA / "chessboards" / "bouguet" / f"Image{number}.tif") as scan:
            boards.append(measure_board(scan, spec).marks)
    measured_marks = [[mark for mark in marks if mark.status.is_observation] for marks in one_definition(boards)]
    points = spec.object_points()
    return (
        [np.array([points[mark.point] for mark in marks], np.float32) for marks in measured_marks],
        [np.array([mark.center_px for mark in marks], np.float32) for marks in measured_marks],
    )


@pytest.mark.study
@needs("chessboards", "bouguet")
def test_published_calibration_of_a_chessboard() -> None:
    """Every parameter within three of the published standard deviations, in spite of that lens's coma."""
    objects, images = chessboards(range(1, 21))
    flags = cv2.CALIB_FIX_K3
    rms, matrix, distortion, *_ = cv2.calibrateCamera(objects, images, (640, 480), None, None, flags=flags)
    found = [*np.asarray(matrix, float)[[0, 1, 0, 1], [0, 1, 2, 2]], *np.asarray(distortion, float).ravel()[:4]]
    assert sum(map(len, images)) >= 3110
    assert rms < 0.19
    assert np.all(np.abs(np.array(found) - PUBLISHED) < THREE_SIGMA)


APRIL_GRID = specs.AprilGridSpec("APRILTAG_36h11", 3, 2, 66.0, 20.0, first_marker=5)


@parametrize_with_studies("turn_deg", [95.0, 5.0])
def test_trap_charuco_corners_shifted_by_half_a_pixel(turn_deg: float) -> None:
    spec = specs.CharucoSpec("4X4_50", 6, 5, 32.0, 24.0)
    drawing = cv2.aruco.CharucoBoard((6, 5), 32.0, 24.0, specs.aruco_dictionary("4X4_50"))
    homography = draw.board_from_pixel(turn_deg, 2e-4)
    corner = np.array([-32.0, 4 * 32.0])
    picture = draw.take_picture(spec, homography, draw.printed(drawing, spec, (192, 160), corner))
    board = measure_board(draw.make_scan(picture), spec)
    errors = draw.errors_px(board, draw.read_truth(spec, homography))
    assert len(errors) >= 16
    assert np.abs(errors).max() < 0.06
    assert np.abs(errors.mean(axis=0)).max() < 0.01


def generated(spec: specs.CharucoSpec) -> NDArray[np.uint8]:
    """OpenCV's own picture of a board, 20 px a square, with a margin of one square."""
    size = (20 * (spec.columns + 2), 20 * (spec.rows + 2))
    picture = charuco_board(spec).generateImage(size, marginSize=20)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), np.uint8)


@pytest.mark.parametrize("kind", ["aruco", "charuco"])
def test_recognise_board_names_the_kind_from_the_markers(kind: str) -> None:
    """By OpenCV's own drawings; a small chessboard beside them, or the edges of markers, make no ChArUco board."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    grid = cv2.aruco.GridBoard((4, 3), 40.0, 10.0, dictionary)
    board = grid if kind == "aruco" else cv2.aruco.CharucoBoard((6, 5), 40.0, 30.0, dictionary)
    markers = board.generateImage((250, 200), marginSize=10)
    chessboard = np.kron(np.indices((5, 5)).sum(axis=0) % 2 * 180 + 40, np.ones((10, 10)))
    picture = np.full((220, 330), 230.0)
    picture[10:210, 10:260], picture[75:125, 270:320] = markers, chessboard
    scan = draw.make_scan(gaussian_filter(picture, 0.6) * 256.0)
    assert recognise_board(scan).startswith(f"--kind {kind} --dictionary 6X6_250")


@pytest.mark.parametrize("seed", [0, 47])
def test_recognise_board_counts_a_chessboard_among_other_things(seed: int) -> None:
    """Drawn by OpenCV's polygons: rectangles around the board, at which a search from the smallest grid starts."""
    random = np.random.default_rng(seed)
    picture = np.full((480, 640), 110.0)
    ends = np.array([(200, 140), (420, 150), (410, 330), (190, 320)]) + random.uniform(-60, 60, (4, 2))
    corners = np.array([(0, 0), (9, 0), (9, 7), (0, 7)], np.float32)
    homography = cv2.getPerspectiveTransform(corners, ends.astype(np.float32))

    def fill(outline: Array, grey: float) -> None:
        places = cv2.perspectiveTransform(outline[:, None].astype(np.float32), homography)
        cv2.fillConvexPoly(picture, np.round(places * 16).astype(np.int32), grey, cv2.LINE_AA, 4)

    for _ in range(40):
        first = random.uniform(0, 600, 2) * (1, 0.75)
        last, grey = first + random.uniform(10, 60, 2), random.uniform(20, 240)
        cv2.rectangle(picture, first.astype(int).tolist(), last.astype(int).tolist(), grey, -1)
    fill(corners + 0.3 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]), 235.0)
    for place in np.argwhere(np.indices((9, 7)).sum(axis=0) % 2 == 0):
        fill(place + np.array([(0, 0), (1, 0), (1, 1), (0, 1)]), 25.0)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + random.normal(0, 3, picture.shape)
    assert recognise_board(draw.make_scan(np.clip(picture, 0, 255) * 256.0)) == "--board 8x6"


@pytest.mark.parametrize("down", [(0, 1), (-1, 2), (0, 3)])
def test_a_grid_that_passes_over_corners_has_no_squares(down: tuple[int, int]) -> None:
    """Every place is a corner, and light and dark alternate around all of them."""
    picture = np.kron(np.indices((16, 16)).sum(axis=0) % 2 * 200 + 20, np.ones((20, 20))).astype(np.uint8)
    places = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1) @ np.array([(1, 0), down])
    assert has_squares(picture, 20.0 * places + (119.5, 39.5)) == (down == (0, 1))


def test_a_wrong_side_of_the_markers_is_named_with_the_right_one() -> None:
    picture = np.full((280, 360), 255, np.uint8)
    for row, column in np.ndindex(3, 4):
        marker = cv2.aruco.generateImageMarker(specs.aruco_dictionary("4X4_50"), 4 * row + column, 60)
        picture[30 + 80 * row : 90 + 80 * row, 30 + 80 * column : 90 + 80 * column] = marker
    assert len(find_aruco(picture, specs.ArucoSpec("4X4_50", 4, 3, 30.0, 10.0)).corners) == 48
    found = find_aruco(picture, specs.ArucoSpec("4X4_50", 4, 3, 25.0, 15.0))
    assert not found.corners
    side = re.search(r"its side is about (\S+) mm against the distances, 25 mm being described", found.reason)
    assert side is not None
    assert float(side[1]) == pytest.approx(30.0, rel=0.03)  # read to a pixel of 60


@pytest.mark.parametrize("legacy", [False, True])
def test_the_markers_tell_the_layout_of_a_charuco_board(legacy: bool) -> None:
    """Without a given layout each corner has the name of its place; a layout that the markers contradict is refused."""
    spec = specs.CharucoSpec("4X4_50", 6, 4, 32.0, 24.0, legacy=legacy)
    picture = generated(spec)
    found = find_charuco(picture, replace(spec, legacy=None)).corners
    assert len(found) == 15
    for name, corner in found.items():
        row, column = divmod(int(name[1:]), 5)
        np.testing.assert_allclose(corner.center_px, (39.5 + 20 * column, 39.5 + 20 * row), atol=0.5)
    refused = find_charuco(picture, replace(spec, legacy=not legacy))
    assert not refused.corners
    assert f"but as with the {'older layout (legacy)' if legacy else 'newer layout (not legacy)'}." in refused.reason


def test_corners_between_markers_in_a_sharpened_picture() -> None:
    """Edges have less blur than none there, and steps along them overshoot: 9 of 22 corners had not been fitted, and
    others lay up to 0.5 px off. True places by the affinity that turns OpenCV's own drawing."""
    spec, fine = specs.CharucoSpec("5X5_250", 7, 5, 20.0, 15.0), 8
    drawing = charuco_board(spec).generateImage((180 * fine, 140 * fine), marginSize=20 * fine)
    turn = cv2.getRotationMatrix2D((90 * fine - 0.5, 70 * fine - 0.5), 7.0, 0.9)
    turned = cv2.warpAffine(drawing.astype(np.float32), turn, (180 * fine, 140 * fine), borderValue=(255,))
    picture = 40 + 0.6 * turned.reshape(140, fine, 180, fine).mean(axis=(1, 3))
    sharpened = 2 * picture - cv2.GaussianBlur(picture, (0, 0), 1.0)
    noisy = np.clip(sharpened + np.random.default_rng(2).normal(0.0, 2.0, picture.shape), 0, 255)
    read = [mark for mark in measure_board(draw.make_scan(noisy, 255), spec).marks if mark.center_px is not None]
    row, column = np.divmod([int(mark.point[1:]) for mark in read], 6)
    on_drawing = np.stack([20 * fine * (column + 2) - 0.5, 20 * fine * (row + 2) - 0.5, np.ones(len(read))])
    off_px = np.array([mark.center_px for mark in read]) - ((turn @ on_drawing).T + 0.5) / fine + 0.5
    assert len(read) >= 20
    assert {mark.status for mark in read} == {Status.MEASURED}
    assert np.hypot(*off_px.T).max() < 0.06


def test_a_charuco_board_of_which_one_line_of_corners_is_visible_is_not_placed() -> None:
    """All of it but two rows of squares is covered: one line had ended in a traceback."""
    spec = specs.CharucoSpec("4X4_50", 6, 4, 32.0, 24.0)
    drawing = charuco_board(spec).generateImage((400, 300), marginSize=50)
    tilt = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 4e-4, 1.0]])
    picture = np.asarray(cv2.warpPerspective(drawing, tilt, (400, 300), borderValue=(255,)), np.uint8)
    picture[145:] = 255
    board = find_charuco(picture, spec)
    assert not board.corners
    assert "only 5 corners of one line were found" in board.reason
    picture[80:] = 255
    assert "too few to place the board's corners" in find_charuco(picture, spec).reason


def test_exchanged_counts_and_another_first_number_at_once() -> None:
    """Each alone does not make the markers agree; both together are named."""
    spec = specs.CharucoSpec("4X4_50", 5, 4, 32.0, 24.0, first_id=9)
    board = find_charuco(generated(spec), replace(spec, columns=4, rows=5, first_id=0))
    assert not board.corners
    assert "but as with 5 columns, 4 rows, first marker 9." in board.reason
    inner = find_charuco(generated(spec), replace(spec, columns=4, rows=3))
    assert "but as with 5 columns, 4 rows." in inner.reason
    aruco = specs.ArucoSpec("4X4_50", 4, 3, 20.0, 8.0, first_marker=5)
    picture = cv2.aruco.GridBoard((4, 3), 20.0, 8.0, specs.aruco_dictionary("4X4_50"), np.arange(5, 17))
    drawing = np.asarray(picture.generateImage((344, 264), marginSize=20), np.uint8)
    read = find_aruco(drawing, replace(aruco, columns=3, rows=4, first_marker=0))
    assert "but as with 4 columns, 3 rows, first marker 5." in read.reason
    assert len(find_aruco(drawing, aruco).corners) == 48


@parametrize_with_studies(
    ("columns", "rows", "words"),
    [(4, 2, "3 rows"), (3, 3, "4 columns"), (6, 5, "4 columns, 3 rows")],
    quick=(0, 2),
)
def test_markers_on_a_board_of_another_count_name_it(columns: int, rows: int, words: str) -> None:
    """The markers of further rows had been left out unnoticed."""
    picture = cv2.aruco.GridBoard((4, 3), 20.0, 8.0, specs.aruco_dictionary("4X4_50"), np.arange(5, 17))
    drawing = np.asarray(picture.generateImage((344, 264), marginSize=20), np.uint8)
    read = find_aruco(drawing, specs.ArucoSpec("4X4_50", columns, rows, 20.0, 8.0, first_marker=5))
    assert not read.corners
    assert f"but as with {words}. Set that" in read.reason


def test_one_marker_more_is_no_board_of_another_count() -> None:
    """It may be a false reading, which agrees with one of many counts."""
    dictionary = specs.aruco_dictionary("4X4_50")
    picture = cv2.aruco.GridBoard((4, 3), 20.0, 8.0, dictionary, np.arange(5, 17))
    drawing = np.full((344, 344), 255, np.uint8)
    drawing[:264] = picture.generateImage((344, 264), marginSize=20)
    further = cv2.aruco.GridBoard((4, 4), 20.0, 8.0, dictionary, np.arange(5, 21)).generateImage(
        (344, 344), marginSize=20
    )
    drawing[264:, :100] = further[264:, :100]
    read = find_aruco(drawing, specs.ArucoSpec("4X4_50", 4, 3, 20.0, 8.0, first_marker=5))
    assert len(read.corners) == 48


@parametrize_with_studies("first", [5, 0])
def test_markers_counted_from_below_are_those_of_an_aprilgrid(first: int) -> None:
    """And the other way round: the kind that fits is named."""
    grid = specs.AprilGridSpec("APRILTAG_36h11", 4, 3, 40.0, 12.0, first_marker=first)
    above = specs.ArucoSpec("APRILTAG_36h11", 4, 3, 40.0, 12.0, first_marker=first)
    for drawn, taken, words in (
        (grid, above, "but as with kind aprilgrid and gaps of 12 mm."),
        (above, grid, "but as with kind aruco and gaps of 12 mm."),
    ):
        picture = np.full((3 * 52 + 40, 4 * 52 + 40), 255, np.uint8)
        for row, column in np.ndindex(3, 4):
            marker = cv2.aruco.generateImageMarker(
                specs.aruco_dictionary(drawn.dictionary), drawn.marker(row, column), 40
            )
            picture[20 + 52 * row : 60 + 52 * row, 20 + 52 * column : 60 + 52 * column] = marker
        board = find_aruco(picture, taken)
        assert not board.corners
        assert words in board.reason
        assert len(find_aruco(picture, drawn).corners) == 48


def drawn_markers(spec: specs.ArucoSpec, is_touched: bool) -> NDArray[np.float64]:
    """A board at 1 px per mm, blurred, the first corner at (19.5, 19.5); with dark squares that touch the markers."""
    side, pitch = int(spec.marker_mm), int(spec.marker_mm + spec.gap_mm)
    picture = np.full((spec.rows * pitch + 40, spec.columns * pitch + 40), 255.0)
    for row, column in np.ndindex(spec.rows + is_touched, spec.columns + is_touched):
        y, x = 20 + pitch * row, 20 + pitch * column
        if row < spec.rows and column < spec.columns:
            code = specs.aruco_dictionary(spec.dictionary)
            picture[y : y + side, x : x + side] = cv2.aruco.generateImageMarker(code, spec.marker(row, column), side)
        if is_touched:
            picture[y + side - pitch : y, x + side - pitch : x] = 0.0
    noise = np.random.default_rng(4).normal(0.0, 300.0, picture.shape)
    return np.asarray(gaussian_filter(10_000.0 + 160.0 * picture, 0.9) + noise)


@pytest.mark.parametrize("kind", [specs.ArucoSpec, specs.AprilGridSpec])
@pytest.mark.parametrize("is_touched", [True, False])
def test_markers_of_either_kind_are_measured_with_and_without_squares_between(
    kind: type[specs.ArucoSpec], is_touched: bool
) -> None:
    spec = kind("APRILTAG_36h11", 3, 2, 60.0, 18.0)
    board = measure_board(draw.make_scan(drawn_markers(spec, is_touched)), spec)
    marks = {mark.point: mark for mark in board.marks if mark.status == Status.MEASURED}
    assert not board.contradiction
    assert len(marks) >= 12
    for row, column in np.ndindex(2, 3):
        for k, (right, down) in enumerate([(0, 0), (1, 0), (1, 1), (0, 1)]):
            mark = marks.get(f"{spec.marker(row, column)}.{k}")
            if mark is not None and mark.center_px is not None:
                place_px = (19.5 + 78 * column + 60 * right, 19.5 + 78 * row + 60 * down)
                np.testing.assert_allclose(mark.center_px, place_px, atol=0.06)


@pytest.mark.parametrize("kind", [specs.ArucoSpec, specs.AprilGridSpec])
def test_a_side_slightly_wrong_against_the_gap_is_named_with_the_right_one(kind: type[specs.ArucoSpec]) -> None:
    scan = draw.make_scan(drawn_markers(kind("APRILTAG_36h11", 3, 2, 60.0, 18.0), kind is specs.AprilGridSpec))
    board = measure_board(scan, kind("APRILTAG_36h11", 3, 2, 60.0, 22.0))
    assert "markers have a side of 63.1 mm at distances of 82 mm, but 60 mm are given" in board.contradiction


@parametrize_with_studies("given", [0, 30])
def test_charuco_numbers_that_begin_later(given: int) -> None:
    """Shifted by two rows of markers, all would lie as on a board that begins at 0."""
    spec = specs.CharucoSpec("4X4_50", 6, 5, 32.0, 24.0, first_id=6)
    picture = generated(spec)
    assert len(find_charuco(picture, spec).corners) == 20
    assert "but as with first marker 6" in find_charuco(picture, replace(spec, first_id=given)).reason


def test_a_charuco_corner_is_held_against_the_markers_next_to_it() -> None:
    """One a square off, as another crossing would be, is named; where no marker beside it was read, nothing tells."""
    spec = specs.CharucoSpec("4X4_50", 6, 5, 32.0, 24.0)
    homography = draw.board_from_pixel(3.0, 1e-4)
    points, truth = spec.object_points(), draw.read_truth(spec, homography)
    outline = np.array([(-12.0, 12.0), (12.0, 12.0), (12.0, -12.0), (-12.0, -12.0)])
    middle = np.mean([point[:2] for point in points.values()], axis=0)
    marker = outline + np.array(points["c2"][:2]) - middle + 16.0  # in the square between c2 and c3
    read = ReadMarkers({1: draw.mapped(np.asarray(np.linalg.inv(homography)), marker)}, {}, 1)
    found = {name: specs.FoundCorner(truth[name], 32 * np.eye(2)) for name in ("c2", "c3", "c19")}
    assert off_corners(found, spec, read) == {}
    found["c2"] = specs.FoundCorner(truth["c7"], 32 * np.eye(2))
    assert "1.0 squares from the place that the adjacent markers give" in off_corners(found, spec, read)["c2"]


@parametrize_with_studies(("turn_deg", "quarter_turns"), [(4.0, 0), (184.0, 2)], quick=(1,))
def test_a_grid_of_april_tags_has_its_corners_at_the_junctions(turn_deg: float, quarter_turns: int) -> None:
    """Counted from the lower left, however each tag is turned; two modules of border, squares at all corners."""
    homography = draw.board_from_pixel(turn_deg, 1e-4)
    picture = draw.take_picture(APRIL_GRID, homography, draw.april_grid_dark(APRIL_GRID, quarter_turns))
    board = measure_board(draw.make_scan(picture), APRIL_GRID)
    errors = draw.errors_px(board, draw.read_truth(APRIL_GRID, homography))
    assert len(errors) == 24
    assert np.sqrt(np.mean(errors**2)) < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.008
    assert all("junction_col_px" in mark.quality for mark in board.marks)
    other = measure_board(draw.make_scan(picture), replace(APRIL_GRID, first_marker=0))
    assert "but as with first marker 5" in other.reason
    assert recognise_board(draw.make_scan(picture)) == "--kind aprilgrid --board COLUMNSxROWS"


@pytest.mark.parametrize("tilt", [0.0, 0.6])
@pytest.mark.parametrize("shift_mm", [(0.0, 0.0), (60.0, 40.0), (120.0, 80.0)])
def test_the_markers_of_a_board_in_a_fisheye_agree(tilt: float, shift_mm: tuple[float, float]) -> None:
    """An equidistant lens, r = c θ, and tags up to 65 degrees off its axis: all of them had been refused."""
    spec = specs.AprilGridSpec("APRILTAG_36h11", 6, 6, 24.0, 7.2)
    points = spec.object_points()
    middle_mm = np.mean([point[:2] for point in points.values()], axis=0)
    turn = np.asarray(cv2.Rodrigues(np.array([tilt, tilt / 2, 0.0]))[0])
    board = {number: np.array([points[f"{number}.{corner}"][:2] for corner in range(4)]) for number in range(36)}
    outlines = {}
    for number, corners in board.items():
        flat = np.column_stack([(corners - middle_mm) * [1.0, -1.0], np.zeros(4)])
        x, y, z = (flat @ turn.T + [*shift_mm, 100.0]).T
        radius = np.hypot(x, y)
        outlines[number] = [511.5 + (382.0 * np.arctan2(radius, z) / radius)[:, None] * np.stack([x, y], axis=1)]
    read = placed_markers(MarkerReadings(outlines, (1024, 1024), 0.2), board)
    assert read.agreeing == 36
    assert not read.refused


@parametrize_with_studies("kind", ["aprilgrid", "charuco", "aruco"], quick=(2,))
def test_a_board_in_a_mirror_keeps_its_names(kind: str) -> None:
    """As it is seen from its back; what was read in the picture as it is, of another board's number, is none of it."""
    spec: specs.ArucoSpec | specs.CharucoSpec = APRIL_GRID
    homography = draw.board_from_pixel(5.0, 1e-4)
    if kind == "charuco":
        spec = specs.CharucoSpec("4X4_50", 6, 5, 32.0, 24.0)
        picture = draw.charuco_picture(spec, homography)
    elif kind == "aruco":
        spec = specs.ArucoSpec("5X5_100", 3, 2, 63.0, 21.0)
        drawing = cv2.aruco.GridBoard((3, 2), 63.0, 21.0, specs.aruco_dictionary("5X5_100"))
        picture = draw.take_picture(spec, homography, draw.printed(drawing, spec, (231, 147), np.array([0.0, 147.0])))
    else:
        picture = draw.take_picture(spec, homography, draw.april_grid_dark(APRIL_GRID))
    truth = draw.read_truth(spec, homography)
    board = measure_board(draw.make_scan(picture[:, ::-1]), spec)
    assert board.is_mirrored
    errors = draw.errors_px(board, {name: np.array([draw.WIDTH - 1 - col, row]) for name, (col, row) in truth.items()})
    assert len(errors) >= 16
    assert np.sqrt(np.mean(errors**2)) < 0.03


@parametrize_with_studies("name", ["aruco", "charuco"])
def test_a_marker_read_twice_is_the_one_where_its_board_has_it(name: str) -> None:
    """A stray copy of one marker is passed over; of two like boards none is measured, and the reason says why."""
    dictionary = specs.aruco_dictionary("4X4_50")
    spec: specs.ArucoSpec | specs.CharucoSpec
    if name == "aruco":
        spec = specs.ArucoSpec("4X4_50", 3, 2, 60.0, 20.0)
        drawing = cv2.aruco.GridBoard((3, 2), 60.0, 20.0, dictionary).generateImage((260, 180), marginSize=20)
    else:
        spec = specs.CharucoSpec("4X4_50", 5, 4, 48.0, 36.0)
        drawing = cv2.aruco.CharucoBoard((5, 4), 48.0, 36.0, dictionary).generateImage((260, 212), marginSize=10)
    height, width = drawing.shape
    picture = np.full((height + 40, 2 * width + 60), 255.0)
    picture[20 : 20 + height, 20 : 20 + width] = drawing
    two = picture.copy()
    picture[60:120, width + 100 : width + 160] = cv2.aruco.generateImageMarker(dictionary, 3, 60)
    two[20 : 20 + height, width + 40 : 2 * width + 40] = drawing
    half = np.full_like(picture, 255.0)
    half[20 : 20 + height, 20 : 20 + width] = drawing
    half[20 : 20 + height, width + 40 + width // 2 : 2 * width + 40] = drawing[:, width // 2 :]

    def measure_picture(grey: Array) -> BoardMeasurement:
        noise = np.random.default_rng(2).normal(0, 300, grey.shape)
        return measure_board(draw.make_scan(8000 + 120 * cv2.GaussianBlur(grey, (0, 0), 0.8) + noise), spec)

    measured_marks = [mark.center_px for mark in measure_picture(picture).marks if mark.status is Status.MEASURED]
    assert len(measured_marks) == len(spec.object_points())
    assert max(center[0] for center in measured_marks if center is not None) < width + 20
    neither = measure_picture(two)
    assert "was read at 2 places" in neither.reason
    assert all(mark.status is Status.ABSENT for mark in neither.marks)
    both = measure_picture(half)
    assert all(mark.status is Status.MEASURED for mark in both.marks)
    assert "of which one lies on the board: there may be another such board" in both.refused[0]


@parametrize_with_studies("gap", [60.0, 130.0])
def test_markers_of_two_boards_are_not_those_of_one(gap: float) -> None:
    """Of one board the right column is seen, of another one the left: together they look like a board that is squeezed,
    and nobody knows which of them is meant."""
    spec = specs.ArucoSpec("4X4_50", 4, 4, 48.0, 16.0)
    picture = np.full((296, 110 + int(gap)), 255.0)
    for row in range(4):
        top = 20 + 64 * row
        for number, left in ((4 * row + 3, 10), (4 * row, 48 + int(gap))):
            marker = cv2.aruco.generateImageMarker(specs.aruco_dictionary("4X4_50"), number, 48)
            picture[top : top + 48, left : left + 48] = marker
    noise = np.random.default_rng(2).normal(0, 300, picture.shape)
    board = measure_board(draw.make_scan(8000 + 120 * cv2.GaussianBlur(picture, (0, 0), 0.8) + noise), spec)
    assert "do not agree on where the board lies" in board.reason
    assert all(mark.status is Status.ABSENT for mark in board.marks)


def test_a_part_of_a_grid_of_dots_has_no_count() -> None:
    """5 x 5 dots alone are a whole grid; rows and columns of three that go on from them show that it is larger."""
    places = [
        (i, j) for i in range(-6, 7) for j in range(-6, 7) if min(abs(i), abs(j)) <= 1 or max(abs(i), abs(j)) <= 2
    ]
    middle = [place for place in places if max(map(abs, place)) <= 2]
    counts = [
        grid_of_any_count(30.0 * np.array(some, float) + 300.0, np.zeros((len(some), 3))) for some in (middle, places)
    ]
    assert counts == [(5, 5, False), None]

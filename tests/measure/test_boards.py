"""Boards drawn from their specification, and boards photographed by others with a calibration that was published."""

import re
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
import pytest
from drawn import (
    HEIGHT,
    WIDTH,
    board_from_pixel,
    chessboard_dark,
    circles_dark,
    draw,
    errors_px,
    make_scan,
    mapped,
    read_truth,
    squares_dark,
    take_picture,
    tile_boards,
)
from numpy.typing import NDArray
from real_data import DATA, needs
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import Status, open_scan
from measure.boards.find import is_even, whole_pattern
from measure.boards.measure import BoardMeasurement, measure_board, one_definition
from measure.boards.specs import (
    AprilGridSpec,
    ArucoSpec,
    BoardSpec,
    CharucoSpec,
    ChessboardSpec,
    CircleGridSpec,
    SquareGridSpec,
)
from measure.flags import Cause, Code
from measure.results import Covariance, MarkMeasurement

Array = NDArray[np.float64]
CHESSBOARD = ChessboardSpec(6, 5, 24.0)
SMALL_DOTS = CircleGridSpec(6, 5, 28.0, 13.0)
SMALL_SQUARES = SquareGridSpec(6, 5, 16.0, 12.0)
STAGGERED = CircleGridSpec(8, 6, 20.0, 13.0, asymmetric=True)


def measure_picture(spec: BoardSpec, dark: Any, homography: Array) -> tuple[BoardMeasurement, Array]:
    """And the errors of what is measured."""
    board = measure_board(make_scan(take_picture(spec, homography, dark)), spec)
    return board, errors_px(board, read_truth(spec, homography))


@pytest.mark.parametrize(
    "turn_deg", [*(pytest.param(turn, marks=pytest.mark.study) for turn in (4.0, 100.0, 275.0)), 187.0]
)
def test_a_chessboard_in_any_direction_keeps_its_names(turn_deg: float) -> None:
    board, errors = measure_picture(CHESSBOARD, chessboard_dark(CHESSBOARD), board_from_pixel(turn_deg))
    assert board.reason == ""
    assert all(mark.status is Status.MEASURED for mark in board.marks)
    assert len(errors) == 30
    assert np.sqrt(np.mean(errors**2)) < 0.012
    assert np.abs(errors.mean(axis=0)).max() < 0.006


def test_trap_half_a_pixel_lost_in_a_search_at_a_reduced_size() -> None:
    homography = board_from_pixel(3.0)
    picture = take_picture(CHESSBOARD, homography, chessboard_dark(CHESSBOARD))
    large = np.pad(np.kron(picture, np.ones((4, 4))), ((0, 0), (0, 1100)), constant_values=38000.0)
    board = measure_board(make_scan(large), CHESSBOARD)
    truth = {name: 4 * place + 1.5 for name, place in read_truth(CHESSBOARD, homography).items()}
    assert np.abs(errors_px(board, truth).mean(axis=0)).max() < 0.04


def test_a_board_that_a_half_turn_does_not_change_is_taken_as_upright_and_says_so() -> None:
    spec = ChessboardSpec(6, 4, 24.0)
    board, errors = measure_picture(spec, chessboard_dark(spec), board_from_pixel(10.0))
    assert "looks the same after a half turn" in board.notes[0]
    assert np.abs(errors).max() < 0.05


@parametrize_with_studies(
    "spec",
    [
        CircleGridSpec(6, 5, 30.0, 14.0),
        CircleGridSpec(9, 7, 16.0, 14.0, asymmetric=True),
        CircleGridSpec(8, 9, 24.0, 15.0, asymmetric=True, row_spacing_mm=13.9),
    ],
)
def test_circle_grids(spec: CircleGridSpec) -> None:
    board, errors = measure_picture(spec, circles_dark(spec), board_from_pixel(tilt=5e-5))
    assert board.reason == ""
    assert len(errors) == len(spec.places())
    assert np.abs(errors).max() < 0.06


@pytest.mark.parametrize(
    ("spec", "dark"),
    [(CircleGridSpec(6, 5, 30.0, 14.0), circles_dark), (SquareGridSpec(5, 4, 20.0, 16.0), squares_dark)],
)
def test_a_reflection_that_clips_the_light_side_of_edges_moves_no_point(spec: BoardSpec, dark: Any) -> None:
    """Dark parts are lighter there as well, and fits of clipped values as of ordinary ones lay up to 1 px off."""
    homography = board_from_pixel(tilt=5e-5)
    col, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    glare = 45000 * np.exp(-((col - WIDTH / 2) ** 2 + (row - HEIGHT / 2) ** 2) / (2 * 30.0**2))
    board = measure_board(make_scan(take_picture(spec, homography, dark(spec)) + glare), spec)
    errors = errors_px(board, read_truth(spec, homography))
    assert len(errors) >= 0.9 * len(spec.object_points())
    assert np.abs(errors).max() < 0.13


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_a_tone_curve_moves_no_corner_of_separate_squares(gamma: float) -> None:
    """It shifts all edges by the same share of their blur, which the distances between squares show."""
    spec, homography = SquareGridSpec(5, 4, 20.0, 16.0), board_from_pixel(tilt=5e-5)
    light = take_picture(spec, homography, squares_dark(spec)) / 65535
    board = measure_board(make_scan(65535 * np.maximum(light, 0.0) ** (1 / gamma)), spec)
    errors = errors_px(board, read_truth(spec, homography))
    assert len(errors) == len(spec.object_points())
    assert np.sqrt(np.mean(errors**2)) < 0.03
    claims = [mark.covariance.sigmas_px for mark in board.marks if mark.covariance is not None]
    assert all(0.0 < each[Cause.TONE] < 0.02 for each in claims)


@pytest.mark.parametrize(("left_px", "cut"), [(-3, 1), (10, 2)])
def test_dots_that_the_edge_of_the_picture_cuts_are_not_measured(left_px: int, cut: int) -> None:
    """left_px: edge beside the centre of the first dot, whose radius is 7 px."""
    spec, homography = CircleGridSpec(6, 5, 30.0, 14.0), board_from_pixel(20.0, tilt=5e-5)
    truth = read_truth(spec, homography)
    left = round(truth["r0c0"][0]) + left_px
    board = measure_board(make_scan(take_picture(spec, homography, circles_dark(spec))[:, left:]), spec)
    outside = [mark for mark in board.marks if mark.reason.codes == (Code.OUTSIDE,)]
    assert [(mark.point, mark.status) for mark in outside] == [(f"r{row}c0", Status.ABSENT) for row in range(cut)]
    errors = errors_px(board, {name: place - [left, 0] for name, place in truth.items()})
    assert len(errors) == 30 - cut
    assert np.abs(errors).max() < 0.06


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_an_asymmetric_grid_in_a_mirror_keeps_its_names(is_mirrored: bool) -> None:
    spec, homography = CircleGridSpec(8, 6, 20.0, 15.0, asymmetric=True), board_from_pixel(tilt=5e-5)
    picture, truth = take_picture(spec, homography, circles_dark(spec)), read_truth(spec, homography)
    if is_mirrored:
        picture = picture[:, ::-1]
        truth = {name: np.array([picture.shape[1] - 1, 0]) + place * (-1, 1) for name, place in truth.items()}
    board = measure_board(make_scan(picture), spec)
    assert (board.reason, board.is_mirrored) == ("", is_mirrored)
    errors = errors_px(board, truth)
    half_turned = dict(zip(truth, reversed(truth.values()), strict=True))
    assert min(np.abs(errors).max(), np.abs(errors_px(board, half_turned)).max()) < 0.06


@parametrize_with_studies(
    ("columns", "rows", "words"),
    [
        (5, 5, "one of 6 x 5 is. Set columns and rows"),
        (6, 4, "one of 6 x 5 is. Set columns and rows"),
        (4, 3, "one of 6 x 5 is. Set columns and rows"),
        (7, 5, "one of 6 x 5 is. Set columns and rows"),
        (7, 6, "one of 6 x 5 is: squares may have been counted"),
    ],
    quick=(2,),
)
def test_a_chessboard_of_another_count_is_refused_with_its_own(columns: int, rows: int, words: str) -> None:
    picture = take_picture(CHESSBOARD, board_from_pixel(8.0, 6e-4), chessboard_dark(CHESSBOARD))
    board = measure_board(make_scan(picture), ChessboardSpec(columns, rows, 24.0))
    assert words in board.reason
    assert {mark.status for mark in board.marks} == {Status.ABSENT}


LARGE = ChessboardSpec(9, 6, 24.0)


@pytest.fixture(scope="module")
def large_board() -> tuple[Array, dict[str, Array]]:
    homography = board_from_pixel(8.0, 3e-4)
    return take_picture(LARGE, homography, chessboard_dark(LARGE)), read_truth(LARGE, homography)


@parametrize_with_studies(
    ("shown", "count"),
    [(np.s_[:, 60:], 51), (np.s_[:, :250], 48), (np.s_[:190, :], 45), (np.s_[80:, 70:], 40), (np.s_[:180, :240], 39)],
    quick=(3,),
)
def test_a_part_of_a_chessboard_has_the_names_of_the_whole(
    large_board: tuple[Array, dict[str, Array]], shown: Any, count: int
) -> None:
    """Its light border is seen on two sides or more; the colours tell which end is which."""
    picture, truth = large_board
    board = measure_board(make_scan(picture[shown]), LARGE)
    errors = errors_px(
        board, {name: place - [shown[1].start or 0, shown[0].start or 0] for name, place in truth.items()}
    )
    assert len(errors) == count
    assert np.abs(errors).max() < 0.03
    hidden = {str(mark.reason) for mark in board.marks if not mark.status.is_observation}
    assert "covered, or outside of the picture" in hidden


@parametrize_with_studies("covered", [np.s_[180:, 200:], np.s_[:, :70]], quick=(0,))
def test_what_covers_a_chessboard_is_no_end_of_it(large_board: tuple[Array, dict[str, Array]], covered: Any) -> None:
    picture, truth = large_board[0].copy(), large_board[1]
    picture[covered] = 22000.0
    errors = errors_px(measure_board(make_scan(picture), LARGE), truth)
    assert len(errors) >= 45
    assert np.abs(errors).max() < 0.03


def test_corners_at_the_edges_of_shadows_are_not_measured(large_board: tuple[Array, dict[str, Array]]) -> None:
    """Bars' shadows, as wide as half a square, over a third of the board."""
    picture, truth = large_board[0].copy(), large_board[1]
    row, col = np.indices(picture.shape, float)
    across = 0.8 * col + 0.6 * row
    shade = 0.5 + 0.5 * np.tanh(4.0 * np.sin(2 * np.pi * across / 24.0))
    board = measure_board(make_scan(picture * np.where(col < 130, 1 - 0.6 * shade, 1.0)), LARGE)
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
    board = measure_board(make_scan(picture + 3.0 * (picture - gaussian_filter(picture, 1.5)) + 20000.0), LARGE)
    assert all(mark.status is Status.MEASURED for mark in board.marks)
    assert np.abs(errors_px(board, truth)).max() < 0.1


@parametrize_with_studies("shown", [np.s_[80:, 150:], np.s_[:, 60:250], np.s_[80:, 60:250]])
def test_a_part_of_a_chessboard_that_may_be_another_is_refused(
    large_board: tuple[Array, dict[str, Array]], shown: Any
) -> None:
    """Of one corner's border with fewer squares than tell the longer side; and without an end of the longer side."""
    board = measure_board(make_scan(large_board[0][shown]), LARGE)
    assert not any(mark.status.is_observation for mark in board.marks)
    assert "nothing tells which part it is" in board.reason


@parametrize_with_studies("covered_mm", [28.0, 31.0, 34.0], quick=(1,))
def test_the_edge_of_what_covers_a_board_is_not_where_its_squares_end(
    large_board: tuple[Array, dict[str, Array]], covered_mm: float
) -> None:
    """Two columns are covered as lightly as paper, to beside the third at 48 mm, and two lie outside of the picture."""
    picture, truth = large_board[0].copy(), large_board[1]
    col, row = np.indices(picture.T.shape, float)
    x, _ = mapped(board_from_pixel(8.0, 3e-4), np.stack([col, row], axis=-1).reshape(-1, 2)).T
    picture[covered_mm > x.reshape(col.shape).T + 96.0] = 38000.0
    end = int(min(truth[f"r{row}c7"][0] for row in range(LARGE.rows))) - 4
    board = measure_board(make_scan(picture[:, :end]), LARGE)
    assert not any(mark.status.is_observation for mark in board.marks)


def test_a_board_whose_outer_corners_lie_outside_is_refused_in_words_that_fit(
    large_board: tuple[Array, dict[str, Array]],
) -> None:
    board = measure_board(make_scan(large_board[0][:195, 52:256]), LARGE)
    assert not any(mark.status.is_observation for mark in board.marks)
    assert "9 x 6 inner corners is whole in the scan: some of its corners, or of the light border" in board.reason


@pytest.mark.parametrize("left_out", [None, 0, 1, 3])
def test_lines_of_a_board_are_evenly_spaced_under_one_homography(left_out: int | None) -> None:
    """Of a lens with 6 % of distortion at the corner, seen at an angle; one line left out shows, wherever it is."""
    column, row = np.meshgrid(np.arange(9.0), np.arange(7.0))
    x, y = mapped(
        np.array([[60.0, 4, 60], [-3, 58, 50], [2e-2, 3e-2, 1]]), np.stack([column, row], axis=-1).reshape(-1, 2)
    ).T
    about = np.stack([x - 320, y - 240], axis=-1)
    grid = np.array([320, 240]) + about * (1 - 0.06 * (about**2).sum(axis=1, keepdims=True) / 400**2)
    grid = grid.reshape(7, 9, 2)
    grid[0, 0] += 20.0  # as detectors put single corners, which the fit finds, or not
    if left_out is not None:
        grid = np.delete(grid, 1 + left_out, axis=0)
    assert is_even(grid, (640, 480)) == (left_out is None)


def test_a_pattern_grows_to_where_it_ends() -> None:
    """From a part of its lines; a line along its border is none of it, and one that the picture cuts is no end."""
    homography = board_from_pixel(5.0, 4e-4)
    picture = (take_picture(CHESSBOARD, homography, chessboard_dark(CHESSBOARD)) / 256).astype(np.uint8)
    grid = np.array(list(read_truth(CHESSBOARD, homography).values())).reshape(5, 6, 2)
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
    spec = SquareGridSpec(5, 4, 45.0 - gap_mm, gap_mm)
    board, errors = measure_picture(spec, squares_dark(spec), board_from_pixel(turn_deg, 2e-4))
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
        (CHESSBOARD, chessboard_dark(CHESSBOARD), "3 boards of 6 x 5 inner corners"),
        (SMALL_DOTS, circles_dark(SMALL_DOTS), "3 grids of 6 x 5 dots"),
        (SMALL_SQUARES, squares_dark(SMALL_SQUARES), "3 boards of 6 x 5 squares"),
        (STAGGERED, circles_dark(STAGGERED), "3 grids of 24 dots in 6 rows"),
    ],
)
def test_of_boards_that_are_alike_none_is_observed(spec: BoardSpec, dark: Any, words: str) -> None:
    """Neither by their size, for nobody knows how far away they are; the reason says how many, and where."""
    one = measure_board(make_scan(tile_boards(spec, dark, (1.0,))), spec)
    assert not one.ambiguous
    assert all(mark.status is Status.MEASURED for mark in one.marks)
    three = measure_board(make_scan(tile_boards(spec, dark, (1.0, 0.9, 1.0))), spec)
    assert words in three.ambiguous
    places = [float(place) for place in re.findall(r"\((\d+), \d+\)", three.ambiguous)]
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
    board = measure_board(make_scan(blurred, 255), ChessboardSpec(9, 6, 30.0))
    assert "2 boards of 9 x 6 inner corners" in board.ambiguous
    assert {mark.status for mark in board.marks} == {Status.REJECTED}


def test_a_circle_grid_is_no_part_of_a_larger_one() -> None:
    larger = CircleGridSpec(7, 5, 28.0, 13.0)
    board = measure_board(make_scan(tile_boards(larger, circles_dark(larger), (1.0,))), SMALL_DOTS)
    assert "the grid is larger than 6 x 5 dots" in board.reason
    assert {mark.status for mark in board.marks} == {Status.ABSENT}


def test_a_few_spots_are_no_circle_grid() -> None:
    """Four of them make no lattice at all."""
    places = np.array([(40.0, 50.0), (90.0, 52.0), (150.0, 140.0), (260.0, 200.0), (300.0, 90.0)])

    def light(col: Array, row: Array) -> Array:
        return np.asarray(np.min([np.hypot(col - x, row - y) for x, y in places], axis=0) > 8.0, float)

    scan = make_scan(8000 + 30000 * draw(light, 340, 250, 0.8, fineness=4))
    board = measure_board(scan, SMALL_DOTS)
    assert "no grid of 6 x 5 dots is whole in the scan; 5 spots are candidates for dots" in board.reason
    board = measure_board(scan, CircleGridSpec(8, 11, 28.0, 12.0, asymmetric=True))
    assert "no grid of 44 dots in 11 rows is whole in the scan" in board.reason  # 4 x 11, as OpenCV counts


@pytest.mark.parametrize(
    "spec",
    [
        ChessboardSpec(9, 6, 25.0),
        CircleGridSpec(6, 5, 30.0, 14.0),
        ArucoSpec("4X4_50", 3, 2, 30.0, 10.0),
        AprilGridSpec("APRILTAG_36h11", 3, 2, 30.0, 9.0),
        CharucoSpec("4X4_50", 6, 5, 32.0, 24.0),
        SquareGridSpec(6, 5, 25.0, 15.0),
    ],
)
@pytest.mark.parametrize("level", [0.0, 30.0])
def test_why_a_board_was_not_found(spec: BoardSpec, level: float) -> None:
    rng = np.random.default_rng(3)
    board = measure_board(make_scan(level + rng.normal(0, level / 10, (480, 640))), spec)
    assert board.reason
    assert {mark.point for mark in board.marks} == set(spec.object_points())
    assert all(mark.status is Status.ABSENT and mark.reason for mark in board.marks)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ChessboardSpec(2, 6, 25.0), "columns is 2"),
        (lambda: ChessboardSpec(9, 6, 0.0), "square_mm"),
        (lambda: CircleGridSpec(6, 5, 10.0, 12.0), "dots less than"),
        (lambda: CharucoSpec("4X4_50", 6, 5, 20.0, 24.0), "less than the square's"),
        (lambda: SquareGridSpec(6, 5, 25.0, 0.0), "gap_mm"),
        (lambda: ArucoSpec("4X4_49", 3, 2, 30.0, 10.0), "one of"),
        (lambda: ArucoSpec("4X4_50", 3, 2, 30.0, 10.0, first_marker=47), "0 to 49"),
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
    spec = ChessboardSpec(13, 12, 30.0)
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


@pytest.mark.study
@needs("circles", "boofcv")
def test_hexagonal_circle_grids_of_another_project() -> None:
    spec = CircleGridSpec(24, 28, 1.2 * np.sqrt(3) / 2, 1.0, asymmetric=True, row_spacing_mm=0.6)
    with open_scan(DATA / "circles" / "boofcv" / "Sony_DSC-HX5V_CircleHexagonal" / "image01.jpg") as scan:
        board = measure_board(scan, spec)
    assert sum(mark.status.is_observation for mark in board.marks) >= 334

"""Boards of markers: ChArUco, ArUco and AprilTag markers, Kalibr's AprilGrid, against their true places."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn import (
    WIDTH,
    april_grid_dark,
    board_from_pixel,
    charuco_picture,
    errors_px,
    make_scan,
    mapped,
    printed,
    read_truth,
    take_picture,
)
from numpy.typing import NDArray
from studies import parametrize_with_studies

from measure import Status
from measure.boards.markers import ReadMarkers, charuco_board, find_aruco, find_charuco, off_corners
from measure.boards.measure import BoardMeasurement, measure_board
from measure.boards.specs import AprilGridSpec, ArucoSpec, CharucoSpec, FoundCorner, aruco_dictionary

Array = NDArray[np.float64]
APRIL_GRID = AprilGridSpec("APRILTAG_36h11", 3, 2, 66.0, 20.0, first_marker=5)


@pytest.mark.parametrize("turn_deg", [5.0, 95.0])
def test_trap_charuco_corners_shifted_by_half_a_pixel(turn_deg: float) -> None:
    spec = CharucoSpec("4X4_50", 6, 5, 32.0, 24.0)
    drawing = cv2.aruco.CharucoBoard((6, 5), 32.0, 24.0, aruco_dictionary("4X4_50"))
    homography = board_from_pixel(turn_deg, 2e-4)
    corner = np.array([-32.0, 4 * 32.0])
    picture = take_picture(spec, homography, printed(drawing, spec, (192, 160), corner))
    board = measure_board(make_scan(picture), spec)
    errors = errors_px(board, read_truth(spec, homography))
    assert len(errors) >= 16
    assert np.abs(errors).max() < 0.06
    assert np.abs(errors.mean(axis=0)).max() < 0.01


def generated(spec: CharucoSpec) -> NDArray[np.uint8]:
    """OpenCV's own picture of a board, 20 px a square, with a margin of one square."""
    size = (20 * (spec.columns + 2), 20 * (spec.rows + 2))
    picture = charuco_board(spec).generateImage(size, marginSize=20)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.7), np.uint8)


def test_a_wrong_side_of_the_markers_is_named_with_the_right_one() -> None:
    picture = np.full((280, 360), 255, np.uint8)
    for row, column in np.ndindex(3, 4):
        marker = cv2.aruco.generateImageMarker(aruco_dictionary("4X4_50"), 4 * row + column, 60)
        picture[30 + 80 * row : 90 + 80 * row, 30 + 80 * column : 90 + 80 * column] = marker
    assert len(find_aruco(picture, ArucoSpec("4X4_50", 4, 3, 30.0, 10.0)).corners) == 48
    found = find_aruco(picture, ArucoSpec("4X4_50", 4, 3, 25.0, 15.0))
    assert not found.corners
    side = re.search(r"its side is about (\S+) mm against the distances, 25 mm being described", found.reason)
    assert side is not None
    assert float(side[1]) == pytest.approx(30.0, rel=0.03)  # read to a pixel of 60


@pytest.mark.parametrize("legacy", [False, True])
def test_the_markers_tell_the_layout_of_a_charuco_board(legacy: bool) -> None:
    """Without a given layout each corner has the name of its place; a layout that the markers contradict is refused."""
    spec = CharucoSpec("4X4_50", 6, 4, 32.0, 24.0, legacy=legacy)
    picture = generated(spec)
    found = find_charuco(picture, replace(spec, legacy=None)).corners
    assert len(found) == 15
    for name, corner in found.items():
        row, column = divmod(int(name[1:]), 5)
        np.testing.assert_allclose(corner.center_px, (39.5 + 20 * column, 39.5 + 20 * row), atol=0.5)
    refused = find_charuco(picture, replace(spec, legacy=not legacy))
    assert not refused.corners
    assert f"but as with legacy = {str(legacy).lower()}" in refused.reason


def test_a_charuco_board_of_which_one_line_of_corners_is_visible_is_not_placed() -> None:
    """All of it but two rows of squares is covered: one line had ended in a traceback."""
    spec = CharucoSpec("4X4_50", 6, 4, 32.0, 24.0)
    drawing = charuco_board(spec).generateImage((400, 300), marginSize=50)
    tilt = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 4e-4, 1.0]])
    picture = np.asarray(cv2.warpPerspective(drawing, tilt, (400, 300), borderValue=(255,)), np.uint8)
    picture[145:] = 255
    board = find_charuco(picture, spec)
    assert not board.corners
    assert "only 5 corners of one line were found" in board.reason


def test_exchanged_counts_and_another_first_number_at_once() -> None:
    """Each alone does not make the markers agree; both together are named."""
    spec = CharucoSpec("4X4_50", 6, 5, 32.0, 24.0, first_id=9)
    board = find_charuco(generated(spec), replace(spec, columns=5, rows=6, first_id=0))
    assert not board.corners
    assert "but as with columns = 6, rows = 5, first_id = 9." in board.reason
    inner = find_charuco(generated(spec), replace(spec, columns=5, rows=4))
    assert "but as with columns = 6, rows = 5." in inner.reason
    aruco = ArucoSpec("4X4_50", 4, 3, 20.0, 8.0, first_marker=5)
    picture = cv2.aruco.GridBoard((4, 3), 20.0, 8.0, aruco_dictionary("4X4_50"), np.arange(5, 17))
    drawing = np.asarray(picture.generateImage((344, 264), marginSize=20), np.uint8)
    read = find_aruco(drawing, replace(aruco, columns=3, rows=4, first_marker=0))
    assert "but as with columns = 4, rows = 3, first_marker = 5." in read.reason
    assert len(find_aruco(drawing, aruco).corners) == 48


@pytest.mark.parametrize("first", [0, 5])
def test_markers_counted_from_below_are_those_of_an_aprilgrid(first: int) -> None:
    """And the other way round: the kind that fits is named, with its own keys."""
    grid = AprilGridSpec("APRILTAG_36h11", 4, 3, 40.0, 12.0, first_marker=first)
    above = ArucoSpec("APRILTAG_36h11", 4, 3, 40.0, 12.0, first_marker=first)
    for drawn, taken, words in (
        (grid, above, 'but as with kind = "aprilgrid", spacing = 0.3.'),
        (above, grid, 'but as with kind = "aruco", gap_mm = 12.'),
    ):
        picture = np.full((3 * 52 + 40, 4 * 52 + 40), 255, np.uint8)
        for row, column in np.ndindex(3, 4):
            marker = cv2.aruco.generateImageMarker(aruco_dictionary(drawn.dictionary), drawn.marker(row, column), 40)
            picture[20 + 52 * row : 60 + 52 * row, 20 + 52 * column : 60 + 52 * column] = marker
        board = find_aruco(picture, taken)
        assert not board.corners
        assert words in board.reason
        assert len(find_aruco(picture, drawn).corners) == 48


def test_charuco_numbers_that_begin_later() -> None:
    """Shifted by two rows of markers, all would lie as on a board that begins at 0."""
    spec = CharucoSpec("4X4_50", 6, 5, 32.0, 24.0, first_id=6)
    homography = board_from_pixel(4.0, 2e-4)
    picture = charuco_picture(spec, homography)
    board = measure_board(make_scan(picture), spec)
    errors = errors_px(board, read_truth(spec, homography))
    assert len(errors) >= 16
    assert np.abs(errors).max() < 0.06
    assert "but as with first_id = 6" in measure_board(make_scan(picture), replace(spec, first_id=0)).reason
    assert "but as with first_id = 6" in measure_board(make_scan(picture), replace(spec, first_id=30)).reason


def test_a_charuco_corner_is_held_against_the_markers_next_to_it() -> None:
    """One a square off, as another crossing would be, is named; where no marker beside it was read, nothing tells."""
    spec = CharucoSpec("4X4_50", 6, 5, 32.0, 24.0)
    homography = board_from_pixel(3.0, 1e-4)
    points, truth = spec.object_points(), read_truth(spec, homography)
    outline = np.array([(-12.0, 12.0), (12.0, 12.0), (12.0, -12.0), (-12.0, -12.0)])
    middle = np.mean([point[:2] for point in points.values()], axis=0)
    marker = outline + np.array(points["c2"][:2]) - middle + 16.0  # in the square between c2 and c3
    read = ReadMarkers({1: mapped(np.asarray(np.linalg.inv(homography)), marker)}, {}, 1)
    found = {name: FoundCorner(truth[name], 32 * np.eye(2)) for name in ("c2", "c3", "c19")}
    assert off_corners(found, spec, read) == {}
    found["c2"] = FoundCorner(truth["c7"], 32 * np.eye(2))
    assert "1.0 squares from the place that the adjacent markers give" in off_corners(found, spec, read)["c2"]


@parametrize_with_studies("dictionary", ["5X5_100", "APRILTAG_36h11"], quick=(1,))
def test_aruco_and_apriltag_corners(dictionary: str) -> None:
    spec = ArucoSpec(dictionary, 3, 2, 63.0, 21.0, first_marker=7)
    drawing = cv2.aruco.GridBoard((3, 2), 63.0, 21.0, aruco_dictionary(dictionary), np.arange(7, 13))
    homography = board_from_pixel(4.0, 1e-4)
    picture = take_picture(spec, homography, printed(drawing, spec, (231, 147), np.array([0.0, 147.0])))
    board = measure_board(make_scan(picture), spec)
    errors = errors_px(board, read_truth(spec, homography))
    assert len(errors) == 24
    assert np.sqrt(np.mean(errors**2)) < 0.03


@parametrize_with_studies(("turn_deg", "quarter_turns"), [(4.0, 0), (184.0, 2)], quick=(1,))
def test_a_grid_of_april_tags_has_its_corners_at_the_junctions(turn_deg: float, quarter_turns: int) -> None:
    """Counted from the lower left, however each tag is turned; two modules of border, squares at all corners."""
    homography = board_from_pixel(turn_deg, 1e-4)
    picture = take_picture(APRIL_GRID, homography, april_grid_dark(APRIL_GRID, quarter_turns))
    board = measure_board(make_scan(picture), APRIL_GRID)
    errors = errors_px(board, read_truth(APRIL_GRID, homography))
    assert len(errors) == 24
    assert np.sqrt(np.mean(errors**2)) < 0.03
    assert np.abs(errors.mean(axis=0)).max() < 0.008
    assert all("junction_col_px" in mark.quality for mark in board.marks)
    other = measure_board(make_scan(picture), replace(APRIL_GRID, first_marker=0))
    assert "but as with first_id = 5" in other.reason


@parametrize_with_studies("kind", ["aprilgrid", "charuco", "aruco"], quick=(2,))
def test_a_board_in_a_mirror_keeps_its_names(kind: str) -> None:
    """As it is seen from its back; what was read in the picture as it is, of another board's number, is none of it."""
    spec: ArucoSpec | CharucoSpec = APRIL_GRID
    homography = board_from_pixel(5.0, 1e-4)
    if kind == "charuco":
        spec = CharucoSpec("4X4_50", 6, 5, 32.0, 24.0)
        picture = charuco_picture(spec, homography)
    elif kind == "aruco":
        spec = ArucoSpec("5X5_100", 3, 2, 63.0, 21.0)
        drawing = cv2.aruco.GridBoard((3, 2), 63.0, 21.0, aruco_dictionary("5X5_100"))
        picture = take_picture(spec, homography, printed(drawing, spec, (231, 147), np.array([0.0, 147.0])))
    else:
        picture = take_picture(spec, homography, april_grid_dark(APRIL_GRID))
    truth = read_truth(spec, homography)
    board = measure_board(make_scan(picture[:, ::-1]), spec)
    assert board.is_mirrored
    errors = errors_px(board, {name: np.array([WIDTH - 1 - col, row]) for name, (col, row) in truth.items()})
    assert len(errors) >= 16
    assert np.sqrt(np.mean(errors**2)) < 0.03


@pytest.mark.parametrize("name", ["aruco", "charuco"])
def test_a_marker_read_twice_is_the_one_where_its_board_has_it(name: str) -> None:
    """A stray copy of one marker is passed over; of two like boards none is measured, and the reason says why."""
    dictionary = aruco_dictionary("4X4_50")
    spec: ArucoSpec | CharucoSpec
    if name == "aruco":
        spec = ArucoSpec("4X4_50", 3, 2, 60.0, 20.0)
        drawing = cv2.aruco.GridBoard((3, 2), 60.0, 20.0, dictionary).generateImage((260, 180), marginSize=20)
    else:
        spec = CharucoSpec("4X4_50", 5, 4, 48.0, 36.0)
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
        return measure_board(make_scan(8000 + 120 * cv2.GaussianBlur(grey, (0, 0), 0.8) + noise), spec)

    measured_marks = [mark.center_px for mark in measure_picture(picture).marks if mark.status is Status.MEASURED]
    assert len(measured_marks) == len(spec.object_points())
    assert max(center[0] for center in measured_marks if center is not None) < width + 20
    neither = measure_picture(two)
    assert "was read at 2 places" in neither.reason
    assert all(mark.status is Status.ABSENT for mark in neither.marks)
    both = measure_picture(half)
    assert all(mark.status is Status.MEASURED for mark in both.marks)
    assert "of which one lies on the board: there may be another such board" in both.refused[0]


@pytest.mark.parametrize("gap", [60.0, 130.0])
def test_markers_of_two_boards_are_not_those_of_one(gap: float) -> None:
    """Of one board the right column is seen, of another one the left: together they look like a board that is squeezed,
    and nobody knows which of them is meant."""
    spec = ArucoSpec("4X4_50", 4, 4, 48.0, 16.0)
    picture = np.full((296, 110 + int(gap)), 255.0)
    for row in range(4):
        top = 20 + 64 * row
        for number, left in ((4 * row + 3, 10), (4 * row, 48 + int(gap))):
            marker = cv2.aruco.generateImageMarker(aruco_dictionary("4X4_50"), number, 48)
            picture[top : top + 48, left : left + 48] = marker
    noise = np.random.default_rng(2).normal(0, 300, picture.shape)
    board = measure_board(make_scan(8000 + 120 * cv2.GaussianBlur(picture, (0, 0), 0.8) + noise), spec)
    assert "do not agree on where the board lies" in board.reason
    assert all(mark.status is Status.ABSENT for mark in board.marks)

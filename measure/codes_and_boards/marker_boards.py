"""The corners of boards with markers in a picture, to a pixel: ArUco grids and ChArUco boards.

Markers that lie as on a board of another layout are refused, with the layout that fits: read as they are said to be,
all points would have their neighbours' names.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.codes_and_boards.board_specs import ArucoSpec, CharucoSpec, aruco_dictionary
from measure.codes_and_boards.found_board import FoundBoard, FoundCorner, corners_of_square
from measure.codes_and_boards.marker_reading import (
    MarkerReadings,
    Markers,
    ReadMarkers,
    better_layout,
    other_first_numbers,
    placed_markers,
    read_markers,
)
from measure.reason import NO_REASON, Code, Reason

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_OFF_SQUARES = 0.25  # of a square, that a corner lies off where the markers beside it put it
_FEWEST_CORNERS = 4


def find_aruco(picture: Bytes, spec: ArucoSpec) -> FoundBoard:
    """The corners of the board's markers that are read; steps are the marker's sides that leave the corner."""
    readings = read_markers(picture, aruco_dictionary(spec.dictionary))
    read = placed_markers(readings, _aruco_markers(spec))
    better = better_layout(readings, read, ((other, _aruco_markers(other)) for other in _other_arucos(spec, readings)))
    if better:
        return _of_other_layout(spec, better[0])
    found: dict[str, FoundCorner] = {}
    for number, corners in read.corners_px.items():
        found |= corners_of_square(f"{number}", corners)
    reason = NO_REASON if found else _too_few(spec, read)
    return FoundBoard(found, reason, read.refused)


def find_charuco(picture: Bytes, spec: CharucoSpec) -> FoundBoard:
    """The inner corners whose neighbouring markers are read. Where the specification does not say which of OpenCV's two
    layouts the board has, its markers do."""
    readings = read_markers(picture, aruco_dictionary(spec.dictionary))
    read = placed_markers(readings, _charuco_markers(spec))
    others = ((other, _charuco_markers(other)) for other in _other_charucos(spec, readings))
    better = better_layout(readings, read, others)
    if better and (spec.legacy is not None or better[0] != replace(spec, legacy=True)):
        return _of_other_layout(spec, better[0])
    if better:
        spec, read = better
    outlines = [outline[None].astype(np.float32) for outline in read.corners_px.values()]
    numbers_read = np.array(list(read.corners_px), np.int32)[:, None]
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(_charuco_board(spec)).detectBoard(
        picture, markerCorners=outlines, markerIds=numbers_read
    )
    if corners is None or len(corners) < _FEWEST_CORNERS:
        return FoundBoard({}, _too_few(spec, read), read.refused)
    places, ids = np.asarray(corners, float).reshape(-1, 2), np.asarray(numbers, int).ravel()
    steps = _charuco_steps(ids, places, spec)
    found = {f"c{id}": FoundCorner(*corner) for id, *corner in zip(ids, places, steps, strict=True)}
    off = off_corners(found, spec, read)
    kept = {name: corner for name, corner in found.items() if name not in off}
    return FoundBoard(kept, refused=read.refused, off_corners=off)


def _other_arucos(spec: ArucoSpec, read: MarkerReadings) -> Iterator[ArucoSpec]:
    """What a board may be that is taken for the one that is described."""
    if spec.columns != spec.rows:
        yield replace(spec, columns=spec.rows, rows=spec.columns)
    for first in other_first_numbers(read, spec.first_marker, spec.columns * spec.rows):
        yield replace(spec, first_marker=first)


def _other_charucos(spec: CharucoSpec, read: MarkerReadings) -> Iterator[CharucoSpec]:
    """What a board may be that is taken for the one that is described."""
    firsts = other_first_numbers(read, spec.first_id, spec.columns * spec.rows // 2)
    turned = replace(spec, columns=spec.rows, rows=spec.columns)
    for board in (spec, turned, *(replace(spec, first_id=first) for first in firsts)):
        for legacy in (False, True):
            if replace(board, legacy=legacy) != replace(spec, legacy=bool(spec.legacy)):
                yield replace(board, legacy=legacy)


def _of_other_layout(spec: ArucoSpec | CharucoSpec, other: ArucoSpec | CharucoSpec) -> FoundBoard:
    """No corners, and what of the description does not fit the markers."""
    keys = ("columns", "rows", "first_marker", "first_id", "legacy")
    differing = [key for key in keys if getattr(spec, key, None) != getattr(other, key, None)]
    if not getattr(other, "legacy", None):
        differing = [key for key in differing if key != "legacy" or getattr(spec, key)]
    fitting = ", ".join(f"{key} = {str(getattr(other, key)).lower()}" for key in differing)
    told = f"the markers that were read do not lie as on the board that is described, but as with {fitting}"
    return FoundBoard({}, Reason(f"{told}. Set that, if it is the board's", Code.NO_BOARD))


def _too_few(spec: ArucoSpec | CharucoSpec, read: ReadMarkers) -> Reason:
    """Why a board was not found."""
    if read.refused:
        return next(iter(read.refused.values()))
    if isinstance(spec, CharucoSpec):
        told = f"{len(read.corners_px)} markers of {spec.dictionary} were read, too few to place the board's corners"
    else:
        last = spec.first_marker + spec.columns * spec.rows - 1
        told = f"no marker {spec.first_marker} to {last} of {spec.dictionary} was read"
    return Reason(told, Code.NO_BOARD)


def _aruco_markers(spec: ArucoSpec) -> Markers:
    points = spec.object_points()
    numbers = range(spec.first_marker, spec.first_marker + spec.columns * spec.rows)
    return {number: np.array([points[f"{number}.{index}"][:2] for index in range(4)]) for number in numbers}


def _charuco_board(spec: CharucoSpec) -> cv2.aruco.CharucoBoard:
    numbers = np.arange(spec.first_id, spec.first_id + spec.columns * spec.rows // 2)
    size = (spec.columns, spec.rows)
    dictionary = aruco_dictionary(spec.dictionary)
    board = cv2.aruco.CharucoBoard(size, spec.square_mm, spec.marker_mm, dictionary, numbers)
    board.setLegacyPattern(bool(spec.legacy))
    return board


def _charuco_markers(spec: CharucoSpec) -> Markers:
    """OpenCV's board: y down, its origin at the upper left square's corner."""
    board = _charuco_board(spec)
    return dict(zip(np.ravel(board.getIds()).tolist(), np.array(board.getObjPoints())[..., :2], strict=True))


def _charuco_steps(ids: NDArray[np.int64], places: Array, spec: CharucoSpec) -> list[Array]:
    """The squares' sides at each corner, from a homography of the board: neighbours may be missing."""
    across = spec.columns - 1
    board = np.stack([ids % across, ids // across], axis=-1).astype(float)
    homography, _ = cv2.findHomography(board, places)
    return [_homography_steps(np.asarray(homography, float), place) for place in board]


def _homography_steps(homography: Array, place: Array) -> Array:
    """(2, 2) derivatives of a homography at a place."""
    x, y, w = homography @ (*place, 1.0)
    return np.asarray((homography[:2, :2] - np.outer((x, y), homography[2, :2]) / w) / w)


def off_corners(found: Mapping[str, FoundCorner], spec: CharucoSpec, read: ReadMarkers) -> dict[str, Reason]:
    """The corners that do not lie where the markers that touch them put them, and why."""
    on_board = _charuco_markers(spec)
    middles = {number: on_board[number].mean(axis=0) / spec.square_mm for number in read.corners_px}
    off = {}
    for name, corner in found.items():
        row, column = divmod(int(name[1:]), spec.columns - 1)
        place = np.array([column + 1.0, row + 1.0])
        beside = [number for number, middle in middles.items() if np.abs(middle - place).max() < 1.0]
        if not beside:
            continue
        squares = np.concatenate([on_board[number] for number in beside]) / spec.square_mm
        seen = np.concatenate([read.corners_px[number] for number in beside])
        homography = np.asarray(cv2.findHomography(squares, seen)[0], float)
        x, y, w = homography @ (*place, 1.0)
        squares_off = np.linalg.solve(_homography_steps(homography, place), corner.center_px - (x / w, y / w))
        if np.hypot(*squares_off) > _OFF_SQUARES:
            told = f"it lies {np.hypot(*squares_off):.1f} squares off where the markers beside it put it"
            off[name] = Reason(told, Code.OFF_PLACE)
    return off

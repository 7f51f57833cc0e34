"""Where a calibration board lies in a scan, to a pixel: OpenCV's detectors on a reduced picture."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.codes_and_boards.board_specs import (
    ArucoSpec,
    CharucoSpec,
    ChessboardSpec,
    SquareGridSpec,
    aruco_dictionary,
)
from measure.codes_and_boards.marker_reading import ReadMarkers, read_markers
from measure.codes_and_boards.square_grids import NoSquareGridError, find_squares
from measure.reason import NO_REASON, Code, Reason
from measure.scans.scan import Scan

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_FIRST_SIZE_PX, _LAST_SIZE_PX = 1500, 4000  # the longer side of the pictures that are searched
_THOROUGHLY = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
_DRAWINGS = 3  # of the chessboard detector's random numbers for a second board: one in twenty missed one at the edge
_LEAST_CONTRAST = 0.01  # of the full scale; below it there is nothing to be seen, and searching takes long


@dataclass(frozen=True)
class FoundCorner:
    """A corner to a pixel. center_px (2,) in the scan; steps_px (2, 2): its columns are the sides of the square that
    begins here (its right and its lower neighbour), or of the marker: the edges leaving the corner."""

    center_px: Array
    steps_px: Array


@dataclass(frozen=True)
class FoundBoard:
    """The corners found, by id; none, and the reason why; refused: the markers that were read and are not used, by
    number, and why; others_px: the middles of further boards that look the same; notes: what the user should know."""

    corners: dict[str, FoundCorner]
    reason: Reason = NO_REASON
    refused: Mapping[int, Reason] = field(default_factory=dict)
    others_px: tuple[Array, ...] = ()
    notes: tuple[str, ...] = ()


def find_board(scan: Scan, spec: ChessboardSpec | ArucoSpec | CharucoSpec | SquareGridSpec) -> FoundBoard:
    """Search a board at a size that shows it whole, then finer: small boards in large scans need it."""
    for factor in _search_factors(scan):
        picture, reason = _searchable(scan, factor)
        if reason:
            return FoundBoard({}, reason)
        if isinstance(spec, ChessboardSpec):
            found = _find_chessboard(picture, spec)
        elif isinstance(spec, CharucoSpec):
            found = _find_charuco(picture, spec)
        elif isinstance(spec, SquareGridSpec):
            found = _find_squares(picture, spec)
        else:
            found = _find_aruco(picture, spec)
        if found.corners:
            corners = {name: _in_scan(corner, factor) for name, corner in found.corners.items()}
            return replace(found, corners=corners, others_px=tuple(_scan_px(one, factor) for one in found.others_px))
    return found


def _search_factors(scan: Scan) -> list[int]:
    """Reductions of the scan to search, the coarsest first."""
    longest = max(scan.width_px, scan.height_px)
    coarse, fine = (max(round(longest / size), 1) for size in (_FIRST_SIZE_PX, _LAST_SIZE_PX))
    return [coarse] if coarse == fine else [coarse, fine]


def _searchable(scan: Scan, factor: int) -> tuple[Bytes, Reason]:
    """The reduced scan stretched to 8 bits, and why there is nothing to search in it, if so."""
    grey = scan.reduced(factor)
    low, high = np.percentile(grey, (1, 99))
    if high - low < _LEAST_CONTRAST * scan.full_scale_dn:
        share = 100 * (high - low) / scan.full_scale_dn
        told = f"the scan has no contrast: its grey values span {share:.1f} % of the scale"
        return np.zeros((1, 1), np.uint8), Reason(told, Code.CONTRAST)
    return np.clip((grey - low) * (255 / (high - low)), 0, 255).astype(np.uint8), NO_REASON


def _in_scan(corner: FoundCorner, factor: int) -> FoundCorner:
    return FoundCorner(_scan_px(corner.center_px, factor), corner.steps_px * factor)


def _scan_px(place_px: Array, factor: int) -> Array:
    """Pixel (i, j) of a reduced picture has its centre at factor j + (factor - 1) / 2."""
    return place_px * factor + (factor - 1) / 2


def _find_chessboard(picture: Bytes, spec: ChessboardSpec) -> FoundBoard:
    """All inner corners of a chessboard that is wholly seen, and whether it is the only one."""
    grid = _chessboard_grid(picture, spec)
    if grid is None:
        told = f"no chessboard of {spec.columns} x {spec.rows} inner corners is wholly seen"
        return FoundBoard({}, Reason(told, Code.NO_BOARD))
    corners = {
        f"r{row}c{column}": FoundCorner(grid[row, column], steps)
        for (row, column), steps in np.ndenumerate(_grid_steps(grid))
    }
    return FoundBoard(corners, others_px=_other_chessboards(picture, grid, spec))


def _chessboard_grid(picture: Bytes, spec: ChessboardSpec) -> Array | None:
    """(rows, columns, 2) the inner corners of a chessboard, None where none is seen."""
    for flags in (_THOROUGHLY, 0):
        grid = _drawn_chessboard_grid(picture, spec, flags, drawings=1)
        if grid is not None:
            return _right_handed(grid)
    # The older detector can search for minutes in vain; its fast check refuses a picture without squares first.
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(picture, (spec.columns, spec.rows), flags=flags)
    return _right_handed(np.asarray(corners, float).reshape(spec.rows, spec.columns, 2)) if found else None


def _drawn_chessboard_grid(picture: Bytes, spec: ChessboardSpec, flags: int, drawings: int) -> Array | None:
    """(rows, columns, 2) as the newer detector sees them. It draws random numbers: always the same ones here, lest a
    result depend on what was searched before it."""
    for seed in range(1, drawings + 1):
        cv2.setRNGSeed(seed)
        found, corners = cv2.findChessboardCornersSB(picture, (spec.columns, spec.rows), flags=flags)
        if found:
            return np.asarray(corners, float).reshape(spec.rows, spec.columns, 2)
    return None


def _other_chessboards(picture: Bytes, grid: Array, spec: ChessboardSpec) -> tuple[Array, ...]:
    """The middles of the chessboards beside those that were found, each painted over before the next is sought."""
    picture, background = picture.copy(), int(np.median(picture))
    others: list[Array] = []
    while True:
        cv2.fillConvexPoly(picture, np.round(_outline(grid)).astype(np.int32), background)
        other = _drawn_chessboard_grid(picture, spec, _THOROUGHLY, _DRAWINGS)
        if other is None:
            return tuple(others)
        grid = other
        others.append(grid.mean(axis=(0, 1)))


def _outline(grid: Array) -> Array:
    """(n, 2) the convex outline of a chessboard's squares: its inner corners and a step beyond them."""
    columns = np.concatenate([2 * grid[:, :1] - grid[:, 1:2], grid, 2 * grid[:, -1:] - grid[:, -2:-1]], axis=1)
    squares = np.concatenate([2 * columns[:1] - columns[1:2], columns, 2 * columns[-1:] - columns[-2:-1]])
    return np.asarray(cv2.convexHull(squares.reshape(-1, 2).astype(np.float32)), float).reshape(-1, 2)


def _right_handed(grid: Array) -> Array:
    """A (rows, columns, 2) grid of which the columns' direction, then the rows', turn as column and row of a scan."""
    across, down = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    turn = np.linalg.det(np.stack([across.mean(axis=0), down.mean(axis=0)]))
    return grid if turn > 0 else grid[:, ::-1]


def _grid_steps(grid: Array) -> NDArray[np.object_]:
    """(rows, columns) of (2, 2) matrices: the grid's steps to the right and down at each of its points."""
    steps = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=-1)
    result = np.empty(grid.shape[:2], object)
    for place in np.ndindex(*result.shape):
        result[place] = steps[place]
    return result


def _find_charuco(picture: Bytes, spec: CharucoSpec) -> FoundBoard:
    """The inner corners whose neighbouring markers are read."""
    size = (spec.columns, spec.rows)
    board = cv2.aruco.CharucoBoard(size, spec.square_mm, spec.marker_mm, aruco_dictionary(spec.dictionary))
    on_board = dict(zip(np.ravel(board.getIds()).tolist(), np.array(board.getObjPoints())[..., :2], strict=True))
    read = read_markers(picture, aruco_dictionary(spec.dictionary), on_board)
    outlines = [read.corners_px[number][None].astype(np.float32) for number in read.corners_px]
    numbers_read = np.array(list(read.corners_px), np.int32)[:, None]
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(
        picture, markerCorners=outlines, markerIds=numbers_read
    )
    if corners is None or len(corners) < 4:
        told = f"{len(outlines)} markers of {spec.dictionary} were read, too few to place the board's corners"
        reason = Reason(told, Code.NO_BOARD)
        return FoundBoard({}, _with_refused(reason, read), read.refused)
    places, ids = np.asarray(corners, float).reshape(-1, 2), np.asarray(numbers, int).ravel()
    return FoundBoard(
        {
            f"c{number}": FoundCorner(place, steps)
            for number, place, steps in zip(ids, places, _charuco_steps(ids, places, spec), strict=True)
        },
        refused=read.refused,
    )


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


def _find_aruco(picture: Bytes, spec: ArucoSpec) -> FoundBoard:
    """The corners of the board's markers that are read; steps are the marker's sides that leave the corner."""
    points = spec.object_points()
    wanted = range(spec.first_marker, spec.first_marker + spec.columns * spec.rows)
    on_board = {number: np.array([points[f"{number}.{index}"][:2] for index in range(4)]) for number in wanted}
    read = read_markers(picture, aruco_dictionary(spec.dictionary), on_board)
    found: dict[str, FoundCorner] = {}
    for number, corners in read.corners_px.items():
        found |= _corners_of(f"{number}", corners)
    if found:
        return FoundBoard(found, NO_REASON, read.refused)
    reason = Reason(f"no marker {wanted[0]} to {wanted[-1]} of {spec.dictionary} was read", Code.NO_BOARD)
    return FoundBoard(found, _with_refused(reason, read), read.refused)


def _find_squares(picture: Bytes, spec: SquareGridSpec) -> FoundBoard:
    """The corners of separate squares; steps are the square's sides that leave the corner."""
    try:
        squares, notes, others = find_squares(picture, spec)
    except NoSquareGridError as error:
        return FoundBoard({}, Reason(str(error), Code.NO_BOARD))
    corners = {id: corner for name, four in squares.items() for id, corner in _corners_of(name, four).items()}
    return FoundBoard(corners, others_px=others, notes=notes)


def _corners_of(name: str, corners: Array) -> dict[str, FoundCorner]:
    """The four corners (4, 2) of a square or marker, with its sides that leave them."""
    found = {}
    for index, corner in enumerate(corners):
        sides = np.stack([corners[(index + 1) % 4] - corner, corners[(index - 1) % 4] - corner], axis=-1)
        found[f"{name}.{index}"] = FoundCorner(corner, sides)
    return found


def _with_refused(reason: Reason, read: ReadMarkers) -> Reason:
    """Why a board was not found, where markers were read that are not used."""
    return next(iter(read.refused.values()), reason)

"""The inner corners of a chessboard in a picture, to a pixel, and whether the board is as large as it is said to be."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.codes_and_boards.board_specs import ChessboardSpec
from measure.codes_and_boards.chessboard_lines import WholePattern, is_even, whole_pattern
from measure.codes_and_boards.found_board import FoundBoard, FoundCorner
from measure.reason import Code, Reason

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_THOROUGHLY = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
_DRAWINGS = 3  # of the chessboard detector's random numbers for a second board: one in twenty missed one at the edge
_LEAST = 3  # lines that a chessboard has in either direction


def find_chessboard(picture: Bytes, spec: ChessboardSpec) -> FoundBoard:
    """All inner corners of a chessboard that is wholly seen, and whether it is the only one. A board of another count
    is refused, with its count: its corners would have their neighbours' names."""
    size_px = (picture.shape[1], picture.shape[0])
    other_size: WholePattern | None = None
    for grid in _grids(picture, spec):
        pattern = whole_pattern(picture, grid) if is_even(grid, size_px) else None
        if pattern is None:
            continue
        if pattern.grid.shape == grid.shape == (spec.rows, spec.columns, 2):
            corners = {
                f"r{row}c{column}": FoundCorner(grid[row, column], steps)
                for (row, column), steps in np.ndenumerate(_grid_steps(grid))
            }
            return FoundBoard(corners, others_px=_other_chessboards(picture, grid, spec))
        other_size = pattern
    return FoundBoard({}, Reason(_refusal(spec, other_size), Code.NO_BOARD))


def _refusal(spec: ChessboardSpec, pattern: WholePattern | None) -> str:
    """Why there is no board of the count that is asked for, with the count that fits, if there is one."""
    told = f"no chessboard of {spec.columns} x {spec.rows} inner corners is wholly seen"
    if pattern is None:
        return told
    rows, columns = pattern.grid.shape[:2]
    both = ((columns, rows), (rows, columns))  # nothing tells which are the rows
    columns, rows = min(both, key=lambda one: ((one[0] - spec.columns) ** 2 + (one[1] - spec.rows) ** 2, -one[0]))
    told += f"; one of {columns} x {rows} is"
    if (columns, rows) == (spec.columns - 1, spec.rows - 1):
        return f"{told}: squares may have been counted in place of inner corners, which columns and rows count"
    if columns > spec.columns or rows > spec.rows or pattern.is_bounded:
        return f"{told}. Set columns and rows to the count of the board's inner corners"
    return f"{told}, and the rest may lie outside of the scan"


def _grids(picture: Bytes, spec: ChessboardSpec) -> Iterator[Array]:
    """(rows, columns, 2) grids of corners that may be the board, those of the most reliable detector first; the last is
    of any count."""
    for flags in (_THOROUGHLY, 0):
        grid = _drawn_chessboard_grid(picture, spec, flags, drawings=1)
        if grid is not None:
            yield _right_handed(grid)
    # The older detector can search for minutes in vain; its fast check refuses a picture without squares first.
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(picture, (spec.columns, spec.rows), flags=flags)
    if found:
        yield _right_handed(np.asarray(corners, float).reshape(spec.rows, spec.columns, 2))
    cv2.setRNGSeed(1)
    flags = _THOROUGHLY | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(picture, (_LEAST, _LEAST), flags)
    if found:
        grid = np.asarray(corners, float).reshape(*meta.shape, 2)
        is_turned = meta.shape == (spec.columns, spec.rows)
        yield _right_handed(grid.transpose(1, 0, 2) if is_turned else grid)


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

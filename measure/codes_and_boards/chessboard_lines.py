"""Whether a grid of corners is a whole chessboard: its lines follow one another evenly, and the pattern ends where they
do.

A detector that is asked for a wrong count leaves out a line, or stops before the pattern ends. The corners that it
gives are consistent with one another, and have their neighbours' names.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.targets.sheets import robust_view

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_UNEVEN = 0.25  # of a square, that a corner lies off an even grid: beside a line that is left out it is a half
_INTO_SQUARE = 0.3  # of its sides: where the grey value of a square is taken
_CROSSING = 0.25  # of the board's contrast: more between all neighbours of the four squares makes a crossing
_SMOOTHED_PX = 10.0  # squares from this side on are looked at over 3 x 3 pixels
_MOST_LINES = 500  # of a board, along a side


@dataclass(frozen=True, eq=False)
class WholePattern:
    """The pattern that a grid belongs to: grid (rows, columns, 2), grown to where the pattern ends; is_bounded: whether
    the picture shows its end on all four sides."""

    grid: Array
    is_bounded: bool


def is_even(grid: Array, size_px: tuple[int, int]) -> bool:
    """Whether the lines of corners (rows, columns, 2) lie evenly under one homography and a lens's radial distortion,
    wherever the detector put single corners."""
    rows, columns = grid.shape[:2]
    places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    view = robust_view(places, grid.reshape(-1, 2), size_px)
    if view is None:
        return False
    off = np.hypot(*(view.places_px(places) - grid.reshape(-1, 2)).T).reshape(rows, columns) / _shorter_steps(grid)
    return all(np.median(line) < _UNEVEN for line in (*off, *off.T))


def whole_pattern(picture: Bytes, grid: Array) -> WholePattern | None:
    """The pattern that a grid is a part of; None where the grid's own lines are not all lines of crossings."""
    if _shorter_steps(grid).min() > _SMOOTHED_PX:
        picture = np.asarray(cv2.blur(picture, (3, 3)), np.uint8)
    crossings = _crossing_contrast(picture, grid)
    contrast = float(np.median(crossings))
    if contrast < 0:
        crossings, contrast = -crossings, -contrast
    seen = crossings > _CROSSING * contrast
    if not (contrast > 0 and all(2 * line.sum() >= len(line) for line in (*seen, *seen.T))):
        return None
    is_bounded = True
    for _ in range(4):
        grid, ends = _grown(picture, grid, contrast)
        is_bounded &= ends
        grid = np.rot90(grid)
    return WholePattern(grid, is_bounded)


def _grown(picture: Bytes, grid: Array, contrast: float) -> tuple[Array, bool]:
    """The grid with the pattern's further lines before its first row, and whether the picture shows where it ends."""
    parity = np.sign(np.median(_crossing_contrast(picture, grid)))
    while True:
        line = 3 * grid[0] - 3 * grid[1] + grid[2]
        further = np.concatenate([line[None], grid])
        height, width = picture.shape
        inside = np.all((line > 0) & (line < (width - 1, height - 1)), axis=1)
        if 2 * inside.sum() < len(inside):
            return grid, False
        parity = -parity
        crossings = parity * _crossing_contrast(picture, further[:3])[0]
        if 2 * np.sum(crossings[inside] > _CROSSING * contrast) < inside.sum() or len(further) > _MOST_LINES:
            return grid, True
        grid = further


def _crossing_contrast(picture: Bytes, grid: Array) -> Array:
    """(rows, columns) the least difference in grey value between neighbours of the four squares about each corner, with
    the sign that the first corner's has; 0 where light and dark do not alternate about it."""
    right, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    corners = [grid + _INTO_SQUARE * (x * right + y * down) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    columns_rows = np.concatenate(corners).astype(np.float32)
    columns, rows = columns_rows[..., 0], columns_rows[..., 1]
    grey = cv2.remap(picture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
    a, b, c, d = np.split(grey, 4)
    between = np.stack([a - b, c - b, c - d, a - d])
    alternating = np.maximum(between.min(axis=0), 0.0) + np.minimum(between.max(axis=0), 0.0)
    return np.asarray(alternating * np.where(np.indices(grid.shape[:2]).sum(axis=0) % 2, -1.0, 1.0))


def _shorter_steps(grid: Array) -> Array:
    """(rows, columns) the shorter of the steps to the next column and the next row, px."""
    across, down = (np.hypot(*np.moveaxis(np.gradient(grid, axis=axis), 2, 0)) for axis in (1, 0))
    return np.asarray(np.minimum(across, down))

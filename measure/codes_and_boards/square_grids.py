"""Grids of separate dark squares, as Zhang's pattern: found as quadrangles, put in the grid's order, named by it."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.codes_and_boards.board_specs import SquareGridSpec
from measure.codes_and_boards.lattices import Place, grid_places, is_whole, other_grids, upright

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_BLOCKS = (1 / 4, 1 / 8, 1 / 16)  # of the picture's shorter side: about so far the ground of a square is looked at
_DARKER = 12  # grey values of 255 that a square is darker by than the mean about it
_SMALLEST_SIDE_PX = 6.0
_LARGEST = 0.2  # of the picture's area: what is larger is no square of a grid
_STRAIGHT = 0.06  # of its outline: how far a quadrangle's sides may leave it
_FILLED = 0.8  # of the quadrangle that the outline holds


class NoSquareGridError(Exception):
    """A picture shows no grid, or more of one than is meant; the message says what it shows."""


def find_squares(picture: Bytes, spec: SquareGridSpec) -> tuple[dict[str, Array], tuple[str, ...], tuple[Array, ...]]:
    """The corners (4, 2) of the squares that are seen, by their names, clockwise from the upper left one; notes on how
    the grid was taken; the middles of further grids that look the same. A pixel or so off.

    Raises NoSquareGridError where not nearly all of a grid of this size is seen.
    """
    told = ""
    for share in _BLOCKS:
        quads = list(_dark_quads(picture, share))
        centers = np.array([quad.mean(axis=0) for quad in quads]).reshape(-1, 2)
        looks = np.log([[cv2.contourArea(quad.astype(np.float32))] for quad in quads] or np.ones((0, 1)))
        assignments = grid_places(centers, looks, spec.places())
        if is_whole(assignments):
            assignment = max(assignments, key=lambda found: upright(found, centers))
            notes = ("the grid looks the same when turned: it was taken as upright in the scan",)
            corners = {
                spec.name_of(place): _ordered(quads[index], _steps(assignment, centers, place))
                for place, index in assignment.items()
            }
            return corners, notes[: len(assignments) - 1], other_grids(centers, looks, assignment, spec.places())
        told = f"no grid of {spec.columns} x {spec.rows} squares is wholly seen; {len(quads)} spots look like squares"
        if assignments:
            told = f"a grid of more than {spec.columns} x {spec.rows} squares is seen, or one with a line of it hidden"
    raise NoSquareGridError(told)


def _dark_quads(picture: Bytes, share: float) -> Iterator[Array]:
    """The outlines (4, 2) of dark quadrangles, against the mean over a part of the picture's shorter side."""
    block = max(int(share * min(picture.shape)), 3) | 1
    dark = cv2.adaptiveThreshold(picture, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, block, _DARKER)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        area = cv2.contourArea(outline)
        if not _SMALLEST_SIDE_PX**2 <= area <= _LARGEST * picture.size:
            continue
        quad = cv2.approxPolyDP(outline, _STRAIGHT * cv2.arcLength(outline, True), True)
        if len(quad) == 4 and cv2.isContourConvex(quad) and area > _FILLED * cv2.contourArea(quad):
            yield np.asarray(quad, float).reshape(4, 2)


def _steps(assignment: dict[Place, int], centers: Array, place: Place) -> Array:
    """(2, 2) the steps to the next column and the next row at a place, by a homography of all squares."""
    grid = np.array([(column, row) for row, column in assignment], float)
    homography, _ = cv2.findHomography(grid, centers[list(assignment.values())])
    x, y, w = np.asarray(homography, float) @ (place[1], place[0], 1.0)
    return np.asarray((homography[:2, :2] - np.outer((x, y), homography[2, :2]) / w) / w, float)


def _ordered(quad: Array, steps: Array) -> Array:
    """The corners from the upper left one on, clockwise as the grid is meant to be seen."""
    right, down = np.linalg.solve(steps, (quad - quad.mean(axis=0)).T)
    return np.asarray(quad[np.argsort(np.arctan2(down, right))])

"""How much of each pixel a drawn mark covers: the ideal picture of a mark, before film and scanner blur it.

A pixel (col, row) is the unit square about its centre. An affine map takes the mark's millimetres (x right, y up) to
pixels (col right, row down). Every part is an outline, a circle one of so many corners that it is as good; by Green's
theorem the area of a part in each pixel follows from the piece of outline in it and in the pixels left of it.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.shapes import Bar, Disk, MarkShape, Part, Polygon, Ring

Array = NDArray[np.float64]
Single = NDArray[np.float32]

CELLS = 4  # cells along a pixel's side: more than any blur of a scan tells apart
_ROUND = 0.002  # cells: how far off its circle an outline may be


def coverage(shape: MarkShape, pixel_from_mark: Array, width: int, height: int) -> Array:
    """(height, width) shares, 0 to 1, of the pixels' areas that the mark covers.

    pixel_from_mark: (2, 3) affine matrix from (x_mm, y_mm, 1) to (col, row) in this window. A part's share is exact;
    where parts overlap they count once, to about 0.001 of a pixel.
    """
    return pixel_means(cell_coverage(shape, pixel_from_mark, width, height, CELLS), CELLS)


def cell_coverage(shape: MarkShape, pixel_from_mark: Array, width: int, height: int, cells: int) -> Single:
    """The coverage of the cells that a window's pixels are divided into, (height * cells, width * cells)."""
    cell_from_mark = np.array(pixel_from_mark, dtype=float)
    cell_from_mark[:, 2] += 0.5
    cell_from_mark *= cells  # corners of cells are whole numbers
    covered = np.zeros((height * cells, width * cells), np.float32)
    for part in shape.parts:
        _add(covered, [_mapped(each, cell_from_mark) for each in _outlines(part, cell_from_mark)])
    return covered


def pixel_means(cell_values: NDArray[np.floating], cells: int) -> Array:
    """Means over the cells of each pixel of an image (rows, columns)."""
    rows, cols = cell_values.shape
    size = (cols // cells, rows // cells)
    return np.asarray(cv2.resize(cell_values, size, interpolation=cv2.INTER_AREA), dtype=float)


def outline_mm(part: Part) -> Array:
    """(n, 2) corners of a convex region that holds the part."""
    if isinstance(part, Polygon):
        return np.asarray(part.vertices_mm, dtype=float)
    if isinstance(part, Bar):
        start, end = np.asarray(part.from_mm), np.asarray(part.to_mm)
        along = (end - start) / np.hypot(*(end - start))
        side = np.array([-along[1], along[0]]) * part.line_mm / 2
        return np.stack([start - side, start + side, end + side, end - side])
    reach = part.radius_mm + (part.line_mm / 2 if isinstance(part, Ring) else 0.0)
    return np.asarray(part.center_mm) + reach * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])


def _outlines(part: Part, cell_from_mark: Array) -> list[Array]:
    """The part's outlines in mm, (n, 2) each; a hole's runs the other way round."""
    if isinstance(part, Bar | Polygon):
        return [outline_mm(part)]
    if isinstance(part, Disk):
        return [_circle(part, part.radius_mm, cell_from_mark)]
    inner, outer = (_circle(part, part.radius_mm + side * part.line_mm / 2, cell_from_mark) for side in (-1, 1))
    return [outer, inner[::-1]]


def _circle(part: Disk | Ring, radius_mm: float, cell_from_mark: Array) -> Array:
    """Corners of a polygon of the circle's area; none where there is no circle."""
    if radius_mm <= 0:
        return np.zeros((0, 2))
    # A chord and its corners lie off the circle of the same area by no more than a third of radius * half angle².
    radius = radius_mm * float(np.linalg.norm(cell_from_mark[:, :2], 2))
    count = max(int(np.ceil(np.pi * np.sqrt(radius / (3 * _ROUND)))), 16)
    turn = 2 * np.pi / count
    angles = turn * np.arange(count)
    corner_mm = radius_mm * np.sqrt(turn / np.sin(turn))
    return np.asarray(part.center_mm + corner_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def _mapped(points_mm: Array, cell_from_mark: Array) -> Array:
    return np.asarray(points_mm @ cell_from_mark[:, :2].T + cell_from_mark[:, 2])


def _add(covered: Single, outlines: list[Array]) -> None:
    """Add a part to what is covered already; only the cells about it are looked at."""
    corners = np.concatenate(outlines)
    size = covered.shape[::-1]
    col0, row0 = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, size)
    col1, row1 = np.clip(np.ceil(corners.max(axis=0)).astype(int), 0, size)
    if col0 < col1 and row0 < row1:
        about = covered[row0:row1, col0:col1]
        part = _areas([each - (col0, row0) for each in outlines], int(col1 - col0), int(row1 - row0))
        about += (1 - about) * part


def _areas(outlines: list[Array], width: int, height: int) -> Single:
    """(height, width) areas inside of closed outlines (n, 2): each piece of them within one cell adds its height to all
    cells right of it, and to its own what lies right of it there."""
    start = np.concatenate(outlines)
    end = np.concatenate([np.roll(each, -1, axis=0) for each in outlines])
    start, end = _split(*_split(start, end, axis=1), axis=0)
    tall, middle = end[:, 1] - start[:, 1], (start + end) / 2
    col, row = np.floor(middle).astype(np.intp).T
    right_part = np.where(col < 0, 1.0, col + 1 - middle[:, 0])
    seen = (row >= 0) & (row < height) & (col < width)
    cell = (row * (width + 1) + np.maximum(col, 0))[seen]
    own = (tall * right_part)[seen]
    rest = tall[seen] - own
    added = np.bincount(cell, own, height * (width + 1)) + np.bincount(cell + 1, rest, height * (width + 1))
    areas = np.cumsum(added.reshape(height, width + 1)[:, :width], axis=1)
    return np.clip(np.abs(areas), 0.0, 1.0).astype(np.float32)


def _split(start: Array, end: Array, axis: int) -> tuple[Array, Array]:
    """Lines (n, 2) cut where they cross whole numbers of a coordinate, in their order."""
    first, last = np.floor(start[:, axis]), np.floor(end[:, axis])
    pieces = np.abs(last - first).astype(np.intp) + 1
    line = np.repeat(np.arange(len(start)), pieces)
    number = np.arange(len(line)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    step = (end - start)[line]
    crossing = first[line] + np.where(step[:, axis] >= 0, number, 1 - number)
    crosses = step[:, axis] != 0
    share = np.divide(crossing - start[line, axis], step[:, axis], out=np.zeros(len(line)), where=crosses)
    at = start[line] + share[:, None] * step
    at[:, axis] = crossing
    cut_start = np.where((number == 0)[:, None], start[line], at)
    is_last = number == pieces[line] - 1
    cut_end = np.where(is_last[:, None], end[line], np.roll(at, -1, axis=0))
    return cut_start, cut_end

"""Area coverage of pixels by a drawn mark: its ideal image without the blur of film and scanner.

A pixel (col, row) is the unit square around its centre. An affine map transforms the mark's millimetres (x right, y up)
to pixels (col right, row down). Every part is an outline; circles are approximated by polygons of sufficiently many
corners. By Green's theorem, the area of a part in each pixel follows from the outline in it and in the pixels left of
it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Single
from measure.marks.shapes import Bar, Disk, MarkShape, Part, Polygon, Ring, outline_mm

Integers = NDArray[np.intp]

CELLS = 4  # cells along a pixel's side, finer than the blur of any scan resolves
_ROUND = 0.002  # cells, largest deviation of an outline from its circle


def cell_coverage(shape: MarkShape, pixel_from_mark: Array, width: int, height: int, cells: int) -> Single:
    """Render a mark without blur.

    Parameters
    ----------
    pixel_from_mark : (2, 3) affine matrix from (x_mm, y_mm, 1) to (col, row) in a window of width x height px.
    cells : number of cells along a pixel's side.

    Returns
    -------
    (height * cells, width * cells) fraction, 0 to 1, of each cell's area that the mark covers. It is exact for a single
    part; the union of overlapping parts is exact to about 0.001 of a pixel.
    """
    cell_from_mark = np.array(pixel_from_mark, dtype=float)
    cell_from_mark[:, 2] += 0.5
    cell_from_mark *= cells  # corners of cells are whole numbers
    covered = np.zeros((height * cells, width * cells), np.float32)
    for pieces in _outline_pieces(shape, cell_from_mark):
        _add(covered, pieces)
    return covered


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Outline of a part, cut into n pieces, each within one cell. row, col: (n,) of the cell; tall: (n,) height,
    positive downwards; middle: (n,) column of the centre."""

    row: Integers
    col: Integers
    tall: Array
    middle: Array


def _outline_pieces(shape: MarkShape, cell_from_mark: Array) -> Iterator[_Pieces]:
    """Cut the outlines of all parts at the cell borders, in one pass; yields the pieces of each part."""
    parts = shape.parts
    outlines = [_outlines(part, cell_from_mark) for part in parts]
    corners = np.concatenate([outline for own in outlines for outline in own])
    ends = np.concatenate([np.roll(outline, -1, axis=0) for own in outlines for outline in own])
    part_of = np.repeat(np.arange(len(parts)), [sum(map(len, own)) for own in outlines])
    linear, shift = cell_from_mark[:, :2].T, cell_from_mark[:, 2]
    start, end, part_of = _split(
        shape.perspective_places(corners) @ linear + shift,
        shape.perspective_places(ends) @ linear + shift,
        part_of,
        axis=1,
    )
    start, end, part_of = _split(start, end, part_of, axis=0)
    tall, middle = end[:, 1] - start[:, 1], (start + end) / 2
    col, row = np.floor(middle).astype(np.intp).T
    bounds = np.searchsorted(part_of, np.arange(len(parts) + 1)).tolist()
    for own in (slice(*pair) for pair in pairwise(bounds)):
        yield _Pieces(row[own], col[own], tall[own], middle[own, 0])


def _outlines(part: Part, cell_from_mark: Array) -> list[Array]:
    """Outlines of a part in mm, (n, 2) each; the outline of a hole has the opposite sense."""
    if isinstance(part, Bar | Polygon):
        return [outline_mm(part)]
    if isinstance(part, Disk):
        return [_circle(part, part.radius_mm, cell_from_mark)]
    inner, outer = (_circle(part, part.radius_mm + side * part.line_mm / 2, cell_from_mark) for side in (-1, 1))
    return [outer, inner[::-1]]


def _circle(part: Disk | Ring, radius_mm: float, cell_from_mark: Array) -> Array:
    """Corners of a polygon of the same area as the circle; none for a radius of zero or less."""
    if radius_mm <= 0:
        return np.zeros((0, 2))
    # Deviation of the polygon from the circle of the same area: at most a third of radius * half angle².
    radius = radius_mm * float(np.linalg.norm(cell_from_mark[:, :2], 2))
    count = max(int(np.ceil(np.pi * np.sqrt(radius / (3 * _ROUND)))), 16)
    turn = 2 * np.pi / count
    angles = turn * np.arange(count)
    corner_mm = radius_mm * np.sqrt(turn / np.sin(turn))
    return np.asarray(part.center_mm + corner_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def _split(start: Array, end: Array, part_of: Integers, axis: int) -> tuple[Array, Array, Integers]:
    """Cut lines, start and end (n, 2), at integers of a coordinate. Returns start, end and part number of the pieces in
    order."""
    first, last = np.floor(start[:, axis]), np.floor(end[:, axis])
    pieces = np.abs(last - first).astype(np.intp) + 1
    line = np.repeat(np.arange(len(start)), pieces)
    number = np.arange(len(line)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    start, step = start[line], (end - start)[line]
    along = step[:, axis]
    crossing = first[line] + np.where(along >= 0, number, 1 - number)
    share = np.divide(crossing - start[:, axis], along, out=np.zeros(len(line)), where=along != 0)
    cut = start + share[:, None] * step
    cut[:, axis] = crossing
    is_first = number == 0
    cut[is_first] = start[is_first]
    # A piece ends at the start of the next one of its line, the last one at the line's end.
    cut_end = np.roll(cut, -1, axis=0)
    is_last = np.roll(is_first, -1)
    cut_end[is_last] = (start + step)[is_last]
    return cut, cut_end, part_of[line]


def _add(covered: Single, pieces: _Pieces) -> None:
    """Add a part to the coverage, by Green's theorem. Each piece of its outline adds its height to all cells right of
    it and, in its own cell, the area right of it. Only cells in the part's bounding box are processed."""
    height, width = covered.shape
    inside = (pieces.row >= 0) & (pieces.row < height) & (pieces.col < width)
    if not inside.any():
        return
    row, col, tall = pieces.row[inside], np.maximum(pieces.col[inside], 0), pieces.tall[inside]
    own = tall * np.where(pieces.col[inside] < 0, 1.0, col + 1 - pieces.middle[inside])
    row0, col0, col1 = row.min(), col.min(), min(pieces.col.max() + 1, width)
    tall_cells, wide_cells = row.max() - row0 + 1, col1 - col0 + 1
    cell = (row - row0) * wide_cells + col - col0
    count = tall_cells * wide_cells
    # In place where possible: a large mark has many cells.
    areas = np.bincount(cell, own, count)
    areas += np.bincount(cell + 1, tall - own, count)
    areas = areas.reshape(tall_cells, wide_cells)
    np.cumsum(areas, axis=1, out=areas)
    np.minimum(np.abs(areas, out=areas), 1.0, out=areas)
    about = covered[row0 : row0 + tall_cells, col0:col1]
    free = 1 - about
    free *= areas[:, :-1]
    about += free

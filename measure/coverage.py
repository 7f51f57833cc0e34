"""How much of each pixel a drawn mark covers: the ideal picture of a mark, before film and scanner blur it.

A pixel (col, row) is the unit square about its centre. An affine map takes the mark's millimetres (x right, y up) to
pixels (col right, row down); every part is then a region with smooth or straight edges, and its share of a small cell
is that of the half-plane through the nearest point of its edge, which has a closed form.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.shapes import Bar, Disk, MarkShape, Part, Polygon, Ring

Array = NDArray[np.float64]

CELLS = 4  # cells along a pixel's side: keeps the half-plane's error below 0.001 px at a dot of 1 px radius


def coverage(shape: MarkShape, pixel_from_mark: Array, width: int, height: int) -> Array:
    """(height, width) shares, 0 to 1, of the pixels' areas that the mark covers.

    pixel_from_mark: (2, 3) affine matrix from (x_mm, y_mm, 1) to (col, row) in this window. Straight edges are exact,
    corners and curves right to about 0.001 of a pixel. Overlapping parts count once.
    """
    return pixel_means(cell_coverage(shape, pixel_from_mark, width, height, CELLS), CELLS)


def cell_coverage(shape: MarkShape, pixel_from_mark: Array, width: int, height: int, cells: int) -> Array:
    """The coverage of the cells that a window's pixels are divided into, (height * cells, width * cells)."""
    cell_from_mark = np.array(pixel_from_mark, dtype=float)
    cell_from_mark[:, 2] += 0.5
    cell_from_mark *= cells
    cell_from_mark[:, 2] -= 0.5
    empty = np.ones((height * cells, width * cells))
    for part in shape.parts:
        empty *= 1.0 - _part_coverage(part, cell_from_mark, width * cells, height * cells)
    return 1.0 - empty


def pixel_means(cell_values: NDArray[np.floating], cells: int) -> Array:
    """Means over the cells of each pixel of an image (rows, columns)."""
    rows, cols = cell_values.shape
    size = (cols // cells, rows // cells)
    return np.asarray(cv2.resize(cell_values, size, interpolation=cv2.INTER_AREA), dtype=float)


def _part_coverage(part: Part, cell_from_mark: Array, width: int, height: int) -> Array:
    if isinstance(part, Polygon):
        return _polygon_coverage(_mapped(part.vertices_mm, cell_from_mark), width, height)
    # Only the cells about the part are computed: a thin bar is a small share of its window.
    outline = _mapped(outline_mm(part), cell_from_mark)
    col0, row0 = np.clip(np.floor(outline.min(axis=0)).astype(int) - 1, 0, (width, height))
    col1, row1 = np.clip(np.ceil(outline.max(axis=0)).astype(int) + 2, 0, (width, height))
    mark_from_cell: Array = np.linalg.inv(cell_from_mark[:, :2]).astype(np.float64)
    col = np.arange(col0, col1) - cell_from_mark[0, 2]
    row = np.arange(row0, row1) - cell_from_mark[1, 2]
    x, y = (line[0] * col[None, :] + line[1] * row[:, None] for line in mark_from_cell)
    covered = np.zeros((height, width))
    if isinstance(part, Bar):
        covered[row0:row1, col0:col1] = _bar_coverage(part, x, y, mark_from_cell)
    else:
        covered[row0:row1, col0:col1] = _round_coverage(part, x, y, mark_from_cell)
    return covered


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


def _mapped(points_mm: Array | tuple[tuple[float, float], ...], cell_from_mark: Array) -> Array:
    return np.asarray(np.asarray(points_mm) @ cell_from_mark[:, :2].T + cell_from_mark[:, 2])


def _bar_coverage(bar: Bar, x: Array, y: Array, mark_from_cell: Array) -> Array:
    start, end = np.asarray(bar.from_mm), np.asarray(bar.to_mm)
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    across = np.array([-along[1], along[0]])
    middle = (start + end) / 2
    result = np.ones(x.shape)
    for direction, extent in ((along, length), (across, bar.line_mm)):
        gradient = direction @ mark_from_cell
        size = float(np.hypot(*gradient))
        position = ((x - middle[0]) * direction[0] + (y - middle[1]) * direction[1]) / size
        half = extent / size / 2
        normal = np.abs(gradient) / size
        result *= _half_plane(position + half, *normal) - _half_plane(position - half, *normal)
    return result


def _round_coverage(part: Disk | Ring, x: Array, y: Array, mark_from_cell: Array) -> Array:
    dx, dy = x - part.center_mm[0], y - part.center_mm[1]
    distance = np.maximum(np.hypot(dx, dy), 1e-12)
    gradient_col = (dx * mark_from_cell[0, 0] + dy * mark_from_cell[1, 0]) / distance
    gradient_row = (dx * mark_from_cell[0, 1] + dy * mark_from_cell[1, 1]) / distance
    size = np.maximum(np.hypot(gradient_col, gradient_row), 1e-12)
    normal = np.abs(gradient_col) / size, np.abs(gradient_row) / size

    def inside(radius_mm: float) -> Array:
        return _half_plane((radius_mm - distance) / size, *normal)

    if isinstance(part, Disk):
        return inside(part.radius_mm)
    return inside(part.radius_mm + part.line_mm / 2) - inside(part.radius_mm - part.line_mm / 2)


def _half_plane(distance: Array, normal_col: Array | float, normal_row: Array | float) -> Array:
    """The share of a unit square on the inner side of a straight edge, whose signed distance from the square's centre
    is positive inwards: the distribution function of a sum of two uniform variables, |normal_col| and |normal_row|
    wide."""
    wide = np.maximum(np.maximum(normal_col, normal_row) / 2, 1e-6)
    narrow = np.maximum(np.minimum(normal_col, normal_row) / 2, 1e-6)

    def ramp(shift: Array) -> Array:
        return np.asarray(np.square(np.maximum(distance + shift, 0.0)))

    area = (ramp(wide + narrow) - ramp(wide - narrow) - ramp(narrow - wide) + ramp(-wide - narrow)) / (
        8 * wide * narrow
    )
    return np.where(distance > 1.0, 1.0, area)


def _polygon_coverage(vertices: Array, width: int, height: int) -> Array:
    """Exact areas, by Green's theorem: each edge adds the area to its right, signed by its direction."""
    covered = np.zeros((height, width))
    right_side = np.arange(width) + 0.5
    for (x0, y0), (x1, y1) in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        first, last = (max(int(np.floor(min(y0, y1) + 0.5)), 0), min(int(np.floor(max(y0, y1) + 0.5)) + 1, height))
        if first >= last:
            continue
        row = np.arange(first, last)[:, None]
        slope = (x1 - x0) / (y1 - y0)
        top = np.clip(row - 0.5, min(y0, y1), max(y0, y1))
        bottom = np.clip(row + 0.5, min(y0, y1), max(y0, y1))
        start = right_side - (x0 + slope * (top - y0))
        end = right_side - (x0 + slope * (bottom - y0))
        covered[first:last] += np.sign(y1 - y0) * (bottom - top) * _mean_of_clipped(start, end)
    return np.clip(np.abs(covered), 0.0, 1.0)


def _mean_of_clipped(start: Array, end: Array) -> Array:
    """The mean of clip(t, 0, 1) for t running evenly from start to end."""

    def integral(t: Array) -> Array:
        clipped = np.clip(t, 0.0, 1.0)
        return np.asarray(clipped**2 / 2 + np.maximum(t - 1.0, 0.0))

    run = end - start
    short = np.abs(run) < 1e-9
    safe = np.where(short, 1.0, run)
    return np.where(short, np.clip((start + end) / 2, 0.0, 1.0), (integral(end) - integral(start)) / safe)

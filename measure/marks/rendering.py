"""Rendering of marks: area coverage of a drawing, or a chip, under a Gaussian blur, with derivatives for matching.

A pixel (col, row) is the unit square around its centre. An affine map transforms the mark's millimetres (x right, y up)
to pixels (col right, row down). For the coverage every part is an outline; circles are approximated by polygons of
sufficiently many corners. By Green's theorem, the area of a part in each pixel follows from the outline in it and in
the pixels left of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

import compiled
from measure.array_types import Array, Indices, Mask, Single
from measure.geometry import Affine, linear_scale
from measure.marks.shapes import (
    Bar,
    Disk,
    Mark,
    MarkShape,
    MarkTemplate,
    Part,
    Polygon,
    Ring,
    drawn_outline_mm,
    outline_mm,
)

_DRAWINGS = 16  # cached drawings, more than a camera has kinds of marks
ROUGH_CELLS = 2  # cells along a pixel's side, for images exact to 0.01
_BLURRED = 2.0  # in blurs, reach of an edge
CELLS = 4  # cells along a pixel's side, finer than the blur of any scan resolves
_ROUND = 0.002  # cells, largest deviation of an outline from its circle


@dataclass(frozen=True, eq=False)
class Rendering:
    """Image of a mark and its first and second derivatives with respect to column and row in px, each (height,
    width)."""

    value: Single
    by_col: Single
    by_row: Single
    by_col_col: Single
    by_col_row: Single
    by_row_row: Single

    @property
    def laplacian(self) -> Single:
        """Laplacian, twice the derivative with respect to the blur's variance."""
        return np.asarray(self.by_col_col + self.by_row_row)

    def deform(self, change: Array, center_px: Array, variance_px2: float) -> "Rendering":
        """Deform the image by a second-order Taylor series: the mark's linear part is multiplied by (I + change).

        The second derivatives are kept. variance_px2: of blur and pixel, which are not deformed with the mark.
        """
        (xx, xy), (yx, yy) = (np.eye(2) - np.linalg.inv(np.eye(2) + change)).astype(np.float32)
        height, width = self.value.shape
        col = np.arange(width, dtype=np.float32) - np.float32(center_px[0])
        row = (np.arange(height, dtype=np.float32) - np.float32(center_px[1]))[:, None]
        right, down = xx * col + xy * row, yx * col + yy * row
        by_col = self.by_col - self.by_col_col * right - self.by_col_row * down
        by_row = self.by_row - self.by_col_row * right - self.by_row_row * down
        spread = np.float32(variance_px2) * change.astype(np.float32)
        value = self.value - (right * (self.by_col + by_col) + down * (self.by_row + by_row)) / 2
        value -= spread[0, 0] * self.by_col_col + (spread[0, 1] + spread[1, 0]) * self.by_col_row
        value -= spread[1, 1] * self.by_row_row
        return replace(self, value=value, by_col=by_col, by_row=by_row)


def render(mark: Mark, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> Rendering:
    """Render a mark under a Gaussian of standard deviation blur_px in a window of width x height px, with derivatives.

    A drawn mark is 1 inside and 0 outside. A chip spans 0 to 1 and is blurred in addition to its own blur.
    pixel_from_mark: (2, 3), from (x_mm, y_mm, 1) to (col, row) of the window.
    """
    orders = (0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)
    return Rendering(*_blurred_derivatives(mark, pixel_from_mark, (width, height), blur_px, orders))


def picture(mark: Mark, pixel_from_mark: Array, width: int, height: int, blur_px: float, cells: int = CELLS) -> Array:
    """(height, width) image of the mark, like `render` without derivatives. cells: of the drawing along a pixel."""
    return _blurred_derivatives(mark, pixel_from_mark, (width, height), blur_px, ((0, 0),), cells)[0].astype(float)


def known_picture(mark: Mark, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> Array:
    """(height, width) approximate image of the mark; nan where its drawing is not known."""
    drawn = picture(mark, pixel_from_mark, width, height, blur_px, ROUGH_CELLS)
    return np.where(known_mask(mark, pixel_from_mark, width, height, _BLURRED * blur_px), drawn, np.nan)


def extent_px(mark: Mark, pixel_from_mark: Array) -> tuple[Array, Array]:
    """Bounding box of the mark: (2,) smallest and (2,) largest column and row."""
    points = Affine(pixel_from_mark).apply(_outline_mm(mark))
    return points.min(axis=0), points.max(axis=0)


def mark_window(mark: Mark, pixel_from_mark: Array, margin_px: float) -> tuple[int, int, int, int]:
    """col0, row0, width, height of the window that holds the mark and margin_px around it."""
    least, greatest = extent_px(mark, np.asarray(pixel_from_mark, dtype=float))
    col0, row0 = np.floor(least - margin_px).astype(int)
    col1, row1 = np.ceil(greatest + margin_px).astype(int)
    return int(col0), int(row0), int(col1 - col0 + 1), int(row1 - row0 + 1)


def detail_px(mark: Mark, linear: Array) -> float:
    """Width of the mark's finest detail in px, at least 1. linear (2, 2): px from mm."""
    return max(linear_scale(linear) * mark.thinnest_mm, 1.0)


def reach_px(mark: Mark, linear: Array) -> float:
    """Largest distance (px) of the mark from its origin. linear (2, 2): px from mm."""
    return float(np.hypot(*(linear @ _outline_mm(mark).T)).max())


@lru_cache(maxsize=_DRAWINGS)
def _outline_mm(mark: Mark) -> Array:
    """(n, 2) corners of a region that contains the known part of the mark."""
    if not isinstance(mark, MarkTemplate):
        return mark.known_outline_mm
    rows, cols = mark.image.shape
    return _chip_from_mark(mark).inverse.apply(np.array([(0, 0), (cols - 1, 0), (cols - 1, rows - 1), (0, rows - 1)]))


def true_mask(mark: Mark, pixel_from_mark: Array, width: int, height: int, margin_px: float) -> Mask:
    """(height, width) mask of the pixels in which the mark's drawing is exact, reduced by margin_px."""
    shown = known_mask(mark, pixel_from_mark, width, height, margin_px)
    if isinstance(mark, MarkTemplate) or mark.true_mm is None:
        return shown
    return shown & _rectangle_mask(mark.true_mm, pixel_from_mark, (width, height), margin_px)


def known_mask(mark: Mark, pixel_from_mark: Array, width: int, height: int, margin_px: float) -> Mask:
    """(height, width) mask of the pixels in which the mark's drawing is known, reduced by margin_px."""
    if isinstance(mark, MarkTemplate) or mark.known_mm is None:
        return np.ones((height, width), dtype=bool)
    return _rectangle_mask(mark.known_mm, pixel_from_mark, (width, height), margin_px)


def frame_pixel_mask(mark: Mark, pixel_from_mark: Array, width: int, height: int, margin_px: float) -> Mask:
    """(height, width) mask of the exposed frame around a mark cut into its border, farther than margin_px from the
    frame's edge; empty for other marks."""
    if isinstance(mark, MarkTemplate) or mark.known_mm is None or np.isfinite(mark.known_mm).all():
        return np.zeros((height, width), dtype=bool)
    least, greatest = np.array(mark.known_mm)  # the frame lies beyond each finite limit
    beyond = np.where(np.isfinite(greatest), greatest, -np.inf), np.where(np.isfinite(least), least, np.inf)
    return _rectangle_mask(beyond, pixel_from_mark, (width, height), margin_px)


def _rectangle_mask(corners: ArrayLike, pixel_from_mark: Array, size: tuple[int, int], margin_px: float) -> Mask:
    """(height, width) mask of the pixels inside a rectangle of the mark's plane (mm), at least margin_px from its
    sides."""
    mark_from_pixel = Affine(np.asarray(pixel_from_mark, float)).inverse
    places = mark_from_pixel.apply(np.stack(np.meshgrid(*map(np.arange, size)), axis=-1))
    least, greatest = np.add(corners, np.array([[1.0], [-1.0]]) * margin_px * mark_from_pixel.scale)
    return np.asarray(np.all((places >= least) & (places <= greatest), axis=-1))


def chip_mask(mark: MarkTemplate, pixel_from_mark: Array, width: int, height: int) -> Mask:
    """(height, width) mask of the pixels on the steady part of the chip."""
    col, row = _chip_positions(mark, pixel_from_mark, width, height, 1)
    rows, cols = mark.image.shape
    inside = (col >= 1) & (col <= cols - 2) & (row >= 1) & (row <= rows - 2)
    if mark.steady is not None:
        inside &= _sampled(mark.steady.astype(float), np.stack([col, row]), 0) > 0.5
    return np.asarray(inside)


def chip_steadiness(mark: MarkTemplate, pixel_from_mark: Array, width: int, height: int) -> Array:
    """(height, width) steadiness of the chip; 1 where unknown."""
    if mark.steadiness is None:
        return np.ones((height, width))
    return _sampled(mark.steadiness, _chip_positions(mark, pixel_from_mark, width, height, 1), 1)


@dataclass(frozen=True, eq=False)
class _Drawing:
    """Rendering without blur. sharp: (rows, columns) cells; cells: number along a pixel's side; first: pixel (col, row)
    of the window that holds the first cell; shift_px: (2,) remaining shift to the right and down."""

    sharp: Single
    cells: int
    first: Indices
    shift_px: Array


def _blurred_derivatives(
    mark: Mark,
    pixel_from_mark: Array,
    size: tuple[int, int],
    blur_px: float,
    orders: Sequence[tuple[int, int]],
    cells: int = CELLS,
) -> list[Single]:
    """Derivatives of the image in a window of size (width, height), one for each pair of orders by column and row."""
    place = np.asarray(pixel_from_mark, dtype=float)
    if isinstance(mark, MarkTemplate):
        drawing = _chip_drawing(mark, place, size, blur_px)
    else:
        drawing = _drawing(mark, place, blur_px, cells)
    cells, most = drawing.cells, np.max(orders, axis=0)
    along = [
        _PixelMeans(blur_px, cells, shift, int(order)) for shift, order in zip(drawing.shift_px, most, strict=True)
    ]
    if compiled.kernels is not None:
        pixels, sharp = np.zeros((len(orders), *size[::-1]), np.float32), np.ascontiguousarray(drawing.sharp)
        taps = np.stack([each.taps for each in along])
        col, row = (np.array([each.first for each in along]) - cells * drawing.first).tolist()
        compiled.kernels.blurred_images(sharp, sharp.shape[1], taps, len(taps[0]), (col, row), cells, pixels, size[0])
        return list(pixels)
    by_col, by_row = (
        axis.matrix(pixels, -cells * first, cell_count)
        for axis, pixels, first, cell_count in zip(along, size, drawing.first, drawing.sharp.shape[::-1], strict=True)
    )
    return [by_row[order_row] @ drawing.sharp @ by_col[order_col].T for order_col, order_row in orders]


def _drawing(mark: MarkShape, pixel_from_mark: Array, blur_px: float, cells: int) -> _Drawing:
    cells = cells if blur_px < 1.5 else max(cells - 1, 2)  # blur hides the error of coarser cells
    whole = np.floor(pixel_from_mark[:, 2])
    rest = pixel_from_mark[:, 2] - whole
    # Without blur cells cannot be shifted by a fraction of their size: draw them at the exact place.
    drawing_origin = np.zeros(2) if blur_px * cells >= 1.0 else rest
    sharp, origin = _sharp_cells(mark, pixel_from_mark[:, :2].tobytes(), tuple(drawing_origin.tolist()), cells)
    return _Drawing(sharp, cells, whole.astype(int) - origin, rest - drawing_origin)


@lru_cache(maxsize=_DRAWINGS)
def _sharp_cells(mark: MarkShape, linear: bytes, origin_px: tuple[float, float], cells: int) -> tuple[Single, Indices]:
    """Draw the mark in cells with its origin at origin_px from a pixel's centre. Returns the cells and that pixel (col,
    row). Marks of the same drawing share the cached result."""
    place = np.column_stack([np.frombuffer(linear).reshape(2, 2), origin_px])
    points = Affine(place).apply(drawn_outline_mm(mark))
    least, greatest = points.min(axis=0), points.max(axis=0)
    low, high = np.floor(least + 0.5).astype(int), np.ceil(greatest + 0.5).astype(int)
    place[:, 2] -= low
    width, height = np.maximum(high - low, 1).tolist()
    return cell_coverage(mark, place, width, height, cells), -low


def _chip_drawing(mark: MarkTemplate, pixel_from_mark: Array, size: tuple[int, int], blur_px: float) -> _Drawing:
    pad = int(np.ceil(4 * blur_px)) + 2
    shifted = pixel_from_mark.copy()
    shifted[:, 2] += pad
    cells = max(1, round(1 / max(linear_scale(pixel_from_mark) * mark.pitch_um / 1000, 1e-3)))  # the chip's pixels
    sampled = _sampled(mark.image, _chip_positions(mark, shifted, size[0] + 2 * pad, size[1] + 2 * pad, cells), 3)
    sharp = (sampled - mark.image.min()) / max(np.ptp(mark.image), 1e-12)
    return _Drawing(sharp.astype(np.float32), cells, np.array([-pad, -pad]), np.zeros(2))


class _PixelMeans:
    """Operator along one axis: means of blurred cells over each pixel, and derivatives in px up to an order."""

    def __init__(self, blur_px: float, cells: int, shift_px: float, order: int) -> None:
        whole = round(shift_px * cells)
        kernels = _kernels(blur_px * cells, shift_px * cells - whole)[: order + 1]
        kernels *= cells ** np.arange(order + 1.0)[:, None]
        reach = kernels.shape[1] // 2
        summed = np.zeros((order + 1, kernels.shape[1] + 2 * cells))
        np.cumsum(kernels, axis=1, out=summed[:, cells:-cells])
        summed[:, -cells:] = summed[:, -cells - 1, None]
        self.cells = cells
        self.taps = ((summed[:, cells:] - summed[:, :-cells]) / cells)[:, :-1].astype(np.float32)
        self.first = -reach - whole

    def matrix(self, count: int, begin: int, cell_count: int) -> Single:
        """(orders, count, cell_count) means and derivatives of count pixels by the cells of a drawing, the first pixel
        beginning at cell begin."""
        orders, taps = self.taps.shape
        wide = np.zeros((orders, count, cell_count + 2 * taps), np.float32)  # taps beyond the drawing are cut off
        starts = np.clip(begin + self.first + taps + self.cells * np.arange(count), 0, cell_count + taps)
        for pixel, start in enumerate(starts.tolist()):
            wide[:, pixel, start : start + taps] = self.taps
        return wide[..., taps:-taps]


def _kernels(sigma: float, shift: float) -> Array:
    """Kernels of a Gaussian, sampled at integers plus shift, and of its first two derivatives, normalised to be exact
    for polynomials."""
    reach = int(np.ceil(4 * sigma)) + 2
    place = np.arange(-reach, reach + 1) + shift
    kernels = np.zeros((3, len(place)))
    smooth, slope, bend = kernels
    smooth[:] = np.exp(-0.5 * (place / max(sigma, 1e-3)) ** 2)
    smooth /= smooth.sum()
    if sigma < 0.5:
        # A chip's detail is hardly coarser than its pixels: central differences of fourth order over five pixels.
        slope[reach - 2 : reach + 3] = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
        bend[reach - 2 : reach + 3] = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / 12
        return kernels
    square = place**2
    slope[:] = place * smooth
    slope /= place @ slope
    bend[:] = (square - sigma**2) * smooth
    bend -= smooth * bend.sum()
    bend *= 2 / (square @ bend)
    return kernels


def _sampled(image: Array, positions: Array, order: Literal[0, 1, 3]) -> Array:
    """Interpolate a chip's image at columns and rows (2, height, width) by splines of an order."""
    return np.asarray(ndimage.map_coordinates(image, positions[::-1], order=order, mode="nearest"))


def _chip_positions(mark: MarkTemplate, pixel_from_mark: Array, width: int, height: int, cells: int) -> Array:
    """(2, rows, columns) column and row of each cell's centre in the chip."""
    place = [(np.arange(size * cells) + 0.5) / cells - 0.5 for size in (width, height)]
    chip_from_pixel = _chip_from_mark(mark).compose(Affine(pixel_from_mark).inverse)
    return np.moveaxis(chip_from_pixel.apply(np.stack(np.meshgrid(*place), axis=-1)), -1, 0)


def _chip_from_mark(mark: MarkTemplate) -> Affine:
    """Transformation from the mark's mm to the chip's column and row, including the mark's rotation."""
    c, s = np.cos(np.deg2rad(mark.turn_deg)), np.sin(np.deg2rad(mark.turn_deg))
    return Affine.from_linear(1000 / mark.pitch_um * np.array([[c, s], [s, -c]]), mark.origin_px)


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
    outlines = [_outlines(part, cell_from_mark) for part in shape.parts]
    corners = np.concatenate([outline for own in outlines for outline in own])
    ends = np.concatenate([np.roll(outline, -1, axis=0) for own in outlines for outline in own])
    counts = [sum(map(len, own)) for own in outlines]
    start, end = (
        shape.perspective_places(places) @ cell_from_mark[:, :2].T + cell_from_mark[:, 2] for places in (corners, ends)
    )
    covered = np.zeros((height * cells, width * cells), np.float32)
    if compiled.kernels is not None:
        first = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        compiled.kernels.cover_cells(start, end, first, covered, width * cells)
        return covered
    part_of = np.repeat(np.arange(len(outlines)), counts)
    for axis in (1, 0):  # cut at the cell borders: each piece lies within one cell
        start, end, part_of = _split(start, end, part_of, axis)
    tall, middle = end[:, 1] - start[:, 1], (start + end) / 2
    col, row = np.floor(middle).astype(np.intp).T
    bounds = np.searchsorted(part_of, np.arange(len(outlines) + 1)).tolist()
    for own in (slice(*pair) for pair in pairwise(bounds)):
        _add(covered, row[own], col[own], tall[own], middle[own, 0])
    return covered


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


def _split(start: Array, end: Array, part_of: Indices, axis: int) -> tuple[Array, Array, Indices]:
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


def _add(covered: Single, row: Indices, col: Indices, tall: Array, middle: Array) -> None:
    """Add a part to the coverage, by Green's theorem. Each piece of its outline adds its height to all cells right of
    it and, in its own cell, the area right of it. Only cells in the part's bounding box are processed.

    row, col : (n,) cell of each piece; tall : (n,) height, positive downwards; middle : (n,) column of the centre.
    """
    height, width = covered.shape
    inside = (row >= 0) & (row < height) & (col < width)
    if not inside.any():
        return
    col1 = min(col.max() + 1, width)
    row, col, tall, middle = row[inside], col[inside], tall[inside], middle[inside]
    own = tall * np.where(col < 0, 1.0, col + 1 - middle)
    col = np.maximum(col, 0)
    row0, col0 = row.min(), col.min()
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

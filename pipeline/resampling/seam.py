"""Mosaic of a frame from several partial scans: each pixel comes from the scan whose inner edges are farthest from
it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from skimage.measure import find_contours

from measure.errors import MeasurementError
from pipeline.resampling.canvas import Canvas, FrameChain, scan_places
from pipeline.resampling.interpolation import Degree, Source, Tile, interpolated
from pipeline.types import Array

_NODES = 129  # along the longer side of the frame; the seam is straight between them
_SHOWN = 33  # points of a seam in the description


@dataclass(frozen=True, eq=False)
class Part:
    """An open partial scan, with its chain to the frame. inner: which of its edges (left, right, top, bottom) lie in
    another scan."""

    source: Source
    chain: FrameChain
    inner: tuple[bool, ...] = (False,) * 4


def find_inner_edges(parts: Sequence[Part]) -> list[Part]:
    """Determine the inner edges of the scans. Raises MeasurementError for scans with different pixel types."""
    kinds = {(part.source.channels, np.dtype(part.source.dtype).name) for part in parts}
    if len(kinds) > 1:
        kinds_text = " and ".join(
            f"{channels} channel{'s' * (channels > 1)} of {dtype}" for channels, dtype in sorted(kinds)
        )
        raise MeasurementError(f"its scans have different pixel types: {kinds_text}. Scan both alike.")
    return [replace(part, inner=_inner_edges(part, [each for each in parts if each is not part])) for part in parts]


def _inner_edges(part: Part, others: Sequence[Part]) -> tuple[bool, ...]:
    """The edges whose centre lies in another scan."""
    right, bottom = part.source.width_px - 1.0, part.source.height_px - 1.0
    middles = np.array([[0.0, bottom / 2], [right, bottom / 2], [right / 2, 0.0], [right / 2, bottom]])
    places_mm, _ = part.chain.frame_from_scan(middles)
    inside = np.zeros(4, dtype=bool)
    for other in others:
        pixels, found = other.chain.scan_from_frame(places_mm)
        col, row = pixels.T
        inside |= found & (col >= 0) & (col < other.source.width_px) & (row >= 0) & (row < other.source.height_px)
    return tuple(inside.tolist())


def joined_tile(parts: Sequence[Part], canvas: Canvas, col0: int, row0: int, side: int, degree: Degree) -> Tile:
    """Tile of the frame. A pixel that is lost in the preferred scan comes from another one that has it."""
    places = [scan_places(part.chain, canvas, col0, row0, side) for part in parts]
    if len(parts) == 1:
        return interpolated(parts[0].source, *places[0], degree)
    depths = np.stack([_depth(part, *place) for part, place in zip(parts, places, strict=True)])
    result: Tile | None = None
    for k in np.argsort(-depths.reshape(len(parts), -1).max(axis=1)).tolist():
        deepest = depths[k] >= np.delete(depths, k, axis=0).max(axis=0)
        wanted = deepest if result is None else deepest | ~result.is_inside
        columns, rows = (np.where(wanted, axis, np.nan) for axis in places[k])
        tile = interpolated(parts[k].source, columns, rows, degree)
        result = tile if result is None else _over(result, tile)
    assert result is not None  # a frame has at least one scan
    return result


def _over(below: Tile, above: Tile) -> Tile:
    samples = np.where(above.is_inside[..., None], above.samples, below.samples)
    return Tile(samples, below.is_inside | above.is_inside, below.clamped + above.clamped)


def _depth(part: Part, columns: Array, rows: Array) -> Array:
    """Distance in px of places from the scan's inner edges; -inf outside of the scan."""
    right, bottom = part.source.width_px - 0.5, part.source.height_px - 0.5
    from_edges = np.stack([columns + 0.5, right - columns, rows + 0.5, bottom - rows])
    inner = np.array(part.inner)
    depth = from_edges[inner].min(axis=0) if inner.any() else np.full(columns.shape, np.finfo(float).max)
    with np.errstate(invalid="ignore"):
        return np.where((from_edges >= 0.0).all(axis=0), depth, -np.inf)


def seams_mm(parts: Sequence[Part], canvas: Canvas) -> list[list[tuple[float, float]]]:
    """Seams between the scans: polylines in mm of the camera frame."""
    step = max(canvas.width_px, canvas.height_px) / (_NODES - 1)
    col, row = (np.arange(0.0, size, step) for size in (canvas.width_px, canvas.height_px))
    nodes = canvas.camera_mm(col, row)
    depths = []
    for part in parts:
        pixels, found = part.chain.scan_from_frame(nodes.reshape(-1, 2))
        pixels[~found] = np.nan
        depths.append(_depth(part, *pixels.T).reshape(nodes.shape[:2]))
    lines = []
    for k, depth in enumerate(depths):
        for other in depths[k + 1 :]:
            both = np.isfinite(depth) & np.isfinite(other)
            between = np.where(both, np.where(both, depth, 0.0) - np.where(both, other, 0.0), np.nan)
            for line in find_contours(between, 0.0):
                shown = line[np.unique(np.linspace(0, len(line) - 1, _SHOWN).astype(int))]
                x_mm = canvas.x_mm + canvas.pitch_mm * step * shown[:, 1]
                y_mm = canvas.y_mm - canvas.pitch_mm * step * shown[:, 0]
                lines.append([(round(x, 3), round(y, 3)) for x, y in zip(x_mm.tolist(), y_mm.tolist(), strict=True)])
    return lines

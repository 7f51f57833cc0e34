"""Tiles of a resampled frame: windows of a scan, whatever the layout of its file, interpolated by splines; a frame from
several partial scans, each pixel from the scan whose inner edges are farthest from it."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, spline_filter
from skimage.measure import find_contours

import compiled
from measure.errors import MeasurementError
from measure.scans.scan import Scan
from pipeline.resampling.canvas import Canvas, FrameChain, scan_places
from pipeline.types import Array, Mask, Samples

_BAND_PX = 256  # rows decoded at a time into the scratch file
Degree = Literal[3, 5]


MARGIN_PX = 16  # around a tile: there the prefilter of a spline of degree 5, with pole 0.43, has decayed to 1e-6
_NODES = 129  # along the longer side of the frame; the seam is straight between them
_SHOWN = 33  # points of a seam in the description


class SampleSource:
    """A scan whose file allows windows (height, width, channels) to be read without decoding the rest. Outside of the
    scan its edge is repeated."""

    is_decoded = False

    def __init__(self, scan: Scan) -> None:
        self.scan = scan
        self.width_px, self.height_px, self.channels = scan.width_px, scan.height_px, scan.channels
        self.dtype = scan.samples_dtype

    def window(self, col0: int, row0: int, width: int, height: int) -> Samples:
        return self.scan.samples(col0, row0, width, height)

    def valid_mask(self, col0: int, row0: int, width: int, height: int) -> Mask:
        """Mask (height, width) of the pixels that are not lost; True outside of the scan."""
        inside = self.scan.inside(col0, row0, width, height, is_read=self.is_decoded)
        cols, rows = np.arange(col0, col0 + width), np.arange(row0, row0 + height)
        in_rows = (rows >= 0) & (rows < self.height_px)
        return np.asarray(inside | ~(in_rows[:, None] & (cols >= 0) & (cols < self.width_px)))


class _Decoded(SampleSource):
    """A scan decoded into an uncompressed file that is read row by row; mapping the file would count as used memory."""

    is_decoded = True

    def __init__(self, scan: Scan, file: int) -> None:
        super().__init__(scan)
        self.file, self.row_bytes = file, scan.width_px * scan.channels * np.dtype(self.dtype).itemsize
        for row in range(0, scan.height_px, _BAND_PX):
            height = min(_BAND_PX, scan.height_px - row)
            os.write(file, scan.samples(0, row, scan.width_px, height).tobytes())

    def window(self, col0: int, row0: int, width: int, height: int) -> Samples:
        rows = np.clip(np.arange(row0, row0 + height), 0, self.height_px - 1)
        left, right = (min(max(col, 0), self.width_px - 1) for col in (col0, col0 + width - 1))
        pixel_bytes = self.row_bytes // self.width_px
        read = {
            row: os.pread(self.file, (right + 1 - left) * pixel_bytes, row * self.row_bytes + left * pixel_bytes)
            for row in np.unique(rows).tolist()
        }
        inside = np.array([np.frombuffer(read[row], self.dtype).reshape(-1, self.channels) for row in rows.tolist()])
        return inside[:, np.clip(np.arange(col0, col0 + width), left, right) - left]


@contextmanager
def open_source(scan: Scan, rows_at_a_time: int, scratch: Path) -> Iterator[SampleSource]:
    """Open a scan as a source. Where a row of tiles needs more rows than stay decoded, the scan is decoded to a file
    first.

    Parameters
    ----------
    rows_at_a_time : rows of the scan that a row of tiles needs.
    """
    wide = scan.segment_px[1] >= scan.width_px
    if not wide or rows_at_a_time <= scan.rows_kept:
        yield SampleSource(scan)
        return
    with tempfile.TemporaryFile(dir=scratch, prefix=".decoded-") as file:
        yield _Decoded(scan, file.fileno())


class Tile(NamedTuple):
    """Interpolated tile.

    Attributes
    ----------
    samples : (side, side, channels), with the type of the scan.
    is_inside : (side, side) mask of the pixels within the scan.
    clamped : number of samples that the spline put beyond the range of the type.
    """

    samples: NDArray[np.uint8 | np.uint16]
    is_inside: Mask
    clamped: int


def interpolated(source: SampleSource, columns: Array, rows: Array, degree: Degree) -> Tile:
    """Interpolate the scan at places (side, side) by splines of the degree; 0 outside of the scan."""
    shape = columns.shape
    inside = (columns >= -0.5) & (columns <= source.width_px - 0.5) & (rows >= -0.5) & (rows <= source.height_px - 0.5)
    samples = np.zeros((*shape, source.channels), source.dtype)
    if not inside.any():
        return Tile(samples, inside, 0)
    left, top = (int(np.floor(places[inside].min())) - MARGIN_PX for places in (columns, rows))
    right, bottom = (int(np.ceil(places[inside].max())) + MARGIN_PX for places in (columns, rows))
    window = source.window(left, top, right - left + 1, bottom - top + 1)
    known = source.valid_mask(left, top, right - left + 1, bottom - top + 1)
    if not known.all():  # a sample is lost if its spline involves a lost pixel
        lost = maximum_filter(~known, size=degree + 2)
        at = np.rint([rows[inside] - top, columns[inside] - left]).astype(int)
        inside[inside] = ~lost[tuple(at)]
    is_whole, clamped = bool(inside.all()), 0
    at = np.stack([rows, columns]).reshape(2, -1) if is_whole else np.array([rows[inside], columns[inside]])
    at -= [[top], [left]]
    for channel in range(source.channels):
        values, beyond = spline_samples(window[..., channel], at, degree, source.dtype)
        samples[..., channel][... if is_whole else inside] = values.reshape(shape) if is_whole else values
        clamped += beyond
    return Tile(samples, inside, clamped)


def spline_samples(
    picture: Samples, places: Array, degree: Degree, dtype: type[np.uint8] | type[np.uint16]
) -> tuple[Samples, int]:
    """Evaluate a spline through an image (rows, columns), mirrored at its edges, at places (2, n), row and column.

    Returns
    -------
    The samples (n,), and how many were clamped to the range of the type.
    """
    coefficients = spline_filter(picture, degree, mode="mirror")
    if compiled.kernels is not None:
        samples: Samples = np.empty(places.shape[1], dtype)
        width = coefficients.shape[1]
        return samples, compiled.kernels.spline_samples(coefficients, width, places[0], places[1], degree, samples)
    values = np.rint(map_coordinates(coefficients, places, order=degree, mode="mirror", prefilter=False))
    highest = np.iinfo(dtype).max
    clamped = int(((values < 0) | (values > highest)).sum())
    return np.clip(values, 0, highest).astype(dtype), clamped


@dataclass(frozen=True, eq=False)
class Part:
    """An open partial scan, with its chain to the frame. inner: which of its edges (left, right, top, bottom) lie in
    another scan."""

    source: SampleSource
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

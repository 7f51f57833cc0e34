"""Windows of a scan, whatever the layout of its file, and tiles interpolated from them by splines."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, spline_filter

import compiled
from measure.scans.scan import Scan
from pipeline.types import Array, Mask, Samples

_BAND_PX = 256  # rows decoded at a time into the scratch file
Degree = Literal[3, 5]


MARGIN_PX = 16  # around a tile: there the prefilter of a spline of degree 5, with pole 0.43, has decayed to 1e-6


class Source:
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


class _Decoded(Source):
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
def open_source(scan: Scan, rows_at_a_time: int, scratch: Path) -> Iterator[Source]:
    """Open a scan as a source. Where a row of tiles needs more rows than stay decoded, the scan is decoded to a file
    first.

    Parameters
    ----------
    rows_at_a_time : rows of the scan that a row of tiles needs.
    scratch : folder of the decoded file.
    """
    wide = scan.segment_px[1] >= scan.width_px
    if not wide or rows_at_a_time <= scan.rows_kept:
        yield Source(scan)
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


def interpolated(source: Source, columns: Array, rows: Array, degree: Degree) -> Tile:
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

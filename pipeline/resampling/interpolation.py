"""A tile of the canvas, interpolated from the scan by splines."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, spline_filter

from pipeline.resampling.source import Source

Degree = Literal[3, 5]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MARGIN_PX = 16  # about a tile: there the prefilter's pole 0.43 of a spline of degree 5 has died to 1e-6


class Tile(NamedTuple):
    """samples (side, side, channels) as the scan stores them; is_inside (side, side): which the scan has; clamped: how
    many samples a spline had thrown beyond what can be stored."""

    samples: NDArray[np.uint8 | np.uint16]
    is_inside: Mask
    clamped: int


def interpolated(source: Source, columns: Array, rows: Array, degree: Degree) -> Tile:
    """The scan at places (side, side), by splines of the degree; 0 where it has no pixel."""
    shape = columns.shape
    inside = (columns >= -0.5) & (columns <= source.width_px - 0.5) & (rows >= -0.5) & (rows <= source.height_px - 0.5)
    samples = np.zeros((*shape, source.channels), source.dtype)
    if not inside.any():
        return Tile(samples, inside, 0)
    left, top = (int(np.floor(places[inside].min())) - MARGIN_PX for places in (columns, rows))
    right, bottom = (int(np.ceil(places[inside].max())) + MARGIN_PX for places in (columns, rows))
    window = source.window(left, top, right - left + 1, bottom - top + 1)
    known = source.known(left, top, right - left + 1, bottom - top + 1)
    at = np.array([rows[inside] - top, columns[inside] - left])
    if not known.all():  # what a spline touches of lost pixels is lost
        lost = maximum_filter(~known, size=degree + 2)
        inside[inside] = ~lost[tuple(np.rint(at).astype(int))]
        at = np.array([rows[inside] - top, columns[inside] - left])
    highest, clamped = np.iinfo(source.dtype).max, 0
    for channel in range(source.channels):
        coefficients = spline_filter(window[..., channel], degree, mode="mirror")
        values = np.rint(map_coordinates(coefficients, at, order=degree, mode="mirror", prefilter=False))
        clamped += int(((values < 0) | (values > highest)).sum())
        samples[inside, channel] = np.clip(values, 0, highest).astype(source.dtype)
    return Tile(samples, inside, clamped)

"""The lattice that a scan is resampled to: camera coordinates of its pixels, and where the scan is asked for them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from adjust.functional_model.families import family
from measure.errors import MeasurementError
from pipeline.resampling.frame_chain import FrameChain

Array = NDArray[np.float64]

_WIDEST = 2.0  # half of a fisheye's ideal picture, in principal distances
_EDGE_POINTS = 65  # of the scan's outline, a side
_NODES_PX = 16  # between the places at which the chain is asked; between them it is interpolated cubically
_BEYOND = 3  # nodes on either side of a tile, for the interpolation


@dataclass(frozen=True)
class Canvas:
    """x_mm, y_mm: camera coordinates of the centre of the first pixel; col = (x' - x_mm) / pitch_mm, row =
    (y_mm - y') / pitch_mm."""

    x_mm: float
    y_mm: float
    pitch_mm: float
    width_px: int
    height_px: int

    def camera_mm(self, col: Array, row: Array) -> Array:
        """(rows, cols, 2) of columns (cols,) and rows (rows,)."""
        x, y = np.meshgrid(self.x_mm + self.pitch_mm * col, self.y_mm - self.pitch_mm * row)
        return np.stack([x, y], axis=-1)


def canvas_of(scans: Sequence[tuple[FrameChain, int, int]], pitch_mm: float) -> Canvas:
    """The canvas that holds the whole outlines of scans, each with its width and height, its pixels at whole multiples
    of the pitch.

    A fisheye's ideal picture has no end: it is cut off where it would be stretched five times over (63 degrees).

    Raises MeasurementError where the lens or the film folds within the scan.
    """
    outline = np.concatenate([_outline_mm(*scan) for scan in scans])
    (left, bottom), (right, top) = outline.min(axis=0) / pitch_mm, outline.max(axis=0) / pitch_mm
    first, last = (ceil(left), floor(top)), (floor(right), ceil(bottom))
    return Canvas(first[0] * pitch_mm, first[1] * pitch_mm, pitch_mm, last[0] - first[0] + 1, first[1] - last[1] + 1)


def _outline_mm(chain: FrameChain, width_px: int, height_px: int) -> Array:
    """(n, 2) places along a scan's edge in the camera frame."""
    across, down = np.linspace(-0.5, width_px - 0.5, _EDGE_POINTS), np.linspace(-0.5, height_px - 0.5, _EDGE_POINTS)
    sides = [(across, np.full_like(across, row)) for row in (down[0], down[-1])]
    sides += [(np.full_like(down, col), down) for col in (across[0], across[-1])]
    outline, found = chain.frame_from_scan(np.concatenate([np.stack(side, axis=1) for side in sides]))
    if chain.lens is not None and not family(chain.lens.distortion.family).is_pinhole_at_zero:
        corners_mm = chain.lens.interior[1:] + _WIDEST * chain.lens.interior[0] * np.array([[-1.0], [1.0]])
        outline = np.clip(outline, *corners_mm) if found.all() else corners_mm
    elif not found.all():
        raise MeasurementError("its distortion folds the image over within the scan: resample without --lens.")
    return outline


def scan_places(chain: FrameChain, canvas: Canvas, col0: int, row0: int, side: int) -> tuple[Array, Array]:
    """Columns and rows of the scan, (side, side) each, at the pixels of a tile of the canvas; NaN where it has none.

    The chain is smooth: between nodes 16 px apart cubic splines are within 1e-4 px of it.
    """
    nodes = np.arange(-_BEYOND * _NODES_PX, side + _BEYOND * _NODES_PX + 1, _NODES_PX, dtype=float)
    places_mm = canvas.camera_mm(col0 + nodes, row0 + nodes)
    pixels, found = chain.scan_from_frame(places_mm.reshape(-1, 2))
    pixels = pixels.reshape(len(nodes), len(nodes), 2)
    at = np.arange(side, dtype=float)
    if not found.all():  # where a lens folds nothing is smooth: the tile is asked pixel by pixel
        exact, known = chain.scan_from_frame(canvas.camera_mm(col0 + at, row0 + at).reshape(-1, 2))
        exact[~known] = np.nan
        return exact[:, 0].reshape(side, side), exact[:, 1].reshape(side, side)
    columns, rows = (RectBivariateSpline(nodes, nodes, pixels[..., axis])(at, at) for axis in (0, 1))
    return columns, rows

"""Marks for the tests, drawn by asking 1024 points of every pixel whether they lie inside: nothing of the program's."""

from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from measure.scan import Scan, open_scan
from measure.shapes import Bar, Disk, MarkShape, Part, Ring

Array = NDArray[np.float64]
POINTS, KEPT = 32, 8  # along a pixel's side; asked, and left for the blur


def brute_picture(mark: MarkShape, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> Array:
    """(height, width) shares of the pixels inside of the mark, after a Gaussian blur."""
    pad = int(np.ceil(5 * blur_px)) + 1
    place = [(np.arange((size + 2 * pad) * POINTS) + 0.5) / POINTS - 0.5 - pad for size in (width, height)]
    offset = np.stack(np.meshgrid(*place)) - pixel_from_mark[:, 2, None, None]
    x, y = np.tensordot(np.linalg.inv(pixel_from_mark[:, :2]), offset, axes=1)
    inside = np.zeros(x.shape, dtype=bool)
    for part in mark.parts:
        inside |= is_inside(part, x, y)
    rows, cols = height + 2 * pad, width + 2 * pad
    kept = inside.reshape(rows * KEPT, POINTS // KEPT, cols * KEPT, POINTS // KEPT).mean(axis=(1, 3))
    blurred = gaussian_filter(kept, blur_px * KEPT, truncate=5) if blur_px > 0 else kept
    return np.asarray(blurred.reshape(rows, KEPT, cols, KEPT).mean(axis=(1, 3))[pad:-pad, pad:-pad])


def is_inside(part: Part, x: Array, y: Array) -> NDArray[np.bool_]:
    """Which points (mm, y up) a part holds."""
    if isinstance(part, Disk):
        return np.asarray((x - part.center_mm[0]) ** 2 + (y - part.center_mm[1]) ** 2 < part.radius_mm**2)
    if isinstance(part, Ring):
        distance = np.sqrt((x - part.center_mm[0]) ** 2 + (y - part.center_mm[1]) ** 2)
        return np.asarray(np.abs(distance - part.radius_mm) < part.line_mm / 2)
    if isinstance(part, Bar):
        dx, dy = part.to_mm[0] - part.from_mm[0], part.to_mm[1] - part.from_mm[1]
        length = float(np.sqrt(dx**2 + dy**2))
        along = ((x - part.from_mm[0]) * dx + (y - part.from_mm[1]) * dy) / length
        across = (-(x - part.from_mm[0]) * dy + (y - part.from_mm[1]) * dx) / length
        return np.asarray((along > 0) & (along < length) & (np.abs(across) < part.line_mm / 2))
    crossings = np.zeros(x.shape, dtype=int)
    for (x0, y0), (x1, y1) in zip(part.vertices_mm, part.vertices_mm[1:] + part.vertices_mm[:1], strict=True):
        if y0 != y1:
            crossings += ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return np.asarray(crossings % 2 == 1)


def placed(px_per_mm: float, center_px: tuple[float, float], turn_rad: float = 0.0) -> Array:
    """(2, 3) from mm (y up) to pixels (row down), turned counter-clockwise as seen in the picture."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.column_stack([px_per_mm * np.array([[c, -s], [-s, -c]]), center_px])


def scan_of(grey: Array, folder: Path, name: str = "scan.tif") -> Scan:
    """The grey values, rounded to 16 bits (8 where they are bytes), as an opened scan."""
    stored = grey if grey.dtype == np.uint8 else np.clip(np.rint(grey), 0, 65535).astype(np.uint16)
    tifffile.imwrite(folder / name, stored)
    return open_scan(folder / name)

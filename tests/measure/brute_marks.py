"""Marks for the tests, drawn by asking 1024 points of every pixel whether they lie inside: nothing of the program's."""

from pathlib import Path

import numpy as np
import tifffile
from drawn import in_strips, pixel_means
from numpy.typing import NDArray

from measure.marks.shapes import Bar, Disk, MarkShape, Part, Ring
from measure.scans.scan import Scan, open_scan

Array = NDArray[np.float64]
POINTS, KEPT = 32, 8  # along a pixel's side; asked, and left for the blur


def brute_picture(mark: MarkShape, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> Array:
    """(height, width) shares of the pixels inside of the mark, after a Gaussian blur."""
    pad = int(np.ceil(5 * blur_px)) + 1
    rows, cols = height + 2 * pad, width + 2 * pad
    inside = np.zeros((rows * POINTS, cols * POINTS), dtype=bool)
    mark_from_pixel = np.linalg.inv(pixel_from_mark[:, :2])
    for part in mark.parts:
        places = corners_mm(part) @ pixel_from_mark[:, :2].T + pixel_from_mark[:, 2] + pad
        first = np.clip(np.floor(places.min(axis=0)).astype(int) - 1, 0, (cols, rows)) * POINTS
        last = np.clip(np.ceil(places.max(axis=0)).astype(int) + 2, 0, (cols, rows)) * POINTS
        col, row = (
            (np.arange(a, b) + 0.5) / POINTS - 0.5 - pad - center
            for a, b, center in zip(first, last, pixel_from_mark[:, 2], strict=True)
        )
        box = inside[first[1] : last[1], first[0] : last[0]]
        for strip, down in zip(in_strips(box, len(col)), in_strips(row, len(col)), strict=True):
            x, y = (line[0] * col[None, :] + line[1] * down[:, None] for line in mark_from_pixel)
            strip |= is_inside(part, x, y)
    step = POINTS // KEPT
    rowwise = np.asarray(np.sum([inside[k::step] for k in range(step)], axis=0, dtype=np.uint8))
    counts = np.asarray(np.sum([rowwise[:, k::step] for k in range(step)], axis=0, dtype=np.uint8))
    return pixel_means(counts / step**2, blur_px, KEPT, pad)


def corners_mm(part: Part) -> Array:
    """(n, 2) points whose bounds hold the part: only there is anybody asked."""
    if isinstance(part, Disk | Ring):
        reach = part.radius_mm + (part.line_mm if isinstance(part, Ring) else 0.0)
        return np.asarray(part.center_mm) + reach * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    if isinstance(part, Bar):
        ends, half = np.array([part.from_mm, part.to_mm]), part.line_mm
        return np.concatenate(
            [ends + offset for offset in ((-half, -half), (half, -half), (half, half), (-half, half))]
        )
    return np.array(part.vertices_mm)


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


def written_scan(grey: Array, folder: Path, name: str = "scan.tif") -> Scan:
    """The grey values, rounded to 16 bits (8 where they are bytes), written to a file and opened."""
    stored = grey if grey.dtype == np.uint8 else np.clip(np.rint(grey), 0, 65535).astype(np.uint16)
    tifffile.imwrite(folder / name, stored)
    return open_scan(folder / name)

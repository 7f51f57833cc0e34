"""Marks for the tests, drawn by asking 1024 points of every pixel whether they lie inside: nothing of the program's."""

from pathlib import Path

import numpy as np
import tifffile
from drawn import encode_strips, pixel_means
from numpy.typing import NDArray

from measure.marks.shapes import Bar, Disk, MarkShape, Part, Ring
from measure.scans.opening import open_scan
from measure.scans.scan import Scan

Array = NDArray[np.float64]
Singles = NDArray[np.float32]
POINTS, KEPT = 32, 8  # along a pixel's side; asked, and left for the blur


def brute_picture(mark: MarkShape, pixel_from_mark: Array, width: int, height: int, blur_px: float) -> Array:
    """(height, width) shares of the pixels inside of the mark, after a Gaussian blur."""
    reach = int(np.ceil(5 * blur_px)) + 1
    corners = np.concatenate([corners_mm(part) for part in mark.parts])
    # No blur reaches farther from the mark: all else stays dark.
    (col0, row0), (col1, row1) = (
        np.clip(each, 0, (width, height)) for each in bounds_px(corners, pixel_from_mark, reach)
    )
    picture = np.zeros((height, width))
    moved = pixel_from_mark - np.array([[0, 0, col0], [0, 0, row0]])
    picture[row0:row1, col0:col1] = _brute_picture(mark, moved, col1 - col0, row1 - row0, blur_px, reach)
    return picture


def bounds_px(corners: Array, pixel_from_mark: Array, spare_px: int) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """The first column and row, and those after the last, of the pixels that hold points (n, 2) in mm, and of so many
    about them."""
    places = corners @ pixel_from_mark[:, :2].T + pixel_from_mark[:, 2]
    return np.floor(places.min(axis=0)).astype(int) - spare_px, np.ceil(places.max(axis=0)).astype(int) + 1 + spare_px


def _brute_picture(mark: MarkShape, pixel_from_mark: Array, width: int, height: int, blur_px: float, pad: int) -> Array:
    rows, cols = height + 2 * pad, width + 2 * pad
    inside = np.zeros((rows * POINTS, cols * POINTS), dtype=bool)
    mark_from_pixel = np.linalg.inv(pixel_from_mark[:, :2])
    for part in mark.parts:
        first, last = (
            np.clip(each + pad, 0, (cols, rows)) * POINTS for each in bounds_px(corners_mm(part), pixel_from_mark, 1)
        )
        col, row = (
            ((np.arange(a, b) + 0.5) / POINTS - 0.5 - pad - center).astype(np.float32)  # to a millionth of a pixel
            for a, b, center in zip(first, last, pixel_from_mark[:, 2], strict=True)
        )
        box = inside[first[1] : last[1], first[0] : last[0]]
        for strip, down in zip(encode_strips(box, len(col)), encode_strips(row, len(col)), strict=True):
            x, y = (line[0] * col[None, :] + line[1] * down[:, None] for line in mark_from_pixel.astype(np.float32))
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


def is_inside(part: Part, x: Singles, y: Singles) -> NDArray[np.bool_]:
    """Which points (mm, y up) a part holds."""
    if isinstance(part, Disk):
        return np.asarray((x - part.center_mm[0]) ** 2 + (y - part.center_mm[1]) ** 2 < part.radius_mm**2)
    if isinstance(part, Ring):
        inner, outer = (max(part.radius_mm + half, 0.0) ** 2 for half in (-part.line_mm / 2, part.line_mm / 2))
        squared = (x - part.center_mm[0]) ** 2 + (y - part.center_mm[1]) ** 2
        return np.asarray((squared > inner) & (squared < outer))
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

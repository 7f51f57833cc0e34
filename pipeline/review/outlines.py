"""The outlines of a drawn mark, as they are laid over its picture."""

import numpy as np
from numpy.typing import NDArray

from measure.marks.shapes import Bar, Disk, Mark, MarkShape, Part, Polygon, Ring

Array = NDArray[np.float64]

_STEPS = 48  # of a circle


def outlines_px(mark: Mark, pixel_from_mark: Array) -> list[list[list[float]]]:
    """Closed lines in pixels of the scan; none of a mark that is a picture."""
    if not isinstance(mark, MarkShape):
        return []
    lines = (line for part in mark.parts for line in _lines_mm(part))
    return [(line @ pixel_from_mark[:, :2].T + pixel_from_mark[:, 2]).round(3).tolist() for line in lines]


def _lines_mm(part: Part) -> list[Array]:
    match part:
        case Disk():
            return [_circle(part.center_mm, part.radius_mm)]
        case Ring():
            half = part.line_mm / 2
            return [_circle(part.center_mm, part.radius_mm + sign * half) for sign in (1, -1)]
        case Bar():
            start, end = np.array(part.from_mm), np.array(part.to_mm)
            along = (end - start) / np.hypot(*(end - start))
            side = part.line_mm / 2 * np.array([-along[1], along[0]])
            return [np.stack([start + side, end + side, end - side, start - side])]
        case Polygon():
            return [np.array(part.vertices_mm)]


def _circle(center_mm: tuple[float, float], radius_mm: float) -> Array:
    angles = np.linspace(0.0, 2 * np.pi, _STEPS, endpoint=False)
    return np.array(center_mm) + radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)

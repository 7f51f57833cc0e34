"""Known part of a mark's drawing, at the border of the exposed frame and along the lines of a réseau.

Solid marks at the border are wings and blocks that project from it, and notches cut into it.

Nothing is exposed beyond the frame. A wing merges there into the unexposed border; a notch is exposed like the frame
and merges into it. The drawing of a wing is therefore known within the frame only, that of a notch beyond its edge
only. A dark mark beyond the edge lies in an exposed pocket: all of it is known.

A réseau of continuous lines is drawn as crosses whose arms reach to the next ones. A crossing is determined by the
lines close to it; farther parts take computing time and meet stars.
"""

from dataclasses import replace
from typing import TypeGuard

import numpy as np
from scipy.spatial import cKDTree

from measure.array_types import Array
from measure.marks.coverage import outline_mm
from measure.marks.shapes import Bar, FiducialLayout, FrameCorner, LayoutMark, Mark, MarkShape, Polygon

_EDGE_MM = 0.1  # mm, tolerance within which a drawing ends on the frame's edge
_TO_NEXT = 0.45  # fraction of the distance to the next mark: longer arms are continuous lines
_LINE_WIDTHS = 5.0  # in line widths, half side of the square used around a crossing


def limit_to_frame(layout: FiducialLayout) -> FiducialLayout:
    """Limit the drawings of solid marks to their known part.

    Marks whose point lies within the frame and that reach its edge are limited to the frame. Marks whose point lies on
    the edge or beyond are limited to the area beyond the edge, unless they are dark.
    """
    return replace(layout, marks=tuple(_limit_mark(mark, np.array(layout.frame_mm) / 2) for mark in layout.marks))


def limit_to_crossings(layout: FiducialLayout) -> FiducialLayout:
    """Limit crosses whose arms reach halfway to the next mark to a few line widths around their points."""
    if len(layout.marks) < 2:
        return layout
    xy = np.array([mark.xy_mm for mark in layout.marks])
    next_mm = np.asarray(cKDTree(xy).query(xy, k=2)[0])[:, 1]
    return replace(
        layout, marks=tuple(_limit_cross(mark, float(mm)) for mark, mm in zip(layout.marks, next_mm, strict=True))
    )


def _limit_cross(mark: LayoutMark, next_mm: float) -> LayoutMark:
    shape = mark.mark
    if not isinstance(shape, MarkShape) or shape.known_mm is not None:
        return mark
    bars = [part for part in shape.parts if isinstance(part, Bar)]
    half_mm = _LINE_WIDTHS * max((bar.line_mm for bar in bars), default=0.0)
    reach_mm = float(np.abs(drawn_outline_mm(shape)).max())
    if len(bars) < len(shape.parts) or reach_mm < max(_TO_NEXT * next_mm, half_mm):
        return mark
    return replace(mark, mark=replace(shape, known_mm=((-half_mm, -half_mm), (half_mm, half_mm))))


def _limit_mark(mark: LayoutMark, half_mm: Array) -> LayoutMark:
    shape, at = mark.mark, np.array(mark.xy_mm)
    if not _is_of_polygons(shape):
        return mark
    drawn = at + drawn_outline_mm(shape)
    beyond = np.abs(at) >= half_mm - _EDGE_MM
    if beyond.any() and shape.polarity == "dark":
        return mark
    if beyond.any():
        outwards = np.where(beyond, np.sign(at), 0.0)
        if beyond.all() or (drawn @ outwards).min() > half_mm[beyond][0] + _EDGE_MM:
            return mark
        least = np.where(outwards > 0, half_mm, -np.inf)
        greatest = np.where(outwards < 0, -half_mm, np.inf)
    elif np.any(np.abs(drawn) >= half_mm - _EDGE_MM):
        least, greatest = -half_mm, half_mm
    else:
        return mark
    (left, bottom), (right, top) = (least - at).tolist(), (greatest - at).tolist()
    return replace(mark, mark=replace(shape, known_mm=((left, bottom), (right, top))))


def _is_of_polygons(mark: Mark) -> TypeGuard[MarkShape]:
    if not isinstance(mark, MarkShape) or isinstance(mark, FrameCorner):
        return False
    return all(isinstance(part, Polygon) for part in mark.parts)


def drawn_outline_mm(mark: MarkShape) -> Array:
    """(n, 2) corners of a region that contains the whole drawing."""
    return mark.perspective_places(np.concatenate([outline_mm(part) for part in mark.parts]))


def known_outline_mm(mark: MarkShape) -> Array:
    """(n, 2) corners of a region that contains the known part of the drawing."""
    drawn = drawn_outline_mm(mark)
    if mark.known_mm is None:
        return drawn
    least, greatest = np.add(mark.known_mm, [[_EDGE_MM], [-_EDGE_MM]])
    parts = [mark.perspective_places(outline_mm(part)) for part in mark.parts]
    for axis in (0, 1):
        parts = [_below(_below(part, axis, 1.0, greatest[axis]), axis, -1.0, -least[axis]) for part in parts]
    known = np.concatenate(parts)
    return known if len(known) else drawn


def _below(polygon: Array, axis: int, sign: float, limit: float) -> Array:
    """Clip a polygon (n, 2) to the half plane sign * coordinate <= limit (Sutherland and Hodgman)."""
    corners = []
    over = sign * polygon[:, axis] - limit
    for start, end, begins, ends in zip(polygon, np.roll(polygon, -1, axis=0), over, np.roll(over, -1), strict=True):
        if begins <= 0:
            corners.append(start)
        if begins * ends < 0:
            corners.append(start + (end - start) * begins / (begins - ends))
    return np.array(corners).reshape(-1, 2)

"""What of a mark's drawing is known to be true, at the border of the exposed frame and along the lines of a réseau.

Solid marks at the border are wings and blocks that grow out of it, and notches that are cut into it.

Nothing was exposed beyond the frame. A wing is no darker there than all else, and merges into the border; a notch is
exposed as the frame is, and merges into that. So the drawing of a wing is true within the frame alone, and that of a
notch beyond its edge. A dark mark beyond the edge stands in a pocket that was exposed, too: all of it is true.

A réseau of continuous lines is drawn as crosses whose arms reach to the next ones. A crossing is told by the lines
next to it; farther off they cost time, and meet stars.
"""

from dataclasses import replace
from typing import TypeGuard

import numpy as np
from scipy.spatial import cKDTree

from measure.array_types import Array
from measure.marks.coverage import outline_mm
from measure.marks.shapes import Bar, FiducialLayout, FrameCorner, LayoutMark, Mark, MarkShape, Polygon

_EDGE_MM = 0.1  # so near to the frame's edge a drawing ends on it
_TO_NEXT = 0.45  # of the distance to the next mark: arms so long are lines that run on
_LINE_WIDTHS = 5.0  # on either side of a crossing


def limit_to_frame(layout: FiducialLayout) -> FiducialLayout:
    """The layout with the drawings of solid marks known where they are true: of those whose points lie in the frame,
    and that reach its edge, within the frame; of those with a point on its edge or beyond, beyond the edge, unless they
    are dark."""
    return replace(layout, marks=tuple(_limit_mark(mark, np.array(layout.frame_mm) / 2) for mark in layout.marks))


def limit_to_crossings(layout: FiducialLayout) -> FiducialLayout:
    """The layout with crosses whose arms reach half way to the next mark known a few line widths about their points."""
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
    """(n, 2) corners of a region that holds all that is drawn."""
    return mark.perspective_places(np.concatenate([outline_mm(part) for part in mark.parts]))


def known_outline_mm(mark: MarkShape) -> Array:
    """(n, 2) the same of what of it is known to be true."""
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
    """(n, 2) the part of a polygon whose coordinate, times the sign, is at most the limit (Sutherland and Hodgman)."""
    corners = []
    over = sign * polygon[:, axis] - limit
    for start, end, begins, ends in zip(polygon, np.roll(polygon, -1, axis=0), over, np.roll(over, -1), strict=True):
        if begins <= 0:
            corners.append(start)
        if begins * ends < 0:
            corners.append(start + (end - start) * begins / (begins - ends))
    return np.array(corners).reshape(-1, 2)

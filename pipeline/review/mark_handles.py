"""Handles of a mark's drawing: points that the user drags on the page, each of which changes one value.

A mark is a table [mark.NAME] of a camera file. The page does not depend on the kind of mark: it shows handles and sends
the place to which one was dragged.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from measure.marks.shapes import Point
from pipeline.errors import InputError
from pipeline.files.mark_table import MarkJson, scaled_mark
from pipeline.types import Array

_LEAST_MM = 1e-3
_RING_DEG, _LINE_DEG = 22.5, -22.5  # degrees, handles on a ring, clear of upright and diagonal arms
_LINE_AT = 0.7  # fraction of an arm's length at which the handle of its width lies
_QUARTER_DEG = 90.0  # degrees, rotational symmetry of a cross


@dataclass(frozen=True)
class Handle:
    """Handle. key: value that it changes; place_mm: in the mark's axes; dragged: returns the mark with the handle at
    another place."""

    key: str
    place_mm: Point
    dragged: Callable[[Array], MarkJson]


def handles(mark: MarkJson, toward: Point = (1.0, 1.0)) -> Iterator[Handle]:
    """Yield the handles of a mark or of a part of one, by the values that it has.

    toward: signs (x, y) of the quadrant in which the frame lies, used for a frame corner.
    """
    center = np.array(mark.get("center_mm", (0.0, 0.0)))
    if "center_mm" in mark:
        yield _place(mark, "center_mm")
    if "ring_mm" in mark:
        yield _length(mark, "ring_mm", _RING_DEG)
        yield _length(mark, "ring_line_mm", _LINE_DEG, 2.0, mark["ring_mm"])
    if "arm_mm" in mark:
        yield from _cross(mark)
    if mark.get("kind") == "frame-corner":
        yield _length(mark, "reach_mm", 0.0 if toward[0] > 0 else 180.0)
        yield _length(mark, "radius_mm", 90.0 if toward[1] > 0 else -90.0)
    elif "radius_mm" in mark:
        yield _length(mark, "radius_mm", 0.0, side=center)
    if mark.get("shape") == "ring":
        yield _length(mark, "line_mm", 90.0, 2.0, mark["radius_mm"], center)
    if "from_mm" in mark:
        start, end = np.array(mark["from_mm"]), np.array(mark["to_mm"])
        angle = math.degrees(math.atan2(*(end - start)[::-1]))
        yield _place(mark, "from_mm")
        yield _place(mark, "to_mm")
        yield _length(mark, "line_mm", angle + 90.0, 2.0, side=(start + end) / 2)
    if "size_mm" in mark:
        half, key = mark["size_mm"] / 2, "size_mm"
        yield Handle(key, (half, half), lambda place: _changed(mark, key, max(2 * np.abs(place).max(), _LEAST_MM)))
    for at, vertex in enumerate(mark.get("vertices_mm", ())):
        yield Handle(
            f"vertices_mm.{at}", _point(vertex), partial(_drag_item, mark, "vertices_mm", at, np.ndarray.tolist)
        )
    for at, part in enumerate(mark.get("part", ())):
        for one in handles(part):
            yield Handle(f"part.{at}.{one.key}", one.place_mm, partial(_drag_item, mark, "part", at, one.dragged))


def first_drawing(kind: str, size_mm: float) -> MarkJson:
    """Initial drawing of a kind of mark, with a half size of about size_mm."""
    arm, line, ring = size_mm, size_mm / 8, size_mm / 2
    cross = {"arm_mm": arm, "line_mm": line, "gap_mm": 0.0, "angle_deg": 0.0}
    rings = {"ring_mm": ring, "ring_line_mm": line}
    starts: dict[str, MarkJson] = {
        "cross": cross,
        "dot": {"radius_mm": ring},
        "ring-cross": {**rings, **cross},
        "ring-dot": {**rings, "radius_mm": ring / 3},
        "polygon": {"vertices_mm": []},
        "parts": {"part": [first_part("disk", ring)]},
        "template": {"size_mm": 2 * size_mm},
        "learned": {"size_mm": 2 * size_mm},
        "frame-corner": {"reach_mm": 4 * size_mm, "radius_mm": 0.0},
    }
    if kind not in starts:
        raise InputError(f"{kind!r} is no kind of mark; {', '.join(starts)} are.")
    return scaled_mark({"kind": kind, **starts[kind]})


def first_part(shape: str, size_mm: float) -> MarkJson:
    """Initial part of a shape."""
    corners = [[0.0, size_mm], [-size_mm, -size_mm], [size_mm, -size_mm]]
    parts: dict[str, MarkJson] = {
        "disk": {"center_mm": [0.0, 0.0], "radius_mm": size_mm},
        "ring": {"center_mm": [0.0, 0.0], "radius_mm": size_mm, "line_mm": size_mm / 4},
        "bar": {"from_mm": [-size_mm, 0.0], "to_mm": [size_mm, 0.0], "line_mm": size_mm / 4},
        "polygon": {"vertices_mm": corners},
    }
    if shape not in parts:
        raise InputError(f"{shape!r} is no shape of a part; {', '.join(parts)} are.")
    return scaled_mark({"shape": shape, **parts[shape]})


def add_vertex(mark: MarkJson, place_mm: Array) -> MarkJson:
    """Add a vertex to a polygon: in the side nearest to it, or at the end if there are fewer than three vertices."""
    vertices = [*mark["vertices_mm"]]
    at = len(vertices)
    if at >= 3:
        starts = np.array(vertices)
        sides = np.roll(starts, -1, axis=0) - starts
        along = np.sum((place_mm - starts) * sides, axis=1) / np.maximum(np.sum(sides**2, axis=1), 1e-12)
        nearest = starts + np.clip(along, 0.0, 1.0)[:, None] * sides
        at = int(np.hypot(*(place_mm - nearest).T).argmin()) + 1
    return scaled_mark({**mark, "vertices_mm": [*vertices[:at], place_mm.tolist(), *vertices[at:]]})


def remove_part(mark: MarkJson, key: str) -> MarkJson:
    """Remove the vertex or the part named by a handle's key."""
    name, *rest = key.split(".")
    if name not in ("vertices_mm", "part"):
        raise InputError("only corners of a polygon and parts can be taken out.")
    at = int(rest[0])
    part = mark[name][at]
    if rest[1:2] == ["vertices_mm"] and len(part["vertices_mm"]) > 3:
        part = {**part, "vertices_mm": _remove_item(part["vertices_mm"], int(rest[2]))}
        return {**mark, name: [*mark[name][:at], part, *mark[name][at + 1 :]]}
    return {**mark, name: _remove_item(mark[name], at)}


def _remove_item(values: list[Any], at: int) -> list[Any]:
    return [*values[:at], *values[at + 1 :]]


def _unit(angle_deg: float) -> Array:
    angle = math.radians(angle_deg)
    return np.array([math.cos(angle), math.sin(angle)])


def _point(place: Array) -> Point:
    return float(place[0]), float(place[1])


def _length(
    mark: MarkJson, key: str, angle_deg: float, factor: float = 1.0, offset: float = 0.0, side: Array | None = None
) -> Handle:
    """Handle of a length: value = factor (distance from side in the direction of angle_deg - offset)."""
    along, start = _unit(angle_deg), np.zeros(2) if side is None else side

    def dragged(place: Array) -> MarkJson:
        value = factor * (float(along @ (place - start)) - offset)
        return _changed(mark, key, max(value, 0.0 if key in ("gap_mm", "reach_mm") else _LEAST_MM))

    return Handle(key, _point(start + along * (offset + mark.get(key, 0.0) / factor)), dragged)


def _place(mark: MarkJson, key: str) -> Handle:
    return Handle(key, _point(mark[key]), lambda place: _changed(mark, key, place.tolist()))


def _changed(mark: MarkJson, key: str, value: Any) -> MarkJson:
    return scaled_mark({**mark, key: value})


def _drag_item(mark: MarkJson, key: str, at: int, dragged: Callable[[Array], Any], place: Array) -> MarkJson:
    """Mark with an item of a list dragged to a place."""
    return _changed(mark, key, [*mark[key][:at], dragged(place), *mark[key][at + 1 :]])


def _cross(mark: MarkJson) -> Iterator[Handle]:
    angle = mark.get("angle_deg", 0.0)

    def turned(place: Array) -> MarkJson:
        degrees = math.degrees(math.atan2(place[1], place[0]))
        return {**mark, "angle_deg": round(degrees % _QUARTER_DEG, 1) % _QUARTER_DEG}

    yield _length(mark, "arm_mm", angle)
    yield _length(mark, "line_mm", angle + 90.0, 2.0, side=_unit(angle) * _LINE_AT * mark["arm_mm"])
    yield _length(mark, "gap_mm", angle + 90.0)
    yield Handle("angle_deg", _point(-_unit(angle) * mark["arm_mm"]), turned)

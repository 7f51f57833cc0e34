"""Handles of a mark's drawing: points that the user drags on the page, each of which changes one value.

A mark is a table [mark.NAME] of a camera file. The page does not depend on the kind of mark: it shows handles and sends
the place to which one was dragged.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from measure.marks.shapes import Point
from pipeline.errors import InputError
from pipeline.types import Array

MarkJson = Mapping[str, Any]

_DECIMALS = 4  # of values in mm: 0.1 µm
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


def handles(mark: MarkJson, toward: Point = (1.0, 1.0)) -> list[Handle]:
    """Handles of a mark. toward: signs (x, y) of the quadrant in which the frame lies, used for a frame corner."""
    return list(_HANDLES[mark["kind"]](mark, toward))


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
    return _rounded({"kind": kind, **starts[kind]})


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
    return _rounded({"shape": shape, **parts[shape]})


def scaled_mark(mark: MarkJson, factor: float) -> MarkJson:
    """Scale all lengths of a mark by a factor."""

    def scaled(key: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: scaled(name, one) for name, one in value.items()}
        if isinstance(value, list):
            return [scaled(key, one) for one in value]
        return value * factor if key.endswith("_mm") else value

    return _rounded({key: scaled(key, value) for key, value in mark.items()})


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
    return _rounded({**mark, "vertices_mm": [*vertices[:at], place_mm.tolist(), *vertices[at:]]})


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


def _rounded(mark: MarkJson) -> MarkJson:
    def rounded(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: rounded(one) for name, one in value.items()}
        if isinstance(value, list):
            return [rounded(one) for one in value]
        return round(float(value), _DECIMALS) if isinstance(value, float | int) else value

    return {key: rounded(value) for key, value in mark.items()}


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
        return _rounded({**mark, key: max(value, 0.0 if key in ("gap_mm", "reach_mm") else _LEAST_MM)})

    return Handle(key, _point(start + along * (offset + mark.get(key, 0.0) / factor)), dragged)


def _place(mark: MarkJson, key: str) -> Handle:
    return Handle(key, _point(mark[key]), lambda place: _rounded({**mark, key: place.tolist()}))


def _dot(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    yield _length(mark, "radius_mm", 0.0)


def _cross(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    angle = mark.get("angle_deg", 0.0)

    def turned(place: Array) -> MarkJson:
        degrees = math.degrees(math.atan2(place[1], place[0]))
        return {**mark, "angle_deg": round(degrees % _QUARTER_DEG, 1) % _QUARTER_DEG}

    yield _length(mark, "arm_mm", angle)
    yield _length(mark, "line_mm", angle + 90.0, 2.0, side=_unit(angle) * _LINE_AT * mark["arm_mm"])
    yield _length(mark, "gap_mm", angle + 90.0)
    yield Handle("angle_deg", _point(-_unit(angle) * mark["arm_mm"]), turned)


def _ring(mark: MarkJson) -> Iterator[Handle]:
    yield _length(mark, "ring_mm", _RING_DEG)
    yield _length(mark, "ring_line_mm", _LINE_DEG, 2.0, mark["ring_mm"])


def _ring_dot(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    yield from (*_ring(mark), *_dot(mark, toward))


def _ring_cross(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    yield from (*_ring(mark), *_cross(mark, toward))


def _polygon(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    for at, vertex in enumerate(mark["vertices_mm"]):

        def dragged(place: Array, at: int = at) -> MarkJson:
            vertices = [*mark["vertices_mm"]]
            vertices[at] = place.tolist()
            return _rounded({**mark, "vertices_mm": vertices})

        yield Handle(f"vertices_mm.{at}", _point(vertex), dragged)


def _parts(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    for at, part in enumerate(mark["part"]):
        for one in _PARTS[part["shape"]](part):

            def dragged(place: Array, at: int = at, one: Handle = one) -> MarkJson:
                parts = [*mark["part"]]
                parts[at] = one.dragged(place)
                return {**mark, "part": parts}

            yield Handle(f"part.{at}.{one.key}", one.place_mm, dragged)


def _disk_part(part: MarkJson) -> Iterator[Handle]:
    yield _place(part, "center_mm")
    yield _length(part, "radius_mm", 0.0, side=np.array(part["center_mm"]))


def _ring_part(part: MarkJson) -> Iterator[Handle]:
    yield from _disk_part(part)
    yield _length(part, "line_mm", 90.0, 2.0, part["radius_mm"], np.array(part["center_mm"]))


def _bar_part(part: MarkJson) -> Iterator[Handle]:
    start, end = np.array(part["from_mm"]), np.array(part["to_mm"])
    angle = math.degrees(math.atan2(*(end - start)[::-1]))
    yield _place(part, "from_mm")
    yield _place(part, "to_mm")
    yield _length(part, "line_mm", angle + 90.0, 2.0, side=(start + end) / 2)


def _square(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    half = mark["size_mm"] / 2

    def dragged(place: Array) -> MarkJson:
        return _rounded({**mark, "size_mm": max(2 * float(np.abs(place).max()), _LEAST_MM)})

    yield Handle("size_mm", (half, half), dragged)


def _corner(mark: MarkJson, toward: Point) -> Iterator[Handle]:
    yield _length(mark, "reach_mm", 0.0 if toward[0] > 0 else 180.0)
    yield _length(mark, "radius_mm", 90.0 if toward[1] > 0 else -90.0)


_HANDLES: Mapping[str, Callable[[MarkJson, Point], Iterator[Handle]]] = {
    "cross": _cross,
    "dot": _dot,
    "ring-cross": _ring_cross,
    "ring-dot": _ring_dot,
    "polygon": _polygon,
    "parts": _parts,
    "template": _square,
    "learned": _square,
    "frame-corner": _corner,
}
_PARTS: Mapping[str, Callable[[MarkJson], Iterator[Handle]]] = {
    "disk": _disk_part,
    "ring": _ring_part,
    "bar": _bar_part,
    "polygon": lambda part: _polygon(part, (1.0, 1.0)),
}

"""Fiducial marks as the camera file draws them: `[mark.NAME]`, a kind and its sizes, to what `measure` knows."""

from dataclasses import replace
from typing import cast

import numpy as np

from measure.marks import shapes
from pipeline.files.template_table import read_template
from pipeline.text.tables import Table

KINDS = ("cross", "dot", "ring-cross", "ring-dot", "polygon", "parts", "template", "learned", "frame-corner")


_ANY_CORNER = (-1.0, -1.0)  # which one it is says the fiducial's place


def read_mark(table: Table) -> shapes.Mark | shapes.LearnedMark:
    """One mark. Raises InputError naming the key that is wrong."""
    kind = table.text("kind", choices=KINDS)
    if kind == "learned":
        return shapes.LearnedMark(table.number("size_mm", above=0.0))
    polarity = cast(shapes.Polarity, table.text("polarity", "auto", ("auto", "light", "dark")))
    if kind == "frame-corner":
        reach, radius = table.number("reach_mm", 0.0, least=0.0), table.number("radius_mm", 0.0, least=0.0)
        if radius and reach and radius >= reach:
            raise table.error("radius_mm", f"must be smaller than reach_mm ({reach:g}), not {radius:g}.")
        return shapes.frame_corner(_ANY_CORNER, reach, radius, polarity)
    if kind == "template":
        return replace(read_template(table), polarity=polarity)
    return shapes.MarkShape(_parts(kind, table), polarity, true_mm=_true_mm(table))


def _true_mm(table: Table) -> tuple[shapes.Point, shapes.Point] | None:
    """The rectangle in which the drawing is true; None: everywhere."""
    if "true_mm" not in table:
        return None
    corners = table.pairs("true_mm")
    if len(corners) != 2 or not np.all(np.less(*corners)):
        corner = "[[least x, least y], [greatest x, greatest y]]"
        raise table.error("true_mm", f"must be two corners of the rectangle in which the drawing is true, {corner}.")
    return corners[0], corners[1]


def _parts(kind: str, table: Table) -> tuple[shapes.Part, ...]:
    if kind == "dot":
        return shapes.dot(table.number("radius_mm", above=0.0))
    if kind == "ring-dot":
        return shapes.ring_dot(*_ring_sizes(table), table.number("radius_mm", above=0.0))
    if kind == "polygon":
        return shapes.polygon(_vertices(table))
    if kind == "parts":
        parts = tuple(_part(part) for part in table.tables("part"))
        if not parts:
            raise table.error("part", f"a mark of kind 'parts' needs at least one [[{table.place}.part]].")
        return parts
    arm, line, gap, angle = _cross_sizes(table)
    if kind == "ring-cross":
        return shapes.ring_cross(*_ring_sizes(table), arm, line, gap, angle)
    return shapes.cross(arm, line, gap, angle)


def _cross_sizes(table: Table) -> tuple[float, float, float, float]:
    arm = table.number("arm_mm", above=0.0)
    gap = table.number("gap_mm", 0.0, least=0.0)
    if gap >= arm:
        raise table.error("gap_mm", f"must be smaller than arm_mm ({arm:g}), not {gap:g}: no arm would be left.")
    return arm, table.number("line_mm", above=0.0), gap, table.number("angle_deg", 0.0)


def _ring_sizes(table: Table) -> tuple[float, float]:
    return table.number("ring_mm", above=0.0), table.number("ring_line_mm", above=0.0)


def _vertices(table: Table) -> tuple[shapes.Point, ...]:
    vertices = table.pairs("vertices_mm")
    if len(vertices) < 3:
        raise table.error("vertices_mm", f"a polygon needs at least three vertices, not {len(vertices)}.")
    x, y = np.transpose(vertices)
    if np.isclose(x @ np.roll(y, 1), y @ np.roll(x, 1), rtol=1e-9, atol=0.0):
        raise table.error("vertices_mm", "the polygon encloses no area. Give its corners in the order of its outline.")
    return vertices


def _part(table: Table) -> shapes.Part:
    shape = table.text("shape", choices=("disk", "ring", "bar", "polygon"))
    part: shapes.Part
    if shape == "disk":
        part = shapes.Disk(table.pair("center_mm", (0.0, 0.0)), table.number("radius_mm", above=0.0))
    elif shape == "ring":
        center, radius = table.pair("center_mm", (0.0, 0.0)), table.number("radius_mm", above=0.0)
        part = shapes.Ring(center, radius, table.number("line_mm", above=0.0))
    elif shape == "bar":
        part = shapes.Bar(table.pair("from_mm"), table.pair("to_mm"), table.number("line_mm", above=0.0))
        if part.from_mm == part.to_mm:
            raise table.error("to_mm", "is the same as from_mm: a bar needs two different ends.")
    else:
        part = shapes.Polygon(_vertices(table))
    table.done()
    return part

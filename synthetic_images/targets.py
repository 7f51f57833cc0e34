"""Test field: targets with their names, true centres and outlines in the object frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area, bar, disk, subdivided
from synthetic_images.scene import BoardField, CrossFigure, DiskField, DiskTarget, RingFigure

Array = NDArray[np.float64]

EDGE_PIECES = 16  # pieces of each straight edge, which the distortion bends
ARC_PIECES = 24  # vertices of the arc of a ring segment
FACES_UP = 0.9  # cosine of the angle between normal and Z above which a target's x axis is along the object's X


@dataclass(frozen=True, eq=False)
class Target:
    """Point of the field. center, normal: (3,); radius: of the disk, or half the length of the cross; 0 for a
    chessboard corner."""

    id: str
    center: Array
    normal: Array
    radius: float


def field_targets(field: DiskField | BoardField) -> tuple[Target, ...]:
    """All measurable points of the field."""
    if isinstance(field, DiskField):
        return tuple(_disk_target(target, field.diameter) for target in field.targets)
    radius = field.diameter / 2 if field.kind == "circle-grid" else 0.0
    up = np.array([0.0, 0.0, 1.0])
    return tuple(
        Target(f"r{row}c{column}", np.array([*_board_point(field, row, column), 0.0]), up, radius)
        for row in range(field.rows)
        for column in range(field.columns)
        if not field.asymmetric or (row + column) % 2 == 0
    )


def _board_point(field: BoardField, row: int, column: int) -> tuple[float, float]:
    """X and Y of a point of a board."""
    return column * field.spacing, (field.rows - 1 - row) * field.spacing


def disk_outline(target: Target, radius: float) -> Array:
    """(n, 3) outline of a disk around a target, in its plane."""
    helper = np.eye(3)[np.argmin(np.abs(target.normal))]
    u = np.cross(target.normal, helper)
    u /= np.linalg.norm(u)
    circle = disk((0.0, 0.0), radius)[0]
    return np.asarray(target.center + circle[:, :1] * u + circle[:, 1:] * np.cross(target.normal, u))


def figure_reach(field: DiskField | BoardField, target: Target) -> float:
    """Radius of the circle that encloses the figure of a target."""
    if isinstance(field, DiskField) and isinstance(field.figure, RingFigure) and target.id in field.figure.numbers:
        return target.radius * field.figure.outer
    return target.radius


def figure_outlines(field: DiskField, target: Target) -> tuple[tuple[Array, ...], ...]:
    """Areas of the figure of a target, each of outlines (n, 3)."""
    if isinstance(field.figure, CrossFigure):
        r, line = target.radius, target.radius * field.figure.line
        areas: tuple[Area, ...] = (bar((-r, 0.0), (r, 0.0), line), bar((0.0, -r), (0.0, r), line))
    elif field.figure is not None and target.id in field.figure.numbers:
        areas = (disk((0.0, 0.0), target.radius), *_segments(field.figure, target))
    else:
        return ((disk_outline(target, target.radius),),)
    u, v = _own_axes(target.normal)
    return tuple(
        tuple(
            target.center + xy[:, :1] * u + xy[:, 1:] * v
            for xy in (subdivided(outline, EDGE_PIECES) for outline in area)
        )
        for area in areas
    )


def _segments(figure: RingFigure, target: Target) -> tuple[Area, ...]:
    """Areas of the ring segments whose bits are set, clockwise from the top."""
    number, step = figure.numbers[target.id], 2.0 * np.pi / figure.bits
    areas: list[Area] = []
    for bit in range(figure.bits):
        if number >> (figure.bits - 1 - bit) & 1:
            angle = np.pi / 2.0 - step * (bit + np.linspace(0.0, 1.0, ARC_PIECES))
            arc = target.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            areas.append((np.concatenate([figure.inner * arc, figure.outer * arc[::-1]]),))
    return tuple(areas)


def _own_axes(normal: Array) -> tuple[Array, Array]:
    """Right and up axes of a target, as seen from its front."""
    if abs(normal[2]) < FACES_UP:
        right = np.cross([0.0, 0.0, 1.0], normal)
    else:
        right = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    right = right / np.linalg.norm(right)
    return right, np.cross(normal, right)


def board_sheet(field: BoardField) -> Array:
    """(n, 3) outline of the board's white sheet, 1.5 spacings beyond the outer points."""
    edge = 1.5 * field.spacing
    right, top = _board_point(field, 0, field.columns - 1)
    return _rectangle(-edge, right + edge, -edge, top + edge)


def chessboard_squares(field: BoardField) -> tuple[Array, ...]:
    """Outlines (n, 3) of the black squares; the square above and left of the first inner corner is black."""
    squares = []
    for row in range(field.rows + 1):
        for column in range(row % 2, field.columns + 1, 2):
            right, bottom = _board_point(field, row, column)
            squares.append(_rectangle(right - field.spacing, right, bottom, bottom + field.spacing))
    return tuple(squares)


def _disk_target(target: DiskTarget, diameter: float) -> Target:
    normal = np.asarray(target.normal, float)
    return Target(target.id, np.asarray(target.center, float), normal / np.linalg.norm(normal), diameter / 2)


def _rectangle(left: float, right: float, bottom: float, top: float) -> Array:
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    outline = subdivided(corners, EDGE_PIECES)
    return np.column_stack([outline, np.zeros(len(outline))])

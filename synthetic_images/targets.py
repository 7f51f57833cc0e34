"""The test field as it is drawn: targets with their names, true centres and outlines in the object frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import disk, subdivided
from synthetic_images.scene import BoardField, DiskField, DiskTarget

Array = NDArray[np.float64]

EDGE_PIECES = 16  # of a board's edges, which the distortion bends


@dataclass(frozen=True, eq=False)
class Target:
    """One point of the field. center, normal: (3,); radius: of its disk, 0 for the corner of a chessboard."""

    id: str
    center: Array
    normal: Array
    radius: float


def field_targets(field: DiskField | BoardField) -> tuple[Target, ...]:
    """Every point that a picture of the field lets one measure."""
    if isinstance(field, DiskField):
        return tuple(_disk_target(target, field.diameter) for target in field.targets)
    radius = field.diameter / 2 if field.kind == "circle-grid" else 0.0
    up = np.array([0.0, 0.0, 1.0])
    return tuple(
        Target(f"r{row}c{column}", np.array([*board_point(field, row, column), 0.0]), up, radius)
        for row in range(field.rows)
        for column in range(field.columns)
        if not field.asymmetric or (row + column) % 2 == 0
    )


def board_point(field: BoardField, row: int, column: int) -> tuple[float, float]:
    """X and Y of a board's point."""
    return column * field.spacing, (field.rows - 1 - row) * field.spacing


def disk_outline(target: Target, radius: float) -> Array:
    """(n, 3) the outline of a disk about a target, in its plane."""
    helper = np.eye(3)[np.argmin(np.abs(target.normal))]
    u = np.cross(target.normal, helper)
    u /= np.linalg.norm(u)
    circle = disk((0.0, 0.0), radius)[0]
    return np.asarray(target.center + circle[:, :1] * u + circle[:, 1:] * np.cross(target.normal, u))


def board_sheet(field: BoardField) -> Array:
    """(n, 3) the outline of the board's white sheet: one spacing and a half beyond its outer points."""
    edge = 1.5 * field.spacing
    right, top = board_point(field, 0, field.columns - 1)
    return _rectangle(-edge, right + edge, -edge, top + edge)


def chessboard_squares(field: BoardField) -> tuple[Array, ...]:
    """Outlines (n, 3) of the black squares; the one above and left of the first inner corner is black."""
    squares = []
    for row in range(field.rows + 1):
        for column in range(row % 2, field.columns + 1, 2):
            right, bottom = board_point(field, row, column)
            squares.append(_rectangle(right - field.spacing, right, bottom, bottom + field.spacing))
    return tuple(squares)


def _disk_target(target: DiskTarget, diameter: float) -> Target:
    normal = np.asarray(target.normal, float)
    return Target(target.id, np.asarray(target.center, float), normal / np.linalg.norm(normal), diameter / 2)


def _rectangle(left: float, right: float, bottom: float, top: float) -> Array:
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    outline = subdivided(corners, EDGE_PIECES)
    return np.column_stack([outline, np.zeros(len(outline))])

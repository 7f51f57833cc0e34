"""A board that is nearly flat: how far its bend puts each of its points beside the plane.

Two parabolas, as mrcal has them (its `ref_calibration_object`, calobject_warp): with ξ and η from -1 to 1 over the
board's points, a point stands bend_x (1 - ξ²) + bend_y (1 - η²) off the plane. The corners stay where they are; in the
middle the two add up.
"""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array

BOARD_NAMES = ("bend_x", "bend_y")
LARGEST_RELIEF = 0.02  # of the longest extent: what has more is no board
_EQUAL = 1e-9  # of the areas of rectangles that are one
_UPRIGHT = 0.9  # of the normal along X, from which on the board's first axis is that along Y


@dataclass(frozen=True)
class BoardForm:
    """normal (3,): off the board, towards the larger of the coordinates that it runs along most. shapes (n, 2): how far
    a bend of 1 along each axis lifts the points."""

    normal: Array
    shapes: Array

    def offsets(self, bends: Array) -> Array:
        """(n, 3) of the points, for bends (2,) in object units."""
        return np.asarray((self.shapes @ bends)[:, None] * self.normal)


def board_form(xyz: Array) -> BoardForm:
    """Of a board's flat points (n, 3). Its axes are the sides of the smallest rectangle about them, the first one that
    is nearer to X, or to Y where the board faces X.

    Raises ValueError for points that are no board: fewer than four, on a line, or with relief.
    """
    centred = xyz - xyz.mean(axis=0)
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    if len(xyz) < 4 or extents[1] <= 1e-6 * extents[0] or extents[2] > LARGEST_RELIEF * extents[0]:
        raise ValueError("a board is at least four points about in a plane, not on a line")
    normal = axes[2] * np.sign(axes[2][np.abs(axes[2]).argmax()])
    upright = np.eye(3)[int(abs(normal[0]) > _UPRIGHT)]
    along = upright - normal * (upright @ normal)
    along /= np.linalg.norm(along)
    places = centred @ np.stack([along, np.cross(normal, along)], axis=1)
    places = places @ _to_sides(places)
    low, high = places.min(axis=0), places.max(axis=0)
    return BoardForm(normal, 1.0 - ((2.0 * places - low - high) / (high - low)) ** 2)


def _to_sides(places: Array) -> Array:
    """(2, 2) the turn, by 45 degrees at most, that lays points (n, 2) along the smallest rectangle about them: one
    of its sides is an edge of their convex hull."""
    from scipy.spatial import ConvexHull  # takes longer to import than most boards to adjust

    corners = places[ConvexHull(places).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    angles = (angles + np.pi / 4.0) % (np.pi / 2.0) - np.pi / 4.0
    turns = np.moveaxis(np.array([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]), -1, 0)
    areas = np.ptp(corners @ turns, axis=1).prod(axis=1)
    smallest = np.flatnonzero(areas < areas.min() * (1.0 + _EQUAL))
    return np.asarray(turns[smallest[np.abs(angles[smallest]).argmin()]])

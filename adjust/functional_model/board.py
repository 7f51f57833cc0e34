"""Bend of a nearly flat calibration board: offsets of its points from the plane.

Two parabolas, as in mrcal (`ref_calibration_object`, calobject_warp): with ξ and η from -1 to 1 over the board's
points, a point lies bend_x (1 - ξ²) + bend_y (1 - η²) off the plane. The corners do not move; in the middle the two
bends add up.
"""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array

BOARD_NAMES = ("bend_x", "bend_y")
LARGEST_RELIEF = 0.02  # fraction of the longest extent; points with more relief are not a board
_EQUAL = 1e-9  # relative difference below which the areas of two rectangles are equal
_UPRIGHT = 0.9  # |X| of the normal above which the board's first axis is taken along Y


@dataclass(frozen=True)
class BoardForm:
    """Shape of the bend of a board.

    normal (3,): unit normal, positive in its largest component. axes (2, 3): unit vectors along the sides. places
    (n, 2): of the points along them, from their mean. shapes (n, 2): offsets of the points for a bend of 1 along each
    axis.
    """

    normal: Array
    axes: Array
    places: Array
    shapes: Array

    def offsets(self, bends: Array) -> Array:
        """(n, 3) offsets of the points for bends (2,), in object units."""
        return np.asarray((self.shapes @ bends)[:, None] * self.normal)

    @property
    def strain_directions(self) -> Array:
        """(n, 2, 3) displacements of the points by a stretch of 1, first axis over second, and by a shear of 1."""
        (along, across), (x, y) = self.axes, self.places.T[..., None]
        return np.stack([x * along - y * across, y * along + x * across], axis=1) / 2.0


def board_form(xyz: Array) -> BoardForm:
    """Determine the axes of a board from its flat points (n, 3).

    The axes are the sides of the smallest rectangle around the points. The first axis is the one nearer to X, or to Y
    where the board faces X. Raises ValueError for fewer than four points, points on a line or points with relief.
    """
    centred = xyz - xyz.mean(axis=0)
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    if len(xyz) < 4 or extents[1] <= 1e-6 * extents[0] or extents[2] > LARGEST_RELIEF * extents[0]:
        raise ValueError("a board is at least four points about in a plane, not on a line")
    normal = axes[2] * np.sign(axes[2][np.abs(axes[2]).argmax()])
    upright = np.eye(3)[int(abs(normal[0]) > _UPRIGHT)]
    along = upright - normal * (upright @ normal)
    along /= np.linalg.norm(along)
    plane = np.stack([along, np.cross(normal, along)], axis=1)
    axes = plane @ _to_sides(centred @ plane)
    places = centred @ axes
    low, high = places.min(axis=0), places.max(axis=0)
    return BoardForm(normal, axes.T, places, 1.0 - ((2.0 * places - low - high) / (high - low)) ** 2)


def _to_sides(places: Array) -> Array:
    """(2, 2) rotation by at most 45 degrees that aligns points (n, 2) with the smallest rectangle around them."""
    # One side of that rectangle is an edge of the convex hull.
    from scipy.spatial import ConvexHull  # slow import: longer than the adjustment of most boards

    corners = places[ConvexHull(places).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    angles = (angles + np.pi / 4.0) % (np.pi / 2.0) - np.pi / 4.0
    turns = np.moveaxis(np.array([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]), -1, 0)
    areas = np.ptp(corners @ turns, axis=1).prod(axis=1)
    smallest = np.flatnonzero(areas < areas.min() * (1.0 + _EQUAL))
    return np.asarray(turns[smallest[np.abs(angles[smallest]).argmin()]])

"""Deformations of an object of given points: displacements of its points by each parameter of 1.

Bend of a nearly flat board: two parabolas, as in mrcal (`ref_calibration_object`, calobject_warp). With ξ and η from -1
to 1 over the board's points, a point lies bend_x (1 - ξ²) + bend_y (1 - η²) off the plane. The corners do not move; in
the middle the two bends add up. A twist by ξη makes it a saddle.

Strain of any object: stretches along its axes relative to the last one, and shears. A change of scale is one of the
stations.

Disks on a flat board: the centre of gravity of their images. With the map f from the board to the image, its gradient J
and its second derivatives f_kk along two axes of the board, it is to second order the image of a point that lies

    r²/4 (J⁻¹ (f_11 + f_22) / 2 + grad ln |J|)

off the centre of a disk of radius r.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from adjust.array_types import Array

BOARD_NAMES = ("bend_x", "bend_y")
LARGEST_RELIEF = 0.02  # fraction of the longest extent; points with more relief are not a board
_EQUAL = 1e-9  # relative difference below which the areas of two rectangles are equal
_UPRIGHT = 0.9  # |X| of the normal above which the board's first axis is taken along Y


@dataclass(frozen=True)
class BoardForm:
    """Shape of the bend of a board.

    normal (3,): unit normal, positive in its largest component. axes (2, 3): unit vectors along the sides. relative
    (n, 2): places of the points along them, from -1 to 1.
    """

    normal: Array
    axes: Array
    relative: Array

    @property
    def bend_directions(self) -> Array:
        """(n, 2, 3) displacements of the points by a bend of 1 along each axis."""
        return np.asarray((1.0 - self.relative**2)[:, :, None] * self.normal)

    @property
    def twist_directions(self) -> Array:
        """(n, 1, 3) displacements of the points by a twist that lifts two opposite corners by 1 and lowers the
        others."""
        return np.asarray(self.relative.prod(axis=1)[:, None, None] * self.normal)


def strain_directions(xyz: Array, axes: Array) -> Array:
    """(n, k, 3) displacements of points (n, 3) by stretches along the axes (m, 3) but the last, and by shears, of 1."""
    places, count = (xyz - xyz.mean(axis=0)) @ axes.T, len(axes)
    stretches = [places[:, i, None] * axes[i] for i in range(count - 1)]
    shears = [
        (places[:, i, None] * axes[j] + places[:, j, None] * axes[i]) / 2.0 for i, j in combinations(range(count), 2)
    ]
    return np.stack([*stretches, *shears], axis=1)


def datum_directions(xyz: Array) -> Array:
    """(n, 7, 3) displacements of points (n, 3) by shifts, turns about X, Y and Z and a scale of 1, about the centre."""
    places = xyz - xyz.mean(axis=0)
    turns = np.cross(np.eye(3), places[:, None])
    return np.concatenate([np.broadcast_to(np.eye(3), (len(xyz), 3, 3)), turns, places[:, None]], axis=1)


def disk_directions(at: Mapping[tuple[int, int], Array], axes: Array, radius: float) -> Array:
    """(n, 1, 3) displacements of disks' centres by a squared radius of 1.

    at: images (n, 2) of points that lie (i, j) radii off the centres along the axes (2, 3) of the board, i and j from
    -1 to 1.
    """
    gradient = np.stack([at[1, 0] - at[-1, 0], at[0, 1] - at[0, -1]], axis=-1) / 2.0
    first, second = at[1, 0] + at[-1, 0] - 2.0 * at[0, 0], at[0, 1] + at[0, -1] - 2.0 * at[0, 0]
    mixed = (at[1, 1] + at[-1, -1] - at[1, -1] - at[-1, 1]) / 4.0
    first, mixed, second = np.linalg.solve(gradient, np.stack([first, mixed, second], axis=-1)).transpose(2, 0, 1)
    by_area = np.stack([first[:, 0] + mixed[:, 1], mixed[:, 0] + second[:, 1]], axis=1)  # gradient of ln |J|
    return np.asarray((((first + second) / 2.0 + by_area) / (4.0 * radius) @ axes)[:, None])


def board_form(xyz: Array) -> BoardForm:
    """Determine the axes of a board from its flat points (n, 3).

    The axes are the sides of the smallest rectangle around the points. The first axis is the one nearer to X, or to Y
    where the board faces X. Raises ValueError for fewer than four points, points on a line or points with relief.
    """
    centred = xyz - xyz.mean(axis=0)
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    if len(xyz) < 4 or extents[1] <= 1e-6 * extents[0] or extents[2] > LARGEST_RELIEF * extents[0]:
        raise ValueError("a board is at least four points about in a plane, not on a line")
    from scipy.spatial import ConvexHull  # slow import: longer than the adjustment of most boards

    normal = axes[2] * np.sign(axes[2][np.abs(axes[2]).argmax()])
    upright = np.eye(3)[int(abs(normal[0]) > _UPRIGHT)]
    along = upright - normal * (upright @ normal)
    along /= np.linalg.norm(along)
    plane = np.stack([along, np.cross(normal, along)], axis=1)
    # One side of the smallest rectangle is an edge of the convex hull: rotations by at most 45 degrees to the edges.
    flat = centred @ plane
    corners = flat[ConvexHull(flat).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    angles = (angles + np.pi / 4.0) % (np.pi / 2.0) - np.pi / 4.0
    turns = np.moveaxis(np.array([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]), -1, 0)
    areas = np.ptp(corners @ turns, axis=1).prod(axis=1)
    smallest = np.flatnonzero(areas < areas.min() * (1.0 + _EQUAL))
    axes = plane @ turns[smallest[np.abs(angles[smallest]).argmin()]]
    places = centred @ axes
    low, high = places.min(axis=0), places.max(axis=0)
    return BoardForm(normal, axes.T, (2.0 * places - low - high) / (high - low))

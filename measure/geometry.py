"""Geometry of a scan: the eight scan orientations, four quarter turns with and without mirror."""

from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Grid = TypeVar("Grid", NDArray[np.float64], NDArray[np.bool_])

Array = NDArray[np.float64]

POSES = ("0", "90", "180", "270", "0m", "90m", "180m", "270m")


@cache
def up_from_camera(pose: str) -> Array:
    """(2, 2) turn, after a mirror if there is one, from the camera's (x', y') to the scan's (right, up)."""
    quarter = int(pose.removesuffix("m")) // 90
    c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[quarter]
    turn = np.array([[c, -s], [s, c]])
    mirror = np.diag([-1.0 if pose.endswith("m") else 1.0, 1.0])
    up = np.asarray(turn @ mirror)
    up.flags.writeable = False  # it is everybody's
    return up


def pose_in_camera(seen: str, frame: str) -> str:
    """How something lies in the camera's frame that is seen in the scan in one pose, the frame being in another."""
    own = up_from_camera(frame).T @ up_from_camera(seen)
    return next(pose for pose in POSES if np.array_equal(up_from_camera(pose), np.rint(own)))


def turn_by_quarters(image: Grid, turn: Array) -> Grid:
    """The image under a turn (2, 2) of its columns and rows by whole quarters, after a mirror if there is one."""
    whole = np.rint(turn)
    turned = image if whole[0, 0] else image.T
    across, down = whole.sum(axis=1)
    return np.ascontiguousarray(turned[:: int(down), :: int(across)])


def linear_scale(matrix: Array) -> float:
    """The scale of a transformation (2, 2) or (2, 3), the mean of both directions: the root of its determinant."""
    return float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))

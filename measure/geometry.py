"""Geometry of a scan: affine transformations, and the eight scan orientations, four turns with and without mirror."""

from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from measure.array_types import Array, Mask

Grid = TypeVar("Grid", Array, Mask)


POSES = ("0", "90", "180", "270", "0m", "90m", "180m", "270m")


@dataclass(frozen=True, eq=False)
class Affine:
    """An affine transformation of the plane: matrix (2, 3), its linear part (2, 2) and its shift (2,)."""

    matrix: Array

    @classmethod
    def from_linear(cls, linear: Array, shift: ArrayLike = (0.0, 0.0)) -> "Affine":
        """The transformation with a linear part (2, 2) and a shift (2,)."""
        return cls(np.column_stack([linear, np.asarray(shift, dtype=float)]))

    @property
    def linear(self) -> Array:
        """(2, 2)."""
        return self.matrix[:, :2]

    @property
    def shift(self) -> Array:
        """(2,) where the origin comes to lie."""
        return self.matrix[:, 2]

    @property
    def inverse(self) -> "Affine":
        """The transformation back."""
        back: Array = np.asarray(np.linalg.inv(self.linear), float)
        return Affine.from_linear(back, -back @ self.shift)

    @property
    def scale(self) -> float:
        """The mean of both directions: the root of the determinant's absolute value."""
        return linear_scale(self.matrix)

    def apply(self, points: Array) -> Array:
        """Points (..., 2) transformed."""
        return np.asarray(points @ self.linear.T + self.shift)

    def compose(self, first: "Affine") -> "Affine":
        """This transformation after another one."""
        return Affine.from_linear(self.linear @ first.linear, self.apply(first.shift))


def linear_scale(matrix: Array) -> float:
    """The scale of a linear part, (2, 2) or the first columns of (2, 3), as `Affine.scale` is."""
    return float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))


@cache
def up_from_camera(pose: str) -> Array:
    """(2, 2) turn, after a mirror if there is one, from the camera's (x', y') to the scan's (right, up)."""
    c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(pose.removesuffix("m")) // 90]
    up = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if pose.endswith("m") else 1.0, 1.0])
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

"""Affine transformations, and the eight scan orientations: four quarter turns, with and without mirroring."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from measure.array_types import Array, Mask

Grid = TypeVar("Grid", Array, Mask)
Complex = NDArray[np.complexfloating[Any, Any]]

POSES = ("0", "90", "180", "270", "0m", "90m", "180m", "270m")


@dataclass(frozen=True, eq=False)
class Affine:
    """Affine transformation of the plane. matrix (2, 3): linear part (2, 2) and shift (2,)."""

    matrix: Array

    @classmethod
    def from_linear(cls, linear: Array, shift: ArrayLike = (0.0, 0.0)) -> "Affine":
        """Compose a transformation from a linear part (2, 2) and a shift (2,)."""
        return cls(np.column_stack([linear, np.asarray(shift, dtype=float)]))

    @property
    def linear(self) -> Array:
        """(2, 2) linear part."""
        return self.matrix[:, :2]

    @property
    def shift(self) -> Array:
        """(2,) image of the origin."""
        return self.matrix[:, 2]

    @property
    def inverse(self) -> "Affine":
        """Inverse transformation."""
        back: Array = np.asarray(np.linalg.inv(self.linear), float)
        return Affine.from_linear(back, -back @ self.shift)

    @property
    def scale(self) -> float:
        """Mean scale: root of the absolute value of the determinant."""
        return linear_scale(self.matrix)

    def apply(self, points: Array) -> Array:
        """Transform points (..., 2)."""
        return np.asarray(points @ self.linear.T + self.shift)

    def compose(self, first: "Affine") -> "Affine":
        """Transformation that applies first, then this one."""
        return Affine.from_linear(self.linear @ first.linear, self.apply(first.shift))


def linear_scale(matrix: Array) -> float:
    """Mean scale, as in `Affine.scale`, of a linear part (2, 2) or of the first columns of a matrix (2, 3)."""
    return float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))


def scan_px(reduced_px: Array, factor: float) -> Array:
    """Convert pixels (..., 2) of a scan reduced by a factor to pixels of the scan; the centre of a pixel is whole."""
    return np.asarray(reduced_px * factor + (factor - 1) / 2)


def reduced_px(scan_px: Array, factor: float) -> Array:
    """Convert pixels (..., 2) of a scan to pixels of the scan reduced by a factor."""
    return np.asarray((scan_px - (factor - 1) / 2) / factor)


def fit_similarity(from_: Complex, to: Complex, weight: Array) -> tuple[Complex, Complex]:
    """Fit similarities a w + b to weighted places (..., n), complex numbers. Returns a and b, (...,) each."""
    total = weight.sum(axis=-1)
    mean_from, mean_to = ((weight * places).sum(axis=-1) / total for places in (from_, to))
    reduced, target = from_ - mean_from[..., None], to - mean_to[..., None]
    scale = (weight * np.conj(reduced) * target).sum(axis=-1) / (weight * np.abs(reduced) ** 2).sum(axis=-1)
    return scale, mean_to - scale * mean_from


def similarity_matrix(scale: complex | Complex, offset: complex | Complex) -> Array:
    """(2, 3) matrix of a similarity a w + b of complex numbers."""
    return np.array([[scale.real, -scale.imag, offset.real], [scale.imag, scale.real, offset.imag]])


def _up_from_camera(pose: str) -> Array:
    c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(pose.removesuffix("m")) // 90]
    up = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if pose.endswith("m") else 1.0, 1.0])
    up.flags.writeable = False  # the array is shared
    return up


# By scan orientation, the (2, 2) rotation, preceded by mirroring if any, from the camera's (x', y') to the scan's
# (right, up).
UP_FROM_CAMERA: Mapping[str, Array] = {pose: _up_from_camera(pose) for pose in POSES}


def pose_in_camera(seen: str, frame: str) -> str:
    """Orientation, in the camera's frame, of an object that appears in the scan in orientation seen, if the scan
    orientation of the frame is frame."""
    own = UP_FROM_CAMERA[frame].T @ UP_FROM_CAMERA[seen]
    return next(pose for pose in POSES if np.array_equal(UP_FROM_CAMERA[pose], np.rint(own)))


def turn_by_quarters(image: Grid, turn: Array) -> Grid:
    """Rotate an image by quarter turns, preceded by mirroring if any. turn (2, 2): of columns and rows."""
    whole = np.rint(turn)
    turned = image if whole[0, 0] else image.T
    across, down = whole.sum(axis=1)
    return np.ascontiguousarray(turned[:: int(down), :: int(across)])

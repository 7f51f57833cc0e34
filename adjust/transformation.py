"""Film transformations T: comparator (x, y) to camera (x', y'), each of them an affinity in its own parameters.

    affine      x' = a1 + a2 x + a3 y      y' = b1 + b2 x + b3 y
    similarity  x' = a1 + p x - m q y      y' = b1 + q x + m p y
    congruent   x' = a1 + cos(t) x - m sin(t) y,   y' = b1 + sin(t) x + m cos(t) y,   t the `angle` in rad
    none        x' = x                     y' = y

m is -1 where the scan is mirrored, which a similarity and a congruent transformation have to be told, and 1 elsewhere.
"""

from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from adjust.network import Transformation

Array = NDArray[np.float64]

NAMES = MappingProxyType[Transformation, tuple[str, ...]](
    {
        "none": (),
        "congruent": ("a1", "b1", "angle"),
        "similarity": ("a1", "b1", "p", "q"),
        "affine": ("a1", "a2", "a3", "b1", "b2", "b3"),
    }
)


def affine_from_parameters(kind: Transformation, parameters: Array, mirrored: bool = False) -> Array:
    """The six coefficients a1, a2, a3, b1, b2, b3 (6,) of a transformation."""
    m = -1.0 if mirrored else 1.0
    match kind:
        case "none":
            return np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
        case "congruent":
            a1, b1, angle = parameters
            c, s = np.cos(angle), np.sin(angle)
            return np.array([a1, c, -m * s, b1, s, m * c])
        case "similarity":
            a1, b1, p, q = parameters
            return np.array([a1, p, -m * q, b1, q, m * p])
        case "affine":
            return np.array(parameters)


def affine_by_parameters(kind: Transformation, parameters: Array, mirrored: bool = False) -> Array:
    """Derivatives of the six coefficients by the transformation's own parameters (6, k)."""
    m = -1.0 if mirrored else 1.0
    match kind:
        case "none":
            return np.zeros((6, 0))
        case "congruent":
            c, s = np.cos(parameters[2]), np.sin(parameters[2])
            return np.stack([_unit(0), _unit(3), np.array([0.0, -s, -m * c, 0.0, c, -m * s])], axis=1)
        case "similarity":
            p = np.array([0.0, 1.0, 0.0, 0.0, 0.0, m])
            q = np.array([0.0, 0.0, -m, 0.0, 1.0, 0.0])
            return np.stack([_unit(0), _unit(3), p, q], axis=1)
        case "affine":
            return np.eye(6)


def _unit(position: int) -> Array:
    return np.asarray(np.eye(6)[position])


def apply_affine(affine: Array, xy: Array) -> Array:
    """Coordinates (..., 2) through the six coefficients (..., 6)."""
    x, y = xy[..., 0], xy[..., 1]
    first = affine[..., 0] + affine[..., 1] * x + affine[..., 2] * y
    second = affine[..., 3] + affine[..., 4] * x + affine[..., 5] * y
    return np.stack([first, second], axis=-1)


def affine_gradient(affine: Array) -> Array:
    """Derivative (..., 2, 2) of the transformed coordinates by the untransformed ones."""
    return np.stack([affine[..., 1:3], affine[..., 4:6]], axis=-2)


def affine_design(xy: Array) -> Array:
    """Derivative (..., 2, 6) of the transformed coordinates by the six coefficients."""
    design = np.zeros((*xy.shape[:-1], 2, 6), dtype=xy.dtype)
    for row in (0, 1):
        design[..., row, 3 * row] = 1.0
        design[..., row, 3 * row + 1 : 3 * row + 3] = xy
    return design


def comparator_from_camera(affine: Array, xy_mm: Array) -> Array:
    """The inverse of a transformation: camera coordinates (..., 2) to comparator coordinates, mm."""
    origin = affine[..., [0, 3]]
    return np.asarray(np.linalg.solve(affine_gradient(affine), (xy_mm - origin)[..., None])[..., 0])

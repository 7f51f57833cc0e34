"""What every distortion family gives: a correction of the observed point or the image of a ray, with derivatives."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Settings(Protocol):
    """What a family is told beside its parameters; see `adjust.network.Distortion`."""

    @property
    def decentering(self) -> str: ...

    @property
    def r0_mm(self) -> float: ...

    @property
    def half_mm(self) -> tuple[float, float]: ...


@dataclass(frozen=True)
class Correction:
    """d (n, 2) in mm, which is subtracted from the observed point, and its derivatives.

    by_xy, by_principal_point (n, 2, 2); by_parameters (n, 2, k).
    """

    value: Array
    by_xy: Array
    by_principal_point: Array
    by_parameters: Array


@dataclass(frozen=True)
class Imaged:
    """h (n, 2), the image of the ray at c = 1, and its derivatives.

    by_ray (n, 2, 2); by_parameters (n, 2, k).
    """

    value: Array
    by_ray: Array
    by_parameters: Array


def no_correction(_: Settings, xy: Array, __: Array, parameters: Array) -> Correction:
    """Of the families that distort the ray, and of none."""
    zeros = np.zeros((len(xy), 2, 2))
    return Correction(np.zeros((len(xy), 2)), zeros, zeros, np.zeros((len(xy), 2, len(parameters))))


def undistorted(ray: Array, parameters: Array) -> Imaged:
    """Of the families that correct the observed point, and of none."""
    return Imaged(ray, np.broadcast_to(np.eye(2), (len(ray), 2, 2)), np.zeros((len(ray), 2, len(parameters))))


def matrices(a11: Array, a12: Array, a21: Array, a22: Array) -> Array:
    """2x2 matrices (n, 2, 2) of their elements (n,)."""
    return np.stack([np.stack([a11, a12], axis=-1), np.stack([a21, a22], axis=-1)], axis=-2)

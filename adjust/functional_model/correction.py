"""Interface of the distortion families: correction of the observed point or image of a ray, with derivatives.

There are three kinds of families: correction of the observed point (image side), correction of the ideal point (object
side, `ideal_point_family`), and distortion of the dimensionless ray (`ray_family`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from adjust.array_types import Array
from adjust.linear_algebra.small_matrices import applied

STEP = 1e-30


class Settings(Protocol):
    """Settings of a family in addition to its parameters; see `adjust.functional_model.lens.Distortion`."""

    @property
    def decentering(self) -> str: ...

    @property
    def r0_mm(self) -> float: ...

    @property
    def half_mm(self) -> tuple[float, float]: ...


@dataclass(frozen=True)
class Correction:
    """Correction d (n, 2) in mm, subtracted from the observed point, and its derivatives.

    xy_jacobian, by_principal_point (n, 2, 2); by_parameters: returns those (n, 2, k) by the parameters, on demand.
    """

    value: Array
    xy_jacobian: Array
    by_principal_point: Array
    by_parameters: Callable[[], Array]

    @cached_property
    def parameter_jacobian(self) -> Array:
        return self.by_parameters()


@dataclass(frozen=True)
class Imaged:
    """Image h (n, 2) of rays in mm relative to the principal point, and its derivatives.

    ray_jacobian (n, 2, 2); by_distance (n, 2), with respect to c; parameter_derivative: returns the derivative (n, 2)
    with respect to one parameter, on demand, since many are never needed.
    """

    value: Array
    ray_jacobian: Array
    by_distance: Array
    parameter_derivative: Callable[[int], Array]


@dataclass(frozen=True)
class DistortedRay:
    """Distorted rays (n, 2), and their derivatives as in `Imaged`."""

    value: Array
    ray_jacobian: Array
    parameter_derivative: Callable[[int], Array]


Correct = Callable[
    [Settings, Array, Array, Array], Correction
]  # arguments: settings, points, principal point, parameters
Image = Callable[[Settings, float, Array, Array], Imaged]  # arguments: settings, c, rays, parameters


def complex_steps(function: Callable[[Array], Array], at: Array) -> Array:
    """Derivatives (..., k) of a function by k numbers (..., k) or (k,), by complex steps: exact, but slower."""
    return np.stack([function(at + 1j * STEP * unit).imag / STEP for unit in np.eye(at.shape[-1])], axis=-1)


def no_correction(_: Settings, xy: Array, __: Array, parameters: Array) -> Correction:
    """Zero correction, of the object-side families and of `none`."""
    zero = np.broadcast_to(0.0, (len(xy), 2, 2))
    return Correction(zero[..., 0], zero, zero, lambda: np.broadcast_to(0.0, (len(xy), 2, len(parameters))))


def straight(ray: Array) -> DistortedRay:
    """Undistorted rays."""
    return DistortedRay(ray, np.broadcast_to(np.eye(2), (len(ray), 2, 2)), lambda _: np.broadcast_to(0.0, ray.shape))


def ray_family(bent: Callable[[Array, Array], DistortedRay]) -> Image:
    """Make the image function of a family that distorts the ray before it is imaged at c."""

    def image(_: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        at = bent(ray, parameters)
        return Imaged(c * at.value, c * at.ray_jacobian, at.value, lambda k: c * at.parameter_derivative(k))

    return image


undistorted = ray_family(lambda ray, _: straight(ray))  # of the image-side families and of `none`


def ideal_point_family(correct: Correct) -> Image:
    """Make the image function of a family that adds a correction to the ideal point.

    The same formula is subtracted where a family corrects the observed point.
    """

    def image(settings: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        ideal_mm = c * ray
        added = correct(settings, ideal_mm, np.zeros(2), parameters)
        by_ideal = np.eye(2) + added.xy_jacobian
        return Imaged(
            ideal_mm + added.value, c * by_ideal, applied(by_ideal, ray), lambda k: added.parameter_jacobian[..., k]
        )

    return image

"""What every distortion family gives: a correction of the observed point or the image of a ray, with derivatives.

Three kinds of formulas make all families: a correction of the observed point (the image side), the same of the ideal
point (the object side, `ideal_point_family`), and what is done to the ray itself, without units (`ray_family`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from adjust.array_types import Array
from adjust.linear_algebra.small_matrices import applied


class Settings(Protocol):
    """What a family is told beside its parameters; see `adjust.functional_model.lens.Distortion`."""

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
    xy_jacobian: Array
    by_principal_point: Array
    parameter_jacobian: Array


@dataclass(frozen=True)
class Imaged:
    """The image h (n, 2) of rays in mm about the principal point, and its derivatives.

    by_ray (n, 2, 2); by_distance (n, 2), by c; by_parameter: gives that by one of the parameters (n, 2), for many of
    them are never asked for.
    """

    value: Array
    ray_jacobian: Array
    by_distance: Array
    parameter_derivative: Callable[[int], Array]


@dataclass(frozen=True)
class DistortedRay:
    """Rays (n, 2) as a lens bends them, and their derivatives as in `Imaged`."""

    value: Array
    ray_jacobian: Array
    parameter_derivative: Callable[[int], Array]


Correct = Callable[[Settings, Array, Array, Array], Correction]  # of settings, points, principal point, parameters
Image = Callable[[Settings, float, Array, Array], Imaged]  # of settings, c, rays, parameters


def no_correction(_: Settings, xy: Array, __: Array, parameters: Array) -> Correction:
    """Of the families that distort the ray, and of none."""
    count = len(xy)
    nothing = [np.broadcast_to(0.0, (count, *shape)) for shape in ((2,), (2, 2), (2, 2), (2, len(parameters)))]
    return Correction(*nothing)


def straight(ray: Array) -> DistortedRay:
    """A ray that nothing bends."""
    return DistortedRay(ray, np.broadcast_to(np.eye(2), (len(ray), 2, 2)), lambda _: np.broadcast_to(0.0, ray.shape))


def ray_family(bent: Callable[[Array, Array], DistortedRay]) -> Image:
    """The image of a ray that is bent before it is imaged at c."""

    def image(_: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        at = bent(ray, parameters)
        return Imaged(c * at.value, c * at.ray_jacobian, at.value, lambda k: c * at.parameter_derivative(k))

    return image


undistorted = ray_family(lambda ray, _: straight(ray))  # of the families that correct the observed point, and of none


def ideal_point_family(correct: Correct) -> Image:
    """The image of a ray whose ideal point gets what a formula of points about the principal point says there.

    It is added, where the same formula of the observed point is subtracted.
    """

    def image(settings: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        ideal_mm = c * ray
        added = correct(settings, ideal_mm, np.zeros(2), parameters)
        by_ideal = np.eye(2) + added.xy_jacobian
        return Imaged(
            ideal_mm + added.value, c * by_ideal, applied(by_ideal, ray), lambda k: added.parameter_jacobian[..., k]
        )

    return image

"""What every distortion family gives: a correction of the observed point or the image of a ray, with derivatives.

Three kinds of formulas make all families: a correction of the observed point (the image side), the same of the ideal
point (the object side, `of_ideal_point`), and what is done to the ray itself, without units (`of_ray`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adjust.linear_algebra.small_matrices import applied

Array = NDArray[np.float64]


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
    by_xy: Array
    by_principal_point: Array
    by_parameters: Array


@dataclass(frozen=True)
class Imaged:
    """The image h (n, 2) of rays in mm about the principal point, and its derivatives.

    by_ray (n, 2, 2); by_distance (n, 2), by c; by_parameter: gives that by one of the parameters (n, 2), for many of
    them are never asked for.
    """

    value: Array
    by_ray: Array
    by_distance: Array
    by_parameter: Callable[[int], Array]


@dataclass(frozen=True)
class DistortedRay:
    """Rays (n, 2) as a lens bends them, and their derivatives as in `Imaged`."""

    value: Array
    by_ray: Array
    by_parameter: Callable[[int], Array]


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


def of_ray(bent: Callable[[Array, Array], DistortedRay]) -> Image:
    """The image of a ray that is bent before it is imaged at c."""

    def image(_: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        at = bent(ray, parameters)
        return Imaged(c * at.value, c * at.by_ray, at.value, lambda k: c * at.by_parameter(k))

    return image


undistorted = of_ray(lambda ray, _: straight(ray))  # of the families that correct the observed point, and of none


def of_ideal_point(correct: Correct) -> Image:
    """The image of a ray whose ideal point gets what a formula of points about the principal point says there.

    It is added, where the same formula of the observed point is subtracted.
    """

    def image(settings: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        ideal_mm = c * ray
        added = correct(settings, ideal_mm, np.zeros(2), parameters)
        by_ideal = np.eye(2) + added.by_xy
        return Imaged(
            ideal_mm + added.value, c * by_ideal, applied(by_ideal, ray), lambda k: added.by_parameters[..., k]
        )

    return image

"""What every distortion family gives: a correction of the observed point or the image of a ray, with derivatives."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Settings(Protocol):
    """What a family is told beside its parameters; see `adjust.problem.network.Distortion`."""

    @property
    def decentering(self) -> str: ...

    @property
    def r0_mm(self) -> float: ...

    @property
    def half_mm(self) -> tuple[float, float]: ...


class DistortionModel(Settings, Protocol):
    """A distortion family by its name, with its settings."""

    @property
    def family(self) -> str: ...


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

    by_ray (n, 2, 2); by_parameter: gives that by one of the parameters (n, 2), for many of them are never asked for.
    """

    value: Array
    by_ray: Array
    by_parameter: Callable[[int], Array]


def no_correction(_: Settings, xy: Array, __: Array, parameters: Array) -> Correction:
    """Of the families that distort the ray, and of none."""
    count = len(xy)
    nothing = [np.broadcast_to(0.0, (count, *shape)) for shape in ((2,), (2, 2), (2, 2), (2, len(parameters)))]
    return Correction(*nothing)


def undistorted(ray: Array, _: Array) -> Imaged:
    """Of the families that correct the observed point, and of none."""
    return Imaged(ray, np.broadcast_to(np.eye(2), (len(ray), 2, 2)), lambda _: np.broadcast_to(0.0, ray.shape))

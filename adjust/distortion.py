"""Distortion: what stands between the ideal ray and the observed camera point.

Every family is one pair of equations between the observed point (x', y') and the ideal ray (u, v) = (-U/W, -V/W):

    F = (x', y') - (x0', y0') - c h(u, v) - d(x', y') = 0

`opencv` distorts the ray by h (d is 0), all others correct the observed point by d (h is the ray itself). All arrays
may be complex: the derivatives are tested by complex steps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.correction import Correction, Imaged
from adjust.families import family
from adjust.network import Distortion
from adjust.small_matrices import zeros

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImageEquations:
    """F (n, 2) in mm of points with the image of their ray and their correction, at a principal distance.

    Its derivatives are those by the observed point xy (n, 2, 2), the ray (n, 2, 2), the interior orientation c, x0',
    y0' (n, 2, 3) and the family's parameters (n, 2, k), or by a single one of these (n, 2).
    """

    value: Array
    c: float
    imaged: Imaged
    correction: Correction

    @property
    def by_xy(self) -> Array:
        return np.asarray(np.eye(2) - self.correction.by_xy)

    @property
    def by_ray(self) -> Array:
        return np.asarray(-self.c * self.imaged.by_ray)

    @property
    def by_interior(self) -> Array:
        by_principal_point = -np.eye(2) - self.correction.by_principal_point
        by_interior = zeros(len(self.value), 2, 3, dtype=self.value.dtype)
        by_interior[..., 0] = -self.imaged.value
        by_interior[..., 1:] = by_principal_point
        return by_interior

    @property
    def by_parameters(self) -> Array:
        by_parameters = zeros(*self.correction.by_parameters.shape, dtype=self.value.dtype)
        for k in range(by_parameters.shape[2]):
            by_parameters[..., k] = self.by_parameter(k)
        return by_parameters

    def by_parameter(self, k: int) -> Array:
        by_correction = self.correction.by_parameters[..., k]
        return -self.c * self.imaged.by_parameters[k] - by_correction if self.imaged.by_parameters else -by_correction


def image_equations(
    distortion: Distortion, interior: Array, parameters: Array, xy_mm: Array, ray: Array
) -> ImageEquations:
    """The pair of equations of n points of one camera.

    interior (3,): c, x0', y0' in mm. parameters (k,): in the order of `families.parameter_names`. xy_mm (n, 2):
    observed camera coordinates. ray (n, 2): -U/W, -V/W.
    """
    return equations_of(distortion, interior, parameters, xy_mm, family(distortion.family).image(ray, parameters))


def equations_of(
    distortion: Distortion, interior: Array, parameters: Array, xy_mm: Array, imaged: Imaged
) -> ImageEquations:
    """The same of points whose rays' images are known."""
    c, principal_point = interior[0], interior[1:]
    correction = family(distortion.family).correct(distortion, xy_mm, principal_point, parameters)
    value = xy_mm - principal_point - c * imaged.value - correction.value
    return ImageEquations(value, c, imaged, correction)

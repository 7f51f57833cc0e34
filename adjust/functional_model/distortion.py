"""Distortion: what stands between the ideal ray and the observed camera point.

Every family is one pair of equations between the observed point (x', y') and the ideal ray (u, v) = (-U/W, -V/W):

    F = (x', y') - (x0', y0') - h(u, v, c) - d(x', y') = 0

Families of the object side make an image h of the ray (d is 0), those of the image side correct the observed point by
d (h is c times the ray). All arrays may be complex: the derivatives are tested by complex steps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.correction import Correction, DistortionModel, Imaged
from adjust.functional_model.families import family
from adjust.linear_algebra.small_matrices import columns, zeros

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImageEquations:
    """F (n, 2) in mm of points with the image of their ray and their correction, at a principal distance.

    Its derivatives are those by the observed point xy (n, 2, 2), the ray (n, 2, 2), the interior orientation c, x0',
    y0' (n, 2, 3) and the family's parameters (n, 2, k).
    """

    value: Array
    imaged: Imaged
    correction: Correction

    @property
    def by_xy(self) -> Array:
        return np.asarray(np.eye(2) - self.correction.by_xy)

    @property
    def by_ray(self) -> Array:
        return -self.imaged.by_ray

    @property
    def by_interior(self) -> Array:
        return columns([self.by_quantity(k) for k in range(3)])

    @property
    def by_parameters(self) -> Array:
        count = self.correction.by_parameters.shape[2]
        return columns([self.by_quantity(3 + k) for k in range(count)]) if count else zeros(len(self.value), 2, 0)

    def by_quantity(self, k: int) -> Array:
        """Derivative (n, 2) by c, x0', y0' or a parameter of the family, in this order."""
        if k == 0:
            return -self.imaged.by_distance
        if k < 3:
            return np.asarray(-np.eye(2)[:, k - 1] - self.correction.by_principal_point[..., k - 1])
        return np.asarray(-self.imaged.by_parameter(k - 3) - self.correction.by_parameters[..., k - 3])


def image_equations(
    distortion: DistortionModel, interior: Array, parameters: Array, xy_mm: Array, ray: Array
) -> ImageEquations:
    """The pair of equations of n points of one camera.

    interior (3,): c, x0', y0' in mm. parameters (k,): in the order of `families.parameter_names`. xy_mm (n, 2):
    observed camera coordinates. ray (n, 2): -U/W, -V/W.
    """
    imaged = family(distortion.family).image(distortion, interior[0], ray, parameters)
    return equations_of(distortion, interior, parameters, xy_mm, imaged)


def equations_of(
    distortion: DistortionModel, interior: Array, parameters: Array, xy_mm: Array, imaged: Imaged
) -> ImageEquations:
    """The same of points whose rays' images are known."""
    correction = family(distortion.family).correct(distortion, xy_mm, interior[1:], parameters)
    return ImageEquations(xy_mm - interior[1:] - imaged.value - correction.value, imaged, correction)

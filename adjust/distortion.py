"""Distortion: what stands between the ideal ray and the observed camera point.

Every family is one pair of equations between the observed point (x', y') and the ideal ray (u, v) = (-U/W, -V/W):

    F = (x', y') - (x0', y0') - c h(u, v) - d(x', y') = 0

`opencv` distorts the ray by h (d is 0), all others correct the observed point by d (h is the ray itself). All arrays
may be complex: the derivatives are tested by complex steps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.correction import Imaged
from adjust.families import family
from adjust.network import Distortion
from adjust.small_matrices import zeros

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ImageEquations:
    """F (n, 2) in mm and its derivatives, by the observed point xy (n, 2, 2), the ray (n, 2, 2), the interior
    orientation c, x0', y0' (n, 2, 3) and the family's parameters (n, 2, k).
    """

    value: Array
    by_xy: Array
    by_ray: Array
    by_interior: Array
    by_parameters: Array


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
    by_interior = zeros(len(xy_mm), 2, 3, dtype=np.result_type(imaged.value, correction.value))
    by_interior[..., 0] = -imaged.value
    by_interior[..., 1:] = -np.eye(2) - correction.by_principal_point
    return ImageEquations(
        value=xy_mm - principal_point - c * imaged.value - correction.value,
        by_xy=np.eye(2) - correction.by_xy,
        by_ray=-c * imaged.by_ray,
        by_interior=by_interior,
        by_parameters=-c * imaged.by_parameters - correction.by_parameters,
    )

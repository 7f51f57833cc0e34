"""Distortion: what stands between the ideal ray and the observed camera point.

Every family is one pair of equations between the observed point (x', y') and the ideal ray (u, v) = (-U/W, -V/W):

    F = (x', y') - (x0', y0') - c h(u, v) - d(x', y') = 0

`opencv` distorts the ray by h (d is 0), all others correct the observed point by d (h is the ray itself). All arrays
may be complex: the derivatives are tested by complex steps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.families import family
from adjust.network import Distortion

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
    c, principal_point = interior[0], interior[1:]
    of = family(distortion.family)
    imaged = of.image(ray, parameters)
    correction = of.correct(distortion, xy_mm, principal_point, parameters)
    by_interior = np.concatenate([-imaged.value[..., None], -np.eye(2) - correction.by_principal_point], axis=2)
    return ImageEquations(
        value=xy_mm - principal_point - c * imaged.value - correction.value,
        by_xy=np.eye(2) - correction.by_xy,
        by_ray=-c * imaged.by_ray,
        by_interior=by_interior,
        by_parameters=-c * imaged.by_parameters - correction.by_parameters,
    )

"""What a lens does to points of its image: observed less ideal place, with its derivatives by the lens's parameters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.correction import DistortionModel
from adjust.functional_model.distortion import image_equations
from adjust.functional_model.projection import ideal_from_observed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Displacement:
    """Observed less ideal point (n, 2) in um, and its derivatives (n, 2, 1 + k) by c and the parameters.

    imaged (n,): which points the lens shows anything at; the others are nan, the derivatives 0.
    """

    value_um: Array
    by_unknowns_um: Array
    imaged: NDArray[np.bool_]


def displacement(
    distortion: DistortionModel, interior: Array, parameters: Array, from_principal_point_mm: Array
) -> Displacement:
    """What a lens does at observed points (n, 2), counted from the principal point. interior (3,): c, x0', y0' in mm.

    By the implicit function theorem: F(point, ray, unknowns) = 0 gives the ray's derivatives.
    """
    c, principal_point = interior[0], interior[1:]
    xy = principal_point + from_principal_point_mm
    ideal, imaged = ideal_from_observed(distortion, interior, parameters, xy)
    ideal[~imaged] = principal_point
    ray = (ideal - principal_point) / c
    equations = image_equations(distortion, interior, parameters, xy, ray)
    by_unknowns = np.concatenate([equations.by_interior[:, :, :1], equations.by_parameters], axis=2)
    derivatives = c * np.linalg.solve(equations.by_ray, by_unknowns)
    derivatives[:, :, 0] -= ray
    derivatives[~imaged] = 0.0
    return Displacement(np.where(imaged[:, None], 1e3 * (xy - ideal), np.nan), 1e3 * derivatives, imaged)

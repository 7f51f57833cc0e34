"""Additional distortion terms of known cause that a family may lack, added to its correction of the observed point.

With (ξ, η) the observed point relative to the principal point, in units of half the frame, and s = ξ² + η², the
correction is

    radial           r3, r5, ...:   (ξ, η) s^m
    decentering      p1, p2, ...:   (s + 2ξ², 2ξη) s^q, (2ξη, s + 2η²) s^q
    affinity         b1, b2:        (ξ, 0), (η, 0)

All parameters are in mm at the edge of the frame. The name of a family with these terms ends in +: "opencv+".
"""

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.correction import Correct, Correction, Image, Imaged, Settings
from adjust.linear_algebra.small_matrices import columns, matrices, vectors

RADIAL_DEGREES = (3, 5, 7, 9, 11, 13)
RADIAL = tuple(f"+r{degree}" for degree in RADIAL_DEGREES)
DECENTERING = (("+p1", "+p2"), ("+p3", "+p4"))  # lowest degree, next degree
AFFINITY = ("+b1", "+b2")
ADDED_NAMES = (*RADIAL, *DECENTERING[0], *DECENTERING[1], *AFFINITY)


def correction_with_terms(correct: Correct, count: int) -> Correct:
    """Add the terms to the correction of a family with count parameters."""

    def corrected(settings: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
        own = correct(settings, xy, principal_point, parameters[:count])
        added = _added(settings.half_mm[0], xy - principal_point, parameters[count:])
        return Correction(
            own.value + added.value,
            own.xy_jacobian + added.xy_jacobian,
            own.by_principal_point + added.by_principal_point,
            np.concatenate([own.parameter_jacobian, added.parameter_jacobian], axis=2),
        )

    return corrected


def image_without_terms(image: Image, count: int) -> Image:
    """Pass only the first count parameters to a family's image of a ray: the added terms do not affect it."""

    def imaged(settings: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        own = image(settings, c, ray, parameters[:count])

        def parameter_derivative(k: int) -> Array:
            return own.parameter_derivative(k) if k < count else np.broadcast_to(0.0, own.value.shape)

        return Imaged(own.value, own.ray_jacobian, own.by_distance, parameter_derivative)

    return imaged


def _added(unit_mm: float, reduced: Array, parameters: Array) -> Correction:
    """Added terms and their derivatives at points (n, 2) relative to the principal point."""
    x, y = (reduced / unit_mm).T
    one, zero, s = np.ones_like(x), np.zeros_like(x), x**2 + y**2
    radial = vectors(x, y), matrices((one, zero), (zero, one))
    tangential = (
        (vectors(s + 2.0 * x**2, 2.0 * x * y), matrices((6.0 * x, 2.0 * y), (2.0 * y, 2.0 * x))),
        (vectors(2.0 * x * y, s + 2.0 * y**2), matrices((2.0 * y, 2.0 * x), (2.0 * x, 6.0 * y))),
    )
    factors = [(radial, (degree - 1) // 2) for degree in RADIAL_DEGREES]
    factors += [(term, power) for power in range(len(DECENTERING)) for term in tangential]
    factors += [
        ((vectors(x, zero), matrices((one, zero), (zero, zero))), 0),
        ((vectors(y, zero), matrices((zero, one), (zero, zero))), 0),
    ]
    value, by_scaled, terms = np.zeros_like(reduced), 0.0, []
    for ((term, slope), power), parameter in zip(factors, parameters, strict=True):
        outward = 2.0 * power * s ** max(power - 1, 0)
        slope = slope * (s**power)[:, None, None] + term[:, :, None] * vectors(x, y)[:, None] * outward[:, None, None]
        terms.append(term * (s**power)[:, None])
        value, by_scaled = value + parameter * terms[-1], by_scaled + parameter * slope
    xy_jacobian = np.asarray(by_scaled) / unit_mm
    return Correction(value, xy_jacobian, -xy_jacobian, columns(terms))

"""Terms that a distortion family may lack: added to its correction of the observed point, each of a known cause.

With (ξ, η) the observed point about the principal point, half the frame the unit, and s = ξ² + η², the correction is

    radial           r3, r5, ...:   (ξ, η) s^m
    decentering      p1, p2, ...:   (s + 2ξ², 2ξη) s^q, (2ξη, s + 2η²) s^q
    affinity         b1, b2:        (ξ, 0), (η, 0)

All parameters are in mm at the edge of the frame. A family with them is spelled with a + behind it: "opencv+".
"""

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.correction import Correct, Correction, Image, Imaged, Settings
from adjust.linear_algebra.small_matrices import columns, matrices, vectors

RADIAL_DEGREES = (3, 5, 7, 9, 11, 13)
RADIAL = tuple(f"+r{degree}" for degree in RADIAL_DEGREES)
DECENTERING = (("+p1", "+p2"), ("+p3", "+p4"))  # of the lowest degree, and of the next
AFFINITY = ("+b1", "+b2")
ADDED_NAMES = (*RADIAL, *DECENTERING[0], *DECENTERING[1], *AFFINITY)


def correction_with_terms(correct: Correct, count: int) -> Correct:
    """The correction of a family of so many parameters, with the terms added to it."""

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
    """The image of a ray by a family of so many parameters, which the added terms have no part in."""

    def imaged(settings: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        own = image(settings, c, ray, parameters[:count])

        def parameter_derivative(k: int) -> Array:
            return own.parameter_derivative(k) if k < count else np.broadcast_to(0.0, own.value.shape)

        return Imaged(own.value, own.ray_jacobian, own.by_distance, parameter_derivative)

    return imaged


def _added(unit_mm: float, reduced: Array, parameters: Array) -> Correction:
    """The added terms and their derivatives at points (n, 2) about the principal point."""
    x, y = (reduced / unit_mm).T
    terms = [_radial(x, y, (degree - 1) // 2) for degree in RADIAL_DEGREES]
    terms += [_decentering(x, y, axis, power) for power in range(len(DECENTERING)) for axis in (0, 1)]
    one, zero = np.ones_like(x), np.zeros_like(x)
    terms += [
        (vectors(x, zero), matrices((one, zero), (zero, zero))),
        (vectors(y, zero), matrices((zero, one), (zero, zero))),
    ]
    value = sum((each * parameter for (each, _), parameter in zip(terms, parameters, strict=True)), np.zeros((1, 2)))
    by_scaled = sum(
        (each * parameter for (_, each), parameter in zip(terms, parameters, strict=True)), np.zeros((1, 2, 2))
    )
    xy_jacobian = by_scaled / unit_mm
    return Correction(value, xy_jacobian, -xy_jacobian, columns([each for each, _ in terms]))


def _radial(x: Array, y: Array, power: int) -> tuple[Array, Array]:
    """(x, y) s^power and its derivative."""
    return _times_power(vectors(x, y), _identity(x), x, y, power)


def _decentering(x: Array, y: Array, axis: int, power: int) -> tuple[Array, Array]:
    """(s + 2x², 2xy) or (2xy, s + 2y²), times s^power, and its derivative."""
    mixed = 2.0 * x * y
    if axis == 0:
        term, xy_jacobian = vectors(3.0 * x**2 + y**2, mixed), matrices((6.0 * x, 2.0 * y), (2.0 * y, 2.0 * x))
    else:
        term, xy_jacobian = vectors(mixed, x**2 + 3.0 * y**2), matrices((2.0 * y, 2.0 * x), (2.0 * x, 6.0 * y))
    return _times_power(term, xy_jacobian, x, y, power)


def _times_power(term: Array, xy_jacobian: Array, x: Array, y: Array, power: int) -> tuple[Array, Array]:
    """A term times s^power, and its derivative."""
    if power == 0:
        return term, xy_jacobian
    s = x**2 + y**2
    slope = 2.0 * power * s ** (power - 1)
    outer = term[:, :, None] * vectors(x, y)[:, None, :] * slope[:, None, None]
    return term * (s**power)[:, None], xy_jacobian * (s**power)[:, None, None] + outer


def _identity(x: Array) -> Array:
    one, zero = np.ones_like(x), np.zeros_like(x)
    return matrices((one, zero), (zero, one))

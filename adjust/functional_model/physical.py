"""Distortion models by physical cause: radial, decentering, affine and tangential, in the forms of several programs.

Torlegård's and Brown's corrections are subtracted from the observed point, Fraser's are added to it, Luhmann's are
added to the ideal point.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.correction import Correction, Settings, complex_steps
from adjust.functional_model.polynomial_terms import AFFINITY, PolynomialTerms, X, Y, combined, decentering, radial
from adjust.linear_algebra.small_matrices import matrices

TORLEGARD_NAMES = ("k3", "k5", "k7", "p1", "p2", "p3", "p4")
BROWN_NAMES = ("k1", "k2", "k3", "p1", "p2", "b1", "b2")
AICON_NAMES = ("a1", "a2", "a3", "b1", "b2", "c1", "c2")
TORLEGARD_UNITS = ("mm⁻²", "mm⁻⁴", "mm⁻⁶", "mm⁻¹", "mm⁻¹", "mm⁻²", "mm⁻⁴")
BROWN_UNITS = (*TORLEGARD_UNITS[:5], "–", "–")
TORLEGARD_GROUPS = (("radial", TORLEGARD_NAMES[:3]), ("decentering", TORLEGARD_NAMES[3:5]))
BROWN_GROUPS = (("radial", BROWN_NAMES[:3]), ("decentering", BROWN_NAMES[3:5]), ("affinity", BROWN_NAMES[5:]))
AICON_GROUPS = (("radial", AICON_NAMES[:3]), ("decentering", AICON_NAMES[3:5]), ("affinity", AICON_NAMES[5:]))


def torlegard(settings: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Torlegård's radial terms, and decentering terms times 1 + p3 r² + p4 r⁴; "paper": with x', y' as printed."""
    decentered, higher = parameters[3:5], parameters[5:, None]
    linear = np.concatenate([parameters[:5], (higher * decentered).ravel()])
    by_own = np.zeros((9, 7), dtype=parameters.dtype)
    by_own[:5, :5] = np.eye(5)
    by_own[5:, 3:5] = np.kron(higher, np.eye(2))
    by_own[5:, 5:] = np.kron(np.eye(2), decentered[:, None])
    is_literal = settings.decentering == "paper"

    def correction(principal_point: Array) -> Correction:
        terms = _terms(settings.r0_mm, 3, tuple(principal_point) if is_literal else (0.0, 0.0))
        return terms.correction(xy, principal_point, linear, by_own=by_own)

    at = correction(principal_point)
    if not is_literal:
        return at
    return replace(at, by_principal_point=complex_steps(lambda moved: correction(moved).value, principal_point))


def brown(_: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Brown's correction of the observed point: Torlegård's with r0 = 0, and affinity b1 and shear b2 of x'."""
    return _terms(0.0).correction(xy, principal_point, parameters)


def australis(_: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Fraser's correction, added to the observed point: Brown's with opposite sign.

    Source: C. S. Fraser, Digital camera self-calibration, ISPRS Journal 52 (1997), the model of Australis and iWitness.
    """
    at = _terms(0.0).correction(xy, principal_point, -parameters)
    return replace(at, by_parameters=lambda: -at.parameter_jacobian)


def aicon(settings: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Balanced radial distortion (second zero at r0), decentering, affinity c1 and shear c2 of x'; of the ideal point.

    Sources: T. Luhmann, S. Robson, S. Kyle, J. Boehm, Close-Range Photogrammetry and 3D Imaging, the standard
    interior orientation; AICON's .ior files (A1 to A3, R0, B1, B2, C1, C2) as JAICOV's `IORFileReader` reads them, and
    the distortion models in its `bundle.derivation`, which add all terms to x0 - c U/W.
    """
    return _terms(settings.r0_mm).correction(xy, principal_point, parameters)


@lru_cache
def _terms(r0_mm: float, decenterings: int = 1, shift_mm: tuple[float, float] = (0.0, 0.0)) -> PolynomialTerms:
    """Three radial terms, pairs of decentering terms of coordinates with a shift, affinity and shear with one pair."""
    x, y = (combined((1.0, [axis]), (shift, [])) for axis, shift in zip((X, Y), shift_mm, strict=True))
    pairs = [term for power in range(decenterings) for term in decentering(power, x, y)]
    affinity = AFFINITY if decenterings == 1 else ()
    return PolynomialTerms.from_terms([*(radial(power, r0_mm) for power in (1, 2, 3)), *pairs, *affinity])


JUHL_NAMES = ("t1", "t2", "t3", "t4", "r1", "r2", "r3", "af", "sh")
JUHL_UNITS = ("µm at 1 dm",) * len(JUHL_NAMES)
JUHL_GROUPS = (("tangential", JUHL_NAMES[:4]), ("radial", JUHL_NAMES[4:7]), ("affinity", JUHL_NAMES[7:]))
MM_PER_DM = 100.0
UM_PER_MM = 1000.0
TANGENTIAL_POWER = 1.85  # the tangential deformation grows with r to this power


def juhl(settings: Settings, xy: Array, _: Array, parameters: Array) -> Correction:
    """Juhl's tangential, radial and affine deformations around the camera's origin, in µm at 1 dm."""

    def terms(xy: Array) -> Array:
        """(n, 2, 9) corrections for parameters of 1."""
        x, y = xy.T / MM_PER_DM
        radius = np.sqrt(x**2 + y**2 + np.finfo(float).tiny)  # the deformations and their derivatives vanish at 0
        r0, zero, cos, sin = settings.r0_mm / MM_PER_DM, np.zeros_like(x), x / radius, y / radius
        power, phase = radius**TANGENTIAL_POWER, np.pi * radius / r0
        across = [power * each for each in (cos, sin, cos**2 - sin**2, 2 * cos * sin)]
        along = radius**3 - r0**2 * radius, radius * np.sin(phase) ** 2, np.sin(2 * phase)
        in_x = [*(sin * each for each in across), *(cos * each for each in along), zero, zero]
        in_y = [*(-cos * each for each in across), *(sin * each for each in along), -y, -x]
        return -matrices(in_x, in_y) / UM_PER_MM

    by_parameters, xy_jacobian = terms(xy), complex_steps(lambda moved: terms(moved) @ parameters, xy)
    return Correction(by_parameters @ parameters, xy_jacobian, np.zeros_like(xy_jacobian), lambda: by_parameters)

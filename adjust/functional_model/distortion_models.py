"""Distortion models of image points by physical cause, and self-calibration sets over the frame.

By cause, radial, decentering, affine and tangential, in the forms of several programs: Torlegård's and Brown's
corrections are subtracted from the observed point, Fraser's are added to it, Luhmann's are added to the ideal point.

Sets: products of orthogonal polynomials (Ebner, Grün, Legendre) and Fourier series. ξ = xr / bx and η = yr / by are
coordinates from the principal point over half the frame (`half_mm`). Parameters: mm.

Polynomials: dx and dy are sums of φm(ξ) φn(η), orthogonal over 3 x 3 points (Ebner), 5 x 5 points (Grün) or the frame
(Legendre). Shifts, rotation, scale and the tilts (x², xy), (xy, y²) are left out, since the orientations absorb them.
What is orthogonal to them remains of their terms: (ξ, -η), (η, ξ), (-t φ2(ξ), ξη), (ξη, -t φ2(η)), with t = 2, 10/7,
5/6; √(by / bx) weights their parts where the frame is not square. A published coefficient is ours over b^(m + n).

Fourier: cosine and sine of π(mξ + nη), for m = 0, n = 1..N and m = 1..N, n = -N..N, in dx and in dy. Opposite edges get
equal corrections unless `half_mm` is larger than half the frame.

Sources: H. Ebner, Bildmessung und Luftbildwesen 44 (1976). A. Grün, ACSM-ASP Convention, Washington 1978. R. Tang et
al., Photogrammetric Engineering and Remote Sensing 78 (2012) for Legendre, ISPRS Journal 71 (2012) for Fourier.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre as series
from numpy.typing import NDArray

from adjust.array_types import Array
from adjust.functional_model.correction import (
    AFFINITY_TERMS,
    Correction,
    PolynomialTerms,
    Settings,
    X,
    Y,
    combined,
    complex_steps,
    decentering,
    radial,
)
from adjust.linear_algebra.small_matrices import matrices

TORLEGARD_NAMES = ("k3", "k5", "k7", "p1", "p2", "p3", "p4")
MM_PER_DM = 100.0
UM_PER_MM = 1000.0
TANGENTIAL_POWER = 1.85  # the tangential deformation grows with r to this power


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
    affinity = AFFINITY_TERMS if decenterings == 1 else ()
    return PolynomialTerms.from_terms([*(radial(power, r0_mm) for power in (1, 2, 3)), *pairs, *affinity])


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


COMBINED = {"stretch": 1, "shear": 1, "tilt_x": 2, "tilt_y": 2}  # combinations of products, and their total degrees
STRETCH, SHEAR, TILT_X, TILT_Y = COMBINED
Term = str | tuple[int, int, int]  # one of the four combinations, or (0 for dx or 1 for dy, m, n)


@dataclass(frozen=True)
class PolynomialSet:
    """Set of products of polynomials.

    polynomials: coefficients of φ per degree, lowest power first. tilt: t above. names, terms: one per parameter.
    """

    polynomials: tuple[tuple[float, ...], ...]
    tilt: float
    names: tuple[str, ...]
    terms: tuple[Term, ...]


def legendre(order: int) -> PolynomialSet:
    """Make the Legendre set of an order: a, b for dx, dy; the first index is the degree in x, the second in y."""
    combined: dict[str, Term] = {"a10": STRETCH, "a01": SHEAR, "a11": TILT_Y, "b11": TILT_X}
    single: dict[str, Term] = {f"{'ab'[axis]}{m}{n}": (axis, m, n) for axis, m, n in _single_terms(order)}
    return legendre_terms(combined | single, order)


def legendre_terms(terms: dict[str, Term], degree: int) -> PolynomialSet:
    """Make a set of named terms of products of Legendre polynomials up to a degree in x and in y."""
    polynomials = [tuple(series.leg2poly([0.0] * each + [1.0]).tolist()) for each in range(degree + 1)]
    return _polynomial_set(polynomials, 5 / 6, terms)


def _single_terms(degree: int) -> list[tuple[int, int, int]]:
    """Products that are single parameters: dx before dy, low degrees first."""
    combined = {(0, 0), (1, 0), (0, 1), (1, 1)}
    products = sorted(((m, n) for m in range(degree + 1) for n in range(degree + 1)), key=lambda mn: (sum(mn), mn[1]))
    return [
        (axis, m, n)
        for axis, tilted in ((0, (2, 0)), (1, (0, 2)))
        for m, n in products
        if (m, n) not in combined | {tilted}
    ]


def _polynomial_set(polynomials: Sequence[tuple[float, ...]], tilt: float, terms: dict[str, Term]) -> PolynomialSet:
    return PolynomialSet(tuple(polynomials), tilt, tuple(terms), tuple(terms.values()))


EBNER = _polynomial_set(
    ((1.0,), (0.0, 1.0), (-2 / 3, 0.0, 1.0)),
    2.0,
    {
        "b1": STRETCH, "b2": SHEAR, "b3": TILT_X, "b4": TILT_Y, "b5": (0, 0, 2), "b6": (1, 2, 0), "b7": (0, 1, 2),
        "b8": (1, 2, 1), "b9": (0, 2, 1), "b10": (1, 1, 2), "b11": (0, 2, 2), "b12": (1, 2, 2),
    },
)  # fmt: skip
# Grün's a and b are the coefficients of dx and dy; their first index is 1 + the degree in y, the second in x.
GRUEN = _polynomial_set(
    ((1.0,), (0.0, 1.0), (-1 / 2, 0.0, 1.0), (0.0, -17 / 20, 0.0, 1.0), (9 / 70, 0.0, -31 / 28, 0.0, 1.0)),
    10 / 7,
    {"a12": STRETCH, "a21": SHEAR, "a22": TILT_Y, "b22": TILT_X}
    | {f"{'ab'[axis]}{n + 1}{m + 1}": (axis, m, n) for axis, m, n in _single_terms(4)},
)


def degree_groups(polynomial_set: PolynomialSet) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Group the parameters by their total degree in x and y."""
    degrees = [COMBINED[term] if isinstance(term, str) else sum(term[1:]) for term in polynomial_set.terms]
    return tuple(
        (
            f"degree {degree}",
            tuple(name for name, own in zip(polynomial_set.names, degrees, strict=True) if own == degree),
        )
        for degree in sorted(set(degrees))
    )


def correct(
    polynomial_set: PolynomialSet, settings: Settings, xy: Array, principal_point: Array, parameters: Array
) -> Correction:
    """Compute the correction of a set. It is subtracted from the observed point."""
    return sum_terms(polynomial_set, np.array(settings.half_mm), xy, principal_point, parameters)


def sum_terms(polynomial_set: PolynomialSet, half: Array, xy: Array, center: Array, parameters: Array) -> Correction:
    """Sum the terms of a set times their parameters (k,) at places (n, 2); center, half (2,) of the extent."""
    return _polynomial_terms(polynomial_set, float(half[1] / half[0])).correction(xy, center, parameters, half)


@lru_cache
def _polynomial_terms(polynomial_set: PolynomialSet, ratio: float) -> PolynomialTerms:
    """Terms of a set; ratio: by / bx."""
    q = np.sqrt(ratio)
    combinations = {
        STRETCH: ((q, (0, 1, 0)), (-1 / q, (1, 0, 1))),
        SHEAR: ((1 / q, (0, 0, 1)), (q, (1, 1, 0))),
        TILT_X: ((-polynomial_set.tilt * q, (0, 2, 0)), (1 / q, (1, 1, 1))),
        TILT_Y: ((q, (0, 1, 1)), (-polynomial_set.tilt / q, (1, 0, 2))),
    }
    in_x, in_y = (
        [{exponents(i): c for i, c in enumerate(p)} for p in polynomial_set.polynomials]
        for exponents in (lambda i: (i, 0), lambda i: (0, i))
    )
    terms = []
    for term in polynomial_set.terms:
        products = combinations[term] if isinstance(term, str) else ((1.0, term),)
        dx, dy = (
            combined(*((factor, (in_x[m], in_y[n])) for factor, (own, m, n) in products if own == axis))
            for axis in (0, 1)
        )
        terms.append((dx, dy))
    return PolynomialTerms.from_terms(terms)


def fourier_names(order: int) -> tuple[str, ...]:
    """Names of a, b, c, d with m and n. A negative n is written with an m before it: a1m2 for m = 1, n = -2."""
    indices = [f"{m}{f'm{-n}' if n < 0 else n}" for m, n in _frequencies(order).tolist()]
    return tuple(f"{letter}{index}" for letter in "abcd" for index in indices)


def order_groups(order: int) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Group the parameters by order, the larger of m and |n|."""
    orders = np.tile(np.abs(_frequencies(order)).max(axis=1), 4)
    names = np.array(fourier_names(order))
    return tuple((f"order {n}", tuple(names[orders == n].tolist())) for n in range(1, order + 1))


def fourier(order: int, settings: Settings, xy: Array, principal_point: Array, parameters: Array) -> Correction:
    """Compute the Fourier correction up to an order. It is subtracted from the observed point."""
    waves = np.pi * _frequencies(order) / np.array(settings.half_mm)  # (frequencies, 2), in rad per mm
    angle = (xy - principal_point) @ waves.T
    cos, sin = np.cos(angle), np.sin(angle)
    basis = np.concatenate([cos, sin], axis=1)
    slope = np.concatenate([-sin[..., None] * waves, cos[..., None] * waves], axis=1)  # (n, terms, 2)
    pair = parameters.reshape(2, -1)
    xy_jacobian = np.einsum("ak,nkj->naj", pair, slope)
    zero = np.zeros_like(basis)
    by_parameters = np.stack([np.hstack([basis, zero]), np.hstack([zero, basis])], axis=1)
    return Correction(basis @ pair.T, xy_jacobian, -xy_jacobian, lambda: by_parameters)


def _frequencies(order: int) -> NDArray[np.int_]:
    """(k, 2) m, n of every term, low frequencies first."""
    pairs = [(m, n) for m in range(order + 1) for n in range(-order, order + 1) if m > 0 or n > 0]
    return np.array(sorted(pairs, key=lambda mn: (max(mn[0], abs(mn[1])), mn)))

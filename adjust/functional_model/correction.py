"""Interface of the distortion families: correction of the observed point or image of a ray, with derivatives.

There are three kinds of families: correction of the observed point (image side), correction of the ideal point (object
side, `ideal_point_family`), and distortion of the dimensionless ray (`ray_family`). Most corrections are sums of terms,
each a polynomial of x and y in dx and one in dy (`PolynomialTerms`).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product
from typing import Protocol

import numpy as np

from adjust.array_types import Array, Indices
from adjust.linear_algebra.small_matrices import applied

STEP = 1e-30


class Settings(Protocol):
    """Settings of a family in addition to its parameters; see `adjust.functional_model.lens.Distortion`."""

    @property
    def decentering(self) -> str: ...

    @property
    def r0_mm(self) -> float: ...

    @property
    def half_mm(self) -> tuple[float, float]: ...


@dataclass(frozen=True)
class Correction:
    """Correction d (n, 2) in mm, subtracted from the observed point, and its derivatives.

    xy_jacobian, by_principal_point (n, 2, 2); by_parameters: returns those (n, 2, k) by the parameters, on demand.
    """

    value: Array
    xy_jacobian: Array
    by_principal_point: Array
    by_parameters: Callable[[], Array]

    @cached_property
    def parameter_jacobian(self) -> Array:
        return self.by_parameters()


@dataclass(frozen=True)
class Imaged:
    """Image h (n, 2) of rays in mm relative to the principal point, and its derivatives.

    ray_jacobian (n, 2, 2); by_distance (n, 2), with respect to c; parameter_derivative: returns the derivative (n, 2)
    with respect to one parameter, on demand, since many are never needed.
    """

    value: Array
    ray_jacobian: Array
    by_distance: Array
    parameter_derivative: Callable[[int], Array]


@dataclass(frozen=True)
class DistortedRay:
    """Distorted rays (n, 2), and their derivatives as in `Imaged`."""

    value: Array
    ray_jacobian: Array
    parameter_derivative: Callable[[int], Array]


Correct = Callable[
    [Settings, Array, Array, Array], Correction
]  # arguments: settings, points, principal point, parameters
Image = Callable[[Settings, float, Array, Array], Imaged]  # arguments: settings, c, rays, parameters


def complex_steps(function: Callable[[Array], Array], at: Array) -> Array:
    """Derivatives (..., k) of a function by k numbers (..., k) or (k,), by complex steps: exact, but slower."""
    return np.stack([function(at + 1j * STEP * unit).imag / STEP for unit in np.eye(at.shape[-1])], axis=-1)


def no_correction(_: Settings, xy: Array, __: Array, parameters: Array) -> Correction:
    """Zero correction, of the object-side families and of `none`."""
    zero = np.broadcast_to(0.0, (len(xy), 2, 2))
    return Correction(zero[..., 0], zero, zero, lambda: np.broadcast_to(0.0, (len(xy), 2, len(parameters))))


def straight(ray: Array) -> DistortedRay:
    """Undistorted rays."""
    return DistortedRay(ray, np.broadcast_to(np.eye(2), (len(ray), 2, 2)), lambda _: np.broadcast_to(0.0, ray.shape))


def ray_family(bent: Callable[[Array, Array], DistortedRay]) -> Image:
    """Make the image function of a family that distorts the ray before it is imaged at c."""

    def image(_: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        at = bent(ray, parameters)
        return Imaged(c * at.value, c * at.ray_jacobian, at.value, lambda k: c * at.parameter_derivative(k))

    return image


undistorted = ray_family(lambda ray, _: straight(ray))  # of the image-side families and of `none`


def ideal_point_family(correct: Correct) -> Image:
    """Make the image function of a family that adds a correction to the ideal point.

    The same formula is subtracted where a family corrects the observed point.
    """

    def image(settings: Settings, c: float, ray: Array, parameters: Array) -> Imaged:
        ideal_mm = c * ray
        added = correct(settings, ideal_mm, np.zeros(2), parameters)
        by_ideal = np.eye(2) + added.xy_jacobian
        return Imaged(
            ideal_mm + added.value, c * by_ideal, applied(by_ideal, ray), lambda k: added.parameter_jacobian[..., k]
        )

    return image


Polynomial = Mapping[tuple[int, int], float]  # coefficients by the exponents of x and y
Term = tuple[Polynomial, Polynomial]  # dx and dy of a parameter of 1

ZERO: Polynomial = {}
X, Y, R2 = {(1, 0): 1.0}, {(0, 1): 1.0}, {(2, 0): 1.0, (0, 2): 1.0}


def combined(*parts: tuple[float, Sequence[Polynomial]]) -> Polynomial:
    """Sum of products of polynomials, each with a factor."""
    total: dict[tuple[int, int], float] = {}
    for factor, factors in parts:
        for monomials in product(*(each.items() for each in factors)):
            exponents = sum(p for (p, _), _ in monomials), sum(q for (_, q), _ in monomials)
            total[exponents] = total.get(exponents, 0.0) + reduce(lambda a, b: a * b[1], monomials, factor)
    return total


def radial(power: int, r0: float = 0.0) -> Term:
    """(x, y) (r^2m - r0^2m)."""
    zero = -(r0 ** (2 * power))
    dx, dy = (combined((1.0, [axis, *power * [R2]]), (zero, [axis])) for axis in (X, Y))
    return dx, dy


def decentering(power: int, x: Polynomial = X, y: Polynomial = Y) -> tuple[Term, Term]:
    """(r² + 2x², 2xy) r^2m and (2xy, r² + 2y²) r^2m."""
    outward = power * [R2]
    along = [combined((1.0, [R2, *outward]), (2.0, [axis, axis, *outward])) for axis in (x, y)]
    across = combined((2.0, [x, y, *outward]))
    return (along[0], across), (across, along[1])


AFFINITY_TERMS: tuple[Term, Term] = ((X, ZERO), (Y, ZERO))


@dataclass(frozen=True, eq=False)
class PolynomialTerms:
    """Terms of k parameters: exponents (m, 2) of the monomials, coefficients (2, k, m) in dx and dy."""

    exponents: Indices
    coefficients: Array

    @classmethod
    def from_terms(cls, terms: Iterable[Term]) -> "PolynomialTerms":
        rows = list(zip(*terms, strict=True))
        exponents = list(dict.fromkeys(each for row in rows for polynomial in row for each in polynomial))
        coefficients = [[[polynomial.get(each, 0.0) for each in exponents] for polynomial in row] for row in rows]
        return cls(np.array(exponents, dtype=np.intp), np.array(coefficients))

    def correction(
        self, xy: Array, center: Array, factors: Array, half: Array | float = 1.0, by_own: Array | None = None
    ) -> Correction:
        """Sum the terms times factors (k,) at places (n, 2), in units of half (2,) from the center (2,).

        by_own (k, j): derivatives of the factors by the parameters; default: these are the parameters.
        """
        scaled = ((xy - center) / half).T
        powers = np.ones((int(self.exponents.max()) + 1, *scaled.shape), dtype=scaled.dtype)
        for degree in range(1, len(powers)):
            powers[degree] = powers[degree - 1] * scaled
        p, q = self.exponents.T
        monomials = powers[p, 0] * powers[q, 1]
        by_x, by_y = p[:, None] * powers[p - 1, 0] * powers[q, 1], q[:, None] * powers[p, 0] * powers[q - 1, 1]
        whole = factors @ self.coefficients
        xy_jacobian = np.stack([whole @ by_x, whole @ by_y], axis=1).T.transpose(0, 2, 1) / half

        def by_parameters() -> Array:
            coefficients = self.coefficients if by_own is None else by_own.T @ self.coefficients
            return np.asarray((coefficients @ monomials).transpose(2, 0, 1))

        return Correction((whole @ monomials).T, xy_jacobian, -xy_jacobian, by_parameters)

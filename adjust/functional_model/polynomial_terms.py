"""Corrections that are linear in their parameters: each term is a polynomial of x and y in dx and one in dy."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.correction import Correction

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


AFFINITY: tuple[Term, Term] = ((X, ZERO), (Y, ZERO))


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

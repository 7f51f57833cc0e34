"""Scanner model: a smooth deformation S, fixed to the scanner's axes and applied before the film transformations.

    x = x_s - sum of a[mn] P_m(ξ) P_n(η),   y = y_s - sum of b[mn] P_m(ξ) P_n(η),   F1 = T_i(S(x_s, y_s)) - ...

ξ, η are scan coordinates relative to the centre of the extent, in units of half the extent; P are Legendre polynomials.
The sum is the displacement of a point by the scanner; all parameters are in mm. Scanner terms that a film
transformation can absorb cannot be estimated separately: only terms that no transformation absorbs are offered. A term
`a21` is a single product. `stretch`, `shear`, `tilt_x` and `tilt_y` are combinations orthogonal to those that a
similarity or a projective transformation absorbs (see `distortion_models`).

A scan taken by a digital camera also has that camera's lens distortion. The lens is known and is applied first:
S(x_s, y_s) removes the lens distortion from the comparator coordinates (image coordinates of the digital camera), then
the scanner terms.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adjust.array_types import Array, Mask
from adjust.functional_model.correction import Correction, no_correction
from adjust.functional_model.distortion_models import COMBINED, PolynomialSet, Term, legendre_terms, sum_terms
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.transformation import polynomial_order
from adjust.linear_algebra.small_matrices import newton, product

SMOOTH = (2, 3)  # total degrees of the smooth terms
ALONG = (4, 5, 6)  # degrees of the carriage terms, along one axis alone, for tests
TOLERANCE_MM = 1e-11


def smooth_terms(films: Iterable[str]) -> tuple[str, ...]:
    """List the combined terms and those of degree 2 and 3 that none of the film transformations absorbs."""
    products = [(axis, degree - n, n) for degree in SMOOTH for axis in (0, 1) for n in range(degree + 1)]
    return _remaining_terms(films, products, COMBINED)


def carriage_terms(films: Iterable[str]) -> tuple[str, ...]:
    """List the terms of degree 4 to 6 along x or y alone that none of the film transformations absorbs."""
    products = [(axis, *pair) for degree in ALONG for pair in ((degree, 0), (0, degree)) for axis in (0, 1)]
    return _remaining_terms(films, products)


def _remaining_terms(
    films: Iterable[str], products: Iterable[tuple[int, int, int]], combined: Iterable[str] = ()
) -> tuple[str, ...]:
    kinds = set(films) - {"none"}
    names = (*combined, *(f"{'ab'[axis]}{m}{n}" for axis, m, n in products))
    return tuple(name for name in names if all(is_left(kind, name) for kind in kinds))


def is_left(kind: str, name: str) -> bool:
    """Whether a film transformation absorbs no part of a scanner term."""
    linear = kind not in ("congruent", "similarity") and not kind.startswith("conformal")
    match name:
        case "stretch" | "shear":
            return not linear
        case "tilt_x" | "tilt_y":
            return kind == "projective"
    axis, m, n = _product(name)
    if kind == "projective":
        return (m, n) != (1, 1) and (axis, m, n) not in ((0, 2, 0), (1, 0, 2))
    if kind == "bilinear":
        return (m, n) != (1, 1)
    return m + n > polynomial_order(kind)


def _product(name: str) -> tuple[int, int, int]:
    return "ab".index(name[0]), int(name[1]), int(name[2])


def term_degree(name: str) -> int:
    """Total degree of a term in x and y."""
    return COMBINED[name] if name in COMBINED else sum(_product(name)[1:])


def is_term(name: str) -> bool:
    """Whether a scanner parameter may have this name."""
    form = re.fullmatch(r"[ab](\d)(\d)", name)
    return name in COMBINED or (form is not None and 1 < int(form[1]) + int(form[2]) <= ALONG[-1])


@dataclass(frozen=True)
class Bend:
    """Scanner deformation S. Without terms and lens it is the identity."""

    terms: tuple[str, ...] = ()  # names of the terms in order
    # center_mm, half_mm: centre and half extent of the scan in x and y
    center_mm: tuple[float, float] = (0.0, 0.0)
    half_mm: tuple[float, float] = (1.0, 1.0)
    # lens of the digital camera that took the scan, interior orientation in the comparator; None for a scanner
    lens: Lens | None = None

    @property
    def is_identity(self) -> bool:
        return not self.terms and self.lens is None

    def displacement(self, parameters: Array, scan_mm: Array) -> Correction:
        """Compute the displacements (n, 2) by the scanner at scan coordinates (n, 2), mm, with their derivatives."""
        straight_mm = scan_mm
        if self.lens is not None:
            ideal_mm, found = self.lens.ideal_from_observed(scan_mm)
            straight_mm = np.where(found[:, None], ideal_mm, np.nan)  # nan where the lens folds over
        bend = no_correction(Distortion(), straight_mm, np.zeros(2), parameters)
        if self.terms:
            half, center = np.array(self.half_mm), np.array(self.center_mm)
            bend = sum_terms(self._polynomial_set, half, straight_mm, center, parameters)
        if self.lens is None:
            return bend
        # The derivatives follow from the lens's condition equations by the implicit function theorem.
        at = self.lens.equations(scan_mm, (ideal_mm - self.lens.interior[1:]) / self.lens.interior[0])
        by_scan = self.lens.interior[0] * np.linalg.solve(-at.ray_jacobian, at.xy_jacobian)
        gradient = product(np.eye(2) - bend.xy_jacobian, by_scan)
        value = scan_mm - straight_mm + bend.value
        return replace(bend, value=value, xy_jacobian=np.eye(2) - gradient)

    def apply(self, parameters: Array, scan_mm: Array) -> Array:
        """Correct scan coordinates (n, 2) for the scanner, mm."""
        return scan_mm if self.is_identity else scan_mm - self.displacement(parameters, scan_mm).value

    def gradient(self, parameters: Array, scan_mm: Array) -> Array:
        """Derivatives (n, 2, 2) of the corrected coordinates with respect to the scan coordinates."""
        if self.is_identity:
            return np.broadcast_to(np.eye(2), (*scan_mm.shape, 2))
        return np.asarray(np.eye(2) - self.displacement(parameters, scan_mm).xy_jacobian)

    def inverse(self, parameters: Array, xy_mm: Array) -> tuple[Array, Mask]:
        """Compute scan coordinates (n, 2) from corrected ones (n, 2); mask of those found (none where S folds over)."""
        if self.is_identity:
            return xy_mm, np.ones(len(xy_mm), dtype=bool)

        def misclosure(scan_mm: Array) -> tuple[Array, Array]:
            at = self.displacement(parameters, scan_mm)
            return scan_mm - at.value - xy_mm, np.eye(2) - at.xy_jacobian

        return newton(xy_mm, misclosure, lambda _: TOLERANCE_MM)

    @cached_property
    def _polynomial_set(self) -> PolynomialSet:
        terms: dict[str, Term] = {name: name if name in COMBINED else _product(name) for name in self.terms}
        degrees = [2 if isinstance(term, str) else max(term[1:]) for term in terms.values()]
        return legendre_terms(terms, max(degrees))


NO_BEND = Bend()

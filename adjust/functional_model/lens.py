"""Lens: distortion family with settings and priors; observed image points from rays and back.

Every family is one pair of condition equations between the observed point (x', y') and the ideal ray
(u, v) = (-U/W, -V/W):

    F = (x', y') - (x0', y0') - h(u, v, c) - d(x', y') = 0

Object-side families distort the ray (h; d = 0). Image-side families correct the observed point (d; h is c times the
ray). All arrays may be complex: the derivatives are tested by complex steps. Lengths in mm.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from adjust.array_types import Array, Mask
from adjust.functional_model.correction import Correction, Imaged, no_correction
from adjust.functional_model.families import family, parameter_names
from adjust.linear_algebra.small_matrices import columns, determinant, newton

Decentering = Literal["reduced", "paper"]

INTERIOR_NAMES = ("c", "x0", "y0")
NEWTON_TOLERANCE = 1e-14  # fraction of the principal distance


@dataclass(frozen=True)
class Prior:
    """Prior of a quantity: value and standard deviation (0 fixed, inf free)."""

    value: float
    sigma: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.value):
            raise ValueError(f"a value must be a finite number, not {self.value}")
        if not self.sigma >= 0.0:
            raise ValueError(f"a standard deviation must be 0 (fixed), positive or inf (free), not {self.sigma}")


@dataclass(frozen=True)
class Distortion:
    """Distortion family with the priors of its parameters and its settings.

    Attributes
    ----------
    family : name in `functional_model.families`.
    parameters : a parameter that is missing is fixed at 0.
    decentering : "paper": Torlegård's decentering terms with x', y' as printed, not reduced to the principal point.
    r0_mm : radius of zero radial distortion of `torlegard`; period of `juhl`.
    half_mm : half the frame in x' and y', the unit length of `ebner`, `gruen`, `legendre(n)` and `fourier(n)`; 0: not
        given.
    """

    family: str = "none"
    parameters: Mapping[str, Prior] = field(default_factory=dict)
    decentering: Decentering = "reduced"
    r0_mm: float = 0.0
    half_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        parameter_names(self.family)  # raises ValueError for an unknown family
        if self.decentering not in get_args(Decentering):
            raise ValueError(f'the decentering must be "reduced" or "paper", not {self.decentering}')
        if not 0.0 <= self.r0_mm < np.inf:
            raise ValueError(f"r0 must be 0 or a positive length in mm, not {self.r0_mm}")
        if not all(0.0 <= half < np.inf for half in self.half_mm):
            raise ValueError(f"half the frame must be two lengths in mm, not {self.half_mm}")

    @property
    def free(self) -> frozenset[str]:
        """Names of the parameters that are estimated."""
        return frozenset(name for name, prior in self.parameters.items() if prior.sigma > 0.0)

    @property
    def values(self) -> Array:
        """(k,) prior values of the family's parameters, 0 where none is given."""
        given = self.parameters
        return np.array([given[name].value if name in given else 0.0 for name in parameter_names(self.family)])


@dataclass(frozen=True)
class ImageEquations:
    """Misclosures F (n, 2) in mm of the condition equations of n points, and their derivatives.

    The derivatives are with respect to the observed point xy (n, 2, 2), the ray (n, 2, 2), and the quantities c, x0',
    y0' and the family's parameters (n, 2, 3 + k).
    """

    value: Array  # (n, 2) misclosures in mm
    imaged: Imaged  # images of the rays
    correction: Correction  # corrections of the observed points

    @property
    def xy_jacobian(self) -> Array:
        return np.asarray(np.eye(2) - self.correction.xy_jacobian)

    @property
    def ray_jacobian(self) -> Array:
        return -self.imaged.ray_jacobian

    @property
    def quantity_jacobian(self) -> Array:
        count = len(INTERIOR_NAMES) + self.correction.parameter_jacobian.shape[2]
        return columns([self.quantity_derivative(k) for k in range(count)])

    def quantity_derivative(self, k: int) -> Array:
        """Derivative (n, 2) with respect to quantity k: c, x0', y0', then the family's parameters."""
        if k == 0:
            return -self.imaged.by_distance
        if k < 3:
            return np.asarray(-np.eye(2)[:, k - 1] - self.correction.by_principal_point[..., k - 1])
        return np.asarray(-self.imaged.parameter_derivative(k - 3) - self.correction.parameter_jacobian[..., k - 3])


@dataclass(frozen=True)
class Displacement:
    """Distortion of n points: observed minus ideal place, of a fisheye at c times the angle off the axis."""

    value_um: Array  # (n, 2) distortion in µm; nan where the point has no ray
    # (n, 2, 1 + k) derivatives with respect to c and the parameters; 0 where the point has no ray
    by_unknowns_um: Array
    imaged: Mask  # (n,) mask of the points that have a ray


@dataclass(frozen=True, eq=False)
class Lens:
    """Lens: distortion family, interior orientation and values of the parameters.

    Attributes
    ----------
    distortion : the family and its settings. Its priors are not used here.
    interior : (3,) principal distance c and principal point x0', y0' in mm.
    parameters : (k,) parameters of the distortion, in the order of `families.parameter_names`, in their own units.
    covariance : (3 + k, 3 + k) covariance of interior orientation and parameters; empty where unknown.
    """

    distortion: Distortion
    interior: Array
    parameters: Array
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of c, x0', y0' and the parameters."""
        return (*INTERIOR_NAMES, *parameter_names(self.distortion.family))

    @property
    def values(self) -> Array:
        """(3 + k,) values of the quantities."""
        return np.concatenate([self.interior, self.parameters])

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion."""
        return family(self.distortion.family).is_pinhole_at_zero and not self.parameters.any()

    def replaced_values(self, values: Array) -> "Lens":
        """Return the lens with other values (3 + k,) of its quantities."""
        return replace(self, interior=values[:3].copy(), parameters=values[3:].copy())

    def image(self, ray: Array) -> Imaged:
        """Image rays (n, 2) relative to the principal point, before the correction of the observed point."""
        with np.errstate(over="ignore", invalid="ignore"):
            return family(self.distortion.family).image(self.distortion, self.interior[0], ray, self.parameters)

    def equations(self, xy_mm: Array, ray: Array) -> ImageEquations:
        """Evaluate the condition equations of observed camera points (n, 2) in mm and rays (n, 2), -U/W and -V/W."""
        lens_family = family(self.distortion.family)
        return self.equations_with_image(
            xy_mm, lens_family.image(self.distortion, self.interior[0], ray, self.parameters)
        )

    def equations_with_image(self, xy_mm: Array, imaged: Imaged) -> ImageEquations:
        """Evaluate the condition equations of observed camera points (n, 2) and imaged rays."""
        correct = family(self.distortion.family).correct
        correction = correct(self.distortion, xy_mm, self.interior[1:], self.parameters)
        return ImageEquations(xy_mm - self.interior[1:] - imaged.value - correction.value, imaged, correction)

    def camera_from_ray(self, ray: Array) -> tuple[Array, Mask]:
        """Compute the observed camera coordinates (n, 2) in mm of rays (n, 2), and the mask (n,) of those found.

        Notes
        -----
        The correction is a function of the observed point and is inverted by Newton's method. No point is found where
        the distortion folds the image over, as a polynomial does far enough outside the frame.
        """
        return self.camera_from_image(self.image(ray))

    def camera_from_image(self, imaged: Imaged) -> tuple[Array, Mask]:
        """Do the same as `camera_from_ray` for rays that are imaged already."""
        c, principal_point = self.interior[0], self.interior[1:]
        correct = family(self.distortion.family).correct
        with np.errstate(over="ignore", invalid="ignore"):
            ideal_mm = principal_point + imaged.value
            unfolded = _is_unfolded(determinant(imaged.ray_jacobian))
            if correct is no_correction:
                return ideal_mm, unfolded & np.isfinite(ideal_mm).all(axis=1)
            tolerance_mm = 4 * NEWTON_TOLERANCE * (abs(c) + np.abs(ideal_mm).max(axis=1))

        def misclosure(xy_mm: Array) -> tuple[Array, Array]:
            correction = correct(self.distortion, xy_mm, principal_point, self.parameters)
            return xy_mm - ideal_mm - correction.value, np.eye(2) - correction.xy_jacobian

        xy_mm, found = newton(ideal_mm, misclosure, lambda _: np.where(unfolded, tolerance_mm, -np.inf))
        return xy_mm, found

    def ideal_from_observed(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Remove the distortion from observed camera coordinates (n, 2) in mm; also return the mask of those found."""
        if self.is_pinhole:
            return xy_mm, np.asarray(np.isfinite(xy_mm).all(axis=1))

        def misclosure(ray: Array) -> tuple[Array, Array]:
            at = self.equations(xy_mm, ray)
            return -at.value, -at.ray_jacobian

        ray, found = newton(
            (xy_mm - self.interior[1:]) / self.interior[0],
            misclosure,
            lambda ray: 4 * NEWTON_TOLERANCE * (1.0 + np.abs(ray).max(axis=1)),
        )
        return self.interior[1:] + self.interior[0] * ray, found

    def ray_from_observed(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Compute rays (n, 2), -U/W and -V/W, of observed camera coordinates (n, 2) in mm; mask of those found."""
        ideal_mm, found = self.ideal_from_observed(xy_mm)
        return (ideal_mm - self.interior[1:]) / self.interior[0], found

    def folded_over(self, xy_mm: Array) -> Mask:
        """Mask of observed camera points (n, 2) in mm that lie where the distortion folds the image over."""
        ray, found = self.ray_from_observed(xy_mm)
        if self.is_pinhole:
            return ~found
        with np.errstate(over="ignore", invalid="ignore"):
            at = self.equations(xy_mm, ray)
            sides = determinant(at.xy_jacobian), determinant(at.imaged.ray_jacobian)
        return ~(found & _is_unfolded(sides[0]) & _is_unfolded(sides[1]))

    def displacement(self, from_principal_point_mm: Array, of_pinhole: bool = False) -> Displacement:
        """Compute the distortion at observed points (n, 2) in mm relative to the principal point.

        of_pinhole: against a pinhole camera also for a fisheye, whose family corrects the equidistant projection.

        Notes
        -----
        The ray's derivatives follow from F(point, ray, unknowns) = 0 by the implicit function theorem.
        """
        c, principal_point = self.interior[0], self.interior[1:]
        xy_mm = principal_point + from_principal_point_mm
        ideal_mm, imaged = self.ideal_from_observed(xy_mm)
        ideal_mm[~imaged] = principal_point
        ray = (ideal_mm - principal_point) / c
        at = self.equations(xy_mm, ray)
        place, by_ray = ray, np.eye(2)
        if not (of_pinhole or family(self.distortion.family).is_pinhole_at_zero):
            place, by_ray = _equidistant(ray)
        derivatives = c * by_ray @ np.linalg.solve(at.ray_jacobian, np.delete(at.quantity_jacobian, [1, 2], axis=2))
        derivatives[:, :, 0] -= place
        derivatives[~imaged] = 0.0
        value_um = 1e3 * (from_principal_point_mm - c * place)
        return Displacement(np.where(imaged[:, None], value_um, np.nan), 1e3 * derivatives, imaged)


def _equidistant(ray: Array) -> tuple[Array, Array]:
    """Places (n, 2) of rays at their angle off the axis, and derivatives (n, 2, 2)."""
    square = np.maximum((ray**2).sum(axis=1), 1e-12)
    factor = np.arctan(np.sqrt(square)) / np.sqrt(square)
    outward = ray[:, :, None] * ray[:, None, :] * ((1.0 / (1.0 + square) - factor) / square)[:, None, None]
    return factor[:, None] * ray, factor[:, None, None] * np.eye(2) + outward


def _is_unfolded(side: Array) -> Mask:
    """Mask of determinants (n,) that are finite and positive: the image is not folded over."""
    return np.asarray(np.isfinite(side) & (side > 0.0))

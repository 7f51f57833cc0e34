"""A lens: its distortion family with settings and priors, and with values the way between observed points and rays.

Every family is one pair of equations between the observed point (x', y') and the ideal ray (u, v) = (-U/W, -V/W):

    F = (x', y') - (x0', y0') - h(u, v, c) - d(x', y') = 0

Families of the object side make an image h of the ray (d is 0), those of the image side correct the observed point by
d (h is c times the ray). All arrays may be complex: the derivatives are tested by complex steps. Lengths in mm.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from adjust.array_types import Array, Mask
from adjust.functional_model.correction import Correction, Imaged, no_correction
from adjust.functional_model.families import family, parameter_names
from adjust.linear_algebra.small_matrices import columns, determinant, solved, zeros

Decentering = Literal["reduced", "paper"]

INTERIOR_NAMES = ("c", "x0", "y0")
NEWTON_STEPS = 30
NEWTON_TOLERANCE = 1e-14  # of the principal distance


@dataclass(frozen=True)
class Prior:
    """A quantity as it is known beforehand: its value and the value's standard deviation (0 fixed, inf free)."""

    value: float
    sigma: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.value):
            raise ValueError(f"a value must be a finite number, not {self.value}")
        if not self.sigma >= 0.0:
            raise ValueError(f"a standard deviation must be 0 (fixed), positive or inf (free), not {self.sigma}")


@dataclass(frozen=True)
class Distortion:
    """A distortion family, a name in `functional_model.families`, and its parameters; one not named is fixed at 0.

    decentering "paper": Torlegård's decentering terms with x', y' as printed and not reduced to the principal point.
    r0_mm: radius of zero radial distortion of `torlegard`, of a period of `juhl`.
    half_mm: half the frame in x' and y', the length 1 of `ebner`, `gruen`, `legendre(n)` and `fourier(n)`; 0 not given.
    """

    family: str = "none"
    parameters: Mapping[str, Prior] = field(default_factory=dict)
    decentering: Decentering = "reduced"
    r0_mm: float = 0.0
    half_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        parameter_names(self.family)  # refuses a family that there is not
        if self.decentering not in get_args(Decentering):
            raise ValueError(f'the decentering must be "reduced" or "paper", not {self.decentering}')
        if not 0.0 <= self.r0_mm < np.inf:
            raise ValueError(f"r0 must be 0 or a positive length in mm, not {self.r0_mm}")
        if not all(0.0 <= half < np.inf for half in self.half_mm):
            raise ValueError(f"half the frame must be two lengths in mm, not {self.half_mm}")

    @property
    def values(self) -> Array:
        """(k,) what is given of the family's parameters, 0 where nothing is."""
        given = self.parameters
        return np.array([given[name].value if name in given else 0.0 for name in parameter_names(self.family)])


@dataclass(frozen=True)
class ImageEquations:
    """F (n, 2) in mm of points with the image of their ray and their correction, at a principal distance.

    Its derivatives are those by the observed point xy (n, 2, 2), the ray (n, 2, 2), the interior orientation c, x0',
    y0' (n, 2, 3) and the family's parameters (n, 2, k).
    """

    value: Array
    imaged: Imaged
    correction: Correction

    @property
    def xy_jacobian(self) -> Array:
        return np.asarray(np.eye(2) - self.correction.xy_jacobian)

    @property
    def ray_jacobian(self) -> Array:
        return -self.imaged.ray_jacobian

    @property
    def interior_jacobian(self) -> Array:
        return columns([self.quantity_derivative(k) for k in range(3)])

    @property
    def parameter_jacobian(self) -> Array:
        count = self.correction.parameter_jacobian.shape[2]
        return (
            columns([self.quantity_derivative(3 + k) for k in range(count)]) if count else zeros(len(self.value), 2, 0)
        )

    def quantity_derivative(self, k: int) -> Array:
        """Derivative (n, 2) by c, x0', y0' or a parameter of the family, in this order."""
        if k == 0:
            return -self.imaged.by_distance
        if k < 3:
            return np.asarray(-np.eye(2)[:, k - 1] - self.correction.by_principal_point[..., k - 1])
        return np.asarray(-self.imaged.parameter_derivative(k - 3) - self.correction.parameter_jacobian[..., k - 3])


@dataclass(frozen=True)
class Displacement:
    """What a lens does to points: observed less ideal place (n, 2) in µm, and its derivatives (n, 2, 1 + k) by c and
    the parameters.

    imaged (n,): which points the lens shows anything at; the others are nan, the derivatives 0.
    """

    value_um: Array
    by_unknowns_um: Array
    imaged: Mask


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens with its values.

    Attributes
    ----------
    distortion : Distortion
        The family and its settings; its priors have no part in what the lens does.
    interior : Array (3,)
        Principal distance c and principal point x0', y0' in mm.
    parameters : Array (k,)
        Of the distortion, in the order of `families.parameter_names`, in their own units.
    covariance : Array (3 + k, 3 + k)
        Of interior orientation and parameters; empty where it is not known.
    """

    distortion: Distortion
    interior: Array
    parameters: Array
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def quantities(self) -> tuple[str, ...]:
        """The names of c, x0', y0' and the parameters."""
        return (*INTERIOR_NAMES, *parameter_names(self.distortion.family))

    @property
    def values(self) -> Array:
        """(3 + k,) of the quantities."""
        return np.concatenate([self.interior, self.parameters])

    @property
    def is_pinhole(self) -> bool:
        """Whether the parameters leave every point where it is."""
        return family(self.distortion.family).is_pinhole_at_zero and not self.parameters.any()

    def replaced_values(self, values: Array) -> "Lens":
        """The lens with other values (3 + k,) of its quantities."""
        return replace(self, interior=values[:3].copy(), parameters=values[3:].copy())

    def image(self, ray: Array) -> Imaged:
        """The images of rays (n, 2) about the principal point, before the correction of the observed point."""
        with np.errstate(over="ignore", invalid="ignore"):
            return family(self.distortion.family).image(self.distortion, self.interior[0], ray, self.parameters)

    def equations(self, xy_mm: Array, ray: Array) -> ImageEquations:
        """The pair of equations of observed camera points (n, 2) and their rays (n, 2), -U/W and -V/W."""
        of = family(self.distortion.family)
        return self.equations_with_image(xy_mm, of.image(self.distortion, self.interior[0], ray, self.parameters))

    def equations_with_image(self, xy_mm: Array, imaged: Imaged) -> ImageEquations:
        """The pair of equations of points whose rays' images are known."""
        correct = family(self.distortion.family).correct
        correction = correct(self.distortion, xy_mm, self.interior[1:], self.parameters)
        return ImageEquations(xy_mm - self.interior[1:] - imaged.value - correction.value, imaged, correction)

    def camera_from_ray(self, ray: Array) -> tuple[Array, Mask]:
        """The observed camera coordinates (n, 2) in mm of rays (n, 2), and which of them (n,) were found.

        Notes
        -----
        The correction is defined at the observed point, so that it is inverted by Newton's method. Where the distortion
        folds the image over, which a polynomial does far enough outside, nothing is found.
        """
        return self.camera_from_image(self.image(ray))

    def camera_from_image(self, imaged: Imaged) -> tuple[Array, Mask]:
        """As `camera_from_ray`, of rays whose images are known."""
        c, principal_point = self.interior[0], self.interior[1:]
        correct = family(self.distortion.family).correct
        found = np.zeros(len(imaged.value), dtype=bool)
        with np.errstate(over="ignore", invalid="ignore"):
            xy_mm = ideal_mm = principal_point + imaged.value
            unfolded = _unfolded(determinant(imaged.ray_jacobian))
            if correct is no_correction:
                return ideal_mm, unfolded & np.isfinite(ideal_mm).all(axis=1)
            tolerance_mm = 4 * NEWTON_TOLERANCE * (abs(c) + np.abs(ideal_mm).max(axis=1))
            for _ in range(NEWTON_STEPS):
                correction = correct(self.distortion, xy_mm, principal_point, self.parameters)
                step, regular = _newton_step(np.eye(2) - correction.xy_jacobian, xy_mm - ideal_mm - correction.value)
                xy_mm = xy_mm - step
                found = regular & unfolded & (np.abs(step).max(axis=1) <= tolerance_mm)
                if found.all():
                    break
        return xy_mm, found

    def ideal_from_observed(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Camera coordinates (n, 2) in mm free of distortion, of observed ones (n, 2); which were found."""
        if self.is_pinhole:
            return xy_mm, np.asarray(np.isfinite(xy_mm).all(axis=1))
        ray = (xy_mm - self.interior[1:]) / self.interior[0]
        found = np.zeros(len(ray), dtype=bool)
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(NEWTON_STEPS):
                at = self.equations(xy_mm, ray)
                step, regular = _newton_step(-at.ray_jacobian, -at.value)
                ray = ray - step
                found = regular & (np.abs(step).max(axis=1) <= 4 * NEWTON_TOLERANCE * (1.0 + np.abs(ray).max(axis=1)))
                if found.all():
                    break
        return self.interior[1:] + self.interior[0] * ray, found

    def ray_from_observed(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Rays (n, 2), -U/W and -V/W, of observed camera coordinates (n, 2) in mm; which were found."""
        ideal_mm, found = self.ideal_from_observed(xy_mm)
        return (ideal_mm - self.interior[1:]) / self.interior[0], found

    def folded_over(self, xy_mm: Array) -> Mask:
        """Which observed camera points (n, 2) in mm lie beyond where the distortion turns the image back on itself."""
        ray, found = self.ray_from_observed(xy_mm)
        if self.is_pinhole:
            return ~found
        with np.errstate(over="ignore", invalid="ignore"):
            at = self.equations(xy_mm, ray)
            sides = determinant(at.xy_jacobian), determinant(at.imaged.ray_jacobian)
        return ~(found & _unfolded(sides[0]) & _unfolded(sides[1]))

    def displacement(self, from_principal_point_mm: Array) -> Displacement:
        """What the lens does at observed points (n, 2), counted from the principal point, mm.

        Notes
        -----
        By the implicit function theorem: F(point, ray, unknowns) = 0 gives the ray's derivatives.
        """
        c, principal_point = self.interior[0], self.interior[1:]
        xy_mm = principal_point + from_principal_point_mm
        ideal_mm, imaged = self.ideal_from_observed(xy_mm)
        ideal_mm[~imaged] = principal_point
        ray = (ideal_mm - principal_point) / c
        at = self.equations(xy_mm, ray)
        by_unknowns = np.concatenate([at.interior_jacobian[:, :, :1], at.parameter_jacobian], axis=2)
        derivatives = c * np.linalg.solve(at.ray_jacobian, by_unknowns)
        derivatives[:, :, 0] -= ray
        derivatives[~imaged] = 0.0
        return Displacement(np.where(imaged[:, None], 1e3 * (xy_mm - ideal_mm), np.nan), 1e3 * derivatives, imaged)


def _newton_step(by_unknown: Array, value: Array) -> tuple[Array, Mask]:
    """Steps (n, 2), and which points (n,) have neighbours that are imaged on the right side of them."""
    side = determinant(by_unknown)
    regular = _unfolded(side)
    return solved(by_unknown, value, regular, side), regular


def _unfolded(side: Array) -> Mask:
    """Which determinants (n,) tell that the image's orientation is kept."""
    return np.asarray(np.isfinite(side) & (side > 0.0))

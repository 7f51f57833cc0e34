"""Object points into images and back: rays, camera points, comparator points, with the adjustment's own functions."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.correction import DistortionModel, Imaged, no_correction
from adjust.functional_model.distortion import image_equations
from adjust.functional_model.families import family
from adjust.functional_model.line_of_sight import STRAIGHT, LineOfSight, sight_vectors
from adjust.functional_model.scanner import NO_BEND, Bend
from adjust.functional_model.transformation import Film
from adjust.linear_algebra.small_matrices import applied, determinant, product, solved

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEWTON_STEPS = 30
NEWTON_TOLERANCE = 1e-14  # of the principal distance


@dataclass(frozen=True)
class ImageModel:
    """One image as it is known at a time: interior and exterior orientation, distortion, film transformation, scanner.

    interior (3,): c, x0', y0' in mm; parameters (k,) of the distortion in the order of `families.parameter_names`;
    rotation (3, 3) object to camera; station (3,) in object units; bend_parameters (k,) of the scanner's bend.
    """

    distortion: DistortionModel
    interior: Array
    parameters: Array
    rotation: Array
    station: Array
    film: Film
    line_of_sight: LineOfSight = STRAIGHT
    bend: Bend = NO_BEND
    bend_parameters: Array = field(default_factory=lambda: np.empty(0))

    def reduced_to(self, xyz: Array) -> tuple["ImageModel", Array]:
        """The same image and object points (n, 3), counted from its station: differences of large numbers are formed
        once. Heights stay as they are where the line of sight depends on them.
        """
        origin = self.station * [1.0, 1.0, float(self.line_of_sight.is_straight)]
        return replace(self, station=self.station - origin), xyz - origin

    def camera_from_object(self, xyz: Array) -> tuple[Array, Mask]:
        """Observed, that is distorted, camera coordinates (n, 2) in mm of object points (n, 3); which have an image."""
        ray, in_camera = rays(self.rotation, sight_vectors(self.line_of_sight, self.station, xyz).vector)
        xy_mm, found = camera_from_ray(self.distortion, self.interior, self.parameters, ray)
        return xy_mm, found & (in_camera[:, 2] < 0.0)

    def comparator_from_object(self, xyz: Array) -> tuple[Array, Mask]:
        """Comparator coordinates (n, 2) in mm of object points (n, 3); which of them have an image."""
        xy_mm, visible = self.camera_from_object(xyz)
        comparator_mm, found = self.comparator_from_camera(xy_mm)
        return comparator_mm, visible & found

    def camera_from_comparator(self, xy_mm: Array) -> Array:
        """Observed camera coordinates (n, 2) of comparator coordinates (n, 2), mm."""
        return self.film.camera_from_comparator(self.bend.apply(self.bend_parameters, xy_mm))

    def camera_by_comparator(self, xy_mm: Array) -> Array:
        """Their derivatives (n, 2, 2) by the comparator coordinates."""
        straight_mm = self.bend.apply(self.bend_parameters, xy_mm)
        return product(self.film.gradient(straight_mm), self.bend.gradient(self.bend_parameters, xy_mm))

    def comparator_from_camera(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Comparator coordinates (n, 2) of observed camera coordinates (n, 2), mm; which film and scanner have."""
        straight_mm, found = self.film.comparator_from_camera(xy_mm)
        scan_mm, unfolded = self.bend.inverse(self.bend_parameters, straight_mm)
        return scan_mm, found & unfolded

    def ideal_from_observed(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Camera coordinates (n, 2) free of distortion, of observed ones (n, 2), mm; which could be corrected."""
        return ideal_from_observed(self.distortion, self.interior, self.parameters, xy_mm)


def rays(rotation: Array, vector: Array) -> tuple[Array, Array]:
    """The rays (n, 2), -U/W and -V/W, along vectors (n, 3) from station to point, and these in the camera's axes.

    rotation (3, 3) or (n, 3, 3). A point in front of the camera has W < 0.
    """
    in_camera = applied(rotation, vector)
    depth = in_camera[..., 2:]
    # A point in the plane of the lens has no image: its ray is kept finite and W = 0 tells.
    return -in_camera[..., :2] / np.where(depth == 0.0, 1.0, depth), in_camera


def camera_from_ray(distortion: DistortionModel, interior: Array, parameters: Array, ray: Array) -> tuple[Array, Mask]:
    """The observed camera coordinates (n, 2) in mm of rays (n, 2), and which of them (n,) were found.

    The correction is defined at the observed point, so that it is inverted by Newton's method. Where the distortion
    folds the image over, which a polynomial does far enough outside, nothing is found.
    """
    return camera_from_image(distortion, interior, parameters, imaged_ray(distortion, interior, parameters, ray))


def imaged_ray(distortion: DistortionModel, interior: Array, parameters: Array, ray: Array) -> Imaged:
    """The images of rays (n, 2)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return family(distortion.family).image(distortion, interior[0], ray, parameters)


def camera_from_image(
    distortion: DistortionModel, interior: Array, parameters: Array, imaged: Imaged
) -> tuple[Array, Mask]:
    """As `camera_from_ray`, of rays whose images are known."""
    c, principal_point = interior[0], interior[1:]
    correct = family(distortion.family).correct
    found = np.zeros(len(imaged.value), dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):
        xy_mm = ideal_mm = principal_point + imaged.value
        unfolded = _unfolded(determinant(imaged.by_ray))
        if correct is no_correction:
            return ideal_mm, unfolded & np.isfinite(ideal_mm).all(axis=1)
        tolerance_mm = 4 * NEWTON_TOLERANCE * (abs(c) + np.abs(ideal_mm).max(axis=1))
        for _ in range(NEWTON_STEPS):
            correction = correct(distortion, xy_mm, principal_point, parameters)
            step, regular = _newton_step(np.eye(2) - correction.by_xy, xy_mm - ideal_mm - correction.value)
            xy_mm = xy_mm - step
            found = regular & unfolded & (np.abs(step).max(axis=1) <= tolerance_mm)
            if found.all():
                break
    return xy_mm, found


def ideal_from_observed(
    distortion: DistortionModel, interior: Array, parameters: Array, xy_mm: Array
) -> tuple[Array, Mask]:
    """Camera coordinates (n, 2) in mm free of distortion, of observed ones (n, 2); which were found."""
    if is_pinhole(distortion, parameters):
        return xy_mm, np.asarray(np.isfinite(xy_mm).all(axis=1))
    ray = (xy_mm - interior[1:]) / interior[0]
    found = np.zeros(len(ray), dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(NEWTON_STEPS):
            at = image_equations(distortion, interior, parameters, xy_mm, ray)
            step, regular = _newton_step(-at.by_ray, -at.value)
            ray = ray - step
            found = regular & (np.abs(step).max(axis=1) <= 4 * NEWTON_TOLERANCE * (1.0 + np.abs(ray).max(axis=1)))
            if found.all():
                break
    return interior[1:] + interior[0] * ray, found


def is_pinhole(distortion: DistortionModel, parameters: Array) -> bool:
    """Whether these parameters (k,) leave every point where it is."""
    return family(distortion.family).is_pinhole_at_zero and not parameters.any()


def folded_over(distortion: DistortionModel, interior: Array, parameters: Array, xy_mm: Array) -> Mask:
    """Which observed camera points (n, 2) in mm lie beyond where the distortion turns the image back on itself."""
    ideal_mm, found = ideal_from_observed(distortion, interior, parameters, xy_mm)
    if is_pinhole(distortion, parameters):
        return ~found
    with np.errstate(over="ignore", invalid="ignore"):
        at = image_equations(distortion, interior, parameters, xy_mm, (ideal_mm - interior[1:]) / interior[0])
        sides = determinant(at.by_xy), determinant(at.imaged.by_ray)
    return ~(found & _unfolded(sides[0]) & _unfolded(sides[1]))


def _newton_step(by_unknown: Array, value: Array) -> tuple[Array, Mask]:
    """Steps (n, 2), and which points (n,) have neighbours that are imaged on the right side of them."""
    side = determinant(by_unknown)
    regular = _unfolded(side)
    return solved(by_unknown, value, regular, side), regular


def _unfolded(side: Array) -> Mask:
    """Which determinants (n,) tell that the image's orientation is kept."""
    return np.asarray(np.isfinite(side) & (side > 0.0))

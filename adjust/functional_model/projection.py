"""Projection of object points to camera and comparator coordinates with the functions of the adjustment."""

from dataclasses import dataclass, field, replace

import numpy as np

from adjust.array_types import Array, Mask
from adjust.functional_model.lens import Lens
from adjust.functional_model.line_of_sight import STRAIGHT, LineOfSight, sight_vectors
from adjust.functional_model.rotation import cross_matrix
from adjust.functional_model.scanner import NO_BEND, Bend
from adjust.functional_model.transformation import Film
from adjust.linear_algebra.small_matrices import applied, product


@dataclass(frozen=True)
class ImageModel:
    """Current model of one image: lens, exterior orientation, film transformation, scanner.

    Attributes
    ----------
    lens : lens with values.
    rotation : (3, 3) object to camera.
    station : (3,) projection centre in object units.
    film : film transformation.
    line_of_sight : earth curvature and refraction.
    bend, bend_parameters : scanner terms and their parameters (k,).
    """

    lens: Lens
    rotation: Array
    station: Array
    film: Film
    line_of_sight: LineOfSight = STRAIGHT
    bend: Bend = NO_BEND
    bend_parameters: Array = field(default_factory=lambda: np.empty(0))

    def reduced_to(self, xyz: Array) -> tuple["ImageModel", Array]:
        """Reduce the image and object points (n, 3) to the station, so that large numbers are subtracted once.

        Heights are not reduced where the line of sight depends on them.
        """
        origin = self.station * [1.0, 1.0, float(self.line_of_sight.is_straight)]
        return replace(self, station=self.station - origin), xyz - origin

    def camera_from_object(self, xyz: Array) -> tuple[Array, Mask]:
        """Project object points (n, 3) to distorted camera coordinates (n, 2) in mm; mask of those imaged."""
        ray, in_camera = rays(self.rotation, sight_vectors(self.line_of_sight, self.station, xyz).vector)
        xy_mm, found = self.lens.camera_from_ray(ray)
        return xy_mm, found & (in_camera[:, 2] < 0.0)

    def comparator_from_object(self, xyz: Array) -> tuple[Array, Mask]:
        """Project object points (n, 3) to comparator coordinates (n, 2) in mm; mask of those imaged."""
        xy_mm, visible = self.camera_from_object(xyz)
        comparator_mm, found = self.comparator_from_camera(xy_mm)
        return comparator_mm, visible & found

    def camera_from_comparator(self, xy_mm: Array) -> Array:
        """Compute observed camera coordinates (n, 2) from comparator coordinates (n, 2), mm."""
        return self.film.camera_from_comparator(self.bend.apply(self.bend_parameters, xy_mm))

    def camera_by_comparator(self, xy_mm: Array) -> Array:
        """Derivatives (n, 2, 2) of the camera coordinates with respect to the comparator coordinates."""
        straight_mm = self.bend.apply(self.bend_parameters, xy_mm)
        return product(self.film.gradient(straight_mm), self.bend.gradient(self.bend_parameters, xy_mm))

    def comparator_from_camera(self, xy_mm: Array) -> tuple[Array, Mask]:
        """Compute comparator coordinates (n, 2) from observed camera coordinates (n, 2), mm; mask of those found."""
        straight_mm, found = self.film.comparator_from_camera(xy_mm)
        scan_mm, unfolded = self.bend.inverse(self.bend_parameters, straight_mm)
        return scan_mm, found & unfolded


def rays(rotation: Array, vector: Array) -> tuple[Array, Array]:
    """Compute rays (n, 2), -U/W and -V/W, of vectors (n, 3) to points, and these vectors in the camera frame.

    rotation (3, 3) or (n, 3, 3). A point in front of the camera has W < 0.
    """
    in_camera = applied(rotation, vector)
    depth = in_camera[..., 2:]
    # A point with W = 0 has no image: its ray is kept finite, and the caller tests W.
    return -in_camera[..., :2] / np.where(depth == 0.0, 1.0, depth), in_camera


def ray_by_orientation(ray: Array, inverse_depth: Array) -> Array:
    """Derivatives (n, 2, 6) of rays (n, 2) with respect to a small rotation and a shift of their points.

    With p = (u, v, -1) along the ray, the point moves by t x p + s / depth.
    """
    point = np.column_stack([ray, -np.ones(len(ray))])
    moved = np.concatenate(
        [-cross_matrix(point), inverse_depth[:, None, None] * np.broadcast_to(np.eye(3), (len(ray), 3, 3))], axis=2
    )
    return np.asarray(moved[:, :2] + ray[:, :, None] * moved[:, 2:])

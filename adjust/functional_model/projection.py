"""Object points into images and back: rays, camera points, comparator points, with the adjustment's own functions."""

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
    """One image as it is known at a time: lens, exterior orientation, film transformation, scanner.

    rotation (3, 3) object to camera; station (3,) in object units; bend_parameters (k,) of the scanner's bend.
    """

    lens: Lens
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
        xy_mm, found = self.lens.camera_from_ray(ray)
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


def rays(rotation: Array, vector: Array) -> tuple[Array, Array]:
    """The rays (n, 2), -U/W and -V/W, along vectors (n, 3) from station to point, and these in the camera's axes.

    rotation (3, 3) or (n, 3, 3). A point in front of the camera has W < 0.
    """
    in_camera = applied(rotation, vector)
    depth = in_camera[..., 2:]
    # A point in the plane of the lens has no image: its ray is kept finite and W = 0 tells.
    return -in_camera[..., :2] / np.where(depth == 0.0, 1.0, depth), in_camera


def ray_by_orientation(ray: Array, inverse_depth: Array) -> Array:
    """Derivatives (n, 2, 6) of rays (n, 2) by a small turn of their points about the camera and by a shift of these.

    With p = (u, v, -1) along the ray, the point moves by t x p + s / depth.
    """
    point = np.column_stack([ray, -np.ones(len(ray))])
    moved = np.concatenate(
        [-cross_matrix(point), inverse_depth[:, None, None] * np.broadcast_to(np.eye(3), (len(ray), 3, 3))], axis=2
    )
    return np.asarray(moved[:, :2] + ray[:, :, None] * moved[:, 2:])

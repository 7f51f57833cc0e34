"""Projection of object points to camera and comparator coordinates, along straight or refracted lines of sight.

Map coordinates X, Y and heights Z refer to a sphere; the axes at a station are those of the map there, its vertical
that of the sphere. Refraction is modelled by raising the point: the refracted line of sight is a straight one to a
point a little higher. The air is the ICAO standard atmosphere, heights above sea in m: temperature falls by 6.5 K/km up
to 11 km and is constant above; dry air, refractivity by Edlén (1966) at 0.55 um; from 0.4 to 0.7 um it differs by less
than 2 %.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from adjust.array_types import Array, Mask
from adjust.functional_model.lens import Lens
from adjust.functional_model.rotation import cross_matrix
from adjust.functional_model.scanner import NO_BEND, Bend
from adjust.functional_model.transformation import Film
from adjust.linear_algebra.small_matrices import applied, product

EARTH_RADIUS_M = 6.371e6  # mean radius; the local radius, and thus the curvature, differs by up to half a percent
SMALL_RAD = 1e-2  # angle at the earth's centre below which the series expansion is exact
SEA_LEVEL_K, SEA_LEVEL_HPA = 288.15, 1013.25
LAPSE_K_PER_M, TROPOPAUSE_M = 0.0065, 11000.0
GRAVITY_M_PER_S2, GAS_CONSTANT = 9.80665, 287.05287  # gas constant of dry air, J/(kg K)
REFRACTIVITY_K_PER_HPA = 2.7782e-4 * SEA_LEVEL_K / SEA_LEVEL_HPA  # (n - 1) T / p
LEVEL_M = 1.0  # heights that differ by less are taken as equal


@dataclass(frozen=True)
class LineOfSight:
    """Model of the lines of sight of aerial images; straight by default.

    curvature: apply earth curvature; X, Y are map coordinates, true to scale at the height Z = 0, and Z heights above
    the curved earth.
    refraction: apply refraction in the standard atmosphere; Z are heights above sea.
    unit_m: length of the object unit in m.
    """

    curvature: bool = False
    refraction: bool = False
    unit_m: float = 1.0

    @property
    def is_straight(self) -> bool:
        return not (self.curvature or self.refraction)


STRAIGHT = LineOfSight()


@dataclass(frozen=True)
class SightVectors:
    """Vectors (n, 3) from stations to apparent points, in object units and along the axes of the map.

    by_station, by_point (n, 3, 3): derivatives with respect to the coordinates of station and point.
    """

    vector: Array
    by_station: Array
    by_point: Array


def sight_vectors(setting: LineOfSight, station: Array, xyz: Array) -> SightVectors:
    """Compute the vectors from stations (3,) or (n, 3) to the apparent places of points (n, 3)."""
    stations, unit_m = np.broadcast_to(station, xyz.shape), setting.unit_m
    if setting.curvature:
        apparent = _over_the_sphere(unit_m, stations, xyz)
    else:
        shape = (*xyz.shape, 3)
        apparent = SightVectors(xyz - stations, np.broadcast_to(-np.eye(3), shape), np.broadcast_to(np.eye(3), shape))
    if not setting.refraction:
        return apparent
    # Raise the points by the refraction coefficient times the square of their distance.
    per_m, by_station_height, by_point_height = bending(unit_m * stations[:, 2], unit_m * xyz[:, 2])
    coefficient = unit_m * per_m
    square = (apparent.vector**2).sum(axis=1)
    vector, by_station, by_point = apparent.vector.copy(), apparent.by_station.copy(), apparent.by_point.copy()
    vector[:, 2] += coefficient * square
    for derivative, by_height, of_vector in (
        (by_station, by_station_height, apparent.by_station),
        (by_point, by_point_height, apparent.by_point),
    ):
        derivative[:, 2] += 2.0 * coefficient[:, None] * np.einsum("ni,nij->nj", apparent.vector, of_vector)
        derivative[:, 2, 2] += unit_m**2 * by_height * square
    return SightVectors(vector, by_station, by_point)


def _over_the_sphere(unit_m: float, stations: Array, xyz: Array) -> SightVectors:
    """Map distances s are arcs at height 0: the point is (R + Z) sin(s/R) away and (R + Z) cos(s/R) - R high."""
    radius = EARTH_RADIUS_M / unit_m
    plan = xyz[:, :2] - stations[:, :2]
    height, angle = xyz[:, 2], np.sqrt((plan**2).sum(axis=1)) / radius
    stretch, sinc, small = 1.0 + height / radius, np.sinc(angle / np.pi), angle < SMALL_RAD
    a = np.where(small, 1.0, angle)
    # Derivative of sin(a) / a, divided by a.
    bent = np.where(small, -1.0 / 3.0 + angle**2 / 30.0, (np.cos(a) - np.sinc(a / np.pi)) / a**2)
    ahead = (stretch * sinc)[:, None] * plan
    drop = -2.0 * (radius + height) * np.sin(angle / 2.0) ** 2  # no difference of large numbers
    vector = np.column_stack([ahead, drop + height - stations[:, 2]])
    by_point = np.zeros((len(xyz), 3, 3))
    by_point[:, :2, :2] = (stretch * sinc)[:, None, None] * np.eye(2)
    by_point[:, :2, :2] += (stretch * bent / radius**2)[:, None, None] * plan[:, :, None] * plan[:, None, :]
    by_point[:, :2, 2] = sinc[:, None] / radius * plan
    by_point[:, 2, :2] = -ahead / radius
    by_point[:, 2, 2] = np.cos(angle)
    by_station = np.zeros_like(by_point)
    by_station[:, :, :2] = -by_point[:, :, :2]
    by_station[:, 2, 2] = -1.0
    return SightVectors(vector, by_station, by_point)


def bending(station_m: Array, point_m: Array) -> tuple[Array, Array, Array]:
    """Refraction coefficients (n,), 1/m, between heights of stations and points, and their derivatives by both, 1/m².

    A point at the slant distance s appears higher by coefficient times s². With N = n - 1 at the station and the mean
    of N between both heights, the angle of refraction is K tan(nadir angle), K = mean - N (Schut, Photogrammetric
    refraction, 1969; Saastamoinen 1972), and the coefficient K over the difference of heights. The mean needs no
    quadrature: N is proportional to the density, whose integral is the difference of the pressures over gravity.
    """
    level = np.abs(station_m - point_m) < LEVEL_M
    difference = np.where(level, 1.0, station_m - point_m)
    (pressure, there, slope), (pressure_below, below, _) = _air(station_m), _air(point_m)
    weight = REFRACTIVITY_K_PER_HPA * GAS_CONSTANT / GRAVITY_M_PER_S2
    mean = weight * (pressure_below - pressure) / difference
    return (
        np.where(level, -slope / 2.0, (mean - there) / difference),
        np.where(level, 0.0, (2.0 * (there - mean) / difference - slope) / difference),
        np.where(level, 0.0, (2.0 * mean - below - there) / difference**2),
    )


def _air(height_m: Array) -> tuple[Array, Array, Array]:
    """Pressure in hPa, N = n - 1 and its derivative with respect to the height in 1/m."""
    below = height_m < TROPOPAUSE_M
    temperature = SEA_LEVEL_K - LAPSE_K_PER_M * np.minimum(height_m, TROPOPAUSE_M)
    exponent = GRAVITY_M_PER_S2 / (GAS_CONSTANT * LAPSE_K_PER_M)
    above_m = np.maximum(height_m - TROPOPAUSE_M, 0.0)
    pressure = SEA_LEVEL_HPA * (temperature / SEA_LEVEL_K) ** exponent
    pressure = pressure * np.exp(-GRAVITY_M_PER_S2 * above_m / (GAS_CONSTANT * temperature))
    refractivity = REFRACTIVITY_K_PER_HPA * pressure / temperature
    relative = (np.where(below, LAPSE_K_PER_M, 0.0) - GRAVITY_M_PER_S2 / GAS_CONSTANT) / temperature
    return pressure, refractivity, refractivity * relative


@dataclass(frozen=True)
class ImageModel:
    """Current model of one image: lens, exterior orientation, film transformation, scanner."""

    lens: Lens  # lens with values
    rotation: Array  # (3, 3) object to camera
    station: Array  # (3,) projection centre in object units
    film: Film  # film transformation
    line_of_sight: LineOfSight = STRAIGHT  # earth curvature and refraction
    # bend, bend_parameters: scanner terms and their parameters (k,)
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

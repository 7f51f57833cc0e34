"""Uncertainty of a lens: its distortion over the radius, the radius of its observations, and projected points.

Projection uncertainty is the covariance of the image of a point that is fixed in the scene. A change of the lens that a
rotation and a shift of the camera compensate has no effect. The change dl of interior orientation and distortion is
therefore combined with the rotation t and the shift s of the camera that compensate it best over all observed targets,
at their distances:

    dq = B dl + P (t, s),    (t, s) = -(sum P' W P)^-1 sum P' W B dl

B and P are the derivatives of the camera point of a fixed ray by the calibration and by the orientation, W the weights.
The covariance is that of dq plus that of the common orientation, sigma0² P (sum P' W P)^-1 P'. The sum is mrcal's
cross-reprojection uncertainty (mrcal.secretsauce.net, "Projection uncertainty"). At infinity a shift has no effect. On
film, the marks define the camera frame: the effect of their changes on the interior orientation of a scan is removed,
and t and s compensate the rest together with the changes of the images' film transformations.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from adjust.array_types import Array
from adjust.errors import AdjustmentError
from adjust.functional_model.families import family
from adjust.functional_model.lens import Lens
from adjust.functional_model.projection import ray_by_orientation, rays, sight_vectors
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.problem.camera import Camera, Corners
from adjust.problem.estimates import Estimates, adjusted_image, adjusted_lens, adjusted_places, observed_places
from adjust.problem.parameter import Parameter

RADII = 80
DIRECTIONS = 36
REACH_DIRECTIONS = 12  # around the axis, in which the distortion is compared
REACH_RADII = 8  # at which the standard deviation of the distortion is evaluated, out to the outermost target
MOST_IMAGES = 100  # used for the fit of the orientation, evenly chosen
GRID = 33  # places along the longer side of an image
RANK = 1e-9  # relative eigenvalue of the scaled normal matrix of an orientation, below which a direction is not fitted


@dataclass(frozen=True)
class Curves:
    """Distortion, in µm, over the radius (n,), in mm; of a fisheye against the equidistant projection.

    radial: outward displacement, mean over all directions; asymmetric: largest displacement over all directions after
    removal of the radial part (decentering and affinity); each with its standard deviation.
    """

    radius_mm: Array
    radial_um: Array
    radial_sigma_um: Array
    asymmetric_um: Array
    asymmetric_sigma_um: Array


def is_defined_over_frame(lens: Lens) -> bool:
    """Whether the family is defined over the frame instead of the radius."""
    return family(lens.distortion.family).needs == "half_mm"


def distortion_curves(lens: Lens, largest_radius_mm: float) -> Curves:
    """Compute the curves from the principal point to a radius, or as far as the lens forms an image."""
    radius = np.linspace(0.0, largest_radius_mm, RADII)[1:]
    outward = directions()
    imaged = lens.displacement((radius[:, None, None] * outward).reshape(-1, 2)).imaged.reshape(len(radius), -1)
    radius = radius[np.logical_and.accumulate(imaged.all(axis=1))]
    radial, radial_by, rest, rest_by = radial_part(lens, radius)
    size = np.hypot(rest[..., 0], rest[..., 1])
    worst = size.argmax(axis=1)
    at = np.arange(len(radius))
    largest = size[at, worst]
    unit = rest[at, worst] / np.maximum(largest, 1e-12)[:, None]
    by_largest = np.einsum("rik,ri->rk", rest_by[at, worst], unit)
    return Curves(radius, radial, function_sigmas(lens, radial_by), largest, function_sigmas(lens, by_largest))


def radial_part(lens: Lens, radius_mm: Array, of_pinhole: bool = False) -> tuple[Array, Array, Array, Array]:
    """Mean outward displacement (r,), µm, at radii and its derivatives (r, 1 + k) by c and the parameters; remaining
    displacement (r, DIRECTIONS, 2) and its derivatives. of_pinhole: as `Lens.displacement` has it."""
    outward = directions()
    moved = lens.displacement((radius_mm[:, None, None] * outward).reshape(-1, 2), of_pinhole)
    value = moved.value_um.reshape(len(radius_mm), DIRECTIONS, 2)
    by = moved.by_unknowns_um.reshape(len(radius_mm), DIRECTIONS, 2, -1)
    radial = np.einsum("rdi,di->r", value, outward) / DIRECTIONS
    radial_by = np.einsum("rdik,di->rk", by, outward) / DIRECTIONS
    rest = value - radial[:, None, None] * outward
    return radial, radial_by, rest, by - radial_by[:, None, None, :] * outward[:, :, None]


def balanced_distance(radius: Array, tangent: Array) -> tuple[float, int, int]:
    """Calibrated principal distance, which balances the largest and smallest distortion r - C tan t at some radii.

    Also returns the indices of these extremes. An exchange algorithm: the pair of radii is replaced by the current
    extremes until it no longer changes. The axis, without distortion, may be one of them.
    """
    distance, high, low = float(radius[-1] / tangent[-1]), 0, 0
    for _ in range(50):
        distortion = radius - distance * tangent
        high, low = int(distortion.argmax()), int(distortion.argmin())
        better = float((radius[high] + radius[low]) / (tangent[high] + tangent[low]))
        if abs(better - distance) < 1e-12 * distance:
            break
        distance = better
    return distance, high, low


def displacement_cofactor(lens: Lens) -> Array:
    """(1 + k, 1 + k) covariance of c and the parameters, on which a displacement about the principal point depends."""
    return np.delete(np.delete(lens.covariance, [1, 2], axis=0), [1, 2], axis=1)


def function_sigmas(lens: Lens, by: Array) -> Array:
    """(n,) standard deviations of functions with derivatives (n, 1 + k)."""
    variance: Array = np.einsum("rk,kl,rl->r", by, displacement_cofactor(lens), by)
    return np.sqrt(np.maximum(variance, 0.0))


def directions(count: int = DIRECTIONS) -> Array:
    angles = np.arange(count) * (2.0 * np.pi / count)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


@dataclass(frozen=True)
class LensReach:
    """Extent of the observations of a lens."""

    radius_mm: float  # from the principal point to the outermost target
    corner_mm: float  # from the principal point to the farthest corner of the frame; nan if the frame is unknown
    # sigma_um, corner_sigma_um: largest standard deviation of the distortion within the radius, and at the corner; nan
    # where the lens forms no image
    sigma_um: float
    corner_sigma_um: float
    frame_mm: Corners | None  # lower left and upper right corner of the frame; None if unknown

    @property
    def share(self) -> float:
        return min(self.radius_mm / self.corner_mm, 1.0)


def lens_reach(estimates: Estimates, camera: Camera, frame_mm: tuple[float, float] | None) -> LensReach | None:
    """Find the extent of the observations of a lens; None without observations. frame_mm: width and height."""
    observations, lens = estimates.network.observations, adjusted_lens(estimates, camera.name)
    rows, places_mm = observed_places(estimates, camera.name, observations.xy_mm)
    observed, principal_point = places_mm[~observations.is_fiducial[rows]], lens.interior[1:]
    if not len(observed):
        return None
    radius_mm = float(np.linalg.norm(observed - principal_point, axis=1).max())
    corner_mm, corners = np.nan, None if frame_mm is None else camera.frame_corners(observed, frame_mm)
    if corners is not None:
        corner_mm = float(np.linalg.norm(np.abs(np.array(corners) - principal_point).max(axis=0)))
    unknowns = [Parameter.interior(camera.name, each) for each in lens.quantities if each not in ("x0", "y0")]
    cofactor = estimates.cofactor_of(unknowns)

    def sigma_um(radius_mm: float) -> float:
        """The largest standard deviation of the distortion at a radius, over all directions and along any."""
        moved = lens.displacement(radius_mm * directions(REACH_DIRECTIONS))
        if not moved.imaged.all():
            return np.nan
        by = moved.by_unknowns_um
        variances = np.linalg.eigvalsh(by @ cofactor @ by.swapaxes(1, 2))[:, -1]
        return estimates.sigma0 * float(np.sqrt(max(variances.max(), 0.0)))

    within = max(sigma_um(radius) for radius in np.linspace(0.0, radius_mm, REACH_RADII + 1)[1:])
    beyond = sigma_um(corner_mm) if np.isfinite(corner_mm) else np.nan
    return LensReach(radius_mm, corner_mm, within, beyond, corners)


@dataclass(frozen=True, eq=False)
class ProjectionUncertainty:
    """Standard deviations of projected points over the image of a camera.

    Attributes
    ----------
    camera : str
    distance : from the camera to the points in object units, inf at infinity.
    median_distance : of the targets that were observed.
    places_mm : (..., 2) of the points, in the camera frame.
    covariance_mm2 : (..., 2, 2) by the model; nan where the lens forms no image.
    cluster_covariance_mm2 : (..., 2, 2) by the delete-one-image jackknife; None where no error is unmodelled
        or images are too few.
    """

    camera: str
    distance: float
    median_distance: float
    places_mm: Array
    covariance_mm2: Array
    cluster_covariance_mm2: Array | None

    @property
    def sigma_model_mm(self) -> Array:
        """(...) by the model, in the least precise direction."""
        return _largest_sigma(self.covariance_mm2)

    @property
    def sigma_clusters_mm(self) -> Array | None:
        """(...) by the jackknife over images."""
        return None if self.cluster_covariance_mm2 is None else _largest_sigma(self.cluster_covariance_mm2)

    @property
    def sigma_mm(self) -> Array:
        """(...) the larger of both, which is the one to use."""
        clusters = self.sigma_clusters_mm
        return self.sigma_model_mm if clusters is None else np.maximum(self.sigma_model_mm, clusters)


def projection_uncertainty(
    estimates: Estimates,
    clusters: Callable[[Sequence[Parameter]], Array | None],
    camera: str = "",
    distance: float = np.inf,
    places_mm: Array | None = None,
) -> ProjectionUncertainty:
    """See `Adjustment.projection_uncertainty`. clusters: returns the jackknife covariance of some quantities."""
    if not distance > 0.0:
        raise AdjustmentError(f"The distance of projected points must be positive, in object units, not {distance}.")
    field = ProjectionField(estimates, only_camera(estimates, camera))
    known = estimates.sigma0**2 * estimates.cofactor_of([*field.calibration, *field.films])
    covariances = known, clusters(field.calibration)
    if places_mm is None:  # a grid over the image, the upper row first
        low, high = np.asarray(field.corners_mm, float)
        counts = np.maximum(np.rint(GRID * (high - low) / (high - low).max()), 3).astype(int)
        x, y = np.linspace(low[0], high[0], counts[0]), np.linspace(high[1], low[1], counts[1])
        places_mm = np.stack(np.meshgrid(x, y), axis=-1)
    places = np.asarray(places_mm, dtype=float)
    flat, shape = places.reshape(-1, 2), (*places.shape[:-1], 2, 2)
    model, robust = (
        None if each is None else field.covariance_mm2(each, flat, distance).reshape(shape) for each in covariances
    )
    assert model is not None
    return ProjectionUncertainty(field.camera.name, distance, field.median_distance, places, model, robust)


def only_camera(estimates: Estimates, name: str = "") -> Camera:
    """Camera by name, or the only one. Raises AdjustmentError where no such camera was calibrated."""
    network = estimates.network
    cameras = {each.name: each for each in network.cameras if each.name not in network.idle_cameras}
    if not estimates.converged or not cameras:
        raise AdjustmentError("No camera is calibrated: the adjustment has no solution, or shows no targets.")
    if not name and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name not in cameras:
        raise AdjustmentError(f"There is no calibrated camera {name!r}. Name one of: {', '.join(cameras)}.")
    return cameras[name]


class ProjectionField:
    """Derivatives of a camera's projection by its calibration, with the orientation eliminated.

    Attributes
    ----------
    calibration : keys of lens and marks.
    films : keys of the film transformations of up to MOST_IMAGES images, to whose targets the orientation is fitted.
    corners_mm : of the image, or of the observations if its size is unknown.
    median_distance : of the targets, object units.
    """

    def __init__(self, estimates: Estimates, camera: Camera) -> None:
        self.camera, self._sigma0 = camera, estimates.sigma0
        self._lens = adjusted_lens(estimates, camera.name)
        self.calibration = [Parameter.interior(camera.name, name) for name in self._lens.quantities]
        self.films = list[Parameter]()
        images = (image for image in estimates.network.images if image.camera == camera.name)
        filmed = next((image for image in images if image.transformation != "none" and camera.fiducials), None)
        self._film = None if filmed is None else adjusted_image(estimates, filmed.name).film
        if self._film is not None:
            keys = [Parameter.fiducial(camera.name, id, axis) for id in camera.fiducials for axis in "xy"]
            self.calibration += keys
            design = _film_derivatives(self._film, estimates.values_of(keys).reshape(-1, 2)).reshape(len(keys), -1)
            sizes = np.linalg.norm(design, axis=0)
            # (q, 2 f) effect of changed marks on the interior orientation of a scan, by least squares
            self._film_by_marks = np.linalg.pinv(design / sizes).astype(np.float64) / sizes[:, None]
        self._align(estimates)

    def _align(self, estimates: Estimates) -> None:
        """Set the cofactor matrix (6, 6) of the orientation, and its derivatives (6, k) by calibration and films."""
        observations = estimates.network.observations
        of_image, is_target = np.array(observations.image), ~observations.is_fiducial
        shown = [each for each in estimates.network.images if each.camera == self.camera.name]
        shown = [each for each in shown if (is_target & (of_image == each.name)).any()]
        normal, right, by_films, distances, places = np.zeros((6, 6)), 0.0, list[Array](), list[Array](), list[Array]()
        for image in shown[:: -(-len(shown) // MOST_IMAGES)]:
            rows = np.flatnonzero(is_target & (of_image == image.name))
            model = adjusted_image(estimates, image.name)
            xyz = adjusted_places(estimates, [observations.point[row] for row in rows])
            ray, in_camera = rays(model.rotation, sight_vectors(model.line_of_sight, model.station, xyz).vector)
            depth = np.abs(in_camera[:, 2])
            places.append(model.camera_from_comparator(observations.xy_mm[rows]))
            distances.append(depth * np.sqrt(1.0 + (ray**2).sum(axis=1)))
            by, turn = self._derivatives(places[-1], ray, 1.0 / depth)
            weights = 2.0 / np.trace(observations.covariance_mm2[rows], axis1=1, axis2=2)
            weighted = (weights[:, None, None] * turn).reshape(-1, 6).T
            normal += weighted @ turn.reshape(-1, 6)
            right = right + weighted @ by.reshape(-1, by.shape[2])
            film_names = film_parameter_names(image.transformation)
            self.films += [Parameter.film(image.name, name) for name in film_names]
            by_films.append(
                -weighted @ _film_derivatives(model.film, places[-1]).reshape(2 * len(rows), len(film_names))
            )
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
        self._orientation = np.linalg.pinv(normal * np.outer(scale, scale), rcond=RANK, hermitian=True)
        self._orientation *= np.outer(scale, scale)
        self._by_calibration = -self._orientation @ right
        self._by_films = -self._orientation @ np.concatenate(by_films, axis=1)
        self.median_distance = float(np.median(np.concatenate(distances)))
        observed = np.concatenate(places)
        self.corners_mm = self.camera.frame_corners(observed) or np.array([observed.min(axis=0), observed.max(axis=0)])

    def covariance_mm2(self, covariance: Array, places_mm: Array, distance: float) -> Array:
        """(n, 2, 2) covariance of points at places (n, 2); nan where there is no image.

        covariance: of calibration and films, or of the calibration alone; the films then follow the marks.
        """
        ray, found = self._lens.ray_from_observed(places_mm)
        found &= ~self._lens.folded_over(places_mm)
        result = np.full((len(places_mm), 2, 2), np.nan)
        ray = ray[found]
        by, turn = self._derivatives(places_mm[found], ray, np.sqrt(1.0 + (ray**2).sum(axis=1)) / distance)
        lens = len(self._lens.values)
        following = self._by_calibration
        if len(covariance) > len(self.calibration):
            following = np.concatenate([following[:, :lens], 0.0 * following[:, lens:], self._by_films], axis=1)
        free = np.pad(by, ((0, 0), (0, 0), (0, following.shape[1] - by.shape[2]))) + turn @ following
        if self._film is not None:  # the film parameters take the place of the marks
            others = len(covariance) - lens - self._film_by_marks.shape[1]
            reduction = block_diag(np.eye(lens), self._film_by_marks, np.eye(others))
            covariance = np.asarray(reduction @ covariance @ reduction.T)
        common = self._sigma0**2 * turn @ self._orientation @ turn.swapaxes(1, 2)
        result[found] = free @ covariance @ free.swapaxes(1, 2) + common
        return result

    def _derivatives(self, xy_mm: Array, ray: Array, inverse_depth: Array) -> tuple[Array, Array]:
        """Derivatives of the images of fixed points by the calibration (n, 2, k) and by rotation and shift (n, 2,
        6)."""
        at = self._lens.equations(xy_mm, ray)
        by = np.asarray(-np.linalg.solve(at.xy_jacobian, at.quantity_jacobian), dtype=np.float64)
        if self._film is not None:
            by = np.concatenate([by, -_film_derivatives(self._film, xy_mm)], axis=2)
        orientation = ray_by_orientation(ray, inverse_depth)
        return by, np.asarray(-np.linalg.solve(at.xy_jacobian, at.ray_jacobian @ orientation), dtype=np.float64)


def _film_derivatives(film: Film, xy_mm: Array) -> Array:
    """(n, 2, q) derivatives of camera points by the parameters of an image's film transformation."""
    return film.design(film.comparator_from_camera(xy_mm)[0])


def _largest_sigma(covariance: Array) -> Array:
    """(...) largest standard deviation over all directions of covariances (..., 2, 2); nan stays."""
    half_sum = 0.5 * (covariance[..., 0, 0] + covariance[..., 1, 1])
    half_difference = 0.5 * (covariance[..., 0, 0] - covariance[..., 1, 1])
    return np.asarray(np.sqrt(half_sum + np.hypot(half_difference, covariance[..., 0, 1])))

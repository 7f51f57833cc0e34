"""Distortion over the radius with standard deviations, and the radius within which a lens is determined."""

from dataclasses import dataclass

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.families import family
from adjust.functional_model.lens import Lens
from adjust.problem.camera import Camera, Corners
from adjust.problem.estimates import Estimates, adjusted_lens, observed_places
from adjust.problem.parameter import Parameter

RADII = 80
DIRECTIONS = 36


@dataclass(frozen=True)
class Curves:
    """Distortion, in µm, over the radius (n,), in mm.

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


def radial_part(lens: Lens, radius_mm: Array) -> tuple[Array, Array, Array, Array]:
    """Mean outward displacement (r,), µm, at radii and its derivatives (r, 1 + k) by c and the parameters; remaining
    displacement (r, DIRECTIONS, 2) and its derivatives."""
    outward = directions()
    moved = lens.displacement((radius_mm[:, None, None] * outward).reshape(-1, 2))
    value = moved.value_um.reshape(len(radius_mm), DIRECTIONS, 2)
    by = moved.by_unknowns_um.reshape(len(radius_mm), DIRECTIONS, 2, -1)
    radial = np.einsum("rdi,di->r", value, outward) / DIRECTIONS
    radial_by = np.einsum("rdik,di->rk", by, outward) / DIRECTIONS
    rest = value - radial[:, None, None] * outward
    return radial, radial_by, rest, by - radial_by[:, None, None, :] * outward[:, :, None]


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


REACH_DIRECTIONS = 12
REACH_RADII = 8  # at which the standard deviation of the distortion is evaluated, out to the outermost target


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
    observations = estimates.network.observations
    principal_point = np.array([estimates.value(Parameter.interior(camera.name, each)) for each in ("x0", "y0")])
    rows, places_mm = observed_places(estimates, camera.name, observations.xy_mm)
    observed = places_mm[~observations.is_fiducial[rows]]
    if not len(observed):
        return None
    radius_mm = float(np.linalg.norm(observed - principal_point, axis=1).max())
    corner_mm, corners = np.nan, None if frame_mm is None else camera.frame_corners(observed, frame_mm)
    if corners is not None:
        corner_mm = float(np.linalg.norm(np.abs(np.array(corners) - principal_point).max(axis=0)))
    within = max(_sigma_um(estimates, camera, radius) for radius in np.linspace(0.0, radius_mm, REACH_RADII + 1)[1:])
    beyond = _sigma_um(estimates, camera, corner_mm) if np.isfinite(corner_mm) else np.nan
    return LensReach(radius_mm, corner_mm, within, beyond, corners)


def _sigma_um(estimates: Estimates, camera: Camera, radius_mm: float) -> float:
    """The largest standard deviation of the distortion at a radius, over all directions and along any."""
    lens = adjusted_lens(estimates, camera.name)
    unknowns = [Parameter.interior(camera.name, each) for each in lens.quantities if each not in ("x0", "y0")]
    moved = lens.displacement(radius_mm * directions(REACH_DIRECTIONS))
    if not moved.imaged.all():
        return np.nan
    by = moved.by_unknowns_um
    variances = np.linalg.eigvalsh(by @ estimates.cofactor_of(unknowns) @ by.swapaxes(1, 2))[:, -1]
    return estimates.sigma0 * float(np.sqrt(max(variances.max(), 0.0)))

"""Radius within which a lens is determined: the outermost observed target, against the corner of the frame."""

from dataclasses import dataclass

import numpy as np

from adjust.problem.camera import Camera, Corners
from adjust.problem.estimates import Estimates
from adjust.problem.images import adjusted_image, adjusted_lens
from adjust.problem.parameter import Parameter

DIRECTIONS = 12
RADII = 8  # at which the standard deviation of the distortion is evaluated, out to the outermost target


@dataclass(frozen=True)
class LensReach:
    """Extent of the observations of a lens.

    Attributes
    ----------
    radius_mm : from the principal point to the outermost target.
    corner_mm : from the principal point to the farthest corner of the frame; nan if the frame is unknown.
    sigma_um, corner_sigma_um : largest standard deviation of the distortion within the radius, and at the corner; nan
        where the lens forms no image.
    frame_mm : lower left and upper right corner of the frame; None if unknown.
    """

    radius_mm: float
    corner_mm: float
    sigma_um: float
    corner_sigma_um: float
    frame_mm: Corners | None

    @property
    def share(self) -> float:
        return min(self.radius_mm / self.corner_mm, 1.0)


def lens_reach(estimates: Estimates, camera: Camera, frame_mm: tuple[float, float] | None) -> LensReach | None:
    """Find the extent of the observations of a lens; None without observations. frame_mm: width and height, centred on
    the origin if there are fiducial marks, else from the top left corner of the scan.
    """
    network = estimates.network
    observations = network.observations
    farthest = [0.0]
    principal_point = np.array([estimates.value(Parameter.interior(camera.name, each)) for each in ("x0", "y0")])
    of_image = np.array(observations.image)
    for image in network.images:
        rows = np.flatnonzero((of_image == image.name) & ~observations.is_fiducial)
        if image.camera == camera.name and len(rows):
            camera_mm = adjusted_image(estimates, image.name).camera_from_comparator(observations.xy_mm[rows])
            farthest.append(float(np.linalg.norm(camera_mm - principal_point, axis=1).max()))
    radius_mm = max(farthest)
    if radius_mm == 0.0:
        return None
    corner_mm, corners = np.nan, None if frame_mm is None else camera.frame_corners(frame_mm)
    if corners is not None:
        corner_mm = float(np.linalg.norm(np.abs(np.array(corners) - principal_point).max(axis=0)))
    within = max(_sigma_um(estimates, camera, radius) for radius in np.linspace(0.0, radius_mm, RADII + 1)[1:])
    beyond = _sigma_um(estimates, camera, corner_mm) if np.isfinite(corner_mm) else np.nan
    return LensReach(radius_mm, corner_mm, within, beyond, corners)


def _sigma_um(estimates: Estimates, camera: Camera, radius_mm: float) -> float:
    """The largest standard deviation of the distortion at a radius, over all directions and along any."""
    lens = adjusted_lens(estimates, camera.name)
    unknowns = [Parameter.interior(camera.name, each) for each in lens.quantities if each not in ("x0", "y0")]
    angles = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
    places = radius_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    moved = lens.displacement(places)
    if not moved.imaged.all():
        return np.nan
    by = moved.by_unknowns_um
    variances = np.linalg.eigvalsh(by @ estimates.cofactor_of(unknowns) @ by.swapaxes(1, 2))[:, -1]
    return estimates.sigma0 * float(np.sqrt(max(variances.max(), 0.0)))

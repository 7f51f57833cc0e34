"""Images without an orientation: leave them out of the adjustment and try them again afterwards."""

from collections import defaultdict
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter
from adjust.solution.result import Adjustment

FITTING = 3.0  # in sigma0 of the others: largest rms standardised residual of an image that agrees with them
CONTRADICTING = 0.5  # share of v'Pv above which one image explains why the iteration does not converge
FEWEST_RAYS = 2  # rays needed for a point without priors


def leave_out(network: Network, frames: Collection[str]) -> Network | None:
    """Remove some frames and what only they show from a network; None where no more than half of it would remain."""
    left = {image.frame for image in network.images if image.frame not in frames}
    if len(left) <= len(frames):
        return None
    images, observations = tuple(image for image in network.images if image.frame in left), network.observations
    names = {image.name for image in images}
    shown = np.isin(observations.image, list(names))
    frames_of = defaultdict[str, set[str]](set)
    for row in np.flatnonzero(shown & ~observations.is_fiducial):
        frames_of[observations.point[row]].add(network.image_by_name[observations.image[row]].frame)
    located = {
        point.id
        for point in network.points
        if len(frames_of[point.id]) >= (FEWEST_RAYS if point.X is point.Y is point.Z is None else 1)
    }
    kept = shown & (observations.is_fiducial | np.isin(observations.point, list(located)))
    return replace(
        network,
        images=images,
        points=tuple(
            point for point in network.points if point.id in located or point.id not in network.observed_points
        ),
        observations=observations.only(np.flatnonzero(kept)),
        distances=tuple(each for each in network.distances if {each.start, each.end} <= located | names),
    )


def adopt_lens(network: Network, result: Adjustment) -> Network:
    """Replace the cameras of a network by those adjusted from a part of it."""
    used = {image.camera for image in result.network.images} - result.network.idle_cameras
    cameras = (_adopt_camera(camera, result) if camera.name in used else camera for camera in network.cameras)
    return replace(network, cameras=tuple(cameras))


def fitting(result: Adjustment, frames: Collection[str], sigma0: float) -> set[str]:
    """Select the frames whose residuals agree with sigma0 of the others."""
    of_mark = np.array([image.frame for image in result.network.images])[result.network.image_numbers]
    excess = (np.nan_to_num(result.residuals.w) ** 2).sum(axis=1) - 2.0 * (FITTING * sigma0) ** 2
    return {frame for frame in frames if (result.weights * excess)[of_mark == frame].sum() <= 0.0}


def contradicting_image(result: Adjustment) -> dict[str, str]:
    """The frame that causes most of v'Pv in an adjustment without a solution, with the reason; empty if none does."""
    image_numbers = result.network.image_numbers
    frames = np.array([image.frame for image in result.network.images])[image_numbers]
    # Without a solution there are no standardised residuals.
    variances = np.diagonal(result.network.observations.covariance_mm2, axis1=1, axis2=2)
    share = (result.residuals.v_mm**2 / variances).sum(axis=1)
    names, of_frame = np.unique(frames, return_inverse=True)
    sums = np.bincount(of_frame, share)
    worst = int(np.argmax(sums))
    if len(names) < 2 or sums[worst] <= CONTRADICTING * sums.sum():
        return {}
    point = result.network.observations.point[int(np.argmax(np.where(of_frame == worst, share, -1.0)))]
    return {
        str(
            names[worst]
        ): f"with image {names[worst]} the iteration does not converge, without it it does. Its largest "
        f"residual is that of {point}. Check the point numbers of this image."
    }


def _adopt_camera(camera: Camera, result: Adjustment) -> Camera:
    def adopted(name: str, given: Prior | None) -> Prior:
        return Prior(result.value(Parameter.interior(camera.name, name)), np.inf if given is None else given.sigma)

    of = camera.distortion
    parameters = {
        name: adopted(name, of.parameters[name]) for name in parameter_names(of.family) if name in of.parameters
    }
    return replace(
        camera,
        principal_distance_mm=adopted("c", camera.principal_distance_mm),
        x0_mm=adopted("x0", camera.x0_mm),
        y0_mm=adopted("y0", camera.y0_mm),
        distortion=replace(of, parameters=parameters),
    )

"""Images left out of an adjustment: those that contradict the others, and what remains without them."""

from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from adjust.errors import AdjustmentError
from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Network
from adjust.problem.parameter import Parameter, shortened
from adjust.solution.result import Adjustment

FITTING = 3.0  # in sigma0 of the others: largest rms standardised residual of an image that agrees with them
CONTRADICTING = 0.5  # share in the squared errors of a camera's images above which some may contradict the others
TRIED = 3  # images left out in turn, those with the largest errors
WHOLE = 3.0  # in given standard deviations: median residual of an image that contradicts the others as a whole
MOST_CONTRADICTING = 1 / 3  # fraction of the images
FEWEST_RAYS = 2  # rays needed for a point without priors
NAMED = 5  # images named in a message


def leave_out_contradicting(
    network: Network,
    first: Adjustment,
    adjusted: Callable[[Network], Adjustment],
    agrees: Callable[[Adjustment], bool],
    several: bool,
) -> Adjustment:
    """Leave out the frames that contradict the others, one after another, until these agree; `first` if they never do.

    Each has to dominate the residuals of its camera with all its marks. Where several may do so together, that one of
    the TRIED worst is left out without which the residuals are smallest.
    """
    most, out, last = MOST_CONTRADICTING * len({image.frame for image in network.images}), list[str](), first
    while not agrees(last):
        worst, trials = _frames_by_error(last, several)[: TRIED if several else 1], dict[str, Adjustment]()
        for each in worst if len(out) + 1 <= most else ():
            rest = leave_out(network, [*out, each.name])
            if rest is not None and (several or (each.share > CONTRADICTING and each.is_whole)):
                with suppress(AdjustmentError):
                    trials[each.name] = adjusted(rest)
        if not trials:
            return first
        out.append(min(trials, key=lambda name: float(np.mean(trials[name].residuals.v_mm ** 2))))
        last = trials[out[-1]]
    return replace(last, left_out={**first.left_out, **last.left_out, **dict.fromkeys(out, _reason(first, last, out))})


def is_of_some_frames(result: Adjustment, camera: str) -> bool:
    """Whether so many frames of a camera as may contradict the others have most of its errors."""
    shares = [each.share for each in _frames_by_error(result, predicted=True) if each.camera == camera]
    return sum(shares[: int(MOST_CONTRADICTING * len(shares))]) > CONTRADICTING


class _FrameError(NamedTuple):
    """Squared error of a frame and its share in that of its camera; whether it is of most of its marks."""

    square: float
    name: str
    camera: str
    share: float
    is_whole: bool


def _frames_by_error(result: Adjustment, predicted: bool) -> list[_FrameError]:
    """Frames by their errors as the others predict them, or by their v'Pv, the largest first."""
    network = result.network
    camera_of = {image.frame: image.camera for image in network.images}
    numbers, of_frame = np.unique(network.frame_numbers[network.image_numbers], return_inverse=True)
    names, cameras = np.array([*camera_of.items()])[numbers].T
    variances = np.diagonal(network.observations.covariance_mm2, axis1=1, axis2=2)
    squares = (result.residuals.v_mm**2 / variances).sum(axis=1)  # without a solution no residual is standardised
    of_others = result.prediction_errors(len(numbers)) if predicted else None
    errors = np.bincount(of_frame, squares) if of_others is None else of_others
    shares = errors / np.maximum((cameras[:, None] == cameras) @ errors, 1e-300)
    medians = np.array([np.median(squares[of_frame == frame]) for frame in range(len(numbers))])
    # Without a solution the worst mark is as large as any.
    is_whole = np.full(len(numbers), not result.converged) | (medians >= 2.0 * WHOLE**2)
    columns = (each.tolist() for each in (errors, names, cameras, shares, is_whole))
    return sorted(map(_FrameError._make, zip(*columns, strict=True)), reverse=True)


def _reason(first: Adjustment, last: Adjustment, frames: Sequence[str]) -> str:
    """Sentence on frames without which the others agree, or the adjustment converges."""
    who, shown = f"image{'s' * (len(frames) > 1)} {shortened(sorted(frames), NAMED)}", first.network.observations
    if not first.converged:
        own = np.isin(shown.image, frames)
        row = int(np.argmax(np.where(own, np.linalg.norm(first.residuals.v_mm, axis=1), -1.0)))
        return (
            f"with {who} the iteration does not converge, without it does. The largest residual there is that of "
            f"{shown.point[row]} in {shown.image[row]}. Check the point numbers."
        )
    falls = [first.unmodelled_mm[camera] / sigma_mm for camera, sigma_mm in last.unmodelled_mm.items() if sigma_mm]
    times = f": unmodelled errors are {max(falls):.2g} times smaller then" if falls else ""
    return (
        f"all marks of {who} contradict the other images, which agree without them{times}. Possible are another size, "
        "pitch, zoom or camera than given, a crop, another print of the board, or wrong point numbers."
    )


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

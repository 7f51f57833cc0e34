"""Bare problem that the adjustment and OpenCV can both solve, and its solution in OpenCV's model."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.lens_conversion import convert_lens
from adjust.problem.camera import Camera
from adjust.problem.estimates import adjusted_image, adjusted_lens, adjusted_places
from adjust.problem.network import EXTERIOR_NAMES, Approximations, Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.problem.parameter import Parameter
from adjust.solution.result import Adjustment
from pipeline.opencv_check.opencv_calibration import (
    FISHEYE,
    Freedom,
    OpenCVPoints,
    can_begin,
    fixed_distortion,
    opencv_values,
)
from pipeline.types import Array

GROSS_WEIGHT = 0.5  # observations with a lower robust weight are left out
# OpenCV's counterparts of each family's parameters. Parameters without one are held at their adjusted values.
COUNTERPARTS: Mapping[str, Mapping[str, str]] = {
    "none": {},
    "torlegard": {"k3": "k1", "k5": "k2", "k7": "k3", "p1": "p1", "p2": "p2"},
    "brown": {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p1", "p2": "p2", "b1": "fy"},
    "australis": {"k1": "k1", "k2": "k2", "k3": "k3", "p1": "p1", "p2": "p2", "b1": "fy"},
    "aicon": {"a1": "k1", "a2": "k2", "a3": "k3", "b1": "p2", "b2": "p1", "c1": "fy"},
    "opencv": {name: name for name in parameter_names("opencv") if name not in ("b1", "b2")} | {"b1": "fy"},
    FISHEYE: {name: name for name in parameter_names(FISHEYE) if name not in ("b1", "b2")}
    | {"b1": "fy", "b2": "alpha"},
}
# Parameters that OpenCV estimates only together.
FREE_TOGETHER = (frozenset({"p1", "p2"}), frozenset({"s1", "s2", "s3", "s4"}), frozenset({"tau_x", "tau_y"}))


@dataclass(frozen=True)
class BareProblem:
    """The bare problem for the adjustment (network, approximations) and for OpenCV (images, freedom).

    Attributes
    ----------
    sigma_mm : common standard deviation of all image coordinates.
    sigma_spread : ratio of the largest to the smallest standard deviation of the observations.
    gross : number of observations with a low robust weight.
    uncertain_points : number of object points that their priors do not fix.
    left_out : images with too few points for OpenCV.
    """

    network: Network
    approximations: Approximations
    images: tuple[OpenCVPoints, ...]
    freedom: Freedom
    sigma_mm: float
    sigma_spread: float
    gross: int
    uncertain_points: int
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class ConvertedSolution:
    """A solution in OpenCV's model.

    Attributes
    ----------
    parameters : (n,) in the order of `model_names`.
    sigmas : (n,) a-priori standard deviations.
    residual_mm : difference of the two lenses over the image, rms per point.
    """

    parameters: Array
    sigmas: Array
    residual_mm: float


def bare_problem(adjustment: Adjustment, camera_name: str) -> BareProblem:
    """Bare problem of one camera with all images for which OpenCV can find initial values, at the adjusted values."""
    network = adjustment.network
    camera = network.camera_by_name[camera_name]
    names = [image.name for image in network.images if image.camera == camera_name]
    shown = {name: _image_points(adjustment, name) for name in names}
    usable = [name for name in names if can_begin(shown[name][0].xyz)]
    sigmas = np.concatenate([shown[name][1] for name in usable]) if usable else np.ones(1)
    sigma_mm = float(np.sqrt((sigmas**2).mean()))
    points = sorted({point for name in usable for point in shown[name][2]})
    places = adjusted_places(adjustment, points)
    free = free_parameters(camera)
    counterparts = {"c": "fx", "x0": "cx", "y0": "cy", **COUNTERPARTS[camera.distortion.family]}
    values = {
        name: adjustment.value(Parameter.interior(camera_name, name))
        for name in ("c", "x0", "y0", *parameter_names(camera.distortion.family))
    }
    return BareProblem(
        network=Network(
            cameras=(free_camera(camera, camera.distortion, values, free),),
            images=tuple(Image(name, camera_name, "none") for name in usable),
            points=tuple(
                ObjectPoint(point, *(Prior(value, 0.0) for value in xyz))
                for point, xyz in zip(points, places.tolist(), strict=True)
            ),
            observations=_observations({name: shown[name] for name in usable}, sigma_mm),
        ),
        approximations=Approximations(
            interior={camera_name: np.array([values["c"], values["x0"], values["y0"]])},
            exterior={
                name: adjustment.values_of(Parameter.exterior(frame, each) for each in EXTERIOR_NAMES)
                for name in usable
                for frame in [adjustment.network.image_by_name[name].frame]
            },
            transformation={name: np.zeros(0) for name in usable},
            points=dict(zip(points, places, strict=True)),
        ),
        images=tuple(shown[name][0] for name in usable),
        freedom=Freedom(tuple(counterpart for name, counterpart in counterparts.items() if name in free)),
        sigma_mm=sigma_mm,
        sigma_spread=float(sigmas.max() / sigmas.min()),
        gross=sum(
            network.observations.image[row] in shown and not network.observations.is_fiducial[row]
            for row in np.flatnonzero(adjustment.weights < GROSS_WEIGHT)
        ),
        uncertain_points=sum(
            any(prior is None or prior.sigma != 0 for prior in network.point_by_id[point].priors) for point in points
        ),
        left_out=tuple(name for name in names if name not in usable),
    )


def free_parameters(camera: Camera) -> set[str]:
    """c, x0, y0 and the distortion parameters that are estimated in the bare problem, with or without priors."""
    given = camera.distortion.parameters
    counterparts = COUNTERPARTS[camera.distortion.family]
    free = {name for name in counterparts if name in given and given[name].sigma > 0}
    for together in FREE_TOGETHER:
        own = {name for name, counterpart in counterparts.items() if counterpart in together}
        if free & own:
            free |= own
    interior = {"c": camera.principal_distance_mm, "x0": camera.x0_mm, "y0": camera.y0_mm}
    free |= {name for name, prior in interior.items() if prior is None or prior.sigma > 0}
    return free | ({"b1"} if camera.distortion.family == FISHEYE and "c" in free else set())


def free_camera(camera: Camera, distortion: Distortion, values: Mapping[str, float], free: set[str]) -> Camera:
    """Camera of a distortion model without fiducials and priors. free: parameters that are estimated."""
    priors = {name: Prior(value, np.inf if name in free else 0.0) for name, value in values.items()}
    parameters = {name: priors[name] for name in parameter_names(distortion.family)}
    return replace(
        camera,
        principal_distance_mm=priors["c"],
        x0_mm=priors["x0"],
        y0_mm=priors["y0"],
        distortion=replace(distortion, parameters=parameters),
        fiducials={},
    )


def _image_points(adjustment: Adjustment, image: str) -> tuple[OpenCVPoints, Array, list[str]]:
    """Observations of an image in the camera frame, their standard deviations (n,), and the names of the points."""
    network, observations = adjustment.network, adjustment.network.observations
    weights = adjustment.weights if len(adjustment.weights) else np.ones(len(observations))
    is_own = network.image_numbers == network.images.index(network.image_by_name[image])
    rows = np.flatnonzero(is_own & ~observations.is_fiducial & (weights >= GROSS_WEIGHT))
    points = [observations.point[row] for row in rows]
    model = adjusted_image(adjustment, image)
    xyz = adjusted_places(adjustment, points)
    gradient = model.camera_by_comparator(observations.xy_mm[rows])
    covariance = gradient @ observations.covariance_mm2[rows] @ gradient.swapaxes(1, 2)
    sigmas = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return OpenCVPoints(image, xyz, model.camera_from_comparator(observations.xy_mm[rows])), sigmas, points


def _observations(shown: Mapping[str, tuple[OpenCVPoints, Array, list[str]]], sigma_mm: float) -> Observations:
    rows = [(name, point) for name, (_, _, points) in shown.items() for point in points]
    kinds: list[ObservationKind] = ["target"] * len(rows)
    coordinates = [image.xy_mm for image, _, _ in shown.values()]
    return Observations(
        tuple(image for image, _ in rows),
        tuple(point for _, point in rows),
        tuple(kinds),
        np.concatenate([*coordinates, np.zeros((0, 2))]),
        np.tile(sigma_mm**2 * np.eye(2), (len(rows), 1, 1)),
    )


def convert_solution(problem: BareProblem, solved: Adjustment) -> ConvertedSolution:
    """Convert a solution to OpenCV's model. Raises AdjustmentError where the fit fails."""
    camera = problem.network.cameras[0]
    family = camera.distortion.family
    lens = adjusted_lens(solved, camera.name)
    own = [Parameter.interior(camera.name, each) for each in lens.quantities]
    if family == FISHEYE or (family == "opencv" and lens.parameters[-1] == 0.0):  # without shear: OpenCV's own model
        parameters, by_lens = opencv_values(lens)
        variances = np.diag(by_lens @ solved.cofactor_of(own) @ by_lens.T)
        return ConvertedSolution(parameters, np.sqrt(np.maximum(variances, 0.0)), 0.0)
    observed = problem.network.observations.xy_mm
    corners_mm = np.array([observed.min(axis=0), observed.max(axis=0)])
    if family == "opencv":  # all but the shear b2, which cv2.calibrateCamera does not model
        begun = dict(zip(lens.quantities[3:], lens.parameters.tolist(), strict=True)) | {"b2": 0.0}
        whole = convert_lens(lens, fixed_distortion(begun), corners_mm, ("b1",))
    else:
        affinity = ["b1"] if "fy" in COUNTERPARTS[family].values() else []
        whole = convert_lens(lens, Distortion("opencv"), corners_mm, ("k1", "k2", "p1", "p2", "k3", *affinity))
    # OpenCV holds the parameters that it does not estimate at these values. Its standard deviations assume them.
    model = fixed_distortion(dict(zip(whole.lens.quantities[3:], whole.lens.parameters.tolist(), strict=True)))
    known = replace(lens, covariance=solved.cofactor_of(own))
    free = convert_lens(known, model, corners_mm, problem.freedom.distortion, held=problem.freedom.held_interior)
    parameters, _ = opencv_values(whole.lens)
    _, by_lens = opencv_values(free.lens)
    covariance = by_lens @ free.lens.covariance @ by_lens.T
    return ConvertedSolution(parameters, np.sqrt(np.maximum(np.diag(covariance), 0.0)), whole.rms_mm)

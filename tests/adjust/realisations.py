"""The reference cases without errors, and as often as one likes with others: observations and priors drawn anew."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from reference_cases import CAMERA, Case, case_approximations, case_network, own_name

from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.condition_equations import computed_observations
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.problem.problem import number

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Exact:
    """A network whose observations and priors have no errors, where it starts, and the truth by the unknowns' names."""

    network: Network
    start: Approximations
    truth: Mapping[str, float]


def exact(case: Case, fiducial_sigma_mm: float | None = None, control_sigma: float | None = None) -> Exact:
    """A case without errors; with other standard deviations of the given fiducials and of the given coordinates.

    The observations are those that the functions give for the truth; the reference adjustments prove the functions.
    """
    truth = {own_name(name): value for name, value in case["truth"].items()}
    start = case_approximations(case, dict(case["truth"]))
    given = case_network(case)
    points = tuple(_true_point(point, truth, control_sigma) for point in given.points)
    network = replace(given, cameras=(_true_camera(given.cameras[0], truth, fiducial_sigma_mm),), points=points)
    problem = number(network, start)
    unknowns = problem.unknowns
    values = np.array(
        [truth.get(key.text, value) for key, value in zip(unknowns.parameters, unknowns.start, strict=True)]
    )
    problem = replace(problem, unknowns=replace(unknowns, start=values))
    xy_mm = computed_observations(problem, problem.start())
    assert xy_mm is not None
    return Exact(replace(network, observations=replace(network.observations, xy_mm=xy_mm)), start, truth)


def _true_camera(camera: Camera, truth: Mapping[str, float], fiducial_sigma_mm: float | None) -> Camera:
    def place(id_: str, mark: Fiducial) -> Fiducial:
        of = f"FID.{CAMERA}.{id_}."
        return Fiducial(
            _true(truth, of + "x", mark.x_mm, fiducial_sigma_mm), _true(truth, of + "y", mark.y_mm, fiducial_sigma_mm)
        )

    interior = f"IO.{CAMERA}."
    parameters = {name: _true(truth, interior + name, prior) for name, prior in camera.distortion.parameters.items()}
    assert camera.principal_distance_mm
    assert camera.x0_mm
    assert camera.y0_mm
    return replace(
        camera,
        principal_distance_mm=_true(truth, interior + "c", camera.principal_distance_mm),
        x0_mm=_true(truth, interior + "x0", camera.x0_mm),
        y0_mm=_true(truth, interior + "y0", camera.y0_mm),
        distortion=replace(camera.distortion, parameters=parameters),
        fiducials={id_: place(id_, mark) for id_, mark in camera.fiducials.items()},
    )


def _true_point(point: ObjectPoint, truth: Mapping[str, float], sigma: float | None) -> ObjectPoint:
    priors = zip("XYZ", (point.X, point.Y, point.Z), strict=True)
    return ObjectPoint(
        point.id, *(prior and _true(truth, f"PT.{point.id}.{axis}", prior, sigma) for axis, prior in priors)
    )


def _true(truth: Mapping[str, float], name: str, prior: Prior, sigma: float | None = None) -> Prior:
    return Prior(truth.get(name, prior.value), prior.sigma if sigma is None else sigma)


def realisation(without_errors: Network, rng: np.random.Generator) -> Network:
    """The network with normally distributed errors in everything that has a standard deviation."""
    observations = without_errors.observations
    root = np.linalg.cholesky(observations.covariance_mm2)
    noise = (root @ rng.normal(size=(len(observations), 2, 1)))[..., 0]

    def draw(prior: Prior | None) -> Prior | None:
        if prior is None or not 0.0 < prior.sigma < np.inf:
            return prior
        return Prior(prior.value + prior.sigma * rng.normal(), prior.sigma)

    def drawn_camera(camera: Camera) -> Camera:
        parameters = {name: draw(prior) or prior for name, prior in camera.distortion.parameters.items()}
        return replace(
            camera,
            principal_distance_mm=draw(camera.principal_distance_mm),
            x0_mm=draw(camera.x0_mm),
            y0_mm=draw(camera.y0_mm),
            distortion=replace(camera.distortion, parameters=parameters),
            fiducials={
                id_: Fiducial(draw(mark.x_mm) or mark.x_mm, draw(mark.y_mm) or mark.y_mm)
                for id_, mark in camera.fiducials.items()
            },
        )

    return replace(
        without_errors,
        cameras=tuple(drawn_camera(camera) for camera in without_errors.cameras),
        points=tuple(
            ObjectPoint(point.id, draw(point.X), draw(point.Y), draw(point.Z)) for point in without_errors.points
        ),
        observations=replace(observations, xy_mm=observations.xy_mm + noise),
    )

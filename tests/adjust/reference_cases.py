"""The reference adjustments of an independent implementation as networks; without errors, or with others."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from networks import map_priors
from numpy.typing import NDArray

from adjust import Camera, Distortion, Fiducial, Observations, Prior
from adjust.functional_model.families import parameter_names
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.condition_equations import computed_observations
from adjust.problem.network import EXTERIOR_NAMES, Approximations, Image, Network, ObjectPoint
from adjust.problem.problem import number

CASES = Path(__file__).parents[1] / "cases"
CAMERA = "K"
DROPPED: dict[str, set[int]] = {  # pseudo-observations, by their words in the file
    "F5-F9": {5, 6, 7, 8, 9},
    "F5-F8": {5, 6, 7, 8},
    "F5,F6": {5, 6},
    "F5,F6,F9": {5, 6, 9},
    "F7,F8": {7, 8},
    "F7-F9": {7, 8, 9},
    "F9": {9},
    "none": set(),
}
CAUSES = {  # what a direction's leading parameter has the message say
    "F:tx": "shift together in x'",
    "F:ty": "shift together in y'",
    "F:rot": "turn together",
    "F:scale": "grow together",
    "F:aff": "stretch in x'",
    "F:shear": "shear",
    "IO.x0": "x0' of camera",
    "IO.y0": "y0' of camera",
    "IO.c": "principal distance of camera",
}

Case = dict[str, Any]


def load(name: str) -> Case:
    """A case's file."""
    case: Case = json.loads((CASES / f"{name}.json").read_text())
    return case


def case_network(case: Case) -> Network:
    """The case's input. Names are the case's numbers."""
    given = case["input"]
    interior = dict(zip(case["io_names"], map(prior, given["io_obs"], given["io_sigma"]), strict=True))
    family = case["distortion"]
    camera = Camera(
        CAMERA,
        interior["c"],
        interior["x0"],
        interior["y0"],
        Distortion(
            family,
            {name: interior[name] for name in parameter_names(family)},
            decentering="paper" if case["decentering_mode"] == "paper" else "reduced",
            r0_mm=case["r0"] * (100.0 if family == "juhl" else 1.0),
        ),
        {
            str(i): Fiducial(*map(prior, values, sigmas))
            for i, (values, sigmas) in enumerate(zip(given["fid_obs"], given["fid_sigma"], strict=True), 1)
        },
    )
    points = tuple(
        ObjectPoint(str(i), *map(prior, values, sigmas))
        for i, (values, sigmas) in enumerate(zip(given["pts_obs"], given["pts_sigma"], strict=True), 1)
    )
    rows = [(*row, "target") for row in given["obs"]] + [(*row, "fiducial") for row in given["fobs"]]
    images = tuple(Image(str(i), CAMERA, case["transform"]) for i in sorted({row[0] for row in rows}))
    observations = Observations(
        tuple(str(row[0]) for row in rows),
        tuple(str(row[1]) for row in rows),
        tuple(row[6] for row in rows),
        np.array([row[2:4] for row in rows]),
        np.array([np.diag(np.square(row[4:6])) for row in rows]),
    )
    return Network((camera,), images, points, observations)


def prior(value: float, sigma: float | None) -> Prior:
    return Prior(value, np.inf if sigma is None else sigma)


def case_approximations(case: Case, values: dict[str, float]) -> Approximations:
    """Approximations by the case's own names; a given value where the case names none."""
    given = case["input"]
    network = case_network(case)
    interior = dict(zip(case["io_names"], given["io_obs"], strict=True))
    start = {f"PT{i}.{a}": x for i, xyz in enumerate(given["pts_obs"], 1) for a, x in zip("XYZ", xyz, strict=True)}
    start |= {f"IO.{name}": value for name, value in interior.items()} | values
    return Approximations(
        interior={CAMERA: np.array([start[f"IO.{name}"] for name in ("c", "x0", "y0")])},
        exterior={
            image.name: np.array([start[f"EO{image.name}.{e}"] for e in EXTERIOR_NAMES]) for image in network.images
        },
        transformation={
            image.name: np.array([start[f"T{image.name}.{p}"] for p in film_parameter_names(case["transform"])])
            for image in network.images
        },
        points={point.id: np.array([start[f"PT{point.id}.{axis}"] for axis in "XYZ"]) for point in network.points},
    )


def own_name(name: str) -> str:
    """A case's name of an unknown in the names of this project: `EO1.X0` is `EO.1.X0`."""
    owner, quantity = name.split(".")
    for prefix in ("EO", "PT", "FID", "T"):
        if owner.startswith(prefix) and owner != "IO":
            number = owner.removeprefix(prefix)
            return f"FID.{CAMERA}.{number}.{quantity}" if prefix == "FID" else f"{prefix}.{number}.{quantity}"
    return f"IO.{CAMERA}.{quantity}"


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Exact:
    """A network whose observations and priors have no errors, where it starts, and the truth by the unknowns' names."""

    network: Network
    start: Approximations
    truth: Mapping[str, float]


def exact(case: Case) -> Exact:
    """A case without errors.

    The observations are those that the functions give for the truth; the reference adjustments prove the functions.
    """
    truth = {own_name(name): value for name, value in case["truth"].items()}
    start = case_approximations(case, dict(case["truth"]))
    network = map_priors(case_network(case), lambda name, prior: replace(prior, value=truth.get(name, prior.value)))
    problem = number(network, start)
    unknowns = problem.unknowns
    values = np.array([truth.get(key.text, x) for key, x in zip(unknowns.parameters, unknowns.start, strict=True)])
    problem = replace(problem, unknowns=replace(unknowns, start=values))
    xy_mm = computed_observations(problem, problem.start())
    assert xy_mm is not None
    return Exact(replace(network, observations=replace(network.observations, xy_mm=xy_mm)), start, truth)


def realisation(without_errors: Network, rng: np.random.Generator) -> Network:
    """The network with normally distributed errors in everything that has a standard deviation."""
    observations = without_errors.observations
    root = np.linalg.cholesky(observations.covariance_mm2)
    noise = (root @ rng.normal(size=(len(observations), 2, 1)))[..., 0]

    def draw(_: str, prior: Prior) -> Prior:
        is_random = 0.0 < prior.sigma < np.inf
        return Prior(prior.value + prior.sigma * rng.normal(), prior.sigma) if is_random else prior

    return replace(
        map_priors(without_errors, draw), observations=replace(observations, xy_mm=observations.xy_mm + noise)
    )

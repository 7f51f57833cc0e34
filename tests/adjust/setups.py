"""Simulated networks of every geometry, without errors, their truth as their approximations.

Unless it says otherwise there is no prior on any fiducial, on c, x0', y0' (F5 to F9 dropped).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import pi

import numpy as np
from numpy.typing import NDArray
from simulated import STATIONS, Truth, field_points, simulated

from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Approximations, Network, ObjectPoint, Transformation

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

FREE = np.inf
HEIGHT = 1500.0
LEVEL_STATIONS = ((0.0, 0.0, HEIGHT), (500.0, 100.0, HEIGHT), (-480.0, 80.0, HEIGHT), (60.0, 520.0, HEIGHT))
CONVERGENT = ((0.01, -0.02, 0.1), (-0.08, 0.36, 1.6), (-0.05, -0.29, 3.0), (-0.35, 0.03, -1.5))
TILTED = (0.2, 0.1, 0.3)
KNOWN, UNKNOWN, HEIGHTS = (0.0, 0.0, 0.0), (FREE, FREE, FREE), (FREE, FREE, 0.0)


@dataclass(frozen=True)
class Setup:
    """What a network is made of. sigma: of X, Y, Z of every point; prior: of c, x0', y0' and of all fiducials."""

    attitudes: tuple[Triple, ...]
    stations: tuple[Triple, ...] = STATIONS
    relief: float = 200.0
    sigma: Triple = KNOWN
    prior: float = FREE
    kind: Transformation = "affine"
    points: Array | None = None
    distortion: Mapping[str, float] = field(default_factory=dict)  # standard deviations; all values are 0
    noise: bool = False

    def network(self) -> tuple[Network, Approximations]:
        """The network, and the truth as its approximations."""
        parameters = dict.fromkeys(self.distortion, 0.0)
        truth = Truth(
            stations=self.stations,
            attitudes=self.attitudes,
            mirrored=(False,) * len(self.stations),
            distortion=parameters,
        )
        points = self.points
        if points is None:
            points = field_points(np.random.default_rng(1), 14, relief=1.0) * [1.0, 1.0, self.relief]
        rng = np.random.default_rng(0)
        network, start = simulated(rng, truth, self.kind, points, 0.0, dict(self.distortion), self.noise)
        exact = {
            f"f{i}": np.array([*station, *attitude])
            for i, (station, attitude) in enumerate(zip(self.stations, self.attitudes, strict=True))
        }
        network = replace(network, points=tuple(set_sigma(point, self.sigma) for point in network.points))
        return set_prior(network, self.prior), replace(start, exterior=exact)


def set_sigma(point: ObjectPoint, sigma: Triple) -> ObjectPoint:
    x, y, z = (
        None if prior is None else replace(prior, sigma=s)
        for prior, s in zip((point.X, point.Y, point.Z), sigma, strict=True)
    )
    return replace(point, X=x, Y=y, Z=z)


def set_prior(network: Network, sigma: float) -> Network:
    """All of F5 to F9 with one standard deviation."""
    return give_values(network, dict.fromkeys(("x", "y", "c", "x0", "y0"), sigma))


def give_values(network: Network, sigmas: Mapping[str, float], marks: int | None = None) -> Network:
    """Standard deviations for c, x0, y0 and for x and y of the first (None: all) fiducials, the others as they are."""
    camera = network.cameras[0]
    fiducials = {
        id_: Fiducial(
            replace(mark.x_mm, sigma=sigmas.get("x", mark.x_mm.sigma)),
            replace(mark.y_mm, sigma=sigmas.get("y", mark.y_mm.sigma)),
        )
        for id_, mark in list(camera.fiducials.items())[:marks]
    }
    changed = Camera(
        camera.name,
        _draw_given(camera.principal_distance_mm, sigmas.get("c")),
        _draw_given(camera.x0_mm, sigmas.get("x0")),
        _draw_given(camera.y0_mm, sigmas.get("y0")),
        camera.distortion,
        {**camera.fiducials, **fiducials},
    )
    return replace(network, cameras=(changed,))


def _draw_given(prior: Prior | None, sigma: float | None) -> Prior | None:
    return prior if prior is None or sigma is None else replace(prior, sigma=sigma)


def vertical(*kappas: float) -> tuple[Triple, ...]:
    return tuple((0.0, 0.0, kappa) for kappa in kappas)


def quarters(omega: float = 0.0, phi: float = 0.0, kappa: float = 0.0) -> tuple[Triple, ...]:
    """Four images turned by 0, 90, 180 and 270 degrees about their common axis."""
    return tuple((omega, phi, kappa + turn) for turn in (0.0, pi / 2, pi, -pi / 2))

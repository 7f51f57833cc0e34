"""Juhl's field, of which only the heights are known, in tilted frames that nobody has oriented."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import Truth, field_points, simulated

from adjust.functional_model.lens import Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.network import Network, ObjectPoint
from adjust.solution.adjustment import adjust
from adjust.solution.options import Options

TILT = 0.14  # rad
AROUND = [2 * np.pi * i / 8 for i in range(8)]
TILTED = Truth(
    stations=tuple((200 * np.cos(a), 200 * np.sin(a), 1500.0 if i % 2 else 1125.0) for i, a in enumerate(AROUND)),
    attitudes=tuple((-TILT * np.sin(a), TILT * np.cos(a), i * np.pi / 2) for i, a in enumerate(AROUND)),
    mirrored=8 * (False,),
)


def make_heights_network(seed: int) -> Network:
    """100 points of a field with 8 m of relief, their heights known to 2 cm, and a camera of which little is known."""
    rng = np.random.default_rng(seed)
    free = dict.fromkeys(TILTED.distortion, np.inf)
    network, _ = simulated(rng, TILTED, points=field_points(rng, 100, relief=8.0), free=free)
    points = tuple(ObjectPoint(p.id, None, None, replace(p.Z, sigma=0.02)) for p in network.points if p.Z is not None)
    camera = network.cameras[0]
    distortion = replace(camera.distortion, parameters={name: Prior(0.0, np.inf) for name in TILTED.distortion})
    interior = replace(
        camera,
        principal_distance_mm=Prior(152.6, np.inf),
        x0_mm=Prior(0.0, np.inf),
        y0_mm=Prior(0.0, np.inf),
        distortion=distortion,
    )
    return replace(network, points=points, cameras=(interior,))


@pytest.mark.study
@pytest.mark.parametrize("seed", [1, 2])
def test_tilted_frames_are_oriented_and_calibrate_the_camera(seed: int) -> None:
    """They start as if they looked straight down, where heights do not tell the principal distance."""
    network = make_heights_network(seed)
    result = adjust(network, approximate(network), Options(datum="minimal"))
    assert result.converged
    assert result.sigma0 < 1.1
    c, sigma = result.value("IO.K.c"), result.sigma("IO.K.c")
    assert abs(c - TILTED.c) < 4 * sigma < 4.0

"""Two marks of one image that bear each other's numbers, found from nothing."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import field_points, simulated

from adjust.initial_values.approximations import approximate
from adjust.problem.network import Network, ObjectPoint
from adjust.solution.adjustment import adjust

POINTS = 14


def exchanged(network: Network, image: str, first: str, second: str) -> Network:
    observations = network.observations
    other = {(image, first): second, (image, second): first}
    rows = zip(observations.image, observations.point, observations.kind, strict=True)
    points = tuple(point if kind == "fiducial" else other.get((name, point), point) for name, point, kind in rows)
    return replace(network, observations=replace(observations, point=points))


@pytest.mark.study
@pytest.mark.parametrize(("seed", "known"), [(8, POINTS), (7, 7)])
def test_exchanged_numbers_are_named_whether_the_adjustment_ends_or_not(seed: int, known: int) -> None:
    rng = np.random.default_rng(seed)
    network, _ = simulated(rng, points=field_points(rng, POINTS), free={"k3": np.inf})
    points = tuple(
        point if int(point.id) < known else ObjectPoint(point.id, None, None, None) for point in network.points
    )
    image, pair = f"f{rng.integers(4)}", sorted(map(str, rng.choice(POINTS, 2, replace=False)))
    network = exchanged(replace(network, points=points), image, *pair)
    result = adjust(network, approximate(network))
    named = [warning for warning in result.warnings if "swapped" in warning]
    assert named == [
        f"The points {pair[0]} and {pair[1]} of image {image} each lie where the other is expected: their numbers may "
        f"be swapped."
    ]


@pytest.mark.study
def test_an_image_that_starts_upside_down_has_no_swapped_numbers() -> None:
    rng = np.random.default_rng(1)
    network, start = simulated(rng, points=field_points(rng, POINTS))
    exterior = {name: elements.copy() for name, elements in start.exterior.items()}
    exterior["f1"][5] += np.pi
    result = adjust(network, replace(start, exterior=exterior))
    assert not [warning for warning in result.warnings if "swapped" in warning]

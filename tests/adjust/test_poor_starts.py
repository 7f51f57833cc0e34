"""Poor starts: attitudes wrong by 30 degrees, stations by 20 % of their distance, in random directions."""

from dataclasses import replace

import numpy as np
import pytest
from reference_cases import case_approximations, case_network, load, own_name
from simulated import Truth, field_points, simulated
from studies import parametrize_with_studies

from adjust.functional_model.lens import Prior
from adjust.functional_model.rotation import angles_from_rotation, rotation_from_angles, rotation_from_vector
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.solution.adjustment import Options, adjust

ANGLE = np.deg2rad(30.0)
SHARE = 0.2


def spoilt(start: Approximations, distance: float, rng: np.random.Generator) -> Approximations:
    exterior = {}
    for name, values in start.exterior.items():
        axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        rotation = rotation_from_vector(ANGLE * axis) @ rotation_from_angles(values[3:])
        exterior[name] = np.concatenate([values[:3] + SHARE * distance * way, angles_from_rotation(rotation)])
    return replace(start, exterior=exterior)


@pytest.mark.parametrize("seed", range(4))
def test_five_images_on_control(seed: int) -> None:
    case = load("i_five_images_affine_reduced")
    start = case_approximations(case, case["input"]["initial_approximations"])
    result = adjust(case_network(case), spoilt(start, 1500.0, np.random.default_rng(seed)))
    assert result.converged
    for name, row in case["result"]["parameters"].items():
        difference = result.value(own_name(name)) - row["value"]
        if name.endswith(("omega", "phi", "kappa")):
            difference = float(np.angle(np.exp(1j * difference)))  # a whole turn is no difference
        assert abs(difference) < 1e-6 * row["std_apriori"]


def heights_only() -> tuple[Network, Approximations]:
    """Three frames crosswise over relief of which the heights are known to 5 cm: c goes with the scale, in a valley."""
    rng = np.random.default_rng(5)
    stations = ((0.0, 0.0, 1500.0), (400.0, 30.0, 1480.0), (30.0, 420.0, 1520.0))
    attitudes = ((0.01, -0.02, 0.0), (-0.02, 0.01, 1.5), (0.02, 0.02, 3.0))
    truth = Truth(distortion={}, stations=stations, attitudes=attitudes, mirrored=(False,) * 3)
    network, start = simulated(rng, truth, points=field_points(rng, 25))
    points = tuple(
        ObjectPoint(each.id, *(None, None), Prior(each.Z.value, 0.05)) for each in network.points if each.Z is not None
    )
    return replace(network, points=points), start


@pytest.mark.study
def test_a_curved_valley_is_followed() -> None:
    """Nine of ten starts reach the minimum; before steps were bent along the valley, one of six did."""
    network, start = heights_only()
    options = Options(datum="minimal")
    right = adjust(network, start, options)
    assert right.converged
    reached = 0
    for seed in range(4):
        result = adjust(network, spoilt(start, 1500.0, np.random.default_rng(seed)), options)
        reached += result.converged and result.vpv == pytest.approx(right.vpv, rel=1e-6)
        assert result.converged or result.warnings
    assert reached >= 3


def test_the_history_tells_what_was_done() -> None:
    network, start = heights_only()
    result = adjust(network, spoilt(start, 1500.0, np.random.default_rng(0)), Options(datum="minimal"))
    sums = [step.vpv for step in result.history]
    assert sums == sorted(sums, reverse=True) or max(np.diff(sums)) < 1e-6 * sums[-1]
    assert any(step.damping > 0.0 and step.attempts > 1 for step in result.history)
    assert result.history[-1].damping == 0.0


@parametrize_with_studies("sigma", [2.0, np.inf], quick=(1,))
def test_a_principal_distance_that_is_a_guess_is_found_from_the_images(sigma: float) -> None:
    """Twice the true one, and known no better than that: it is sought where the iteration does not come to rest."""
    rng = np.random.default_rng(1)
    network, _ = simulated(rng, points=field_points(rng, 40))
    camera = network.cameras[0]
    assert camera.principal_distance_mm is not None
    guess = 2.0 * camera.principal_distance_mm.value
    for known, converges in ((sigma * guess, True), (0.05 * guess, False)):
        guessed = replace(camera, principal_distance_mm=Prior(guess, known))
        result = adjust(replace(network, cameras=(guessed,)), options=Options(iteration_limit=7))
        assert result.converged == converges
        assert any("repeated with approximations" in remark for remark in result.remarks) == converges

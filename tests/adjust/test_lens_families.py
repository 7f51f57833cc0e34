"""The families of industrial bundles, Zhang's skew and OpenCV's fisheye, against the renderer's own projections."""

from dataclasses import replace

import numpy as np
import pytest
from lens_networks import LENSES, R0_MM, make_network
from studies import parametrize_with_studies

from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.initial_values.approximations import approximate
from adjust.solution.adjustment import adjust


@pytest.mark.parametrize("name", list(LENSES))
def test_a_lens_is_found_from_exact_images(name: str) -> None:
    """From start values that the points give, with nothing known of the lens."""
    network = make_network(name)
    found = adjust(network, approximate(network))
    assert found.converged
    assert found.vpv < 1e-10
    c, values = LENSES[name]
    for each, value in (values | {"c": c, "x0": 0.12, "y0": -0.07}).items():
        assert abs(found.value(f"IO.L.{each}") - value) < 1e-4 * found.sigma(f"IO.L.{each}") / found.sigma0, each


@parametrize_with_studies("name", list(LENSES))
def test_nothing_but_the_points_has_to_be_known(name: str) -> None:
    """Neither c nor the principal point; of the fisheye points up to 80 degrees off the axis."""
    network = make_network(name, np.random.default_rng(1))
    camera = replace(network.cameras[0], principal_distance_mm=None, x0_mm=None, y0_mm=None)
    network = replace(network, cameras=(camera,))
    start = approximate(network)
    assert start.interior["L"][0] == pytest.approx(LENSES[name][0], rel=0.1)
    found = adjust(network, start)
    assert found.converged
    assert 0.9 < found.sigma0 < 1.1
    assert abs(found.value("IO.L.c") - LENSES[name][0]) < 4.0 * found.sigma("IO.L.c")


@parametrize_with_studies("name", list(LENSES), quick=(3,))
def test_claimed_sigmas_are_realised(name: str) -> None:
    """Twelve sets of errors, pooled over the parameters: chi-square per degree of freedom within three sigmas of 1."""
    rng = np.random.default_rng(5)
    first = make_network(name)
    c, values = LENSES[name]
    true = values | {"c": c, "x0": 0.12, "y0": -0.07}
    start = approximate(first)
    squares = []
    for _ in range(12):
        found = adjust(make_network(name, rng), start)
        names = [f"IO.L.{each}" for each in true]
        errors = np.array([found.value(each) for each in names]) - list(true.values())
        squares.append(errors @ np.linalg.solve(found.cofactor_of(names), errors))
    count = len(true) * len(squares)
    assert abs(np.sum(squares) / count - 1.0) < 3.0 * np.sqrt(2.0 / count)


def test_r0_balances_the_ideal_point_and_not_the_observed_one() -> None:
    """On the circle r0 about the principal point the ideal point stays; aicon adds what torlegard subtracts."""
    turn = np.linspace(0.0, 2.0 * np.pi, 7)
    rays = R0_MM / 30.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    interior, values = np.array([30.0, 0.5, -0.2]), np.array([-1e-4, 1e-7, 0.0, 0.0, 0.0, 0.0, 0.0])
    balanced = Distortion("aicon", r0_mm=R0_MM)
    projected, found = Lens(balanced, interior, values).camera_from_ray(rays)
    assert found.all()
    np.testing.assert_allclose(projected, interior[1:] + 30.0 * rays, atol=1e-13)
    inner, _ = Lens(balanced, interior, values).camera_from_ray(0.5 * rays)
    half = R0_MM / 2.0
    expected = half * (1.0 - 1e-4 * (half**2 - R0_MM**2) + 1e-7 * (half**4 - R0_MM**4))
    np.testing.assert_allclose(np.linalg.norm(inner - interior[1:], axis=1), expected, rtol=1e-13)


def test_a_fisheye_without_parameters_is_equidistant() -> None:
    """All parameters 0 are no pinhole; what no ray below 90 degrees makes is told."""
    interior, zero = np.array([10.0, 0.0, 0.0]), np.zeros(len(parameter_names("opencv_fisheye")))
    angles = np.radians([0.0, 30.0, 60.0, 85.0])
    at = np.column_stack([10.0 * angles, np.zeros(4)])
    ideal, found = Lens(Distortion("opencv_fisheye"), interior, zero).ideal_from_observed(at)
    assert found.all()
    np.testing.assert_allclose(ideal[:, 0], 10.0 * np.tan(angles), rtol=1e-12)
    beyond = np.array([[16.0, 0.0], [3.0, 0.0]])
    assert list(Lens(Distortion("opencv_fisheye"), interior, zero).folded_over(beyond)) == [True, False]


def test_every_parameter_has_its_unit_and_a_ladder_names_only_parameters() -> None:
    for name in ("torlegard", "brown", "australis", "aicon", "opencv", "opencv_fisheye", "juhl", "ebner"):
        of = family(name)
        assert all(of.unit(each) for each in of.parameters)
        assert {each for rung in of.ladder for each in rung.split()} <= set(of.parameters)

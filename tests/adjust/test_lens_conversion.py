"""Lenses in the parameters of another family, and families against the renderer's own projections."""

from dataclasses import replace

import numpy as np
import pytest
from networks import LENS_R0_MM, LENSES, lens_network
from numpy.typing import NDArray
from studies import parametrize_with_studies

from adjust import Adjustment, AdjustmentError, Network, adjust, approximate
from adjust.functional_model.families import family, parameter_names
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.lens_conversion import convert_lens

Array = NDArray[np.float64]

CORNERS_MM = np.array([[-17.0, -12.0], [18.0, 12.0]])
INTERIOR = np.array([28.8, 0.05, -0.03])


def values(family: str, **given: float) -> Array:
    return np.array([given.get(name, 0.0) for name in parameter_names(family)])


def test_another_r0_is_another_principal_distance() -> None:
    """c, k and p are divided by 1 + k3 r0² + k5 r0⁴: exact, and the derivative by k3 is that of the quotient."""
    r0, k3, k5, p1 = 9.0, 1.1e-4, -2e-7, 4e-6
    lens = values("torlegard", k3=k3, k5=k5, p1=p1)
    found = convert_lens(Lens(Distortion("torlegard", r0_mm=r0), INTERIOR, lens), Distortion("brown"), CORNERS_MM)
    s = 1 + k3 * r0**2 + k5 * r0**4
    assert found.is_same
    assert found.estimated == ("k1", "k2", "p1")
    np.testing.assert_allclose(found.lens.interior, [INTERIOR[0] / s, *INTERIOR[1:]], rtol=1e-12)
    np.testing.assert_allclose(found.lens.parameters, values("brown", k1=k3 / s, k2=k5 / s, p1=p1 / s), rtol=1e-8)
    c_by_k3 = -INTERIOR[0] * r0**2 / s**2
    assert found.by_source[0, 3] == pytest.approx(c_by_k3, rel=1e-7)
    assert found.by_source[3, 3] == pytest.approx(1 / s - k3 * r0**2 / s**2, rel=1e-6)


@pytest.mark.parametrize("name", ["torlegard", "opencv"])
def test_parameters_of_a_lens_without_distortion_are_zero(name: str) -> None:
    source = Lens(Distortion("none"), np.array([INTERIOR[0], 0.0, 0.0]), np.zeros(0))
    target = Distortion(name, r0_mm=9.0 if family(name).needs == "r0_mm" else 0.0)
    found = convert_lens(source, target, CORNERS_MM, parameter_names(name))
    assert found.lens.values[0] == pytest.approx(INTERIOR[0], rel=1e-12)
    assert not found.lens.values[1:].any()


def test_what_is_0_and_uncertain_has_its_counterpart() -> None:
    """A lens that is yet to be found: k3 and p1 free at 0 are k1 and p1, and nothing else."""
    lens = Lens(Distortion("torlegard"), INTERIOR, np.zeros(7))
    found = convert_lens(lens, Distortion("brown"), CORNERS_MM, None, ("k3", "p1"))
    assert found.is_same
    assert found.estimated == ("k1", "p1")
    assert convert_lens(lens, Distortion("brown"), CORNERS_MM).estimated == ()


def test_covariance_is_that_of_the_same_data_adjusted_in_the_other_family() -> None:
    """Values to a millionth of their sigmas, the covariance to a millionth: aicon with r0 as OpenCV's."""
    rng = np.random.default_rng(2)
    first = adjust_network(lens_network("aicon", rng), ("a1", "a2", "b1", "b2"))
    network = first.network
    other = replace(network, cameras=(replace(network.cameras[0], distortion=Distortion("opencv")),))
    second = adjust_network(other, ("k1", "k2", "p1", "p2"))
    source, names = quantities("aicon"), quantities("opencv")
    values = np.array([first.value(name) for name in source])
    lens = Lens(network.cameras[0].distortion, values[:3], values[3:], first.cofactor_of(source))
    found = convert_lens(lens, Distortion("opencv"), CORNERS_MM)
    assert found.is_same
    covariance, expected = found.lens.covariance, second.cofactor_of(names)
    sigmas = np.sqrt(np.diag(expected))
    free = sigmas > 0.0
    assert (np.abs(found.lens.values - [second.value(n) for n in names])[free]
            < 1e-4 * sigmas[free]).all()  # fmt: skip
    scale = np.outer(sigmas, sigmas)[np.ix_(free, free)]
    np.testing.assert_allclose(covariance[np.ix_(free, free)] / scale, expected[np.ix_(free, free)] / scale, atol=1e-5)
    assert not covariance[~free].any()


def quantities(family: str) -> list[str]:
    return [f"IO.L.{name}" for name in ("c", "x0", "y0", *parameter_names(family))]


def adjust_network(network: Network, free: tuple[str, ...]) -> Adjustment:
    camera = network.cameras[0]
    distortion = replace(camera.distortion, parameters={name: Prior(0.0, np.inf) for name in free})
    network = replace(network, cameras=(replace(camera, distortion=distortion),))
    return adjust(network, approximate(network))


def test_what_no_family_takes_is_known_by_its_residual() -> None:
    """A correction of the observed point as one of the ideal point: 0.7 um are left."""
    lens = values("torlegard", k3=1e-4, k5=-1e-7, p1=5e-6, p2=-8e-6)
    found = convert_lens(Lens(Distortion("torlegard"), INTERIOR, lens), Distortion("opencv"), CORNERS_MM)
    assert not found.is_same
    assert 1e-4 < found.largest_mm < 1e-3
    assert found.rms_mm < found.largest_mm


@pytest.mark.parametrize("source", list(LENSES))
@pytest.mark.parametrize("target", ["torlegard", "brown", "australis", "aicon", "opencv", "opencv_fisheye"])
def test_every_lens_comes_near_every_other(source: str, target: str) -> None:
    c, given = LENSES[source]
    lens = values(source, **given), np.array([c, 0.12, -0.07])
    into = Distortion(target, r0_mm=10.0 if target in ("torlegard", "aicon") else 0.0)
    found = convert_lens(Lens(Distortion(source, r0_mm=13.0), lens[1], lens[0]), into, CORNERS_MM / 2.0)
    assert found.largest_mm < 0.03


def test_a_frame_without_an_image_is_refused() -> None:
    with pytest.raises(AdjustmentError, match="makes no image at"):
        convert_lens(
            Lens(Distortion("opencv_fisheye"), np.array([5.0, 0.0, 0.0]), np.zeros(6)), Distortion("opencv"), CORNERS_MM
        )
    with pytest.raises(ValueError, match="brown has no parameter a1"):
        convert_lens(Lens(Distortion("opencv"), INTERIOR, np.zeros(16)), Distortion("brown"), CORNERS_MM, ("a1",))


@parametrize_with_studies("name", list(LENSES))
def test_nothing_but_the_points_has_to_be_known(name: str) -> None:
    """Neither c nor the principal point; of the fisheye points up to 80 degrees off the axis."""
    network = lens_network(name, np.random.default_rng(1))
    camera = replace(network.cameras[0], principal_distance_mm=None, x0_mm=None, y0_mm=None)
    network = replace(network, cameras=(camera,))
    start = approximate(network)
    assert start.interior["L"][0] == pytest.approx(LENSES[name][0], rel=0.1)
    found = adjust(network, start)
    assert found.converged
    assert 0.9 < found.sigma0 < 1.1
    assert abs(found.value("IO.L.c") - LENSES[name][0]) < 4.0 * found.sigma("IO.L.c")


def test_r0_balances_the_ideal_point_and_not_the_observed_one() -> None:
    """On the circle r0 about the principal point the ideal point stays; aicon adds what torlegard subtracts."""
    turn = np.linspace(0.0, 2.0 * np.pi, 7)
    rays = LENS_R0_MM / 30.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    interior, values = np.array([30.0, 0.5, -0.2]), np.array([-1e-4, 1e-7, 0.0, 0.0, 0.0, 0.0, 0.0])
    balanced = Distortion("aicon", r0_mm=LENS_R0_MM)
    projected, found = Lens(balanced, interior, values).camera_from_ray(rays)
    assert found.all()
    np.testing.assert_allclose(projected, interior[1:] + 30.0 * rays, atol=1e-13)
    inner, _ = Lens(balanced, interior, values).camera_from_ray(0.5 * rays)
    half = LENS_R0_MM / 2.0
    expected = half * (1.0 - 1e-4 * (half**2 - LENS_R0_MM**2) + 1e-7 * (half**4 - LENS_R0_MM**4))
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

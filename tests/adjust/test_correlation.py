"""High correlations, parameters that trade off, and significance, against other ways to the same figures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from networks import (
    CONVERGENT,
    FREE,
    Setup,
    Truth,
    digital_network,
    field_points,
    give_values,
    given_interior,
    set_camera,
    set_observations,
    simulated,
    vertical,
    view_rows,
)
from scipy import stats
from studies import parametrize_with_studies

from adjust import Adjustment, AdjustmentError, Camera, Network, ObjectPoint, adjust
from adjust.functional_model.lens import Distortion, Prior
from adjust.quality.significance import SignificanceTest

LOW_RELIEF = Setup(vertical(0.0, 0.0, 0.0, 0.0), relief=20.0, prior=1.0)


def test_flying_height_and_principal_distance_are_reported() -> None:
    """With fixed fiducials nothing is taken out: the correlation is that of the cofactor matrix."""
    network, start = LOW_RELIEF.network()
    result = adjust(give_values(network, {"x": 0.0, "y": 0.0}), start)
    first = result.correlations[0]
    assert [each.text for each in first.parameters] == ["IO.K.c", "EO.*.Z0"]
    assert "c of camera K and Z0 of all images are correlated by" in first.cause
    assert "flying height and principal distance are correlated" in first.cause
    assert "tilted in different directions" in first.remedy
    rho = []
    for i in range(4):
        q = result.cofactor_of(["IO.K.c", f"EO.f{i}.Z0"])
        rho.append(q[0, 1] / np.sqrt(q[0, 0] * q[1, 1]))
    assert first.rho == pytest.approx(max(rho, key=abs), rel=1e-9)


def test_powers_of_the_radius_and_decentering_are_reported() -> None:
    setup = Setup(CONVERGENT, prior=1.0, distortion={"k3": FREE, "k5": FREE, "k7": FREE})
    found = adjust(*setup.network()).correlations
    powers = [each for each in found if each.parameters[0].text.startswith("IO.K.k")]
    assert powers
    assert all("neighbouring powers of the radius" in each.cause for each in powers)
    assert all("Compare the curve" in each.remedy for each in powers)


EIGHT = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
TWELVE = (*EIGHT, "s1", "s2", "s3", "s4")
FOURTEEN = (*TWELVE, "tau_x", "tau_y")
SIGMA_MM = 0.001
FRAME_MM = np.array([12.8, 9.6])
C, CX, CY = 10.0, 6.41, 4.77
LENS = np.array([-0.25, 0.08, 4e-4, -3e-4, 0.01])


def board_network(
    seed: int, free: tuple[str, ...], noise: bool = True, images: int = 8, tilts_deg: tuple[float, float] = (20.0, 40.0)
) -> Network:
    """A board of 54 corners in the middle of pictures of 1280 x 960 pixels of 0.01 mm, noise of a tenth of one."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    board = 25.0 * np.stack([x.ravel() - 4.0, y.ravel() - 2.5, np.zeros(54)], axis=1)
    matrix = np.array([[C, 0.0, CX], [0.0, C, CY], [0.0, 0.0, 1.0]])
    view = []
    for i in range(images):
        azimuth, tilt = 2.0 * np.pi * i / images, np.radians(rng.uniform(*tilts_deg))
        turn = np.array([np.cos(azimuth) * tilt, np.sin(azimuth) * tilt, 0.2 * rng.normal()])
        shift = np.array([*rng.uniform(-60.0, 60.0, 2), rng.uniform(550.0, 800.0)])
        view.append(cv2.projectPoints(board, turn, shift, matrix, LENS)[0].reshape(-1, 2) * [1.0, -1.0])
    views = np.array(view)
    interior = given_interior((1.02 * C, FRAME_MM[0] / 2.0, -FRAME_MM[1] / 2.0), np.inf)
    camera = Camera("cam", *interior, Distortion("opencv", {name: Prior(0.0, np.inf) for name in free}))
    points = {f"c{k}": xyz for k, xyz in enumerate(board)}
    rows = view_rows(views + noise * rng.normal(0.0, SIGMA_MM, views.shape), list(points))
    return digital_network(camera, rows, points, SIGMA_MM)


@parametrize_with_studies("free", [EIGHT, TWELVE, FOURTEEN], quick=(0, 1))
@parametrize_with_studies("seed", [0, 1])
def test_an_ordinary_board_gives_a_rational_lens(seed: int, free: tuple[str, ...]) -> None:
    result = adjust(board_network(seed, free))
    assert result.converged
    assert result.iterations < 60
    # With thin prisms free, too, the principal point lies in a curved valley: it is up to 3.4 of its claims off.
    assert all(free != EIGHT and "hardly tell" in warning for warning in result.warnings)
    (note,) = result.notes
    assert "k4" in note
    assert "of camera cam cannot be separated" in note
    assert abs(result.sigma0 - 1.0) < 0.1
    assert abs(result.value("IO.cam.c") - C) < 4.0 * result.sigma("IO.cam.c")
    assert result.sigma("IO.cam.k4") > 0.3
    # Two directions or more of the eight parameters are none that the observations determine.
    observed = 2 * len(result.network.observations)
    assert observed - result.unknowns < result.redundancy <= observed - result.unknowns + 4 + len(free) - len(EIGHT)
    assert result.redundancy == pytest.approx(result.residuals.redundancy.sum(), abs=1.0)


def test_how_far_out_the_lens_is_known() -> None:
    """The outermost corner of the board against the picture's, and a standard deviation that grows beyond."""
    result = adjust(board_network(0, EIGHT))
    camera = result.network.cameras[0]
    reach = result.lens_reach(camera, (float(FRAME_MM[0]), float(FRAME_MM[1])))
    assert reach is not None
    x0, y0 = result.value("IO.cam.x0"), result.value("IO.cam.y0")
    offsets = result.network.observations.xy_mm - (x0, y0)
    assert reach.radius_mm == pytest.approx(np.hypot(*offsets.T).max())
    assert reach.corner_mm == pytest.approx(max(np.hypot(x - x0, y - y0) for x in (0.0, 12.8) for y in (0.0, -9.6)))
    assert reach.share == pytest.approx(reach.radius_mm / reach.corner_mm)
    assert reach.sigma_um < 3.0
    assert not reach.corner_sigma_um < 20.0
    unknown = result.lens_reach(camera)
    assert unknown is not None
    assert np.isnan(unknown.corner_mm)


def test_a_principal_distance_that_nearly_parallel_images_hardly_tell_is_named() -> None:
    """It went out as calibrated, known to a tenth of itself, without a word."""
    result = adjust(board_network(0, EIGHT[:2], tilts_deg=(0.5, 1.5)))
    share = result.sigma("IO.cam.c") / result.value("IO.cam.c")
    assert share > 0.05
    (warning,) = result.warnings
    assert "The principal distance of camera cam is determined to " in warning
    assert warning.endswith("points at other heights; or give it with its standard deviation.")
    assert not adjust(board_network(0, EIGHT[:2])).warnings


@pytest.mark.parametrize(("direction", "where"), [((1.0, 0.5, 0.0), "on one line"), ((0.0, 0.0, 0.0), "at one place")])
def test_known_points_without_extent_tell_no_principal_distance(direction: tuple[float, ...], where: str) -> None:
    network = board_network(0, ())
    points = tuple(
        ObjectPoint(point.id, *(Prior(20.0 + k * each) for each in direction)) for k, point in enumerate(network.points)
    )
    unknown = set_camera(network, principal_distance_mm=None)
    with pytest.raises(AdjustmentError, match=f"all known points that they show lie {where}"):
        adjust(replace(unknown, points=points))


@pytest.mark.study
def test_a_lens_without_radial_terms_is_advised_no_denominator() -> None:
    (found,) = adjust(board_network(0, (), images=4)).explanations[:1]
    assert found.remedy == 'Free k1, k2, k3 under [distortion.sigma] of the camera ("free").'


def test_coordinates_that_count_from_the_middle_of_the_picture_have_its_corners_about_it() -> None:
    """They were taken to begin at the first pixel: the lens seemed to be known half as far."""
    network = board_network(0, EIGHT[:5])
    zero, moved_mm = Prior(0.0, np.inf), network.observations.xy_mm - FRAME_MM / 2.0 * [1.0, -1.0]
    centred = set_observations(set_camera(network, x0_mm=zero, y0_mm=zero), xy_mm=moved_mm)
    frame_mm = (float(FRAME_MM[0]), float(FRAME_MM[1]))
    one, other = (adjust(each).lens_reach(each.cameras[0], frame_mm) for each in (network, centred))
    assert one is not None
    assert other is not None
    assert other.share == pytest.approx(one.share, rel=1e-6)
    assert other.frame_mm == ((-6.4, -4.8), (6.4, 4.8))


def free_all(network: Network, *names: str) -> Network:
    unknown = dict.fromkeys(names, Prior(0.0, np.inf))
    return set_camera(network, distortion=replace(network.cameras[0].distortion, parameters=unknown))


def significance_tests(adjustment: Adjustment) -> dict[str, SignificanceTest]:
    camera = adjustment.network.cameras[0].name
    return {test.name: test for test in adjustment.significance["interior", camera]}


def test_a_pairs_f_test_is_that_of_the_adjustments_with_and_without_it() -> None:
    """F from the covariance (Wald) against F from both sums of squares: equal as far as the model is linear."""
    truth = Truth(distortion={"k3": 1.5e-7, "p1": 1e-7, "p2": -6e-8})
    network, start = simulated(np.random.default_rng(4), truth, points=field_points(np.random.default_rng(1), 20))
    both, without = (adjust(free_all(network, *names), start) for names in (("k3", "p1", "p2"), ("k3",)))
    f = (without.vpv - both.vpv) / 2 / both.sigma0**2
    pair = significance_tests(both)["decentering"]
    assert pair.parameters == ("p1", "p2")
    assert pair.statistic == pytest.approx(f, rel=1e-3)
    assert pair.p == pytest.approx(stats.f.sf(f, 2, both.redundancy), rel=1e-2)
    single = significance_tests(both)["p1"]
    assert single.p == pytest.approx(2.0 * stats.t.sf(abs(single.statistic), both.redundancy), rel=1e-6)


def test_what_is_fixed_or_without_a_solution_is_not_tested() -> None:
    network, start = simulated(np.random.default_rng(2))
    result = adjust(network, start)
    assert set(significance_tests(result)) == {"c", "x0", "y0"}
    assert replace(result, termination="diverged").significance == {}


def test_sets_are_tested_by_degree() -> None:
    truth = Truth(family="ebner", distortion={f"b{i}": 0.0 for i in range(3, 13)} | {"b7": 0.06})
    points = field_points(np.random.default_rng(1), 40)
    free = dict.fromkeys(truth.distortion, np.inf)
    network, start = simulated(np.random.default_rng(3), truth, points=points, free=free)
    result = adjust(network, start)
    tests = {name: test for name, test in significance_tests(result).items() if test.is_group}
    assert list(tests) == ["degree 2", "degree 3", "degree 4", "all"]
    assert tests["degree 3"].significant
    assert tests["all"].significant
    assert not tests["degree 4"].significant

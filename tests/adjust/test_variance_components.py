"""Standard deviations, sigma0 and variance components against dense formulas and simulation."""

from dataclasses import replace

import numpy as np
import pytest
from networks import (
    FILM_CAMERA,
    DrawnFrames,
    Truth,
    add_errors,
    draw_frames,
    field_points,
    observation_row,
    orient,
    set_camera,
    set_observations,
    simulated,
)
from numpy.typing import NDArray
from reference_cases import exact, load, realisation
from studies import parametrize_with_studies

from adjust import Adjustment, Camera, Fiducial, Options, Prior, adjust
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.transformation import Film, film_parameter_names
from adjust.least_squares.equations import Numbering, prior_root_weights
from adjust.least_squares.iteration import linearise
from adjust.problem.condition_equations import compute, derivatives
from adjust.problem.estimates import GivenGroup, adjusted_image
from adjust.problem.network import Approximations, Exterior, Network
from adjust.problem.problem import State, number
from adjust.quality.fiducial_corrections import common_transformation, corrections_to_given
from adjust.quality.tested import robust_weights

Array = NDArray[np.float64]


def test_redundancy_is_what_a_residual_shows_of_an_error() -> None:
    """An error in one coordinate appears in its residual times minus the redundancy number, correlations included."""
    network, start = simulated(np.random.default_rng(3), noise=False)
    row = observation_row(network, "target", "f2", "7")
    covariance = network.observations.covariance_mm2.copy()
    covariance[row] = 0.004**2 * np.array([[1.0, 0.6], [0.6, 2.0]])
    for axis in (0, 1):
        spoilt = add_errors(set_observations(network, covariance_mm2=covariance), {row: 1e-4 * np.eye(2)[axis]})
        result = adjust(spoilt, start)
        shown = -result.residuals.v_mm[row, axis] / 1e-4
        assert shown == pytest.approx(result.residuals.redundancy[row, axis], rel=1e-4)


def test_rms_is_per_axis() -> None:
    """Per point it would be larger by the root of two."""
    network, start = simulated(np.random.default_rng(4))
    result = adjust(network, start)
    targets = np.array([kind == "target" for kind in network.observations.kind])
    v_um = 1000.0 * result.residuals.v_mm[targets]
    group = result.groups["target"]
    assert group.rms_x_um == pytest.approx(np.sqrt((v_um[:, 0] ** 2).mean()))
    per_point = np.sqrt((v_um**2).sum(axis=1).mean())
    assert np.hypot(group.rms_x_um, group.rms_y_um) == pytest.approx(per_point)


def test_variance_components_find_the_variances() -> None:
    """Targets twice as bad as claimed, fiducials half as bad; 1 is what a right claim gives."""
    rng = np.random.default_rng(8)
    network, start = simulated(rng, points=field_points(rng, 40))
    fiducial = np.array([kind == "fiducial" for kind in network.observations.kind])
    claimed = network.observations.covariance_mm2 * np.where(fiducial, 4.0, 0.25)[:, None, None]
    result = adjust(set_observations(network, covariance_mm2=claimed), start, Options(variance_components=True))
    assert result.converged
    assert result.variance_factors["target"] == pytest.approx(4.0, rel=0.3)
    assert result.variance_factors["fiducial"] == pytest.approx(0.25, rel=0.6)
    assert result.groups["target"].sigma0 == pytest.approx(1.0, abs=2e-3)
    assert result.groups["fiducial"].sigma0 == pytest.approx(1.0, abs=2e-3)


def test_an_affine_on_three_marks_has_no_check() -> None:
    """Its residuals are 0 because they must be: the redundancy says so, and neither sigma0 nor w pretend otherwise."""
    truth = Truth()
    network, start = simulated(np.random.default_rng(10), truth, points=np.zeros((0, 3)))
    camera = network.cameras[0]
    marks = {
        id_: Fiducial(Prior(m.x_mm.value), Prior(m.y_mm.value)) for id_, m in camera.fiducials.items() if id_ in "123"
    }
    known = Camera("K", Prior(truth.c), Prior(truth.x0), Prior(truth.y0), camera.distortion, marks)
    rows = network.observations
    three = rows.only(np.flatnonzero([point in marks for point in rows.point]))
    network = orient(network, {f"f{i}": Exterior(values, np.zeros(6)) for i, values in enumerate(truth.exteriors)})
    result = adjust(replace(network, cameras=(known,), observations=three), start)
    assert result.converged
    assert result.redundancy == 0
    assert result.sigma0 == 1.0
    group = result.groups["fiducial"]
    assert group.redundancy == pytest.approx(0.0, abs=1e-9)
    assert group.rms_x_um == pytest.approx(0.0, abs=1e-6)
    assert group.sigma0 == 0.0
    assert (result.residuals.w == 0.0).all()


def test_the_redescending_weights_are_the_published_ones() -> None:
    """Yang, Song and Xu 2002, k = 2 and K = 4.5: 1, then k / t ((K - t) / (K - k))², then none. t of an observation is
    over the scale that the median gives: of a pair of normally distributed errors that is sqrt(ln 2)."""
    t = np.array([0.5, 1.9, 2.5, 3.25, 4.4, 6.0])
    ordinary = np.full(101, np.log(2.0))
    weights = robust_weights(2.0 * np.array([*ordinary, *t**2]), np.full(107, 2), 107, "igg3")[101:]
    expected = [1.0, 1.0, 0.8 * 0.64, 2.0 / 3.25 * 0.25, 2.0 / 4.4 * 0.0016, 0.0]
    np.testing.assert_allclose(weights, expected, rtol=1e-9, atol=1e-11)
    huber = robust_weights(2.0 * np.array([*ordinary, *t**2]), np.full(107, 2), 107, "huber")[101:]
    np.testing.assert_allclose(huber, [1.0, 1.0, 0.8, 2.0 / 3.25, 2.0 / 4.4, 1.0 / 3.0], rtol=1e-9)


GROUPS = ("target", "fiducial", "control", "datum")


def checkable(seed: int, points: int) -> tuple[Network, Approximations]:
    rng = np.random.default_rng(seed)
    return simulated(rng, points=field_points(rng, points), fiducial_sigma=0.01, point_sigma=0.05)


def dense_sigmas(network: Network, start: Approximations, result: Adjustment) -> list[float]:
    """Twice the inverse of Helmert's matrix, from the dense matrix I - B N^-1 B' of all whitened rows."""
    problem = number(network, start)
    factors = np.array([result.variance_factors[group] for group in GROUPS])
    kinds = np.where(problem.is_fiducial, factors[1], factors[0])
    names = np.array([each.text for each in problem.unknowns.parameters])
    sigma = problem.unknowns.sigma.copy()
    sigma[np.char.startswith(names, "PT.")] *= np.sqrt(factors[2])
    sigma[np.char.startswith(names, "FID.")] *= np.sqrt(factors[3])
    problem = replace(problem, unknowns=replace(problem.unknowns, sigma=sigma))
    numbering = Numbering(problem)
    state = State(result.values, rotation_from_angles(result.values[problem.exterior[:, 3:]]))
    at = linearise(numbering, network.observations.covariance_mm2 * kinds[:, None, None], state)
    assert at is not None
    computed = compute(problem, state)
    assert computed is not None
    full = derivatives(problem, state, computed)
    matrix = np.zeros((len(network.observations), 2, len(sigma) + 1))
    whitened = np.linalg.solve(at.rows.root, full.by_unknowns)
    for row, columns in enumerate(problem.columns):
        matrix[row][:, columns] = whitened[row]
    weights = prior_root_weights(numbering)
    given = np.flatnonzero(weights > 0.0)
    rows = np.vstack([matrix[..., numbering.free].reshape(-1, len(numbering.free)), np.diag(weights)[given]])
    q, _ = np.linalg.qr(rows / np.linalg.norm(rows, axis=0))
    hidden = np.eye(len(rows)) - q @ q.T
    prefixes = np.array([name.split(".")[0] for name in names[numbering.free][given]])
    observed = np.repeat(np.where(problem.is_fiducial, "fiducial", "target"), 2)
    group = np.concatenate([observed, [{"PT": "control", "FID": "datum"}.get(p, p) for p in prefixes]])
    helmert = [[(hidden[np.ix_(group == a, group == b)] ** 2).sum() for b in GROUPS] for a in GROUPS]
    return list(factors * np.sqrt(2.0 * np.diag(np.linalg.inv(np.array(helmert)))))


@parametrize_with_studies("points", [8, 20])  # images, then points are eliminated first
def test_the_sigmas_of_the_factors_are_helmerts(points: int) -> None:
    network, start = checkable(3, points)
    result = adjust(network, start, Options(variance_components=GROUPS))
    assert result.converged
    expected = dense_sigmas(network, start, result)
    assert [result.variance_sigmas[group] for group in GROUPS] == pytest.approx(expected, rel=1e-3)
    for group in GROUPS:
        assert result.groups[group].sigma0 == pytest.approx(1.0, abs=2e-3)


def test_a_group_without_redundancy_keeps_its_variance() -> None:
    network, start = simulated(np.random.default_rng(3))
    result = adjust(network, start, Options(variance_components=("target", "interior")))
    assert result.variance_factors.keys() == {"target", "interior"}
    assert result.variance_sigmas["target"] > 0.0
    few = adjust(network, start, Options(variance_components=("exterior", "tie")))
    assert few.variance_factors == {}


@pytest.mark.study
def test_a_gross_error_that_is_left_out_does_not_spoil_the_factors() -> None:
    network, start = checkable(5, 15)
    spoilt = add_errors(network, {9: np.array([0.3, 0.1])})
    clean = adjust(network, start, Options(variance_components=True))
    result = adjust(spoilt, start, Options(variance_components=True, snooping=True))
    assert len(result.suspects) == 1
    assert result.variance_factors["target"] == pytest.approx(clean.variance_factors["target"], rel=0.1)


def adjust_network(truth: DrawnFrames) -> Adjustment:
    return adjust(truth.network, truth.start)


def test_sigma0_multiplies_the_noise_of_marks_and_not_the_datum() -> None:
    calm, loud = (
        adjust_network(draw_frames("affine", 5, 8, 1.0, 0.01, np.random.default_rng(3), noise)) for noise in (1.0, 4.0)
    )
    assert loud.sigma0 == pytest.approx(4.0 * calm.sigma0, rel=1e-2)
    assert loud.sigma("T.f0.a1") == pytest.approx(calm.sigma("T.f0.a1"), rel=1e-3)
    assert loud.sigma("T.f0.a1") == pytest.approx(1.0 / np.sqrt(8), rel=0.01)
    of_noise = [np.sqrt(np.diag(corrections_covariance(each))) for each in (calm, loud)]
    np.testing.assert_allclose(of_noise[1], 4.0 * of_noise[0], rtol=0.02)


def corrections_covariance(result: Adjustment) -> Array:
    fiducials = result.network.cameras[0].fiducials
    names = [f"FID.{FILM_CAMERA}.{id_}.{axis}" for id_ in fiducials for axis in "xy"]
    places = np.array([result.value(name) for name in names]).reshape(-1, 2)
    given = np.array([(mark.x_mm.value, mark.y_mm.value) for mark in fiducials.values()])
    films = [adjusted_image(result, image.name).film for image in result.network.images]
    found = corrections_to_given(films, places, given)
    assert found
    names += [f"T.f0.{name}" for name in film_parameter_names(films[0].transformation)]
    return np.asarray(found.by_unknowns @ (result.sigma0**2 * result.cofactor_of(names)) @ found.by_unknowns.T)


def test_given_values_that_are_too_good_are_left_out_of_a_whole_network_too() -> None:
    """Five images with targets: given fiducials right to a hundredth of their sigma; drawn from it, they take part."""
    case = exact(load("i_five_images_affine_reduced"))
    drawn = realisation(case.network, np.random.default_rng(0))
    fiducials = case.network.cameras[0].fiducials
    right = set_camera(drawn, fiducials=fiducials)
    whole, without = adjust(drawn, case.start), adjust(right, case.start)
    assert not whole.variance.left_out
    assert whole.sigma0 == np.sqrt(whole.vpv / whole.redundancy)
    assert without.variance.left_out == (GivenGroup("datum", FILM_CAMERA),)
    assert without.variance.redundancy == pytest.approx(without.redundancy - without.groups["datum"].redundancy)
    assert without.sigma("FID.K.1.x") == pytest.approx(whole.sigma("FID.K.1.x") / whole.sigma0, rel=1e-3)


@pytest.mark.parametrize(
    ("kinds", "common"),
    [
        (["affine", "affine"], "affine"),
        (["affine", "congruent"], "congruent"),
        (["affine", "none"], "none"),
        (["conformal(3)", "conformal(2)"], "conformal(2)"),
        (["conformal(3)", "similarity"], "similarity"),
        (["conformal(3)", "projective"], "similarity"),
        (["projective", "bilinear"], "affine"),
        (["polynomial(3)", "polynomial(2)"], "polynomial(2)"),
    ],
)
def test_what_films_of_several_kinds_take_up(kinds: list[str], common: str) -> None:
    assert common_transformation(kinds) == common


def test_corrections_are_the_residuals_of_a_least_squares_fit() -> None:
    """By hand, of places that an affine film has moved by a tenth of a degree and 1 mm."""
    rng = np.random.default_rng(5)
    given = draw_frames("affine", 1, 8, 1.0, 1.0, rng).places_mm
    true = given + rng.normal(0.0, 0.01, given.shape)
    design = np.column_stack([np.ones(8), true])
    left = design @ np.linalg.lstsq(design, given)[0] - given
    moved = true @ np.array([[1.001, 0.02], [-0.03, 0.999]]) + 1.0
    film = Film("affine", np.array([3.0, -1.0, 0.01, 2.0, 0.02, 1.0]), np.zeros(2))
    found = corrections_to_given([film], moved, given)
    assert found
    np.testing.assert_allclose(found.corrections_mm, left, atol=1e-9)
    assert corrections_to_given([film], moved[:3], given[:3]) is None

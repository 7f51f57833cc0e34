"""Redundancy, w, tau, detectable errors; gross errors that are made, found by snooping and robust estimation."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from faults import shift_given
from networks import (
    Truth,
    add_errors,
    drop_rows,
    field_points,
    free_points,
    observation_row,
    orient,
    set_camera,
    set_observations,
    simulated,
)
from numpy.typing import NDArray

from adjust import Adjustment, Calibration, Options, Parameter, Prior, adjust
from adjust.problem.network import Approximations, Exterior, Network, ObjectPoint
from adjust.quality.reliability import Reliability
from adjust.quality.tested import Probabilities

Array = NDArray[np.float64]

DELTA0 = 4.13  # alpha 0.1 %, power 80 %


def exact_network() -> tuple[Network, Approximations]:
    """No errors; weighted control, tight fiducials, one observed station, one target with correlated coordinates."""
    truth = Truth()
    network, start = simulated(
        np.random.default_rng(3), truth, point_sigma=0.02, noise=False, fiducial_sigma=0.005, free={"k3": np.inf}
    )
    covariance = network.observations.covariance_mm2.copy()
    covariance[observation_row(network, "target", "f1", "4")] = 0.004**2 * np.array([[1.0, 0.6], [0.6, 2.0]])
    sigmas = np.array([0.1, 0.1, np.inf, np.inf, np.inf, np.inf])
    network = orient(network, {"f2": Exterior(truth.exteriors[2], sigmas)})
    return set_observations(network, covariance_mm2=covariance), start


def assess_reliability(result: Adjustment) -> Reliability:
    assert result.reliability is not None
    return result.reliability


def spoil_control(network: Network, error: float) -> Network:
    return shift_given(network, "PT.5.Z", error)


def spoil_fiducial(network: Network, error: float) -> Network:
    return shift_given(network, "FID.K.3.y", error)


def spoil_station(network: Network, error: float) -> Network:
    exterior = network.image_by_name["f2"].exterior
    assert exterior is not None
    return orient(network, {"f2": Exterior(exterior.values + error * np.eye(6)[0], exterior.sigmas)})


X, Y = np.array([1.0, 0.0]), np.array([0.0, 1.0])
CASES: dict[str, tuple[str, int, Callable[[Network, float], Network]]] = {
    "target": ("target 4 in image f1", 1, lambda n, e: add_errors(n, {observation_row(n, "target", "f1", "4"): e * Y})),
    "fiducial": (
        "fiducial 2 in image f3",
        0,
        lambda n, e: add_errors(n, {observation_row(n, "fiducial", "f3", "2"): e * X}),
    ),
    "control": ("control point 5 Z", 0, spoil_control),
    "datum": ("given fiducial 3 (camera K)", 1, spoil_fiducial),
    "exterior": ("given X0 of image f2", 0, spoil_station),
}


@pytest.mark.parametrize("case", CASES)
def test_the_smallest_detectable_error_shifts_the_test_by_delta0_and_the_camera_as_stated(case: str) -> None:
    name, axis, spoilt = CASES[case]
    network, start = exact_network()
    clean = adjust(network, start)
    tests = assess_reliability(clean)
    unit = [tested.name for tested in tests.tested].index(name)
    error = tests.smallest[unit, axis]
    dirty = adjust(spoilt(network, error), start)
    assert abs(assess_reliability(dirty).w[unit, axis]) == pytest.approx(DELTA0, rel=2e-3)

    shift = dirty.values - clean.values
    sigma = np.sqrt(clean.cofactor.variances)
    free = np.flatnonzero(sigma > 0.0)
    inverse = np.linalg.inv(clean.cofactor.part(free) / np.outer(sigma[free], sigma[free]))
    normalised = shift[free] / sigma[free]
    assert np.sqrt(normalised @ inverse @ normalised) == pytest.approx(tests.effect[unit, axis], rel=5e-3)
    for outer in tests.outer:
        position = clean.index(outer.parameter)
        assert abs(shift[position]) < 1.005 * abs(outer.effect) + 1e-4 * sigma[position]
        assert outer.in_sigmas == pytest.approx(abs(outer.effect) / sigma[position], rel=1e-9)


def test_an_undetected_error_of_an_earlier_calibration_moves_the_camera_as_stated() -> None:
    """Its values are correlated; the one that does most harm is wrong."""
    truth = Truth()
    network, start = simulated(np.random.default_rng(3), truth, noise=False, free={"k3": np.inf})
    network = set_camera(network, principal_distance_mm=Prior(truth.c, np.inf))
    own = (Parameter.interior("K", "c"), Parameter.interior("K", "k3"))
    values = np.array([truth.c, truth.distortion["k3"]])
    sigmas = np.array([0.002, 1e-9])
    covariance = np.array([[1.0, -0.6], [-0.6, 1.0]]) * np.outer(sigmas, sigmas)

    def set_calibration(error: Array) -> Network:
        return replace(network, calibrations=(Calibration(own, values + error, covariance),))

    clean = adjust(set_calibration(np.zeros(2)), start)
    result = {outer.parameter: outer for outer in assess_reliability(clean).outer}
    for name in own:
        i = [f"calibration {each.label}" for each in own].index(result[name].cause)
        wrong = adjust(set_calibration(clean.further[i].detectable * np.eye(2)[i]), start)
        assert wrong.value(name) - clean.value(name) == pytest.approx(result[name].effect, rel=0.01)


def test_the_usual_probabilities_give_baardas_delta0() -> None:
    assert Probabilities().noncentrality(1) == pytest.approx(DELTA0, abs=0.005)
    assert Probabilities(alpha=0.05).noncentrality(1) == pytest.approx(2.80, abs=0.005)


def test_critical_tau_is_the_quantile_of_a_residual_over_its_own_sigma0() -> None:
    rng = np.random.default_rng(1)
    for redundancy in (3, 12):
        z = rng.normal(size=(400_000, redundancy))
        tau = np.abs(z[:, 0]) / np.sqrt((z**2).mean(axis=1))
        assert Probabilities(alpha=0.01).critical_tau(redundancy) == pytest.approx(np.quantile(tau, 0.99), rel=0.005)
    assert np.isinf(Probabilities().critical_tau(1))


def checkable(seed: int, points: int = 15) -> tuple[Network, Approximations]:
    """Fiducials and control given well enough for their errors to be seen."""
    rng = np.random.default_rng(seed)
    return simulated(rng, points=field_points(rng, points), fiducial_sigma=0.01, point_sigma=0.05)


def named(result: Adjustment) -> list[str]:
    return sorted(suspect.tested.name for suspect in result.suspects)


def row_name(network: Network, row: int) -> str:
    rows = network.observations
    return f"{rows.kind[row]} {rows.point[row]} in image {rows.image[row]}"


def test_what_is_removed_is_named_and_has_no_influence() -> None:
    network, start = checkable(1)
    spoilt = add_errors(network, {8: np.array([0.06, 0.0]), 30: np.array([-0.04, 0.05])})
    result = adjust(spoilt, start, Options(snooping=True))
    assert named(result) == sorted([row_name(network, 8), row_name(network, 30)])
    assert all(suspect.removed for suspect in result.suspects)
    assert result.suspects[0].error == pytest.approx((-0.04, 0.05), abs=0.02)
    expected = adjust(drop_rows(network, [8, 30]), start)
    assert (result.conditions, result.redundancy) == (expected.conditions, expected.redundancy)
    assert result.vpv == pytest.approx(expected.vpv, rel=1e-6)
    sigma = np.sqrt(expected.cofactor.variances)
    free = sigma > 0.0
    np.testing.assert_allclose((result.values - expected.values)[free] / sigma[free], 0.0, atol=1e-5)
    np.testing.assert_allclose(np.sqrt(result.cofactor.variances)[free], sigma[free], rtol=1e-6)
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(result.redundancy)


def test_wrong_given_values_are_named() -> None:
    network, start = checkable(2)
    spoilt = spoil_fiducial(spoil_control(network, 1.0), 0.15)
    for options in (Options(), Options(snooping=True), Options(robust="igg3")):
        assert named(adjust(spoilt, start, options)) == ["control point 5 Z", "given fiducial 3 (camera K)"]


@pytest.mark.study
def test_clean_observations_are_rarely_suspect() -> None:
    """One adjustment of a hundred is expected to name any."""
    called = sum(bool(named(adjust(*checkable(100 + seed, 6)))) for seed in range(40))
    assert called <= 3


def test_observations_all_worse_than_stated_raise_the_limits_by_the_square_of_their_scale() -> None:
    """Errors three times as large as they are given: a statistic is a square, so that chance lets it be nine times."""
    network, start = checkable(3)
    rows = network.observations
    claimed = set_observations(network, covariance_mm2=rows.covariance_mm2 / 9.0)
    errors = np.arange(0, len(rows), 25)
    amounts = {int(row): np.array([0.12, -0.09]) for row in errors[1:2]}
    spoilt = add_errors(claimed, amounts)
    result = adjust(spoilt, start, Options(snooping=True))
    assert named(result) == sorted(row_name(network, row) for row in amounts)


@pytest.mark.study
def test_two_rays_of_a_point_cannot_be_distinguished() -> None:
    network, start = simulated(np.random.default_rng(4), point_sigma=0.0)
    rows = network.observations
    of_point = [i for i in range(len(rows)) if rows.point[i] == "4" and rows.kind[i] == "target"]
    two = drop_rows(free_points(network, {"4"}), of_point[2:])
    result = adjust(add_errors(two, {of_point[0]: np.array([0.15, 0.15])}), start, Options(snooping=True))
    rays = {row_name(network, of_point[0]), row_name(network, of_point[1])}
    assert len(result.suspects) == 1
    assert {result.suspects[0].tested.name, *result.suspects[0].alike} == rays


def test_over_flat_ground_of_known_height_no_principal_distance_is_wrong_by_metres() -> None:
    """Parallel axes: the heights' errors alone pull at c, which no image point says anything about."""
    rng = np.random.default_rng(6)
    truth = Truth(attitudes=((0.004, -0.005, 0.1), (-0.005, 0.002, 1.6), (0.002, 0.007, 3.0), (0.001, -0.003, -1.5)))
    network, start = simulated(rng, truth, points=field_points(rng, 100, relief=0.3), point_sigma=np.inf)
    flat = replace(network, points=tuple(ObjectPoint(each.id, None, None, Prior(0.0, 0.2)) for each in network.points))
    result = adjust(flat, start, Options(datum="minimal"))
    assert result.reliability is not None
    row = next(i for i, each in enumerate(result.reliability.tested) if each.name == "given c (camera K)")
    assert result.reliability.w[row, 0] < -3.0
    assert named(result) == []

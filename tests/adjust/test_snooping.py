"""Gross errors that are really made: found, named and without influence, by data snooping and by robust estimation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import Truth, field_points, simulated, with_errors, without_rows

from adjust.functional_model.lens import Prior
from adjust.problem.camera import Fiducial
from adjust.problem.network import Approximations, Network
from adjust.quality.weighting import WeightFunction
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]


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
    spoilt = with_errors(network, {8: np.array([0.06, 0.0]), 30: np.array([-0.04, 0.05])})
    result = adjust(spoilt, start, Options(snooping=True))
    assert named(result) == sorted([row_name(network, 8), row_name(network, 30)])
    assert all(suspect.removed for suspect in result.suspects)
    assert result.suspects[0].error == pytest.approx((-0.04, 0.05), abs=0.02)
    expected = adjust(without_rows(network, [8, 30]), start)
    assert (result.conditions, result.redundancy) == (expected.conditions, expected.redundancy)
    assert result.vpv == pytest.approx(expected.vpv, rel=1e-6)
    sigma = np.sqrt(expected.cofactor.variances)
    free = sigma > 0.0
    np.testing.assert_allclose((result.values - expected.values)[free] / sigma[free], 0.0, atol=1e-5)
    np.testing.assert_allclose(np.sqrt(result.cofactor.variances)[free], sigma[free], rtol=1e-6)
    assert sum(group.redundancy for group in result.groups.values()) == pytest.approx(result.redundancy)


def test_suspects_are_named_without_being_removed() -> None:
    """The residuals of good observations that a gross error has spoilt do not make them suspect."""
    network, start = checkable(1)
    spoilt = with_errors(network, {8: np.array([0.1, 0.0]), 30: np.array([-0.08, 0.1])})
    result = adjust(spoilt, start)
    w = np.abs(result.residuals.w).max(axis=1)
    assert (w > 4.5).sum() > 2
    assert named(result) == sorted([row_name(network, 8), row_name(network, 30)])
    assert not any(suspect.removed for suspect in result.suspects)
    assert (result.weights == 1.0).all()


def test_wrong_given_values_are_named() -> None:
    network, start = checkable(2)
    camera = network.cameras[0]
    mark = camera.fiducials["3"]
    wrong = Fiducial(mark.x_mm, Prior(mark.y_mm.value + 0.15, mark.y_mm.sigma))
    points = tuple(
        replace(point, Z=Prior(point.Z.value + 1.0, point.Z.sigma)) if point.id == "5" and point.Z else point
        for point in network.points
    )
    spoilt = replace(
        network, cameras=(replace(camera, fiducials=dict(camera.fiducials) | {"3": wrong}),), points=points
    )
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
    claimed = replace(network, observations=replace(rows, covariance_mm2=rows.covariance_mm2 / 9.0))
    errors = np.arange(0, len(rows), 25)
    amounts = {int(row): np.array([0.12, -0.09]) for row in errors[1:2]}
    spoilt = with_errors(claimed, amounts)
    result = adjust(spoilt, start, Options(snooping=True))
    assert named(result) == sorted(row_name(network, row) for row in amounts)


@pytest.mark.study
def test_two_rays_of_a_point_cannot_be_distinguished() -> None:
    network, start = simulated(np.random.default_rng(4), point_sigma=0.0)
    rows = network.observations
    free = replace(next(point for point in network.points if point.id == "4"), X=None, Y=None, Z=None)
    points = tuple(free if point.id == "4" else point for point in network.points)
    of_point = [i for i in range(len(rows)) if rows.point[i] == "4" and rows.kind[i] == "target"]
    two = without_rows(replace(network, points=points), of_point[2:])
    result = adjust(with_errors(two, {of_point[0]: np.array([0.15, 0.15])}), start, Options(snooping=True))
    rays = {row_name(network, of_point[0]), row_name(network, of_point[1])}
    assert len(result.suspects) == 1
    assert {result.suspects[0].tested.name, *result.suspects[0].alike} == rays


@pytest.mark.study
@pytest.mark.parametrize("size_mm", [0.1, 5.0])
def test_five_percent_of_gross_errors_lose_their_influence_wholly(size_mm: float) -> None:
    rng = np.random.default_rng(4)
    network, start = simulated(rng, points=field_points(rng, 20), fiducial_sigma=0.01)
    count = len(network.observations)
    wrong = [int(i) for i in rng.choice(count, count // 20, replace=False)]
    direction = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
    errors = size_mm * np.column_stack([np.cos(direction), np.sin(direction)])
    spoilt = with_errors(network, dict(zip(wrong, errors, strict=True)))
    expected = adjust(without_rows(network, wrong), start)
    sigma = np.sqrt(expected.cofactor.variances)
    free = sigma > 0.0
    for options in (Options(robust="igg3"), Options(snooping=True)):
        result = adjust(spoilt, start, options)
        assert result.converged
        assert named(result) == sorted(row_name(network, row) for row in wrong)
        assert (result.weights[wrong] < 1e-9).all()
        difference = (result.values - expected.values)[free] / sigma[free]
        assert np.sqrt((difference**2).mean()) < 0.15
        assert result.sigma0 == pytest.approx(expected.sigma0, rel=0.05)


@pytest.mark.parametrize("function", ["huber", "igg3"])
def test_robust_weights_leave_clean_observations_alone(function: WeightFunction) -> None:
    network, start = checkable(7)
    plain, robust = adjust(network, start), adjust(network, start, Options(robust=function))
    assert (robust.weights == 1.0).mean() > 0.85
    assert abs(robust.value("IO.K.c") - plain.value("IO.K.c")) < plain.sigma("IO.K.c") / plain.sigma0


def test_options_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="choose one of them"):
        Options(robust=True, snooping=True)
    with pytest.raises(ValueError, match="no group bolts"):
        Options(variance_components=("bolts",))
    with pytest.raises(ValueError, match="huber, igg3"):
        Options(robust="tukey")  # type: ignore[arg-type]


def test_over_flat_ground_of_known_height_no_principal_distance_is_wrong_by_metres() -> None:
    """Parallel axes: the heights' errors alone pull at c, which no image point says anything about."""
    rng = np.random.default_rng(6)
    truth = Truth(attitudes=((0.004, -0.005, 0.1), (-0.005, 0.002, 1.6), (0.002, 0.007, 3.0), (0.001, -0.003, -1.5)))
    network, start = simulated(rng, truth, points=field_points(rng, 100, relief=0.3), point_sigma=np.inf)
    heights = tuple(replace(point, Z=Prior(0.0, 0.2)) for point in network.points)
    flat = replace(network, points=tuple(replace(point, X=None, Y=None) for point in heights))
    result = adjust(flat, start, Options(datum="minimal"))
    assert result.reliability is not None
    row = next(i for i, each in enumerate(result.reliability.tested) if each.name == "given c (camera K)")
    assert result.reliability.w[row, 0] < -3.0
    assert named(result) == []

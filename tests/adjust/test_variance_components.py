"""Variance components of all groups and their standard deviations, against dense formulas and simulation."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated import field_points, simulated, with_errors
from studies import parametrize_with_studies

from adjust.functional_model.rotation import rotation_from_angles
from adjust.least_squares.iteration import linearise
from adjust.least_squares.numbering import Numbering
from adjust.least_squares.rows import prior_root_weights
from adjust.problem.condition_equations import compute, derivatives
from adjust.problem.network import Approximations, Network
from adjust.problem.problem import State, number
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment

Array = NDArray[np.float64]

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
    spoilt = with_errors(network, {9: np.array([0.3, 0.1])})
    clean = adjust(network, start, Options(variance_components=True))
    result = adjust(spoilt, start, Options(variance_components=True, snooping=True))
    assert len(result.suspects) == 1
    assert result.variance_factors["target"] == pytest.approx(clean.variance_factors["target"], rel=0.1)


@pytest.mark.study
def test_the_factors_scatter_as_claimed() -> None:
    runs = [adjust(*checkable(1000 + seed, 15), Options(variance_components=GROUPS)) for seed in range(300)]
    for group in GROUPS:
        factors = np.array([run.variance_factors[group] for run in runs])
        claimed = np.sqrt(np.mean([(run.variance_sigmas[group] / run.variance_factors[group]) ** 2 for run in runs]))
        assert factors.mean() == pytest.approx(1.0, abs=4.0 * claimed / np.sqrt(300))
        assert factors.std() == pytest.approx(claimed, rel=0.15)

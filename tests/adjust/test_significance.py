"""Tests of parameters against other ways to the same figures: adjustments without them, and repeated noise."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from simulated import Truth, field_points, simulated

from adjust.functional_model.lens import Prior
from adjust.problem.network import Network
from adjust.quality.significance import SignificanceTest
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

FREE = dict.fromkeys(("k3", "k5", "p1", "p2"), np.inf)


def free_all(network: Network, *names: str) -> Network:
    camera = network.cameras[0]
    distortion = replace(camera.distortion, parameters={name: Prior(0.0, np.inf) for name in names})
    return replace(network, cameras=(replace(camera, distortion=distortion),))


def significance_tests(adjustment: Adjustment) -> dict[str, SignificanceTest]:
    camera = adjustment.network.cameras[0].name
    return {test.name: test for test in adjustment.significance["interior", camera]}


def p_values(adjustment: Adjustment) -> dict[str, float]:
    return {name: test.p for name, test in significance_tests(adjustment).items()}


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


def test_what_is_there_is_significant_and_what_is_not_is_not() -> None:
    truth = Truth(distortion={"k3": 1.5e-7})
    network, start = simulated(np.random.default_rng(6), truth)
    p = p_values(adjust(free_all(network, "k3", "p1", "p2"), start))
    assert p["k3"] < 1e-6
    assert p["all"] < 1e-6
    assert min(p["p1"], p["p2"], p["decentering"], p["x0"], p["y0"]) > 0.01


@pytest.mark.study
def test_superfluous_parameters_have_evenly_spread_p() -> None:
    """p of p1, of the pair and of the priors' departures are uniform where these are true (Kolmogorov-Smirnov)."""
    truth = Truth(distortion={})
    points = field_points(np.random.default_rng(1), 6)
    found = []
    for seed in range(40):
        network, start = simulated(np.random.default_rng(seed), truth, points=points)
        found.append(p_values(adjust(free_all(network, "p1", "p2"), start)))
    for name in ("p1", "decentering", "x0", "c"):
        assert stats.kstest([p[name] for p in found], "uniform").pvalue > 0.01, name


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

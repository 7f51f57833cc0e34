"""The bend that observations ask for: the terms that are there, no others, and what is said where none can be told."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from bent_scans import MIDDLE_MM, RESEAU_MM, bend_in_scanner, films
from simulated import STATIONS, Truth, field_points, simulated

from adjust.initial_values.approximations import approximate
from adjust.model_selection.scanner_choice import bent_network, choose_bends
from adjust.problem.network import Approximations, Network
from adjust.solution.adjustment import adjust
from adjust.solution.result import Adjustment

QUARTERS = [0.0, 90.0, 180.0, 270.0]


def adjust_network(network: Network) -> Adjustment:
    return adjust(network, approximate(network))


def laid_in_quarters(network: Network) -> Adjustment:
    """From marks without errors: to find those of films among marks a millimetre off takes longest."""
    return adjust(network, _start())


@cache
def _start() -> Approximations:
    return approximate(films(QUARTERS, {}, {}))


def chosen(network: Network, by: Callable[[Network], Adjustment] = adjust_network) -> set[str]:
    return set(choose_bends(network, by).network.scanners[0].terms)


def test_the_terms_that_are_there_are_chosen() -> None:
    truth = {"a20": 0.02, "b11": -0.015, "b02": 0.01}
    network = films(QUARTERS * 2, truth, {}, np.random.default_rng(1))
    choice = choose_bends(network, adjust_network)
    # over the extent of the marks, which is not that of the truth, products of degree 2 take parts of degree 1 and 0
    assert set(choice.network.scanners[0].terms) == set(truth)
    result = adjust_network(choice.network)
    assert result.sigma0 == pytest.approx(1.0, abs=0.2)
    assert result.value("SC.S.a20") == pytest.approx(0.02, rel=0.15)


def test_a_carriage_that_wavers_is_found_by_a_reseau() -> None:
    truth = {"a04": 0.02, "b05": -0.02}
    found = chosen(films([0.0, 90.0], truth, {}, np.random.default_rng(2), sigma_given_mm=1e-3, marks_mm=RESEAU_MM))
    assert {"a04", "b05"} <= found
    assert all(term[1] == "0" or term[2] == "0" for term in found)


def test_where_nothing_bends_nothing_is_chosen() -> None:
    """At one percent for all candidates together: none in 10 networks."""
    networks = [films(QUARTERS, {}, {}, np.random.default_rng(seed)) for seed in range(10)]
    found = [chosen(network, laid_in_quarters) for network in networks]
    assert not any(found)


def test_frames_that_lie_alike_get_no_bend_and_a_sentence() -> None:
    choice = choose_bends(films([0.0] * 4, {"a20": 0.05}, {}, np.random.default_rng(3)), adjust_network)
    assert not choice.network.scanners[0].terms
    even, odd = choice.remarks
    assert "a20, a11, a02, b20, b11, b02: all frames lie alike in the scanner" in even
    assert even.endswith("turned by 180 degrees.")
    assert odd.endswith("turned by 90 degrees.")


def test_targets_tell_the_bend_of_frames_that_lie_alike() -> None:
    """Known points and a lens without distortion, as a calibrated camera has it."""
    truth = Truth(distortion={})
    points = field_points(np.random.default_rng(5), 60)
    network, _ = simulated(np.random.default_rng(4), truth, points=points)
    bent = bend_in_scanner(network, {"a20": 0.05}, {})
    assert len(chosen(bent)) > 0


def test_two_photographs_are_enough_for_terms_that_they_tell() -> None:
    """Their trial has far more terms than they tell, which are held by no more than its prior."""
    truth = Truth(stations=STATIONS[:2], attitudes=((0.0, 0.0, 0.0), (-0.05, 0.36, 1.6)), middle_mm=MIDDLE_MM)
    points = field_points(np.random.default_rng(5), 30)
    network, _ = simulated(np.random.default_rng(4), truth, points=points, free={"k3": np.inf, "k5": np.inf})
    choice = choose_bends(bend_in_scanner(network, {"a20": 0.04, "b11": -0.03}, {}), adjust_network)
    assert {"a20", "b11"} <= set(choice.network.scanners[0].terms)
    assert not any("No bend of the scanner was estimated" in text for text in choice.remarks)


def test_a_bend_of_given_terms_over_the_extent_of_the_scans() -> None:
    network = films(QUARTERS, {}, {})
    (scanner,) = bent_network(network, ("a20", "b02"), 0.01).scanners
    assert {name: prior.sigma for name, prior in scanner.terms.items()} == {"a20": 0.01, "b02": 0.01}
    xy_mm = network.observations.xy_mm
    np.testing.assert_allclose(np.array(scanner.center_mm) - scanner.half_mm, xy_mm.min(axis=0))
    assert len(bent_network(network).scanners[0].terms) == 14

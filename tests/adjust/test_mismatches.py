"""Tie points wrongly joined: the point and the image are named, and nothing else is blamed."""

from collections.abc import Callable

import numpy as np
import pytest
from networks import (
    Truth,
    add_errors,
    drop_rows,
    field_points,
    free_points,
    observation_row,
    set_camera,
    set_observations,
    simulated,
)

from adjust import Adjustment, adjust
from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.network import Network

POINTS, KNOWN = 26, 8
Spoilt = tuple[Network, set[tuple[str, str]]]  # with the rays (point, image) that are wrong


def _network(seed: int, truth: Truth | None = None) -> Network:
    """Four films of a field, most points of which are unknown."""
    rng = np.random.default_rng([71, seed])
    made, _ = simulated(rng, truth, points=field_points(rng, POINTS), point_sigma=0.05, fiducial_sigma=0.01)
    return free_points(made, {str(k) for k in range(KNOWN, POINTS)})


def _at(network: Network, image: str, point: str) -> int:
    return observation_row(network, "target", image, point)


def _joined(network: Network, image: str, point: str, other: str) -> Network:
    """With the mark of another point under a point's name."""
    names = list(network.observations.point)
    names[_at(network, image, other)] = point
    return drop_rows(set_observations(network, point=tuple(names)), [_at(network, image, point)])


def _one_ray(network: Network) -> Spoilt:
    return _joined(network, "f2", "12", "20"), {("12", "f2")}


def _several(network: Network) -> Spoilt:
    wrong = {("9", "f2"), ("12", "f0"), ("15", "f3")}
    for point, image in sorted(wrong):
        network = _joined(network, image, point, str(int(point) + 5))
    return network, wrong


def _exchanged(network: Network) -> Spoilt:
    point, rows = list(network.observations.point), [_at(network, "f1", name) for name in ("12", "20")]
    point[rows[0]], point[rows[1]] = "20", "12"
    return set_observations(network, point=tuple(point)), {("12", "f1"), ("20", "f1")}


def _sound(network: Network) -> Spoilt:
    return network, set()


@pytest.mark.parametrize("spoil", [_several, _exchanged, _sound])
def test_rays_that_do_not_meet_the_others_are_left_out_and_named(spoil: Callable[[Network], Spoilt]) -> None:
    spoilt, wrong = spoil(_network(1))
    result = adjust(spoilt)
    _check(result)
    assert {(each.tested.point, each.tested.owner) for each in result.suspects if each.removed} == wrong
    assert len(result.suspects) == len(wrong)


def test_point_without_two_rays_that_meet_is_left_out_and_named() -> None:
    spoilt, _ = _one_ray(_network(2))
    spoilt = drop_rows(spoilt, [_at(spoilt, image, "12") for image in ("f1", "f3")])
    result = adjust(spoilt)
    _check(result)
    assert result.warnings == (
        "No two rays of point 12 meet, from the images f0, f2: the point is left out. Check its number there.",
    )
    assert not result.suspects


def test_one_of_two_pairs_of_rays_that_meet_is_not_distinguishable_from_the_other() -> None:
    """Of four rays of a point, two belong to another: nothing tells which point has the name."""
    made = _network(3)
    spoilt = _joined(_joined(made, "f2", "12", "20"), "f3", "12", "20")
    result = adjust(spoilt)
    _check(result)
    assert {each.tested.point for each in result.suspects} == {"12"}
    left_out = {each.tested.owner for each in result.suspects}
    kept = {f"target 12 in image {image}" for image in {"f0", "f1", "f2", "f3"} - left_out}
    assert left_out in ({"f0", "f1"}, {"f2", "f3"})
    assert {*result.suspects[0].alike} == kept


def test_mismatch_smaller_than_an_unknown_lens_bends_rays_is_found_once_that_is_known() -> None:
    """At the start the lens, of 1 mm, hides an error of 0.7 mm."""
    made = _network(1, Truth(distortion={"k3": 1e-6, "k5": -2e-11}))
    unknown = Distortion("torlegard", dict.fromkeys(("k3", "k5"), Prior(0.0, np.inf)))
    made = set_camera(made, distortion=unknown)
    result = adjust(add_errors(made, {_at(made, "f2", "12"): np.array([0.5, -0.5])}))
    _check(result)
    assert [each.tested.name for each in result.suspects] == ["target 12 in image f2"]


def _check(result: Adjustment) -> None:
    assert result.converged
    assert result.sigma0 == pytest.approx(1.0, abs=0.3)
    assert not result.explanations

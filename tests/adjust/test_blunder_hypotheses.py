"""Slips of whole networks are named, and nothing else is blamed; what is no such slip is not taken for one."""

from dataclasses import replace

import numpy as np
import pytest
from planted import KINDS, change_points, describe, exchanged, network, outcome
from studies import parametrize_with_studies

from adjust.errors import AdjustmentError
from adjust.solution.adjustment import Options, adjust
from adjust.solution.blunder_hypotheses import AXES

FAST = (
    "sign of X, approximate orientations",
    "sign of Z, observed orientations",
    "y of the camera down",
    "mm for m, approximate orientations",
    "names of two frames exchanged, approximate orientations",
    "nothing, approximate orientations",
)


@pytest.mark.parametrize(
    "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.study) for name in KINDS]
)
def test_what_is_wrong_with_all_is_named(name: str) -> None:
    kind = KINDS[name]
    sentences = describe(kind.spoil(network(0, kind.oriented)))
    assert outcome(kind, sentences) == "named", sentences


@parametrize_with_studies("options", [Options(), Options(robust="igg3")], quick=(1,))
def test_targets_of_exchanged_frames_are_named(options: Options) -> None:
    few = network(1)
    with pytest.raises(AdjustmentError, match=r"targets of the frames f1 and f3 are exchanged\. Without this all"):
        adjust(exchanged(few), options=options)


@pytest.mark.parametrize("options", [Options(robust=True), Options(snooping=True)])
def test_robust_methods_do_not_hide_a_slip_of_the_whole(options: Options) -> None:
    with pytest.raises(AdjustmentError, match="The points are mirrored"):
        adjust(change_points(network(2), lambda xyz: xyz * [1.0, 1.0, -1.0]), options=options)


def test_flat_fields_are_mirrored_by_their_stations_alone() -> None:
    """Their residuals are those of the true field: cameras behind it see it so."""
    given = network(3, np.full(6, np.inf), relief=0.0)
    finding = [
        each for each in adjust(change_points(given, lambda xyz: xyz[[1, 0, 2]])).warnings if "nowhere near" in each
    ]
    assert ["X and Y of all points are exchanged" in each for each in finding] == [True]
    assert not [each for each in adjust(given).warnings if "nowhere near" in each]


def test_every_mirror_is_its_own_inverse_and_turns_the_hand() -> None:
    for words, moved in AXES.items():
        np.testing.assert_array_equal(moved @ moved, np.eye(3), err_msg=words)
        assert np.linalg.det(moved) == pytest.approx(-1.0)


def test_sigmas_that_are_somewhat_too_small_are_no_slip() -> None:
    given = network(4)
    close = given.observations.covariance_mm2 / 1.7**2
    assert adjust(replace(given, observations=replace(given.observations, covariance_mm2=close))).converged

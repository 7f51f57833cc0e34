"""Images oriented together in closed form, against cv2.projectPoints; what does not agree is left to resection."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from projected import C_MM as FRAME_C_MM
from projected import simulated as simulated_network
from test_approximations import without_interior
from test_resection import C_MM, FIELDS, ORIGIN, simulated

from adjust.initial_values import principal_distance, resection
from adjust.initial_values.approximations import approximate
from adjust.initial_values.dlt import closed_form_poses, principal_distance_together
from adjust.initial_values.pose import KnownField, Pose
from adjust.initial_values.resection import Resection, resect

Array = NDArray[np.float64]

SIGMA_MM = 0.005
BOARD = np.array([[x, y, 0.0] for x in range(-4, 5) for y in range(-3, 4)]) * 100.0
STATIONS = [
    (800.0 * np.sin(turn), 800.0 * np.cos(turn), 1200.0, -0.55 * np.cos(turn), 0.55 * np.sin(turn), turn)
    for turn in np.linspace(0.0, 5.5, 12)
]


def fields(counts: list[int], relief: float, tilt_rad: float, noise_mm: float) -> tuple[list[KnownField], list[Pose]]:
    rng = np.random.default_rng(5)
    drawn = [simulated(n, relief, tilt_rad, rng, noise_mm) for n in counts]
    return [KnownField(xyz, xy, SIGMA_MM) for xyz, xy, _ in drawn], [pose for _, _, pose in drawn]


@pytest.mark.parametrize("relief", [*FIELDS.values(), 0.2], ids=[*FIELDS, "between"])
@pytest.mark.parametrize("tilt_rad", [0.05, 0.7], ids=["vertical", "oblique"])
def test_exact_points_give_the_poses_of_images_of_any_size(relief: float, tilt_rad: float) -> None:
    given, poses = fields([40, 6, 300, 12, 7, 40], relief, tilt_rad, 0.0)
    for found, pose in zip(closed_form_poses(given, [C_MM] * len(given)), poses, strict=True):
        assert found is not None
        assert np.linalg.norm(found.center - pose.center) < 1e-3
        np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-6)


@pytest.mark.parametrize("relief", [0.0, 0.3])
def test_images_are_oriented_by_those_of_their_points_that_agree(relief: float) -> None:
    given, poses = fields([40] * 12, relief, 0.7, SIGMA_MM)
    clean = closed_form_poses(given, [C_MM] * len(given))
    given[3].xy_mm[:8] += np.random.default_rng(1).uniform(-20.0, 20.0, (8, 2))
    given[7].xy_mm[[0, 1]] = given[7].xy_mm[[1, 0]]  # exchanged
    for found, without, pose in zip(closed_form_poses(given, [C_MM] * len(given)), clean, poses, strict=True):
        assert found is not None
        assert without is not None
        assert np.linalg.norm(found.center - without.center) < 1.0
        assert np.linalg.norm(found.center - pose.center) < 2.0


def test_an_image_most_of_whose_points_are_wrong_is_left() -> None:
    given, _ = fields([40] * 12, 0.0, 0.7, SIGMA_MM)
    given[3].xy_mm[:25] = given[3].xy_mm[:25][::-1].copy()
    found = closed_form_poses(given, [C_MM] * len(given))
    assert [i for i, pose in enumerate(found) if pose is None] == [3]


def test_a_plane_from_far_away_leaves_two_poses_and_none_is_given() -> None:
    rng = np.random.default_rng(1)
    xyz, xy, _ = simulated(12, 0.0, 0.3, rng, SIGMA_MM)
    about = xyz - ORIGIN
    given = [KnownField(0.002 * about + ORIGIN, 0.002 * xy + rng.normal(0.0, SIGMA_MM, xy.shape), SIGMA_MM)]
    assert closed_form_poses(given, [C_MM]) == [None]


@pytest.mark.parametrize("gross", [0, 5])
@pytest.mark.parametrize("relief", [0.0, 0.3])
def test_the_principal_distance_of_a_lens_that_is_not_known(
    relief: float, gross: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(principal_distance, "_resections", None)  # which searches
    rng = np.random.default_rng(3)
    points = BOARD + np.column_stack([np.zeros((len(BOARD), 2)), relief * 300.0 * rng.uniform(-1.0, 1.0, len(BOARD))])
    truth = simulated_network(points, STATIONS, kind="none", distortion=(-0.05, 0.01, 0.0, 0.0))
    xy_mm = truth.network.observations.xy_mm
    wrong = rng.permutation(len(xy_mm))[: len(xy_mm) * gross // 100]
    xy_mm[wrong] += rng.uniform(-20.0, 20.0, (len(wrong), 2))
    found = approximate(without_interior(truth.network))
    assert abs(found.interior["rc20"][0] - FRAME_C_MM) < 2e-3 * FRAME_C_MM


def test_a_plane_parallel_to_the_images_does_not_tell_the_principal_distance() -> None:
    given, _ = fields([40] * 12, 0.0, 0.0, SIGMA_MM)
    together = principal_distance_together(given)
    assert together is None or together[1] > 0.15


def test_the_search_is_for_images_that_do_not_agree_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[int] = []

    def search(xyz: Array, *others: Any) -> Resection | None:
        searched.append(len(xyz))
        return resect(xyz, *others)

    monkeypatch.setattr(resection, "resect", search)
    truth = simulated_network(BOARD, STATIONS, kind="none")
    approximate(truth.network)
    assert searched == []
    few = np.delete(np.arange(len(truth.network.observations)), slice(12, 63))  # of the first image: 12 points
    network = replace(truth.network, observations=truth.network.observations.only(few))
    network.observations.xy_mm[5] += 3.0
    approximate(network)
    assert searched == [12]

"""Relative and absolute orientation and intersection, against the poses, similarities and points that were chosen."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from studies import parametrize_with_studies

from adjust.initial_values.intersection import intersect
from adjust.initial_values.model_formation import absolute_orientation, relative_poses
from adjust.initial_values.pose import Pose

Array = NDArray[np.float64]

NOISE_RAD = 3e-5  # 4.5 um at 150 mm


def pair(relief: float, tilt_rad: float, n: int, rng: np.random.Generator) -> tuple[Pose, Array, Array]:
    """A second camera about 0.5 away from a first that looks down at a field 1.5 below, and rays to the same points."""
    points = np.column_stack([rng.uniform(-0.7, 0.9, (n, 2)), -1.5 + relief * rng.uniform(-1.0, 1.0, n)])
    center = np.array([0.5, 0.1, 0.05])
    center /= np.linalg.norm(center)
    rotation = (
        Rotation.from_euler("XYZ", [rng.uniform(-tilt_rad, tilt_rad), tilt_rad, rng.uniform(-3, 3)]).as_matrix().T
    )
    second = (points * 2 - center) @ rotation.T
    first = points * 2
    noisy = [rays[:, :2] / -rays[:, 2:] + rng.normal(0.0, NOISE_RAD, (n, 2)) for rays in (first, second)]
    rays = [np.column_stack([xy, -np.ones(n)]) for xy in noisy]
    return Pose(rotation, center), rays[0], rays[1]


@pytest.mark.parametrize("relief", [0.0, 0.05, 0.3], ids=["flat", "hilly", "deep"])
@pytest.mark.parametrize("tilt_rad", [0.02, 0.35], ids=["parallel", "convergent"])
@pytest.mark.parametrize("wrong", [0, 6], ids=["clean", "gross errors"])
def test_relative_orientation_is_among_the_poses(relief: float, tilt_rad: float, wrong: int) -> None:
    rng = np.random.default_rng(4)
    for _ in range(3):
        pose, first, second = pair(relief, tilt_rad, 40, rng)
        second[:wrong, :2] += rng.uniform(0.05, 0.3, (wrong, 2))
        poses = relative_poses(first, second, np.random.default_rng(0))
        turns = [np.linalg.norm(found.rotation - pose.rotation) for found in poses]
        best = poses[int(np.argmin(turns))]
        assert min(turns) < 0.02
        assert np.linalg.norm(best.center - pose.center) < 0.05
        assert all(np.linalg.det(found.rotation) == pytest.approx(1.0) for found in poses)


def test_relative_orientation_from_exact_rays_is_exact_and_first() -> None:
    rng = np.random.default_rng(2)
    pose, first, _ = pair(0.3, 0.3, 12, rng)
    points = first / -first[:, 2:] * rng.uniform(2.0, 4.0, (12, 1))
    exact = (points - pose.center) @ pose.rotation.T
    found = relative_poses(points, exact, np.random.default_rng(0))[0]
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-6)
    np.testing.assert_allclose(found.center, pose.center, atol=1e-6)


def model_in_space(rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Model points and stations, and the same in the object space, the cameras above."""
    points = rng.uniform(-1.0, 1.0, (12, 3)) * [900.0, 900.0, 200.0] + [5e4, 2e4, 300.0]
    stations = np.array([[5e4, 2e4, 1800.0], [5.05e4, 2e4, 1750.0]])
    turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    shift = rng.uniform(-3.0, 3.0, 3)
    return (
        (points - points[0]) @ turn.T / 700.0 + shift,
        (stations - points[0]) @ turn.T / 700.0 + shift,
        points,
        stations,
    )


@parametrize_with_studies("datum", ["all", "minimal", "planimetry and three heights"], quick=(1,))
def test_absolute_orientation_recovers_the_object_space(datum: str) -> None:
    rng = np.random.default_rng(6)
    for _ in range(4):
        model, model_stations, points, stations = model_in_space(rng)
        known = np.full_like(points, np.nan)
        if datum == "all":
            known = points
        elif datum == "minimal":
            known[0], known[1], known[2, 2] = points[0], points[1], points[2, 2]
        else:
            known[[0, 1], :2], known[[2, 3, 4], 2] = points[[0, 1], :2], points[[2, 3, 4], 2]
        similarity = absolute_orientation(model, known, model_stations)
        assert similarity is not None
        np.testing.assert_allclose(similarity.apply(model), points, atol=0.05)
        np.testing.assert_allclose(similarity.apply(model_stations), stations, atol=0.05)


def test_absolute_orientation_needs_seven_values_that_determine_it() -> None:
    model, model_stations, points, _ = model_in_space(np.random.default_rng(1))
    known = np.full_like(points, np.nan)
    known[:2] = points[:2]
    assert absolute_orientation(model, known, model_stations) is None
    known[2] = points[2]
    line = model.copy()
    line[2] = (model[0] + model[1]) / 2
    known[2] = (points[0] + points[1]) / 2
    assert absolute_orientation(line, known, model_stations) is None


def test_rays_meet_in_their_points_and_one_gross_error_does_no_harm() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (20, 3))
    centers = rng.uniform(-1.0, 1.0, (5, 3)) + np.array([0.0, 0.0, 5.0])
    number = np.repeat(np.arange(20), 5)
    origin = np.tile(centers, (20, 1))
    rays = points[number] - origin
    exact, determination = intersect(origin, rays, number, np.full((20, 3), np.nan))
    np.testing.assert_allclose(exact, points, atol=1e-9)
    assert (determination > 1e-3).all()
    rays[::5, 0] += 0.5
    robust, _ = intersect(origin, rays, number, np.full((20, 3), np.nan))
    assert np.abs(robust - points).max() < 1e-3


def test_given_coordinates_are_kept_and_one_ray_is_enough_for_the_rest() -> None:
    known = np.array([[np.nan, np.nan, 0.5], [1.0, 2.0, np.nan]])
    centers = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 5.0]])
    rays = np.array([[0.3, 0.6, -4.5], [1.0, 2.0, -4.0]]) * 2.0
    points, _ = intersect(centers, rays, np.array([0, 1]), known)
    np.testing.assert_allclose(points, [[0.3, 0.6, 0.5], [1.0, 2.0, 1.0]], atol=1e-9)


def test_parallel_rays_and_points_behind_the_camera_give_none() -> None:
    centers = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    rays = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]])
    points, determination = intersect(centers, rays, np.array([0, 0, 1, 1]), np.full((2, 3), np.nan))
    assert np.isnan(points).all()
    assert (determination == 0.0).all()

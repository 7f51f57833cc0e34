"""Resection against cv2.projectPoints: flat and deep fields, any attitude, gross errors, one image and many."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adjust.initial_values.pose import KnownField, Pose, image_distances
from adjust.initial_values.principal_distance import find_principal_distance
from adjust.initial_values.resection import resect, resect_images, resections, three_point_poses

Array = NDArray[np.float64]

C_MM = 150.0
ORIGIN = np.array([512_000.0, 6_210_000.0, 300.0])  # map coordinates: large numbers must do no harm
FIELDS = {"flat": 0.0, "hilly": 0.05, "deep": 0.4}  # height over half width
SIGMA_MM = 0.005


def simulated(
    n: int, relief: float, tilt_rad: float, rng: np.random.Generator, noise_mm: float = 0.0
) -> tuple[Array, Array, Pose]:
    """Points, their image coordinates (y up) by OpenCV, and the pose."""
    omega, phi = rng.uniform(-tilt_rad, tilt_rad, 2)
    # R3(kappa) R2(phi) R1(omega) turns the axes, not the point: the transpose of scipy's intrinsic rotation
    rotation = Rotation.from_euler("XYZ", [omega, phi, rng.uniform(-np.pi, np.pi)]).as_matrix().T
    xyz = rng.uniform(-800.0, 800.0, (n, 3)) * [1.0, 1.0, relief]
    center = -rotation.T @ np.array([rng.uniform(-200, 200), rng.uniform(-200, 200), -1530.0])
    downward = np.diag([1.0, -1.0, -1.0]) @ rotation
    camera_matrix = np.diag([C_MM, C_MM, 1.0])
    projected, _ = cv2.projectPoints(xyz, cv2.Rodrigues(downward)[0], -downward @ center, camera_matrix, np.zeros(5))
    xy = projected.reshape(-1, 2) * [1.0, -1.0] + rng.normal(0.0, noise_mm, (n, 2))
    return xyz + ORIGIN, xy, Pose(rotation, center + ORIGIN)


@pytest.mark.parametrize("relief", FIELDS.values(), ids=FIELDS.keys())
@pytest.mark.parametrize("tilt_rad", [0.05, 0.7], ids=["vertical", "oblique"])
def test_gross_errors_are_found_and_do_no_harm(relief: float, tilt_rad: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        xyz, xy, pose = simulated(40, relief, tilt_rad, rng, noise_mm=0.005)
        wrong = rng.choice(40, 8, replace=False)
        xy[wrong] += rng.uniform(1.0, 60.0, (8, 2)) * rng.choice([-1.0, 1.0], (8, 2))
        found = resect(xyz, xy, C_MM)
        assert found is not None
        assert not found.inliers[wrong].any()
        assert found.inliers.sum() >= 28
        assert np.linalg.norm(found.pose.center - pose.center) < 1.0
        assert 0.003 < found.sigma_mm < 0.008


def test_distances_are_those_of_opencv_and_infinite_behind_the_camera() -> None:
    xyz, xy, pose = simulated(10, 0.4, 0.7, np.random.default_rng(1))
    np.testing.assert_allclose(image_distances(pose, xyz, xy, C_MM), 0.0, atol=1e-6)
    np.testing.assert_allclose(image_distances(pose, xyz, xy + np.array([3.0, 4.0]), C_MM), 5.0, atol=1e-6)
    behind = 2 * pose.center - xyz
    assert np.isinf(image_distances(pose, behind, xy, C_MM)).all()


def test_three_points_leave_several_poses_the_true_one_among_them() -> None:
    rng = np.random.default_rng(3)
    counts = []
    for _ in range(20):
        xyz, xy, pose = simulated(3, 0.4, 0.5, rng)
        poses = three_point_poses(xyz, xy, C_MM)
        counts.append(len(poses))
        assert min(float(np.linalg.norm(candidate.center - pose.center)) for candidate in poses) < 1e-2
        assert all(image_distances(candidate, xyz, xy, C_MM).max() < 0.02 for candidate in poses)
    assert max(counts) <= 4
    assert max(counts) > 1


def test_points_on_one_line_give_no_pose() -> None:
    rng = np.random.default_rng(2)
    xyz, _, pose = simulated(2, 0.0, 0.05, rng)
    line = xyz[0] + np.linspace(0, 1, 8)[:, None] * (xyz[1] - xyz[0])
    camera = (line - pose.center) @ pose.rotation.T
    xy = -C_MM * camera[:, :2] / camera[:, 2:]
    for noise_mm in (0.0, 0.005):
        assert resect(line, xy + rng.normal(0.0, noise_mm, xy.shape), C_MM) is None


def known_fields(
    counts: list[int], relief: float, tilt_rad: float, noise_mm: float
) -> tuple[list[KnownField], list[Pose]]:
    rng = np.random.default_rng(5)
    drawn = [simulated(n, relief, tilt_rad, rng, noise_mm) for n in counts]
    return [KnownField(xyz, xy, SIGMA_MM) for xyz, xy, _ in drawn], [pose for _, _, pose in drawn]


@pytest.mark.parametrize("relief", [*FIELDS.values(), 0.2], ids=[*FIELDS, "between"])
@pytest.mark.parametrize("tilt_rad", [0.05, 0.7], ids=["vertical", "oblique"])
def test_exact_points_give_the_poses_of_images_of_any_size(relief: float, tilt_rad: float) -> None:
    given, poses = known_fields([40, 4, 6, 300, 12, 7, 40], relief, tilt_rad, 0.0)
    for found, pose in zip(resect_images(given, [C_MM] * len(given)), poses, strict=True):
        assert found is not None
        assert np.linalg.norm(found.center - pose.center) < 1e-3
        np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-6)


@pytest.mark.parametrize("relief", [0.0, 0.3])
def test_images_are_oriented_by_those_of_their_points_that_agree(relief: float) -> None:
    given, poses = known_fields([40] * 12, relief, 0.7, SIGMA_MM)
    given[3].xy_mm[:18] += np.random.default_rng(1).uniform(-20.0, 20.0, (18, 2))
    given[7].xy_mm[[0, 1]] = given[7].xy_mm[[1, 0]]  # exchanged
    found = resections(given, [C_MM] * len(given))
    for each, pose in zip(found, poses, strict=True):
        assert each is not None
        assert np.linalg.norm(each.pose.center - pose.center) < 2.0
    assert [each.inliers[:18].sum() for each in found if each is not None][3] == 0


def test_images_are_oriented_alike_whatever_others_there_are() -> None:
    given, _ = known_fields([40, 6, 300, 12, 7, 40], 0.3, 0.7, SIGMA_MM)
    alone = [resect_images([each], [C_MM])[0] for each in given]
    for one, each in zip(alone, resect_images(given, [C_MM] * len(given)), strict=True):
        assert one is not None
        assert each is not None
        np.testing.assert_allclose(each.center, one.center, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("gross", [0, 5])
@pytest.mark.parametrize("relief", [0.0, 0.3])
def test_the_principal_distance_of_a_lens_that_is_not_known(relief: float, gross: int) -> None:
    given, _ = known_fields([63] * 12, relief, 0.7, SIGMA_MM)
    rng = np.random.default_rng(3)
    for field in given:
        field.xy_mm[:] *= 1.0 - 0.05 * ((field.xy_mm / C_MM) ** 2).sum(axis=1, keepdims=True)
        wrong = rng.permutation(63)[: 63 * gross // 100]
        field.xy_mm[wrong] += rng.uniform(-20.0, 20.0, (len(wrong), 2))
    found = find_principal_distance(given)
    assert found is not None
    assert abs(found - C_MM) < 3e-3 * C_MM


def test_a_plane_parallel_to_the_images_does_not_tell_the_principal_distance() -> None:
    given, _ = known_fields([40] * 12, 0.0, 0.0, SIGMA_MM)
    assert find_principal_distance(given) is None

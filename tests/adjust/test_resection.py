"""Resection against cv2.projectPoints: flat and deep fields, any attitude, gross errors."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adjust.initial_values.pose import Pose, image_distances
from adjust.initial_values.resection import resect, three_point_poses

Array = NDArray[np.float64]

C_MM = 150.0
ORIGIN = np.array([512_000.0, 6_210_000.0, 300.0])  # map coordinates: large numbers must do no harm
FIELDS = {"flat": 0.0, "hilly": 0.05, "deep": 0.4}  # height over half width


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
@pytest.mark.parametrize("n", [4, 6, 12, 300])
def test_exact_points_give_the_pose(n: int, relief: float, tilt_rad: float) -> None:
    rng = np.random.default_rng(n)
    for _ in range(5):
        xyz, xy, pose = simulated(n, relief, tilt_rad, rng)
        found = resect(xyz, xy, C_MM, np.random.default_rng(0))
        assert found is not None
        assert np.linalg.norm(found.pose.center - pose.center) < 1e-3
        np.testing.assert_allclose(found.pose.rotation, pose.rotation, atol=1e-6)
        assert found.inliers.all()


@pytest.mark.parametrize("relief", FIELDS.values(), ids=FIELDS.keys())
@pytest.mark.parametrize("tilt_rad", [0.05, 0.7], ids=["vertical", "oblique"])
def test_gross_errors_are_found_and_do_no_harm(relief: float, tilt_rad: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(5):
        xyz, xy, pose = simulated(40, relief, tilt_rad, rng, noise_mm=0.005)
        wrong = rng.choice(40, 8, replace=False)
        xy[wrong] += rng.uniform(1.0, 60.0, (8, 2)) * rng.choice([-1.0, 1.0], (8, 2))
        found = resect(xyz, xy, C_MM, np.random.default_rng(0))
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
        assert resect(line, xy + rng.normal(0.0, noise_mm, xy.shape), C_MM, np.random.default_rng(0)) is None

"""Projection and distortion against OpenCV, and against the reference adjustments' own truth."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from synthetic_images.projection import camera_from_object, object_rotation
from synthetic_images.scene import PARAMETERS, Distortion, SceneCamera

Array = NDArray[np.float64]

CASES = Path(__file__).parents[1] / "cases"
FRAME = (230.0, 230.0)


def case(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((CASES / f"{name}.json").read_text(encoding="utf-8"))
    return content


def exterior(truth: dict[str, float], image: int) -> tuple[float, ...]:
    return tuple(truth[f"EO{image}.{name}"] for name in ("X0", "Y0", "Z0", "omega", "phi", "kappa"))


def test_torlegard_with_literal_decentring_agrees_with_exact_observations() -> None:
    reference = case("i_five_images_affine_paper_noisefree")
    truth, given = reference["truth"], reference["input"]
    parameters = {name: truth[f"IO.{name}"] for name in ("k3", "k5", "p1", "p2")}
    distortion = Distortion("torlegard", parameters, reference["r0"], "paper")
    camera = SceneCamera("c", FRAME, truth["IO.c"], (truth["IO.x0"], truth["IO.y0"]), distortion)
    worst = 0.0
    for image, point, x, y, *_ in given["obs"]:
        a1, a2, a3, b1, b2, b3 = (truth[f"T{image}.{name}"] for name in reference["transform_parameters"])
        observed = np.array([a1 + a2 * x + a3 * y, b1 + b2 * x + b3 * y])
        projected = camera_from_object(camera, exterior(truth, image), np.array([given["pts_obs"][point - 1]]))[0]
        worst = max(worst, float(np.abs(projected - observed).max()))
    assert worst < 1e-12  # mm


def test_juhl_leaves_the_noise_of_his_simulated_example() -> None:
    reference = case("ii_juhl_3photos")
    truth, given = reference["truth"], reference["input"]
    parameters = {name: truth[f"IO.{name}"] for name in PARAMETERS["juhl"]}
    camera = SceneCamera("c", FRAME, 150.0, (0.0, 0.0), Distortion("juhl", parameters, 100.0 * reference["r0"]))
    misses = []
    for image, point, x, y, *_ in given["obs"]:
        known = given["pts_obs"][point - 1]
        place = np.array([[truth.get(f"PT{point}.{axis}", known[i]) for i, axis in enumerate("XYZ")]])
        misses.append(camera_from_object(camera, exterior(truth, image), place)[0] - (x, y))
    assert np.std(misses, axis=0) * 1000 == pytest.approx([3.5, 3.5], abs=0.2)  # um
    assert np.abs(np.mean(misses, axis=0) * 1000).max() < 0.6


def test_opencv_family_is_opencv_in_pixels() -> None:
    """A scan of this camera, pixels of 10 um, is what OpenCV projects with its own axes and camera matrix."""
    parameters = {"k1": -0.11, "k2": 0.05, "p1": 0.0012, "p2": -0.0007, "k3": 0.01, "s1": 2e-3, "s3": -1e-3}
    camera = SceneCamera("c", (60.0, 60.0), 52.0, (0.21, -0.34), Distortion("opencv", parameters))
    station, angles = np.array([0.4, -0.3, 5.0]), (0.12, -0.2, 2.1)
    points = np.random.default_rng(3).uniform((-1.5, -1.5, -0.5), (1.5, 1.5, 0.5), (40, 3))
    down = np.diag([1.0, -1.0, -1.0])
    rotation = down @ object_rotation(*angles)
    matrix = np.array([[5200.0, 0.0, 3000.0 + 21.0], [0.0, 5200.0, 3000.0 + 34.0], [0.0, 0.0, 1.0]])
    coefficients = np.array([parameters.get(name, 0.0) for name in PARAMETERS["opencv"][:12]])
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], -rotation @ station, matrix, coefficients)
    camera_mm = camera_from_object(camera, (*station, *angles), points)
    pixels = np.column_stack([3000.0 + 100.0 * camera_mm[:, 0], 3000.0 - 100.0 * camera_mm[:, 1]])
    assert np.abs(pixels - np.asarray(expected).reshape(-1, 2)).max() < 1e-8


def test_b1_is_the_difference_of_opencvs_focal_lengths() -> None:
    plain, stretched = (
        SceneCamera("c", (60.0, 60.0), 52.0, (0.2, 0.1), Distortion("opencv", {"k1": -0.1, "b1": b1}))
        for b1 in (0.0, 0.003)
    )
    points, pose = np.array([[0.3, 0.4, 0.0]]), (0.0, 0.0, 5.0, 0.0, 0.0, 0.0)
    a, b = (camera_from_object(camera, pose, points)[0] - (0.2, 0.1) for camera in (plain, stretched))
    assert b == pytest.approx(a * (1.003, 1.0), abs=1e-12)


@pytest.mark.parametrize("family", ["torlegard", "brown"])
def test_a_purely_radial_correction_is_inverted(family: str) -> None:
    """k r^3 along a radius: the observed radius is the root of r - k r^3 = ideal, here by bisection."""
    k = 2.0e-7
    name = "k3" if family == "torlegard" else "k1"
    distortion = Distortion("torlegard" if family == "torlegard" else "brown", {name: k})
    camera = SceneCamera("c", FRAME, 150.0, (0.0, 0.0), distortion)
    point = np.array([[0.6, 0.45, 0.0]])  # 3 : 4 : 5, ideal radius 112.5
    radius = np.hypot(*camera_from_object(camera, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), point)[0])
    low, high = 100.0, 130.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if middle - k * middle**3 < 112.5 else (low, middle)
    assert radius == pytest.approx(low, abs=1e-11)


def test_the_rotation_turns_the_axes_as_the_angles_say() -> None:
    """Each elementary rotation by 90 degrees, by hand."""
    quarter = np.pi / 2
    assert object_rotation(0, 0, quarter) @ (1, 0, 0) == pytest.approx((0, -1, 0))
    assert object_rotation(quarter, 0, 0) @ (0, 1, 0) == pytest.approx((0, 0, -1))
    assert object_rotation(0, quarter, 0) @ (0, 0, 1) == pytest.approx((-1, 0, 0))


def test_points_that_no_lens_images_have_no_place() -> None:
    camera = SceneCamera("c", (60.0, 60.0), 52.0)
    points = np.array([[0.0, 0.0, 9.0], [90.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    projected = np.isfinite(camera_from_object(camera, (0.0, 0.0, 5.0, 0.0, 0.0, 0.0), points)).all(axis=1)
    assert projected.tolist() == [False, False, True]

"""Projection and distortion against OpenCV, and against the reference adjustments' own truth."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import SCANNER, scene

from synthetic_images import scene as scenes
from synthetic_images.background import scene_background
from synthetic_images.film import frame_geometry
from synthetic_images.projection import camera_from_object, object_rotation
from synthetic_images.terrain import object_from_pixel, scene_terrain, transferred

Array = NDArray[np.float64]

CASES = Path(__file__).parents[1] / "cases"
FRAME = (230.0, 230.0)


def case(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((CASES / f"{name}.json").read_text())
    return content


def exterior(truth: dict[str, float], image: int) -> tuple[float, ...]:
    return tuple(truth[f"EO{image}.{name}"] for name in ("X0", "Y0", "Z0", "omega", "phi", "kappa"))


def test_torlegard_with_literal_decentring_agrees_with_exact_observations() -> None:
    reference = case("i_five_images_affine_paper_noisefree")
    truth, given = reference["truth"], reference["input"]
    parameters = {name: truth[f"IO.{name}"] for name in ("k3", "k5", "p1", "p2")}
    distortion = scenes.SceneDistortion("torlegard", parameters, reference["r0"], "paper")
    camera = scenes.SceneCamera("c", FRAME, truth["IO.c"], (truth["IO.x0"], truth["IO.y0"]), distortion)
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
    parameters = {name: truth[f"IO.{name}"] for name in scenes.PARAMETERS["juhl"]}
    camera = scenes.SceneCamera(
        "c", FRAME, 150.0, (0.0, 0.0), scenes.SceneDistortion("juhl", parameters, 100.0 * reference["r0"])
    )
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
    camera = scenes.SceneCamera("c", (60.0, 60.0), 52.0, (0.21, -0.34), scenes.SceneDistortion("opencv", parameters))
    station, angles = np.array([0.4, -0.3, 5.0]), (0.12, -0.2, 2.1)
    points = np.random.default_rng(3).uniform((-1.5, -1.5, -0.5), (1.5, 1.5, 0.5), (40, 3))
    down = np.diag([1.0, -1.0, -1.0])
    rotation = down @ object_rotation(*angles)
    matrix = np.array([[5200.0, 0.0, 3000.0 + 21.0], [0.0, 5200.0, 3000.0 + 34.0], [0.0, 0.0, 1.0]])
    coefficients = np.array([parameters.get(name, 0.0) for name in scenes.PARAMETERS["opencv"][:12]])
    expected, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], -rotation @ station, matrix, coefficients)
    camera_mm = camera_from_object(camera, (*station, *angles), points)
    pixels = np.column_stack([3000.0 + 100.0 * camera_mm[:, 0], 3000.0 - 100.0 * camera_mm[:, 1]])
    assert np.abs(pixels - np.asarray(expected).reshape(-1, 2)).max() < 1e-8


def test_b1_is_the_difference_of_opencvs_focal_lengths() -> None:
    plain, stretched = (
        scenes.SceneCamera(
            "c", (60.0, 60.0), 52.0, (0.2, 0.1), scenes.SceneDistortion("opencv", {"k1": -0.1, "b1": b1})
        )
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
    distortion = scenes.SceneDistortion("torlegard" if family == "torlegard" else "brown", {name: k})
    camera = scenes.SceneCamera("c", FRAME, 150.0, (0.0, 0.0), distortion)
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
    camera = scenes.SceneCamera("c", (60.0, 60.0), 52.0)
    points = np.array([[0.0, 0.0, 9.0], [90.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    projected = np.isfinite(camera_from_object(camera, (0.0, 0.0, 5.0, 0.0, 0.0, 0.0), points)).all(axis=1)
    assert projected.tolist() == [False, False, True]


PLACES = np.random.default_rng(1).uniform(-5.5, 5.5, (20, 2))
CENTER = (170.0, 160.0)
LENS = scenes.SceneTakingLens(500.0, CENTER, k1=-0.2, k2=0.1, p1=2e-3, p2=-1e-3, k3=0.05)


def test_a_taking_lens_puts_pixels_where_opencv_does_and_gives_them_back() -> None:
    through = frame_geometry(scene(scanner=replace(SCANNER, lens=LENS, bend_um={"a20": 30.0})), 0)
    ideal = frame_geometry(scene(scanner=replace(SCANNER, bend_um={"a20": 30.0})), 0).pixel_from_camera(PLACES)
    rays = np.column_stack([(ideal - CENTER) / LENS.focal_px, np.ones(len(ideal))])
    matrix = np.array([[500.0, 0.0, 170.0], [0.0, 500.0, 160.0], [0.0, 0.0, 1.0]])
    expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array([-0.2, 0.1, 2e-3, -1e-3, 0.05]))[0]
    pictured = through.pixel_from_camera(PLACES)
    np.testing.assert_allclose(pictured, expected[:, 0], atol=1e-9)
    assert np.abs(pictured - ideal).max() > 1.0
    np.testing.assert_allclose(through.camera_from_scan(pictured), PLACES, atol=1e-6)


BROWN = scenes.SceneDistortion("brown", {"k1": 2e-6, "p1": 1e-5})
OPENCV = scenes.SceneDistortion("opencv", {"k1": -0.1, "k2": 0.02, "p1": 1e-3, "b1": 1e-3})


def crosswise(distortion: scenes.SceneDistortion = BROWN, relief: float = 8.0) -> scenes.Scene:
    """Two small frames over hilly ground, the second turned and its scan mirrored."""
    film = scenes.FilmTransformation(scale=(1.0003, 0.9996), shear_rad=1e-4)
    return scenes.Scene(
        name="hills",
        seed=4,
        camera=scenes.SceneCamera("c", (40.0, 40.0), 30.0, (0.1, -0.05), distortion),
        field=scenes.DiskField((), 1.0),
        images=(
            scenes.SceneImage("a", (-20.0, 0.0, 300.0, 0.02, -0.03, 0.01), film=film),
            scenes.SceneImage("b", (30.0, 10.0, 310.0, -0.02, 0.04, 1.6), pose="90m", film=film),
        ),
        scanner=scenes.SceneScanner((100.0, 100.0)),
        film=scenes.SceneFilm(deformation_um=20.0),
        background="terrain",
        ground=15.0,
        relief=relief,
    )


@pytest.mark.parametrize("distortion", [BROWN, OPENCV, scenes.SceneDistortion()])
def test_rays_lead_to_terrain_that_is_visible_at_the_same_pixel(distortion: scenes.SceneDistortion) -> None:
    scene = crosswise(distortion)
    geometry = frame_geometry(scene, 1)
    pixels = np.random.default_rng(1).uniform(60.0, 440.0, (50, 2))
    places = object_from_pixel(geometry, pixels)
    assert np.allclose(places[:, 2], scene_terrain(scene).heights(places[:, :2]), atol=1e-7)
    assert np.abs(geometry.pixel_from_object(places) - pixels).max() < 1e-6


def test_relief_has_the_rms_that_is_requested_and_its_slopes_are_its_derivatives() -> None:
    terrain = scene_terrain(crosswise())
    plan = np.random.default_rng(2).uniform(-5e4, 5e4, (20000, 2))
    assert np.std(terrain.heights(plan)) == pytest.approx(8.0, rel=0.03)
    step = np.array([1e-3, 0.0])
    numeric = (terrain.heights(plan[:50] + step) - terrain.heights(plan[:50] - step)) / 2e-3
    assert np.allclose(terrain.slopes(plan[:50])[:, 0], numeric, atol=1e-6)


def test_the_same_terrain_has_the_same_tone_in_both_frames() -> None:
    scene = crosswise()
    background = scene_background(scene)
    first, second = (frame_geometry(scene, index) for index in (0, 1))
    a, b = (background.rows(each, 0, each.height_px).astype(float) for each in (first, second))
    columns, rows = (each.ravel() for each in np.meshgrid(np.arange(120, 380, 3), np.arange(120, 380, 3)))
    places = transferred(np.stack([columns, rows], axis=1).astype(float), first, second)
    inside = ((places > 2.0) & (places < 496.0)).all(axis=1)
    col, row = np.floor(places[inside]).astype(int).T
    fraction = places[inside] - np.floor(places[inside])
    view = sum(
        b[row + j, col + i] * np.abs(1 - i - fraction[:, 0]) * np.abs(1 - j - fraction[:, 1])
        for i in (0, 1)
        for j in (0, 1)
    )
    here = a[rows, columns][inside]
    assert np.corrcoef(here, view)[0, 1] > 0.98
    plane = replace(scene, relief=0.0)
    flat = transferred(np.array([[200.0, 220.0]]), frame_geometry(plane, 0), frame_geometry(plane, 1))
    hilly = transferred(np.array([[200.0, 220.0]]), first, second)
    assert np.linalg.norm(flat - hilly) > 0.5


def test_strips_of_the_terrain_join() -> None:
    scene = crosswise()
    background, geometry = scene_background(scene), frame_geometry(scene, 0)
    whole = background.rows(geometry, 0, 100)
    assert np.allclose(
        np.vstack([background.rows(geometry, 0, 37), background.rows(geometry, 37, 63)]), whole, atol=1e-3
    )

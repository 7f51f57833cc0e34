"""Disks in perspective, against the truth of rendered frames, whose projection is another program's."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import rotation_from_angles
from adjust.functional_model.transformation import Film
from pipeline.measuring.target_field import across, disk_images, disk_normals, eccentricity_mm, plane_normal
from pipeline.rendered.scene_file import read_scene
from pipeline.results.comparator_file import pixel_from_comparator
from synthetic_images.frame import frame_truth
from synthetic_images.truth import Truth, truth_json


def test_eccentricity_and_place_of_a_disk_are_those_of_the_rendered_one(rendered_demo: Path) -> None:
    truth = json.loads((rendered_demo / "truth.json").read_text(encoding="utf-8"))
    (camera,) = truth["cameras"].values()
    radius = 0.013  # m
    largest = 0.0
    for frame in truth["images"].values():
        model = true_model(camera, frame)
        shown = {id: place for id, place in frame["targets"].items() if place["visible"]}
        points = [truth["points"][id] for id in shown]
        centers = np.array([[point[axis]["value"] for axis in "XYZ"] for point in points])
        normals = np.array([point["normal"] for point in points])
        pitch = tuple(frame["pitch_um"])
        place_px, maps, perspective, visible = disk_images(model, pitch, centers, normals, radius)
        assert visible.all()
        # A point of the plane ten radii off, moved by perspective by up to 0.8 px: film and lens hardly bend here.
        off_px = maps @ (6.0, 8.0)
        first, second = across(normals)
        far, _ = model.comparator_from_object(centers + radius * (6.0 * first + 8.0 * second))
        projected_px = place_px + off_px / (1.0 + np.sum(perspective * off_px, axis=1))[:, None]
        np.testing.assert_allclose(pixel_from_comparator(far, pitch), projected_px, atol=0.03)
        true_px = np.array([(place["col_px"], place["row_px"]) for place in shown.values()])
        ellipse_px = np.array([(place["ellipse_col_px"], place["ellipse_row_px"]) for place in shown.values()])
        np.testing.assert_allclose(place_px, true_px, atol=1e-6)
        off_px = pixel_from_comparator(eccentricity_mm(model, centers, normals, radius), pitch)
        np.testing.assert_allclose(off_px, ellipse_px - true_px, atol=2e-5)
        largest = max(largest, float(np.abs(off_px).max()))
    assert largest > 0.005  # or there was nothing to see


CLOSE = """[camera]
name = "c"
frame_mm = [24.0, 16.0]
principal_distance_mm = 20.0
[camera.distortion]
family = "brown"
[camera.distortion.value]
k1 = -2.0e-4
p1 = 2.0e-5
[field]
diameter_mm = 120.0
[[field.grid]]
first = 1
columns = 5
rows = 4
right = [0.36, 0.0, 0.0]
up = [0.0, 0.33, 0.0]
relief = 0.15
[scan]
pitch_um = 12.0
[[image]]
name = "a"
position = [0.9, -0.4, 1.6]
angles_deg = [12.0, 28.0, 10.0]
"""


def test_large_disks_at_close_range_under_strong_distortion(tmp_path: Path) -> None:
    """125 px wide and up to 1.2 px off, 0.1 px of which comes from the lens, of 2 % in the corner."""
    (tmp_path / "scene.toml").write_text(CLOSE, encoding="utf-8")
    scene = read_scene(tmp_path / "scene.toml").scene
    truth = Truth(scene, (frame_truth(scene, 0),))
    document = json.loads(truth_json(truth))
    (camera,), (frame,) = document["cameras"].values(), document["images"].values()
    shown = {id: place for id, place in frame["targets"].items() if place["visible"]}
    points = [document["points"][id] for id in shown]
    centers = np.array([[point[axis]["value"] for axis in "XYZ"] for point in points])
    normals = np.array([point["normal"] for point in points])
    off_mm = eccentricity_mm(true_model(camera, frame), centers, normals, 0.06)
    off_px = pixel_from_comparator(off_mm, tuple(frame["pitch_um"]))
    true_px = np.array(
        [(t["ellipse_col_px"] - t["col_px"], t["ellipse_row_px"] - t["row_px"]) for t in shown.values()]
    )  # fmt: skip
    assert np.abs(true_px).max() > 0.9
    np.testing.assert_allclose(off_px, true_px, atol=2e-3)


def true_model(camera: dict[str, Any], frame: dict[str, Any]) -> ImageModel:
    distortion, exterior, film = camera["distortion"], frame["exterior"], frame["transformation"]
    angles = np.deg2rad([exterior[name]["value"] for name in ("omega_deg", "phi_deg", "kappa_deg")])
    return ImageModel(
        Lens(
            Distortion(distortion["family"], {}, distortion["decentering"], distortion["r0_mm"]),
            np.array(
                [
                    camera["principal_distance_mm"]["value"],
                    camera["principal_point_mm"]["x"]["value"],
                    camera["principal_point_mm"]["y"]["value"],
                ]
            ),
            np.array([distortion[name]["value"] for name in parameter_names(distortion["family"])]),
        ),
        rotation_from_angles(angles),
        np.array([exterior[name]["value"] for name in ("X0", "Y0", "Z0")]),
        Film("affine", np.array([film[name]["value"] for name in ("a1", "a2", "a3", "b1", "b2", "b3")]), np.zeros(2)),
    )


def test_normals_of_a_flat_field_are_its_planes_and_face_the_camera() -> None:
    rng = np.random.default_rng(1)
    coordinates = np.column_stack([rng.uniform(-1.0, 1.0, (6, 2)), np.zeros(6)])
    plane = plane_normal(coordinates)
    ids = [str(i) for i in range(6)]
    below = np.array([0.0, 0.0, -5.0])
    normals, known = disk_normals(ids, coordinates, {"2": np.array([1.0, 0.0, 0.0])}, plane, below)
    assert known.all()
    np.testing.assert_allclose(normals[0], (0.0, 0.0, -1.0), atol=1e-12)
    np.testing.assert_allclose(normals[2], (1.0, 0.0, 0.0))
    _, known = disk_normals(ids, coordinates, {}, None, below)
    assert not known.any()
    assert plane_normal(rng.uniform(-1.0, 1.0, (6, 3))) is None


def test_vectors_across_are_at_right_angles() -> None:
    normals = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    first, second = across(normals)
    for one, other in ((first, normals), (second, normals), (first, second)):
        np.testing.assert_allclose(np.sum(one * other, axis=1), 0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(first, axis=1), 1.0)
    np.testing.assert_allclose(np.linalg.norm(second, axis=1), 1.0)


def test_the_ellipse_of_a_near_disk_is_that_of_its_outline() -> None:
    """Through a pinhole, of a disk a third as far off as it is wide: the centre of gravity of 4000 points' polygon."""
    radius, c = 0.9, 100.0
    centers, normals = np.array([[0.8, -0.5, -3.0], [-1.0, 0.6, -2.7]]), np.array([[0.6, 0.0, 0.8], [0.36, -0.48, 0.8]])
    film = Film("none", np.empty(0), np.zeros(2), False)
    model = ImageModel(Lens(Distortion("none", {}), np.array([c, 0.0, 0.0]), np.empty(0)), np.eye(3), np.zeros(3), film)
    found = eccentricity_mm(model, centers, normals, radius)
    angles = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    for center, normal, off in zip(centers, normals, found, strict=True):
        first = np.cross(normal, [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        outline = center + radius * (
            np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(normal, first))
        )
        x, y = -c * outline[:, 0] / outline[:, 2], -c * outline[:, 1] / outline[:, 2]
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        middle = np.array([((x + np.roll(x, -1)) * cross).sum(), ((y + np.roll(y, -1)) * cross).sum()])
        middle /= 3.0 * cross.sum()
        np.testing.assert_allclose(off, middle + c * center[:2] / center[2], atol=1e-3)


def test_the_eccentricity_of_disks_at_seven_digits_is_that_at_the_origin() -> None:
    """To a picometre and less: what coordinates of seven digits lose by rounding would be 10 pm here."""
    centers, normals = (
        np.array([[0.75, -0.5, -3.0], [-1.0, 0.625, -2.75]]),
        np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]]),
    )
    film = Film("none", np.empty(0), np.zeros(2), False)
    model = ImageModel(
        Lens(Distortion("none", {}), np.array([100.0, 0.0, 0.0]), np.empty(0)), np.eye(3), np.zeros(3), film
    )
    far = np.array([500_000.0, 5_400_000.0, 300.0])
    there = eccentricity_mm(replace(model, station=far), centers + far, normals, 0.013)
    np.testing.assert_allclose(there, eccentricity_mm(model, centers, normals, 0.013), rtol=0.0, atol=1e-12)

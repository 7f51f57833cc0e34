"""Disks in perspective, against the truth of rendered frames, whose projection is another program's."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from adjust.families import parameter_names
from adjust.network import Distortion
from adjust.projection import ImageModel
from adjust.rotation import rotation_from_angles
from adjust.transformation import Film
from pipeline.comparator_file import pixel_from_comparator
from pipeline.disks import across, disk_images, disk_normals, eccentricity_mm, plane_normal


def test_eccentricity_and_place_of_a_disk_are_those_of_the_rendered_one(rendered: Path) -> None:
    truth = json.loads((rendered / "truth.json").read_text(encoding="utf-8"))
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
        place_px, _, visible = disk_images(model, pitch, centers, normals, radius)
        assert visible.all()
        true_px = np.array([(place["col_px"], place["row_px"]) for place in shown.values()])
        ellipse_px = np.array([(place["ellipse_col_px"], place["ellipse_row_px"]) for place in shown.values()])
        np.testing.assert_allclose(place_px, true_px, atol=1e-6)
        off_px = pixel_from_comparator(eccentricity_mm(model, centers, normals, radius), pitch)
        np.testing.assert_allclose(off_px, ellipse_px - true_px, atol=5e-4)  # the lens bends ellipses a little
        largest = max(largest, float(np.abs(off_px).max()))
    assert largest > 0.005  # or there was nothing to see


def true_model(camera: dict[str, Any], frame: dict[str, Any]) -> ImageModel:
    distortion, exterior, film = camera["distortion"], frame["exterior"], frame["transformation"]
    angles = np.deg2rad([exterior[name]["value"] for name in ("omega_deg", "phi_deg", "kappa_deg")])
    return ImageModel(
        Distortion(distortion["family"], {}, distortion["decentering"], distortion["r0_mm"]),
        np.array(
            [
                camera["principal_distance_mm"]["value"],
                camera["principal_point_mm"]["x"]["value"],
                camera["principal_point_mm"]["y"]["value"],
            ]
        ),
        np.array([distortion[name]["value"] for name in parameter_names(distortion["family"])]),
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

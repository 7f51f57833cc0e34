"""Scans that the scanner bends: marks where formulas of their own put them, and the bend in truth.json."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_scene import OBLIQUE, PLACES, SCANNER, rendered, scene
from studies import parametrize_with_studies
from test_render import CENTER_PX, centroid

from synthetic_images.film import frame_geometry
from synthetic_images.scene import Film

BEND_UM = {"a20": 60.0, "b11": -50.0, "a03": 20.0, "b60": 2.0}
BENT = replace(SCANNER, bend_um=BEND_UM)
HALF_MM = 7.0  # of the bed: the frame is 12 mm wide, with a margin of 1 mm


def displaced_mm(x: float, y: float) -> tuple[float, float]:
    """The four terms as the polynomials are printed, x and y from the middle of the bed."""
    u, v = x / HALF_MM, y / HALF_MM
    p6 = (231 * u**6 - 315 * u**4 + 105 * u**2 - 5) / 16
    return 0.060 * (3 * u * u - 1) / 2 + 0.020 * (5 * v**3 - 3 * v) / 2, -0.050 * u * v + 0.002 * p6


@parametrize_with_studies("pose", ["0", "90", "180m"])
def test_a_mark_lies_where_film_and_scanner_put_it(tmp_path: Path, pose: str) -> None:
    """The bend stays in the scanner's axes however the frame is laid."""
    image = replace(OBLIQUE, pose=pose)
    picture, truth = rendered(tmp_path, scene(images=(image,), scanner=BENT))
    _, straight = rendered(tmp_path / "straight", scene(images=(image,)))
    middle_px = (np.array([truth.frames[0].geometry.width_px, truth.frames[0].geometry.height_px]) - 1) / 2
    for id in PLACES:
        bent_px = truth.frames[0].fiducials[id].center_px
        assert np.abs(centroid(picture, bent_px, 18) - bent_px).max() < 10 * CENTER_PX  # bent within itself, too
        x, y = (bent_px - middle_px) * [0.04, -0.04]
        dx, dy = displaced_mm(x, y)
        moved_px = bent_px - straight.frames[0].fiducials[id].center_px
        # The bed's middle is half a pixel from the scan's, for the origin is the centre of the first pixel.
        np.testing.assert_allclose(moved_px, [dx / 0.04, -dy / 0.04], atol=0.05)


def test_pixels_lead_back_to_the_camera() -> None:
    geometry = frame_geometry(scene(scanner=BENT, images=(replace(OBLIQUE, pose="90"),)), 0)
    camera_mm = np.random.default_rng(1).uniform(-5.5, 5.5, (20, 2))
    np.testing.assert_allclose(geometry.camera_from_scan(geometry.pixel_from_camera(camera_mm)), camera_mm, atol=1e-10)


def test_the_truth_says_the_bend(tmp_path: Path) -> None:
    rendered(tmp_path, scene(scanner=BENT))
    (scanner,) = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))["scanners"].values()
    assert scanner["half_mm"] == [HALF_MM, HALF_MM]
    assert scanner["center_mm"] == [HALF_MM, -HALF_MM]
    assert scanner["terms"]["b11"]["value"] == pytest.approx(-0.050)
    rendered(tmp_path / "straight", scene())
    assert json.loads((tmp_path / "straight" / "truth.json").read_text(encoding="utf-8"))["scanners"] == {}


def test_a_term_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="no term 'c20'"):
        replace(SCANNER, bend_um={"c20": 1.0})


@pytest.mark.parametrize("pose", ["0", "90m"])
def test_film_photographed_by_a_tilted_camera_is_visible_as_a_pinhole_sees_it(tmp_path: Path, pose: str) -> None:
    """The film's points turned about an axis in it and projected, by the collinearity of a pinhole 80 mm away."""
    image = replace(OBLIQUE, pose=pose)
    film = Film("projective", tilt_deg=8.0, tilt_direction_deg=30.0, photographed_from_mm=80.0)
    _, truth = rendered(tmp_path, scene(images=(image,), film=film))
    flat = frame_geometry(scene(images=(image,)), 0)
    axis = np.array([-np.sin(np.deg2rad(30.0)), np.cos(np.deg2rad(30.0)), 0.0])
    rotation = cv2.Rodrigues(-np.deg2rad(8.0) * axis)[0]
    for id, place in PLACES.items():
        turned = rotation @ (*(np.asarray(place) * image.film.scale), 0.0) + (0.0, 0.0, 80.0)
        pictured = 80.0 * turned[:2] / turned[2] / image.film.scale
        expected_px = flat.pixel_from_camera(pictured[None])[0]
        np.testing.assert_allclose(truth.frames[0].fiducials[id].center_px, expected_px, atol=1e-6)
    geometry = truth.frames[0].geometry
    camera_mm = np.random.default_rng(1).uniform(-5.5, 5.5, (20, 2))
    np.testing.assert_allclose(geometry.camera_from_scan(geometry.pixel_from_camera(camera_mm)), camera_mm, atol=1e-10)
    summary = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))["images"][image.name]["transformation"]
    assert {"a1", "b3", "c1", "c2"} < summary.keys()


def test_film_that_a_tilted_camera_photographed_is_projective() -> None:
    with pytest.raises(ValueError, match="projective"):
        Film("affine", tilt_deg=2.0)

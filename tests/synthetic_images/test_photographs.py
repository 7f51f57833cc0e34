"""The lens of a camera that takes the scans, against OpenCV's model."""

from dataclasses import replace

import cv2
import numpy as np
from small_scene import SCANNER, scene

from synthetic_images.film import frame_geometry
from synthetic_images.scene import TakingLens

PLACES = np.random.default_rng(1).uniform(-5.5, 5.5, (20, 2))
CENTER = (170.0, 160.0)
LENS = TakingLens(500.0, CENTER, k1=-0.2, k2=0.1, p1=2e-3, p2=-1e-3, k3=0.05)


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

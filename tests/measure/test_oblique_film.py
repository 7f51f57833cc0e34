"""Film photographed obliquely, found whatever film model is stated: steel balls under 4 % of perspective."""

from pathlib import Path

import numpy as np
from small_scene import hidden_field

from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Code, Status
from measure.marks.shapes import Disk, FiducialLayout, LayoutMark, MarkShape
from measure.scans.opening import open_scan
from measure.tone.curve import LINEAR
from synthetic_images.areas import disk
from synthetic_images.render import render_scene
from synthetic_images.scene import DrawnMark, Film, Scanner, Scene, SceneCamera, SceneFiducial, SceneImage, Tones

PLACES = {f"{x}{y}": (106.0 * x, 106.0 * y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y}
RADIUS_MM, PITCH_UM, FRAME_MM = 1.5, 150.0, (228.0, 228.0)


def test_balls_under_a_perspective_are_found_and_the_perspective_is_named(tmp_path: Path) -> None:
    ball = DrawnMark((disk((0.0, 0.0), RADIUS_MM),))
    camera = SceneCamera(
        "film", FRAME_MM, 150.0, fiducials=tuple(SceneFiducial(k, xy, ball) for k, xy in PLACES.items())
    )
    film = Film("projective", tilt_deg=float(np.degrees(np.arcsin(0.04 * 600.0 / 212.0))), tilt_direction_deg=40.0)
    scanner = Scanner((PITCH_UM, PITCH_UM), margin_mm=6.0, noise=0.01)
    image = SceneImage("f", (0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    scene = Scene("film", 1, camera, hidden_field(), (image,), scanner, film, Tones(contrast=0.0))
    (truth,) = render_scene(scene, tmp_path).frames
    shape = MarkShape((Disk((0.0, 0.0), RADIUS_MM),), "light")
    layout = FiducialLayout(tuple(LayoutMark(k, xy, (0.002, 0.002), shape) for k, xy in PLACES.items()), FRAME_MM)
    with open_scan(tmp_path / "scans" / "f.tif") as scan:
        frame = measure_fiducials(scan.replace_tone(LINEAR), layout, (PITCH_UM, PITCH_UM), FiducialOptions("0"))
    assert {mark.status for mark in frame.marks} == {Status.MEASURED}
    for mark in frame.marks:
        assert mark.center_px is not None
        assert np.abs(mark.center_px - truth.fiducials[mark.point].center_px).max() < 0.05
    (said,) = (problem for problem in frame.problems if Code.PERSPECTIVE in problem.codes)
    assert 'transformation = "projective"' in said

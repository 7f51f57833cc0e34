"""A project of small drawn frames, each with four ring-crosses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tifffile
from drawn_frames import ALIKE, CORNERS, PITCH_UM, frame_picture, pixel_from_camera

from measure.marks.shapes import FiducialLayout

CAMERA = (
    'name = "K"\nframe_mm = [17.0, 17.0]\nprincipal_distance_mm = 30.0\n'
    + "".join(
        f'[[fiducial]]\nid = "{number}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0.01\nmark = "m"\n'
        for number, (x, y) in enumerate(CORNERS, 1)
    )
    + '[mark.m]\nkind = "ring-cross"\nring_mm = 0.5\nring_line_mm = 0.1\narm_mm = 0.8\nline_mm = 0.1\n'
)
PROJECT = f'camera = "camera.toml"\nscans = ["*.tif"]\npitch_um = {PITCH_UM}\n[measure]\npose = "0"\n'


def write_project(folder: Path, names: Sequence[str], project: str = PROJECT, layout: FiducialLayout = ALIKE) -> Path:
    """project.toml with its camera and its scans, which show that layout; the frames differ in noise and turn."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.toml").write_text(CAMERA, encoding="utf-8")
    for seed, name in enumerate(names, 1):
        grey = frame_picture(layout, pixel_from_camera("0", 0.004 * seed), seed)
        tifffile.imwrite(folder / f"{name}.tif", np.clip(np.rint(grey), 0, 65535).astype(np.uint16))
    (folder / "project.toml").write_text(project, encoding="utf-8")
    return folder / "project.toml"

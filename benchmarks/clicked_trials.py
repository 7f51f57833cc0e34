"""Poses of frames measured by pictures of marks from one scan alone, as the review page tries clicks: how often a wrong
pose is called decided, and how often the true one is ruled out.

python -m benchmarks clicked_trials [--scenes 12] [--first 0]

Four like crosses on a landscape, in three frames that lie alike and one turned by 90 degrees. They are clicked in the
second; writing is stamped beside a mark of one frame or two. The first and the last are measured by these pictures. No
picture can tell the poses of such marks apart.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from measure.geometry import pose_in_camera
from pipeline.files.project_file import read_project
from pipeline.review.frame_view import measured_as_shown
from synthetic_images import areas, scene
from synthetic_images.render import render_scene

Array = NDArray[np.float64]

CORNERS = {"1": (6.0, -6.0), "2": (-6.0, -6.0), "3": (-6.0, 6.0), "4": (6.0, 6.0)}
CROSS = (areas.bar((-0.9, 0.0), (0.9, 0.0), 0.15), areas.bar((0.0, -0.9), (0.0, 0.9), 0.15))
POSES = {"f0": "0", "f1": "0", "f2": "0", "f3": "90"}
STAMPED = (("f1",), ("f0",), ("f3",), ("f1", "f2"))
CLICKED, TRIED = "f1", ("f0", "f3")
PADS_MM = (0.0, 0.0, 1.0, 1.6)
CAMERA = 'name = "small"\nframe_mm = [16.0, 16.0]\n[mark.m]\nkind = "learned"\nsize_mm = 2.4\n'
PROJECT = 'camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = 50.0\n'


def main() -> None:
    """Print every frame whose pose is wrong, then the counts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    wrong = ruled_out = frames = 0
    for seed in range(given.first, given.first + given.scenes):
        with TemporaryDirectory() as folder:
            for name, (pose, decided, possible) in tried(Path(folder), seed).items():
                frames += 1
                wrong += decided and pose != POSES[name]
                ruled_out += not decided and POSES[name] not in possible
                if POSES[name] not in possible:
                    print(f"scene {seed}, {name}: {pose}, {'decided' if decided else 'assumed'}", flush=True)
    print(f"{frames} frames: {wrong} in a wrong pose called decided; of {ruled_out} others the true pose is ruled out")


def tried(folder: Path, seed: int) -> dict[str, tuple[str, bool, set[str]]]:
    """Of each frame that is tried its pose, whether that is decided, and all poses that are possible."""
    rng = np.random.default_rng(seed)
    true = rendered(folder, seed, rng)
    (folder / "camera.toml").write_text(
        CAMERA
        + "".join(f'[[fiducial]]\nid = "{id}"\nxy_mm = [{x}, {y}]\nmark = "m"\n' for id, (x, y) in CORNERS.items())
    )
    (folder / "project.toml").write_text(PROJECT)
    clicks = np.round(true[CLICKED] + rng.uniform(-1.5, 1.5, (4, 2))).tolist()
    px = {id: (col, row) for id, (col, row) in zip(CORNERS, clicks, strict=True)}
    project, result = read_project(folder / "project.toml"), {}
    for name in TRIED:
        pose = measured_as_shown(project, CLICKED, px, name).frame.pose
        if pose is not None:
            possible = {pose.name, *(pose_in_camera(each, pose.name) for each in pose.rivals)}
            result[name] = (pose.name, pose.decided, possible)
    return result


def rendered(folder: Path, seed: int, rng: np.random.Generator) -> dict[str, Array]:
    """The scans, and where their marks lie, px."""
    images = tuple(
        scene.SceneImage(name, (40.0 * k, 10.0 * k, 100.0, 0.0, 0.0, 0.5 * k), pose=pose, turn_rad=0.004 * k)
        for k, (name, pose) in enumerate(POSES.items())
    )
    marks = tuple(scene.SceneFiducial(id, place, scene.DrawnMark(CROSS)) for id, place in CORNERS.items())
    camera = scene.SceneCamera("small", (16.0, 16.0), 30.0, fiducials=marks)
    scanner, pad_mm = scene.Scanner((50.0, 50.0), margin_mm=1.0, noise=0.004), float(rng.choice(PADS_MM))
    field = scene.DiskField((), 1.0)
    made = scene.Scene("clicked", seed, camera, field, images, scanner, background="terrain", pad_mm=pad_mm)
    render_scene(made, folder)
    told = json.loads((folder / "truth.json").read_text())["images"]
    true = {
        name: np.array([[told[name]["fiducials"][id][f"{axis}_px"] for axis in ("col", "row")] for id in CORNERS])
        for name in POSES
    }
    for name in STAMPED[seed % len(STAMPED)]:
        stamp(folder / "scans" / f"{name}.tif", true[name][rng.integers(4)], rng)
    return true


def stamp(path: Path, about_px: Array, rng: np.random.Generator) -> None:
    """Two letters beside a mark, as light or dark as anything in the scan."""
    grey = tifffile.imread(path)
    col, row = (about_px + rng.uniform(-14, 14, 2)).astype(int).tolist()
    letters, mask = "".join(rng.choice(list("ABRTEF57"), 2).tolist()), np.zeros(grey.shape, np.uint8)
    font, size, width = cv2.FONT_HERSHEY_SIMPLEX, float(rng.uniform(0.6, 1.3)), int(rng.integers(2, 5))
    cv2.putText(mask, letters, (col - 18, row + 10), font, size, (255,), width)
    grey[mask > 0] = grey.max() if rng.random() < 0.5 else grey.min()
    tifffile.imwrite(path, grey)


if __name__ == "__main__":
    main()

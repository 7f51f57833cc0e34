"""Rendered block of 32 frames over relief without orientations: by `reseau block` (COLMAP and one adjustment), and by
COLMAP alone.

python -m benchmarks colmap_block FOLDER [SEED...]

Renders 4 strips of 8 frames (60 % and 40 % overlap, 1:10,000, relief 60 m RMS, six poses, different film deformations),
runs `reseau measure` for the fiducials, marks 12 control points in all frames that show them (true places with 0.3 px
of noise, as a person would click them), and runs `reseau block`. FOLDER is kept, and existing files are used again.
With several seeds, each has its own sub-folder.
"""

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import synthetic_images
from adjust.initial_values.model_formation import absolute_orientation
from benchmarks.harness import reseau, rms
from pipeline.blocks.block_stage import quiet_colmap
from pipeline.rendered.scene_file import read_scene, render_project
from pipeline.results.comparator_file import comparator_from_pixel
from synthetic_images.film import frame_geometry
from synthetic_images.projection import object_rotation
from synthetic_images.scene import Scene
from synthetic_images.terrain import scene_terrain

Array = NDArray[np.float64]

STRIPS, FRAMES = 4, 8
BASE_M, STRIP_M, HEIGHT_M, GROUND_M = 912.0, 1370.0, 1530.0, 100.0
POSES = ("0", "180", "90m", "270", "0m", "90")
CONTROL = (4, 3)
CONTROL_SIGMA_M, CLICK_PX = 0.05, 0.3
MARGIN_MM = 12.0  # mm, margin of the frame that contains the fiducials
SEED = 11

PROJECT = """camera = "project/camera.toml"
scans = ["project/scans/*.tif"]
comparator = "comparator.csv"
output = "out"
[object]
points = "control.csv"
unit = "m"
[adjust]
transformation = "affine"
datum = "control"
"""

SCENE = f"""name = "colmap_block"
seed = {{seed}}
camera = "aerial_camera.toml"
[field]
kind = "natural"
[picture]
background = "terrain"
ground = {GROUND_M}
relief = 60.0
pad_mm = 3.6
[film]
transformation = "affine"
scale_sigma_ppm = 200.0
shear_sigma_urad = 60.0
grain = 0.015
grain_px = 0.8
dust = 60
hairs = 2
[scan]
pitch_um = 120.0
margin_mm = 6.0
turn_sigma_deg = 0.3
offset_sigma_mm = 0.5
blur_px = 0.7
noise = 0.004
compression = "lzw"
[given]
principal_distance_error_mm = 0.3
principal_point_error_mm = 0.05
fiducial_error_mm = 0.005
position_error = 0.01
angle_error_deg = 1.0
point_sigma = [0.0, 0.03]
"""


def main() -> None:
    folder, seeds = Path(sys.argv[1]), [int(word) for word in sys.argv[2:]]
    for seed in seeds or [SEED]:
        one_block(folder / str(seed) if seeds else folder, seed)


def one_block(folder: Path, seed: int) -> None:
    """Render, measure, orient and adjust a block by the user's commands, timed, and compare it with the true values."""
    print(f"seed {seed}", flush=True)
    scene = rendered(folder, seed)
    project, comparator = folder / "block.toml", folder / "comparator.csv"
    if not comparator.exists():
        project.write_text(PROJECT, encoding="utf-8")
        give_control(folder, scene, seed)
        run_timed("measure", project)
        click_control(comparator, scene, seed)
    print(run_timed("block", project, folder / "block"))
    adjustment = json.loads((folder / "block" / "out" / "adjustment.json").read_text(encoding="utf-8"))
    tell(adjustment, scene)
    tell_alone(folder / "block", scene)


def run_timed(command: str, *arguments: object) -> str:
    """Run a command and print its time; returns its output."""
    done = reseau(command, *arguments)
    print(f"reseau {command}: exit code {done.code}, {done.cpu_seconds:.0f} s of CPU in {done.seconds:.0f} s")
    return done.out


def rendered(folder: Path, seed: int) -> Scene:
    path = folder / "scene.toml"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        camera = Path(synthetic_images.__file__).parent / "scenes" / "aerial_camera.toml"
        (folder / camera.name).write_text(camera.read_text(encoding="utf-8"), encoding="utf-8")
        path.write_text(SCENE.format(seed=seed) + images(np.random.default_rng(seed)), encoding="utf-8")
        render_project(path, folder / "project")
    return read_scene(path).scene


def images(rng: np.random.Generator) -> str:
    """Image tables of the scene: strips flown in alternating directions."""
    tables = []
    for number in range(STRIPS * FRAMES):
        strip, frame = divmod(number, FRAMES)
        plan = np.array([(frame - (FRAMES - 1) / 2) * BASE_M, (strip - (STRIPS - 1) / 2) * STRIP_M])
        x, y = plan + rng.uniform(-40.0, 40.0, 2)
        z = GROUND_M + HEIGHT_M + rng.uniform(-25.0, 25.0)
        omega, phi = rng.uniform(-1.5, 1.5, 2)
        kappa = 180.0 * (strip % 2) + rng.uniform(-4.0, 4.0)
        tables.append(
            f'[[image]]\nname = "s{strip + 1}-{frame + 1}"\nposition = [{x:.1f}, {y:.1f}, {z:.1f}]\n'
            f'angles_deg = [{omega:.3f}, {phi:.3f}, {kappa:.3f}]\npose = "{POSES[number % len(POSES)]}"\n'
        )
    return "\n".join(tables)


def control_points(scene: Scene) -> Array:
    """(n, 3) control points on the ground, in a grid over the block."""
    reach = np.array([(FRAMES - 1) * BASE_M, (STRIPS - 1) * STRIP_M]) / 2.0
    x, y = np.meshgrid(*(np.linspace(-end, end, count) for end, count in zip(reach, CONTROL, strict=True)))
    plan = np.column_stack([x.ravel(), y.ravel()])
    return np.column_stack([plan, scene_terrain(scene).heights(plan)])


def give_control(folder: Path, scene: Scene, seed: int) -> None:
    """Write control.csv with survey errors."""
    true = control_points(scene)
    given = true + np.random.default_rng([seed, 6]).normal(0.0, CONTROL_SIGMA_M, true.shape)
    rows = [[f"control-{number}", *xyz, *[CONTROL_SIGMA_M] * 3] for number, xyz in enumerate(given.round(3).tolist())]
    with (folder / "control.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([["point", "X", "Y", "Z", "sX", "sY", "sZ"], *rows])


def click_control(comparator: Path, scene: Scene, seed: int) -> None:
    """Add the control points, with click errors, in all frames that show them inside their fiducials."""
    rng, true = np.random.default_rng([seed, 5]), control_points(scene)
    pitch = (float(scene.scanner.pitch_um[0]), float(scene.scanner.pitch_um[1]))
    half = np.array(scene.camera.frame_mm) / 2.0 - MARGIN_MM
    lines = comparator.read_text(encoding="utf-8").splitlines()
    for index, image in enumerate(scene.images):
        geometry = frame_geometry(scene, index)
        view = geometry.pixel_from_object(true)
        for number in np.flatnonzero((np.abs(geometry.camera_from_scan(view)) < half).all(axis=1)):
            px = view[number] + rng.normal(0.0, CLICK_PX, 2)
            (mm, sigma) = comparator_from_pixel(px, pitch), CLICK_PX * pitch[0] / 1000.0
            place = f"{mm[0]:.6f},{mm[1]:.6f},{sigma:.6f},{sigma:.6f},0,{px[0]:.4f},{px[1]:.4f}"
            lines.append(f"{image.name},control-{number},target,{place},measured,")
    comparator.write_text("\n".join(lines) + "\n", encoding="utf-8")


def tell(adjustment: dict[str, Any], scene: Scene) -> None:
    """Print the errors of orientations, lens and fiducials against the true values."""
    truth = {image.name: np.array(image.exterior) for image in scene.images}
    images = adjustment["images"]
    rows = []
    for number, element in enumerate(("X0", "Y0", "Z0", "omega_deg", "phi_deg", "kappa_deg")):
        unit = np.pi / 180.0 if number >= 3 else 1.0
        stored = [own["exterior"][element] for own in images.values()]
        off = np.array([unit * own["value"] for own in stored]) - [truth[name][number] for name in images]
        if number >= 3:
            off = (off + np.pi) % (2.0 * np.pi) - np.pi
        rows.append((element, off, np.array([unit * own["sigma"] for own in stored])))
    groups = {name: round(group["sigma0"], 3) for name, group in adjustment["groups"].items() if group["sigma0"]}
    print(f"sigma0 {adjustment['sigma0']:.3f}, redundancy {adjustment['redundancy']}, of groups {groups}")
    print(f"{'element':10} {'rms error':>12} {'rms sigma':>12} {'error/sigma':>12}   (m, urad)")
    for element, off, sigma in rows:
        unit = 1e6 if element.endswith("deg") else 1.0
        print(f"{element:10} {unit * rms(off):12.4f} {unit * rms(sigma):12.4f} {rms(off / sigma):12.3f}")
    ratios = np.concatenate([off / sigma for _, off, sigma in rows])
    print(f"all orientation elements: error over sigma {rms(ratios):.3f}")
    camera, (own,) = scene.camera, adjustment["cameras"].values()
    point, lens = own["principal_point_mm"], own["distortion"]
    quantities = {"c": own["principal_distance_mm"], "x0": point["x"], "y0": point["y"]}
    quantities |= {name: lens[name] for name in camera.distortion.parameters}
    known = {"c": camera.principal_distance_mm, "x0": camera.principal_point_mm[0], "y0": camera.principal_point_mm[1]}
    for name, value in (known | dict(camera.distortion.parameters)).items():
        found, sigma = quantities[name]["value"], quantities[name]["sigma"]
        print(f"{name:8} {found:14.7g} true {value:14.7g} sigma {sigma:10.3g}: {(found - value) / sigma:+.2f} sigmas")
    worst = [
        abs(own["fiducials"][mark.id][f"{axis}_mm"]["value"] - value) / own["fiducials"][mark.id][f"{axis}_mm"]["sigma"]
        for mark in camera.fiducials
        for axis, value in zip("xy", mark.xy_mm, strict=True)
    ]
    print(f"fiducials: rms {rms(worst):.2f}, at most {max(worst):.2f} sigmas")
    ties = [point for id, point in adjustment["points"].items() if id.startswith("tie-")]
    ground = np.array([[point[axis]["value"] for axis in "XYZ"] for point in ties])
    tell_ground("ground", ground, scene)


def tell_ground(name: str, points: Array, scene: Scene) -> None:
    above = points[:, 2] - scene_terrain(scene).heights(points[:, :2])
    print(f"{name}: {np.mean(above):+.3f} m, rms {rms(above):.3f} m beside the terrain")


def tell_alone(folder: Path, scene: Scene) -> None:
    """Print the errors of COLMAP alone, from the same features and with its default camera estimation, after a
    similarity to the true stations."""
    pycolmap = quiet_colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    models = pycolmap.incremental_mapping(str(folder / "colmap.db"), str(folder / "pictures"), str(folder), options)
    model = max(models.values(), key=lambda each: each.num_reg_images())
    poses = {Path(model.images[id].name).stem: model.images[id].cam_from_world() for id in model.reg_image_ids()}
    truth = {image.name: np.array(image.exterior) for image in scene.images}
    turns = [pose.rotation.matrix() for pose in poses.values()]
    stations = np.array([-turn.T @ pose.translation for turn, pose in zip(turns, poses.values(), strict=True)])
    true = np.array([truth[name][:3] for name in poses])
    found = absolute_orientation(stations, true, stations)
    assert found is not None
    off = found.apply(stations) - true
    angles = []
    for name, own in zip(poses, turns, strict=True):
        rotation = np.diag([1.0, -1.0, -1.0]) @ own @ found.rotation.T
        angles.append(np.arccos(np.clip((np.trace(rotation @ object_rotation(*truth[name][3:]).T) - 1.0) / 2.0, -1, 1)))
    errors = f"rms {rms(off[:, :2]):.3f} m in plan, {rms(off[:, 2]):.3f} m in height, {1e6 * rms(angles):.0f} urad"
    print(f"COLMAP alone, {len(poses)} images laid on the true stations: {errors}")
    tell_ground("  its ground", found.apply(np.array([each.xyz for each in model.points3D.values()])), scene)
    pitch_mm = read_pitch(folder)
    focal_px = np.mean([camera.mean_focal_length() for camera in model.cameras.values()])
    print(f"  its c is {focal_px * pitch_mm:.3f} mm of {scene.camera.principal_distance_mm:.3f} mm", flush=True)


def read_pitch(folder: Path) -> float:
    """Pixel pitch of the block's images, mm."""
    import tifffile

    with tifffile.TiffFile(next((folder / "frames").glob("*.tif"))) as file:
        return float(json.loads(file.pages.first.description)["pitch_mm"])


if __name__ == "__main__":
    main()

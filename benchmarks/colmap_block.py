"""A rendered block of 32 frames over relief without any orientation: through COLMAP and one adjustment, and alone.

python benchmarks/colmap_block.py FOLDER [SEED...]

Renders 4 strips of 8 frames (60 % and 40 % overlap, 1:10,000, relief 60 m rms, six poses, films of their own), measures
the fiducials, marks 12 control points in every frame that shows them (true places with 0.3 px of noise: what a person
would do), and runs `reseau block`. FOLDER is kept: what is there already is not made again. Of several seeds each has a
folder in it.
"""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import synthetic_images
from adjust.problem.network import EXTERIOR_NAMES, ObjectPoint, Prior
from adjust.problem.result import Adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.blocks.block_stage import OrientedBlock, run_block
from pipeline.blocks.mapping import run_mapping
from pipeline.blocks.ties import similarity
from pipeline.files.points_file import GivenPoints
from pipeline.files.project_file import Project, read_project
from pipeline.progress import Reporter
from pipeline.rendered.scene_file import read_scene, render_project
from pipeline.results.comparator_file import comparator_from_pixel, read_comparator
from pipeline.stages import run_measure
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
MARGIN_MM = 12.0  # of the frame: there are its fiducials
SEED = 11

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
    """Render, measure, orient, adjust and compare; each step is timed."""
    print(f"seed {seed}")
    scene = rendered(folder, seed)
    project = replace(read_project(folder / "project" / "project.toml"), ties=None, given_images=None)
    if not project.comparator.exists():
        start = time.monotonic()
        run_measure(project, Reporter())
        print(f"measuring the fiducials: {time.monotonic() - start:.0f} s")
    project = with_control(project, scene, seed)
    block = run_block(project, folder / "block", None, Reporter())
    print(f"COLMAP oriented {len(block.mapped.poses)} of {len(scene.images)} images; {block.ties} tie marks of "
          f"{block.tracks} points are taken of {len(block.mapped.points)}")  # fmt: skip
    for step, seconds in block.seconds.items():
        print(f"  {step}: {seconds:.0f} s")
    start = time.monotonic()
    adjustment = adjust_marks(block.project, read_comparator(block.project.comparator))
    print(
        f"  one adjustment: {time.monotonic() - start:.0f} s, {adjustment.termination}, {adjustment.unknowns} unknowns"
    )
    tell(adjustment, scene)
    tell_alone(block, scene)


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
    """The frames' tables: strips flown there and back."""
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


def with_control(project: Project, scene: Scene, seed: int) -> Project:
    """The project with control points, marked in every frame that shows them within its marks."""
    rng = np.random.default_rng([seed, 5])
    reach = np.array([(FRAMES - 1) * BASE_M, (STRIPS - 1) * STRIP_M]) / 2.0
    x, y = np.meshgrid(*(np.linspace(-end, end, count) for end, count in zip(reach, CONTROL, strict=True)))
    plan = np.column_stack([x.ravel(), y.ravel()])
    true = np.column_stack([plan, scene_terrain(scene).heights(plan)])
    lines = [line for line in project.comparator.read_text(encoding="utf-8").splitlines() if ",control-" not in line]
    for index, image in enumerate(scene.images):
        geometry = frame_geometry(scene, index)
        seen = geometry.pixel_from_object(true)
        camera = geometry.camera_from_scan(seen)
        half = np.array(scene.camera.frame_mm) / 2.0 - MARGIN_MM
        pitch = (float(scene.scanner.pitch_um[0]), float(scene.scanner.pitch_um[1]))
        for number in np.flatnonzero((np.abs(camera) < half).all(axis=1)):
            px = seen[number] + rng.normal(0.0, CLICK_PX, 2)
            (mm, sigma) = comparator_from_pixel(px, pitch), CLICK_PX * pitch[0] / 1000.0
            place = f"{mm[0]:.6f},{mm[1]:.6f},{sigma:.6f},{sigma:.6f},0,{px[0]:.4f},{px[1]:.4f}"
            lines.append(f"{image.name},control-{number},target,{place},measured,")
    project.comparator.write_text("\n".join(lines) + "\n", encoding="utf-8")
    given = true + rng.normal(0.0, CONTROL_SIGMA_M, true.shape)
    points = [
        ObjectPoint(f"control-{number}", *(Prior(float(value), CONTROL_SIGMA_M) for value in xyz))
        for number, xyz in enumerate(given)
    ]
    settings = replace(project.adjust, datum="control")
    return replace(project, given_points=GivenPoints(tuple(points), {}), adjust=settings)


@dataclass(frozen=True)
class Errors:
    """Errors (n,) and their standard deviations (n,)."""

    name: str
    error: Array
    sigma: Array


def tell(adjustment: Adjustment, scene: Scene) -> None:
    """Orientation, lens and fiducials against the truth."""
    names = [image.name for image in adjustment.network.images]
    truth = {image.name: np.array(image.exterior) for image in scene.images}
    rows = []
    for number, element in enumerate(EXTERIOR_NAMES):
        off = np.array([adjustment.value(f"EO.{name}.{element}") - truth[name][number] for name in names])
        if number >= 3:
            off = (off + np.pi) % (2.0 * np.pi) - np.pi
        rows.append(Errors(element, off, np.array([adjustment.sigma(f"EO.{name}.{element}") for name in names])))
    factors = {name: round(value, 3) for name, value in adjustment.variance_factors.items()}
    print(f"sigma0 {adjustment.sigma0:.3f}, redundancy {adjustment.redundancy}, variance factors {factors}")
    print(f"{'element':8} {'rms error':>12} {'rms sigma':>12} {'error/sigma':>12}")
    for row in rows:
        unit = 1e6 if row.name in EXTERIOR_NAMES[3:] else 1.0
        rms, sigma = (unit * float(np.sqrt((each**2).mean())) for each in (row.error, row.sigma))
        ratio = float(np.sqrt(((row.error / row.sigma) ** 2).mean()))
        print(f"{row.name:8} {rms:12.4f} {sigma:12.4f} {ratio:12.3f}")
    ratios = np.concatenate([row.error / row.sigma for row in rows])
    print(f"all orientation elements: error over sigma {np.sqrt((ratios**2).mean()):.3f}")
    camera = scene.camera
    own = adjustment.network.cameras[0]
    known = {"c": camera.principal_distance_mm, "x0": camera.principal_point_mm[0], "y0": camera.principal_point_mm[1]}
    known |= dict(camera.distortion.parameters)
    for name, value in known.items():
        full = f"IO.{own.name}.{name}"
        sigma = adjustment.sigma(full)
        if sigma > 0.0:
            found = adjustment.value(full)
            print(
                f"{name:8} {found:14.7g} true {value:14.7g} sigma {sigma:10.3g}: {(found - value) / sigma:+.2f} sigmas"
            )
    worst = [
        abs(adjustment.value(f"FID.{own.name}.{mark.id}.{axis}") - value)
        / adjustment.sigma(f"FID.{own.name}.{mark.id}.{axis}")
        for mark in camera.fiducials
        for axis, value in zip("xy", mark.xy_mm, strict=True)
    ]
    ground = np.array(
        [
            [adjustment.value(f"PT.{point.id}.{axis}") for axis in "XYZ"]
            for point in adjustment.network.points
            if point.id.startswith("tie-")
        ]
    )
    above = ground[:, 2] - scene_terrain(scene).heights(ground[:, :2])
    print(f"ground: {np.mean(above):+.3f} m, rms {np.sqrt(np.mean(above**2)):.3f} m beside the terrain")
    print(f"fiducials: rms {np.sqrt(np.mean(np.square(worst))):.2f}, at most {max(worst):.2f} sigmas")


def tell_alone(block: OrientedBlock, scene: Scene) -> None:
    """COLMAP by itself, its camera estimated as it does by default, its block laid on the true stations."""
    folder = block.project.comparator.parent
    alone = run_mapping(block.pictures, folder, True)
    truth = {image.name: np.array(image.exterior) for image in scene.images}
    names = sorted(alone.poses)
    stations = np.array([-rotation.T @ shift for rotation, shift in (alone.poses[name] for name in names)])
    true = np.array([truth[name][:3] for name in names])
    scale, turn, shift = similarity(stations, true)
    off = shift + scale * stations @ turn.T - true
    angles = []
    for name in names:
        rotation = np.diag([1.0, -1.0, -1.0]) @ alone.poses[name][0] @ turn.T
        angles.append(np.arccos(np.clip((np.trace(rotation @ object_rotation(*truth[name][3:]).T) - 1.0) / 2.0, -1, 1)))
    plan, height = (float(np.sqrt((part**2).mean())) for part in (off[:, :2], off[:, 2]))
    print(f"COLMAP alone, laid on the true stations: rms {plan:.3f} m in plan, {height:.3f} m in height, "
          f"{1e6 * np.sqrt(np.mean(np.square(angles))):.0f} urad")  # fmt: skip
    terrain = scene_terrain(scene)
    points = np.array([shift + scale * turn @ point for point in alone.points.values()])
    above = points[:, 2] - terrain.heights(points[:, :2])
    print(f"  its ground: {np.mean(above):+.3f} m, rms {np.sqrt(np.mean(above**2)):.3f} m beside the terrain")
    print(f"  its c is {alone.focal_px * block.pictures[0].lattice.pitch_mm:.3f} mm of "
          f"{scene.camera.principal_distance_mm:.3f} mm")  # fmt: skip


if __name__ == "__main__":
    main()

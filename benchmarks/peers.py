"""Comparison of reseau, OpenCV, mrcal and COLMAP: CPU time of calibrations, and robustness against gross errors.

python -m benchmarks peers [boards] [bundles] [gross] [commands] [VIEWS ...]     tables, all where none is named
python -m benchmarks peers one PROGRAM VIEWS flat|relief given|free PERCENT     one measurement

Each measurement runs in its own process with one thread; in each of five rounds the programs alternate, and medians and
ranges are printed. No program gets orientations. c is given with an error of half a percent, or not at all; then mrcal,
which requires one, gets twice the true value, and so does OpenCV for points in relief. mrcal, limited to flat boards,
runs in the system's interpreter; programs that are not installed are left out. The time includes approximate values,
adjustment and, for reseau and OpenCV, standard deviations. COLMAP resects image by image and adjusts with Ceres.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.solution.adjustment import Options, adjust
from benchmarks.harness import ONE_THREAD
from benchmarks.large_networks import FOCAL_MM, FRAME_MM, SIGMA_MM, Scene, make_board
from benchmarks.scale import run_timed

Array = NDArray[np.float64]
Figures = dict[str, Any]

VIEWS, ROUNDS = (20, 50, 200, 1000), 5
BUNDLES = ((60, 5000), (200, 20000))
GROSS_PERCENT, GROSS_MM = (1, 5, 20), 20.0  # per cent of the points, and largest error per axis
OFF = 1.005  # given principal distance in units of the true one
GUESS = 2.0  # the same if it is unknown but required
PIXELS_PER_MM = 10.0
PATIENCE_S = 60.0  # s; slower programs are measured once only
SYSTEM_PYTHON = "/usr/bin/python3"
SOLVED_SIGMAS = 5.0  # largest error of c, in sigmas of reseau without gross errors


def main() -> None:
    if sys.argv[1:2] == ["one"]:
        program, views, shape, c, percent = sys.argv[2:]
        print(json.dumps(one(program, int(views), shape == "relief", c == "given", int(percent))))
        return
    of_tables = [int(each) for each in sys.argv[1:] if each.isdigit()]
    for table in [each for each in sys.argv[1:] if each in TABLES] or TABLES:
        TABLES[table](of_tables or VIEWS)


def one(program: str, views: int, relief: bool, given: bool, percent: int) -> Figures:
    """CPU seconds, and the error of c in standard deviations of an adjustment without gross errors."""
    clean = make_board(views, 0.05 if relief else 0.0)
    begin = time.process_time()
    c_mm, cpu_s = PROGRAMS[program](spoilt(clean, percent), relief, given, percent > 0)
    seconds = time.process_time() - begin if cpu_s is None else cpu_s
    sigma_mm = adjust(clean.network, clean.start).sigma("IO.K.c")
    return {"seconds": seconds, "sigmas": (c_mm - FOCAL_MM) / sigma_mm}


def spoilt(scene: Scene, percent: int) -> Scene:
    """Add gross errors to some of the observations of a scene."""
    rng = np.random.default_rng(percent)
    xy_mm = scene.network.observations.xy_mm.copy()
    rows = rng.permutation(len(xy_mm))[: len(xy_mm) * percent // 100]
    xy_mm[rows] += rng.uniform(-GROSS_MM, GROSS_MM, (len(rows), 2))
    network = replace(scene.network, observations=replace(scene.network.observations, xy_mm=xy_mm))
    ends = np.cumsum([len(inside) for inside, _ in scene.seen])[:-1]
    view = [(inside, xy) for (inside, _), xy in zip(scene.seen, np.split(xy_mm, ends), strict=True)]
    return replace(scene, network=network, seen=view)


Found = tuple[float, float | None]  # c, mm, and CPU seconds if another process was used


def reseau(scene: Scene, relief: bool, given: bool, gross: bool) -> Found:
    c = Prior(FOCAL_MM * OFF, np.inf) if given else None
    cameras = tuple(replace(each, principal_distance_mm=c, x0_mm=None, y0_mm=None) for each in scene.network.cameras)
    options = Options(robust="igg3") if gross else None
    result = adjust(replace(scene.network, cameras=cameras), None, options)
    assert len(result.cofactor.variances)  # OpenCV computes them, too
    return result.value("IO.K.c"), None


def _pixels(scene: Scene) -> list[Array]:
    """Pixel coordinates (m, 2) of the marks of each image, y down."""
    return [(places * (1.0, -1.0) + FRAME_MM / 2) * PIXELS_PER_MM for _, places in scene.seen]


def opencv(scene: Scene, relief: bool, given: bool, gross: bool) -> Found:
    cv2.setNumThreads(1)
    points = [scene.points[inside].astype(np.float32) for inside, _ in scene.seen]
    places = [each.astype(np.float32) for each in _pixels(scene)]
    size = int(FRAME_MM * PIXELS_PER_MM)
    c = FOCAL_MM * PIXELS_PER_MM * (OFF if given else GUESS)
    start = np.array([[c, 0.0, size / 2], [0.0, c, size / 2], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | (cv2.CALIB_USE_INTRINSIC_GUESS if given or relief else 0)
    found = cv2.calibrateCameraExtended(points, places, (size, size), start, np.zeros(5), flags=flags)
    return float(found[1][0, 0]) / PIXELS_PER_MM, None


def colmap(scene: Scene, relief: bool, given: bool, gross: bool) -> Found:
    import pycolmap

    size = int(FRAME_MM * PIXELS_PER_MM)
    c = FOCAL_MM * PIXELS_PER_MM * (OFF if given else GUESS)
    camera = pycolmap.Camera(
        camera_id=1, model="OPENCV", width=size, height=size, params=[c, c, size / 2, size / 2, 0.0, 0.0, 0.0, 0.0]
    )
    block, config = pycolmap.Reconstruction(), pycolmap.BundleAdjustmentConfig()
    block.add_camera_with_trivial_rig(camera)
    resection = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=not given)
    resection.ransac.random_seed = 1
    tracks: dict[int, Any] = {}
    for number, ((inside, _), places) in enumerate(zip(scene.seen, _pixels(scene), strict=True), 1):
        own = pycolmap.Camera(model="OPENCV", width=size, height=size, params=camera.params)
        refinement = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=not given)
        pose = pycolmap.estimate_and_refine_absolute_pose(places, scene.points[inside], own, resection, refinement)
        if pose is None:
            continue
        marks = pycolmap.Point2DList([pycolmap.Point2D(place) for place in places])
        shown = pycolmap.Image(image_id=number, camera_id=1, name=str(number), points2D=marks)
        block.add_image_with_trivial_frame(shown, pose["cam_from_world"])
        config.add_image(number)
        for place, i in enumerate(inside):
            if pose["inlier_mask"][place]:
                tracks.setdefault(int(i), pycolmap.Track()).add_element(number, place)
        if not given:
            block.camera(1).params = [own.params[0]] * 2 + list(camera.params[2:])
    for i, track in tracks.items():
        config.add_constant_point(block.add_point3D(scene.points[i], track))
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.solver_options.num_threads, options.ceres.solver_options.max_num_iterations = 1, 100
    if gross:
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = SIGMA_MM * PIXELS_PER_MM
    pycolmap.create_default_ceres_bundle_adjuster(options, config, block).solve()
    return float(np.mean(block.camera(1).params[:2])) / PIXELS_PER_MM, None


MRCAL = """
import json, sys, time, numpy as np, cv2, mrcal
cv2.setNumThreads(1)
given = np.load(sys.argv[1])
observations, size, c, gross = given["observations"], int(given["size"]), float(given["c"]), bool(given["gross"])
begin = time.process_time()
indices = np.column_stack([np.arange(len(observations)), np.zeros(len(observations)), -np.ones(len(observations))])
indices = indices.astype(np.int32)
sizes = np.array([[size, size]], dtype=np.int32)
core, extrinsics, frames = mrcal.seed_stereographic(
    imagersizes=sizes, focal_estimate=c, indices_frame_camera=indices[:, :2].copy(), observations=observations,
    object_spacing=0.1)
problem = dict(
    extrinsics_rt_fromref=np.zeros((0, 6)), frames_rt_toref=frames, points=None, observations_board=observations,
    indices_frame_camintrinsics_camextrinsics=indices, observations_point=None,
    indices_point_camintrinsics_camextrinsics=None, imagersizes=sizes, calibration_object_spacing=0.1, verbose=False,
    do_apply_regularization=False, do_optimize_calobject_warp=False, do_apply_outlier_rejection=False,
    do_optimize_extrinsics=False, do_optimize_frames=True)
intrinsics = core
mrcal.optimize(intrinsics=intrinsics, lensmodel="LENSMODEL_STEREOGRAPHIC", do_optimize_intrinsics_core=False,
    do_optimize_intrinsics_distortions=False, **problem)
intrinsics = np.hstack([core, np.zeros((1, 5))])
problem["do_apply_outlier_rejection"] = gross
mrcal.optimize(intrinsics=intrinsics, lensmodel="LENSMODEL_OPENCV5", do_optimize_intrinsics_core=True,
    do_optimize_intrinsics_distortions=True, **problem)
print(json.dumps([float(intrinsics[0, :2].mean()), time.process_time() - begin]))
"""


def mrcal(scene: Scene, relief: bool, given: bool, gross: bool) -> Found:
    """Run mrcal in a process of the system's interpreter."""
    observations = np.full((len(scene.seen), 100, 3), -1.0)
    for of_view, (inside, _), places in zip(observations, scene.seen, _pixels(scene), strict=True):
        of_view[inside] = np.column_stack([places, np.ones(len(places))])
    file = Path(f"/tmp/peers-{os.getpid()}.npz")
    size, c = FRAME_MM * PIXELS_PER_MM, FOCAL_MM * PIXELS_PER_MM * (OFF if given else GUESS)
    np.savez(file, observations=observations.reshape(-1, 10, 10, 3), size=size, c=c, gross=gross)
    try:
        done = subprocess.run([SYSTEM_PYTHON, "-c", MRCAL, file], capture_output=True, text=True, check=True)
    finally:
        file.unlink()
    c_px, seconds = json.loads(done.stdout.splitlines()[-1])
    return c_px / PIXELS_PER_MM, seconds


PROGRAMS: dict[str, Callable[[Scene, bool, bool, bool], Found]] = {
    "reseau": reseau, "opencv": opencv, "mrcal": mrcal, "colmap": colmap,
}  # fmt: skip


def _once(program: str, views: int, shape: str, c: str, percent: int) -> Figures:
    command = [sys.executable, __file__, "one", program, str(views), shape, c, str(percent)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False, env=os.environ | ONE_THREAD
        )
    except subprocess.TimeoutExpired:
        return {}
    return {} if done.returncode else dict(json.loads(done.stdout.splitlines()[-1]))


def _rounds(programs: Sequence[str], measure: Callable[[str], Figures]) -> dict[str, list[Figures]]:
    """Measure the programs in turn, ROUNDS times; those that fail or are too slow once."""
    found: dict[str, list[Figures]] = {program: [] for program in programs}
    for _ in range(ROUNDS):
        for program, figures in found.items():
            if all(each and each["seconds"] < PATIENCE_S for each in figures):
                figures.append(measure(program))
    return found


def _describe(figures: Sequence[Figures]) -> str:
    if not all(figures):
        return "fails"
    seconds = [each["seconds"] for each in figures]
    return f"{statistics.median(seconds):.3f} ({min(seconds):.3f} to {max(seconds):.3f})"


def boards(views_of_tables: Sequence[int]) -> None:
    """Print the CPU times of calibrations with 100 points per view."""
    print(f"\n{'views':>5} {'points':7} {'c':6}" + "".join(f"{program:>26}" for program in PROGRAMS))
    for views in views_of_tables:
        for shape in ("flat", "relief"):
            for c in ("given", "free"):
                programs = [each for each in PROGRAMS if shape == "flat" or each != "mrcal"]
                found = _rounds(programs, partial(_once, views=views, shape=shape, c=c, percent=0))
                cells = [f"{_cell(found.get(program, [])):>26}" for program in PROGRAMS]
                print(f"{views:5} {shape:7} {c:6}" + "".join(cells), flush=True)


def _cell(figures: Sequence[Figures]) -> str:
    if not figures:
        return "-"
    off = any(each and abs(each["sigmas"]) > SOLVED_SIGMAS for each in figures)
    return _describe(figures) + (" wrong" if off else "")


def bundles(_: Sequence[int]) -> None:
    """Print the CPU times of bundle adjustments with the covariance of camera, images and points."""
    for images, points in BUNDLES:
        found = _rounds(("reseau", "ceres"), partial(_bundle, images=images, points=points))
        ours, theirs = (statistics.median(each["seconds"] for each in figures) for figures in found.values())
        result = ", ".join(f"{program} {_describe(figures)}" for program, figures in found.items())
        print(f"{images} images, {points} points: {result}; ratio {ours / theirs:.2f}", flush=True)


def _bundle(program: str, images: int, points: int) -> Figures:
    found = run_timed(program, images=images, points=points)
    return found | {"seconds": found["cpu_seconds"]} if found else {}


def gross(views_of_tables: Sequence[int]) -> None:
    """Print errors of c in standard deviations and CPU times with gross errors, for up to 50 views."""
    print(f"\n{'views':>5} {'points':7} {'c':6} {'%':>3}" + "".join(f"{program:>20}" for program in PROGRAMS))
    for views in [each for each in views_of_tables if each <= 50]:
        for shape in ("flat", "relief"):
            for c in ("given", "free"):
                for percent in GROSS_PERCENT:
                    found = [
                        {} if shape == "relief" and program == "mrcal" else _once(program, views, shape, c, percent)
                        for program in PROGRAMS
                    ]
                    result = [f"{each['sigmas']:.1f} in {each['seconds']:.2f} s" if each else "-" for each in found]
                    print(
                        f"{views:5} {shape:7} {c:6} {percent:3}" + "".join(f"{each:>20}" for each in result), flush=True
                    )


def commands(_: Sequence[int]) -> None:
    """Print the CPU times of commands on the demonstration's five frames."""
    command = str(Path(sys.executable).with_name("reseau"))
    with TemporaryDirectory() as folder:
        subprocess.run([command, "demo", folder], capture_output=True, check=False, env=os.environ | ONE_THREAD)
        project = f"{folder}/project.toml"
        arguments = {"--help": ["--help"]} | {name: [name, project] for name in ("status", "adjust", "check", "report")}
        found = _rounds(list(arguments), lambda name: _run_once([command, *arguments[name]]))
    for name, figures in found.items():
        print(f"reseau {name}: {_describe(figures)}", flush=True)


def _run_once(command: Sequence[str]) -> Figures:
    before = sum(os.times()[2:4])  # CPU time of child processes
    done = subprocess.run(command, capture_output=True, check=False, env=os.environ | ONE_THREAD)
    return {} if done.returncode > 1 else {"seconds": sum(os.times()[2:4]) - before}  # 1: needs a look


TABLES = {"boards": boards, "bundles": bundles, "gross": gross, "commands": commands}

if __name__ == "__main__":
    main()

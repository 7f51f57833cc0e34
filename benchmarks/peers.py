"""Comparison of reseau, OpenCV, mrcal and COLMAP: CPU time of calibrations, and robustness against gross errors.

Tables: boards (100 points per view), gross (errors in up to 20 % of the points), bundles (with the covariance of
camera, images and points), commands (of the demonstration's five frames).

Each row has its own process with one thread; in each of five rounds the programs alternate, and medians and ranges are
printed. No program gets orientations. c is given with an error of half a percent, or not at all; then mrcal, which
requires one, gets twice the true value, and so does OpenCV for points in relief. mrcal, limited to flat boards, runs in
the system's interpreter. The time includes approximate values, adjustment and, for reseau and OpenCV, standard
deviations. COLMAP resects image by image and adjusts with Ceres.
"""

import json
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.solution.adjustment import Options, adjust
from benchmarks import harness, scale
from benchmarks.harness import Row
from benchmarks.large_networks import FOCAL_MM, FRAME_MM, SIGMA_MM, LargeScene, make_board
from benchmarks.scale import GUESS, OFF, PIXELS_PER_MM, pixels_of_images

Array = NDArray[np.float64]

OWN_PROCESS = True
VIEWS = (20, 50, 200, 1000)
OPENCV_VIEWS, GROSS_VIEWS = (
    200,
    50,
)  # largest numbers of views: of OpenCV, which takes minutes for more; of gross errors
BUNDLES = ((60, 5000), (200, 20000))
GROSS_PERCENT, GROSS_MM = (1, 5, 20), 20.0  # per cent of the points, and largest error per axis
COMMANDS = ("--help", "status", "adjust", "check", "report")
SYSTEM_PYTHON = "/usr/bin/python3"
SOLVED_SIGMAS = 5.0  # largest error of c, in sigmas of reseau without gross errors


def cells(views: tuple[int, ...] = VIEWS, rounds: int = 5) -> Iterator[Row]:
    for count, shape, c in product(views, ("flat", "relief"), ("given", "free")):
        programs = [
            name
            for name in PROGRAMS
            if (shape == "flat" or name != "mrcal") and (count <= OPENCV_VIEWS or name != "opencv")
        ]
        network = {"images": count, "shape": shape, "c": c}
        for round_, program in product(range(rounds), programs):
            yield {"table": "boards", **network, "program": program, "round": round_}
        for percent, program in product(GROSS_PERCENT if count <= GROSS_VIEWS else (), programs):
            yield {"table": "gross", **network, "percent": percent, "program": program}
    for (images, points), round_, program in product(BUNDLES, range(rounds), ("reseau", "ceres")):
        yield {"table": "bundles", "images": images, "points": points, "program": program, "round": round_}
    for round_, command in product(range(rounds), COMMANDS):
        yield {"table": "commands", "program": command, "round": round_}


def case(
    table: str, program: str, images: int = 0, points: int = 0, shape: str = "flat", c: str = "given", percent: int = 0,
    round: int = 0,
) -> Row:  # fmt: skip
    """CPU seconds and, of boards, the error of c in standard deviations of an adjustment without gross errors."""
    if table == "commands":
        return {"cpu": command_s(program)}
    if table == "bundles":
        return {"cpu": scale.case("unknown", program, images, points)["cpu_seconds"]}
    clean = make_board(images, 0.05 if shape == "relief" else 0.0)
    try:
        c_mm, seconds = PROGRAMS[program](spoilt(clean, percent), shape == "relief", c == "given", percent > 0)
    except Exception as error:  # of any of the programs
        return {"cpu": None, "says": str(error)}
    return {"cpu": seconds, "sigmas": (c_mm - FOCAL_MM) / adjust(clean.network, clean.start).sigma("IO.K.c")}


def report(rows: Sequence[Row]) -> Iterator[str]:
    """A line for each network: medians and ranges of the programs' CPU seconds, and errors of c beyond the limit."""
    for network, own in groupby(rows, lambda row: [row.get(key) for key in NETWORK]):
        by_program: dict[str, list[Row]] = {}
        for row in own:
            by_program.setdefault(row["program"], []).append(row)
        programs = (f"{program} {_describe(figures)}" for program, figures in by_program.items())
        yield f"{' '.join(str(each) for each in network if each is not None)}: {', '.join(programs)}"


NETWORK = ("table", "images", "points", "shape", "c", "percent")


def _describe(figures: Sequence[Row]) -> str:
    if any(each["cpu"] is None for each in figures):
        return "fails"
    seconds, off = [each["cpu"] for each in figures], [abs(each.get("sigmas", 0.0)) for each in figures]
    spread = f" ({min(seconds):.3f} to {max(seconds):.3f})" if len(seconds) > 1 else ""
    wrong = f" off by {max(off):.1f} sigmas" if max(off) > SOLVED_SIGMAS else ""
    return f"{statistics.median(seconds):.3f}{spread}{wrong}"


def command_s(command: str) -> float:
    """CPU time of a command on the demonstration's frames."""
    with TemporaryDirectory() as folder:
        if command == "--help":
            return harness.reseau(command).cpu_seconds
        harness.reseau("demo", folder)
        return harness.reseau(command, f"{folder}/project.toml").cpu_seconds


def spoilt(scene: LargeScene, percent: int) -> LargeScene:
    """Add gross errors to some of the observations of a scene."""
    rng = np.random.default_rng(percent)
    xy_mm = scene.network.observations.xy_mm.copy()
    rows = rng.permutation(len(xy_mm))[: len(xy_mm) * percent // 100]
    xy_mm[rows] += rng.uniform(-GROSS_MM, GROSS_MM, (len(rows), 2))
    network = replace(scene.network, observations=replace(scene.network.observations, xy_mm=xy_mm))
    ends = np.cumsum([len(inside) for inside, _ in scene.visible])[:-1]
    view = [(inside, xy) for (inside, _), xy in zip(scene.visible, np.split(xy_mm, ends), strict=True)]
    return replace(scene, network=network, visible=view)


Found = tuple[float, float]  # c, mm, and CPU seconds


def reseau(scene: LargeScene, relief: bool, given: bool, gross: bool) -> Found:
    c = Prior(FOCAL_MM * OFF, np.inf) if given else None
    found = scale.reseau_from_points(scene, c, Options(robust="igg3") if gross else None)
    return found["c_mm"], found["cpu_seconds"]


def opencv(scene: LargeScene, relief: bool, given: bool, gross: bool) -> Found:
    found = scale.opencv(scene, free=not given, flat=not relief)
    return found["c_mm"], found["cpu_seconds"]


def colmap(scene: LargeScene, relief: bool, given: bool, gross: bool) -> Found:
    import pycolmap

    begin = time.process_time()
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
    for number, ((inside, _), places) in enumerate(zip(scene.visible, pixels_of_images(scene), strict=True), 1):
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
    return float(np.mean(block.camera(1).params[:2])) / PIXELS_PER_MM, time.process_time() - begin


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


def mrcal(scene: LargeScene, relief: bool, given: bool, gross: bool) -> Found:
    """Run mrcal in a process of the system's interpreter."""
    observations = np.full((len(scene.visible), 100, 3), -1.0)
    for of_view, (inside, _), places in zip(observations, scene.visible, pixels_of_images(scene), strict=True):
        of_view[inside] = np.column_stack([places, np.ones(len(places))])
    size, c = FRAME_MM * PIXELS_PER_MM, FOCAL_MM * PIXELS_PER_MM * (OFF if given else GUESS)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "scene.npz"
        np.savez(file, observations=observations.reshape(-1, 10, 10, 3), size=size, c=c, gross=gross)
        done = subprocess.run([SYSTEM_PYTHON, "-c", MRCAL, file], capture_output=True, text=True, check=True)
    c_px, seconds = json.loads(done.stdout.splitlines()[-1])
    return c_px / PIXELS_PER_MM, seconds


PROGRAMS: dict[str, Callable[[LargeScene, bool, bool, bool], Found]] = {
    "reseau": reseau, "opencv": opencv, "mrcal": mrcal, "colmap": colmap,
}  # fmt: skip

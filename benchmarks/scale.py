"""Time and memory of large adjustments beside OpenCV, SciPy and Ceres, each in a process of its own with one thread.

python -m benchmarks scale                      the whole table
python -m benchmarks scale known reseau 200     one measurement: task, program, views
python -m benchmarks scale known start 200      approximations; "nothing": without a principal distance, and adjusted
python -m benchmarks scale unknown ceres 200 20000

A single measurement is of as many threads as OPENBLAS_NUM_THREADS says.

Ceres is measured where pycolmap is installed, which brings it. CPU seconds are told, so that other work does not count.
"""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from adjust.functional_model.rotation import rotation_from_angles
from adjust.initial_values.approximations import approximate
from adjust.least_squares.iteration import linearise
from adjust.least_squares.numbering import Numbering
from adjust.problem.network import Exterior
from adjust.problem.problem import ABSENT, number
from adjust.solution.adjustment import adjust
from benchmarks.large_networks import (
    CONTROL_EVERY,
    FLIP,
    FOCAL_MM,
    FRAME_MM,
    SIGMA_MM,
    Scene,
    make_board,
    strip,
    unknown,
)

Array = NDArray[np.float64]
Figures = dict[str, Any]

VIEWS, VIEWS_OF_RESEAU_ALONE = (50, 200, 1000), (4000,)
NETWORKS = ((50, 2000), (200, 20000))  # images and unknown points
NETWORK_OF_RESEAU_ALONE = (1000, 50000)
STRIPS, STRIPS_OF_RESEAU_ALONE, HANGING = (500,), (1000, 2000, 4000), 1000  # images
PATIENCE_S = 300.0  # of CPU time, for SciPy
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}


def main() -> None:
    """One measurement, or all of them."""
    if len(sys.argv) > 1:
        task, program, *sizes = sys.argv[1:]
        print(json.dumps(PROGRAMS[task, program](*map(int, sizes))))
        return
    print("100 known points, full covariance of the camera; CPU seconds of one thread, peak MiB")
    print("tests: all residuals' tests, reliability, suspects and warnings, where they are asked for besides")
    print("start: approximations from the points alone, where none are given")
    print(f"{'views':>7} {'reseau':>16} {'OpenCV':>16} {'ratio':>7} {'tests':>9} {'start':>9}")
    for views in VIEWS:
        ours, theirs = run_timed("known", "reseau", views), run_timed("known", "opencv", views)
        ratio = f"{theirs['seconds'] / ours['seconds']:7.1f}" if "seconds" in theirs else f"{'':>7}"
        print(f"{views:7} {_figures(ours)} {_figures(theirs)} {ratio} {_besides(ours, views)}")
    for views in VIEWS_OF_RESEAU_ALONE:
        ours = run_timed("known", "reseau", views)
        print(f"{views:7} {_figures(ours)} {'':24} {_besides(ours, views)}")
    print("\nUnknown points; the covariance that each gives in the time behind +")
    for images, points in NETWORKS:
        print(f"{images} images, {points} points")
        _compare("unknown", images, points)
    images, points = NETWORK_OF_RESEAU_ALONE
    print(f"{images} images, {points} points\n    reseau   {_figures(run_timed('unknown', 'reseau', images, points))}")
    for images in STRIPS:
        print(f"A strip of {images} images")
        _compare("strip", images)
    for images in STRIPS_OF_RESEAU_ALONE:
        ours = run_timed("strip", "reseau", images)
        print(f"A strip of {images} images\n    reseau   {_figures(ours)}")
    ours = run_timed("strip", "reseau", HANGING, 0)
    print(f"A strip of {HANGING} images, known points in the first two alone\n    reseau   {_figures(ours)}")


def _compare(task: str, *sizes: int) -> None:
    """All programs on one network, and whether they have come to the same minimum."""
    vpv = {}
    for program in ("reseau", "scipy", "ceres"):
        found = run_timed(task, program, *sizes)
        print(f"    {program:8} {_figures(found)}  {found.get('says', '')}")
        if "vpv" in found and found.get("finished", True):
            vpv[program] = found["vpv"]
    different = [name for name in vpv if abs(vpv[name] / vpv["reseau"] - 1.0) > 1e-6]
    same = ", ".join(name for name in vpv if name not in different)
    print(f"    the same minimum v'Pv = {vpv['reseau']:.6f}: {same}")
    if different:
        sys.exit(f"another minimum: {', '.join(f'{name} {vpv[name]:.6f}' for name in different)}")


def run_timed(task: str, program: str, *sizes: int) -> Figures:
    """The figures of one measurement in a process of its own."""
    command = [sys.executable, __file__, task, program, *map(str, sizes)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=2 * PATIENCE_S, check=False, env=os.environ | ONE_THREAD
        )
    except subprocess.TimeoutExpired:
        return {"says": f"not done in {2 * PATIENCE_S:.0f} s"}
    if done.returncode:
        return {"says": f"not measured: {done.stderr.strip().splitlines()[-1]}"}
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _figures(found: Figures) -> str:
    if "seconds" not in found:
        return f"{'-':>16}"
    covariance = f"+{found['covariance_seconds']:.1f}" if "covariance_seconds" in found else ""
    return f"{found['seconds']:.2f}{covariance} s {found['mib']:.0f}".rjust(16)


def _besides(ours: Figures, views: int) -> str:
    """Seconds of the tests, and of approximations."""
    start = run_timed("known", "start", views)
    return " ".join(f"{each['seconds']:7.2f} s" for each in ({"seconds": ours["tests_seconds"]}, start))


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.process_time()
    result = work()
    return result, time.process_time() - begin


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def reseau(scene: Scene) -> Figures:
    """With the covariance of camera, images and points; what the observations tell besides is measured by itself."""
    result, seconds = _timed(lambda: adjust(scene.network, scene.start))
    assert result.converged
    cameras = [name for name in result.names if name.startswith("IO.")]
    starts = {first: [i for i, name in enumerate(result.names) if name.endswith(first)] for first in (".X0", ".X")}
    images, points = (np.add.outer(starts[first], np.arange(size)) for first, size in ((".X0", 6), (".X", 3)))
    of_each = result.cofactor.parts
    _, more = _timed(lambda: (result.cofactor.variances, result.cofactor_of(cameras), of_each(images), of_each(points)))
    figures = {"seconds": seconds + more, "mib": _peak_mib(), "vpv": result.vpv, "says": "everything"}
    _, tests = _timed(lambda: (result.residuals, result.groups, result.reliability, result.suspects, result.warnings))
    return figures | {"tests_seconds": tests, "mib_with_tests": _peak_mib()}


def start(scene: Scene) -> Figures:
    """Approximations from the known points alone, and that the adjustment from them leads to the same minimum."""
    found, seconds = _timed(lambda: approximate(scene.network))
    return {"seconds": seconds, "mib": _peak_mib(), "vpv": adjust(scene.network, found).vpv}


def nothing(scene: Scene) -> Figures:
    """Approximations and adjustment where nothing is given but the points, not even a principal distance."""
    cameras = tuple(
        replace(camera, principal_distance_mm=None, x0_mm=None, y0_mm=None) for camera in scene.network.cameras
    )
    network = replace(scene.network, cameras=cameras)
    found, seconds = _timed(lambda: approximate(network))
    result, more = _timed(lambda: adjust(network, found))
    return {"seconds": seconds, "adjustment_seconds": more, "mib": _peak_mib(), "vpv": result.vpv}


def opencv(scene: Scene) -> Figures:
    """OpenCV's calibration with its standard deviations, from the same principal distance."""
    cv2.setNumThreads(1)
    model = [scene.points[inside].astype(np.float32) for inside, _ in scene.seen]
    imaged = [((places * (1.0, -1.0) + FRAME_MM / 2) * 10.0).astype(np.float32) for _, places in scene.seen]
    size = int(10 * FRAME_MM)
    start = np.array([[10 * FOCAL_MM * 1.005, 0.0, size / 2], [0.0, 10 * FOCAL_MM * 1.005, size / 2], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO
    found, seconds = _timed(
        lambda: cv2.calibrateCameraExtended(model, imaged, (size, size), start, np.zeros(5), flags=flags)
    )
    count = sum(len(inside) for inside, _ in scene.seen)
    return {"seconds": seconds, "mib": _peak_mib(), "vpv": found[0] ** 2 * count / (10 * SIGMA_MM) ** 2}


class SparseProblem:
    """The residuals of a scene and their analytic sparse Jacobian, as SciPy asks for them."""

    def __init__(self, scene: Scene) -> None:
        exterior = np.full(6, np.inf)
        exterior[3:] = 1e6  # angles as unknowns, all but free: they add up
        images = tuple(
            replace(image, exterior=Exterior(scene.start.exterior[image.name], exterior))
            for image in scene.network.images
        )
        self.problem = number(replace(scene.network, images=images), scene.start)
        self.numbering, self.first = Numbering(self.problem), self.problem.start()
        self.numbers = self.numbering.numbers[self.problem.columns]
        self.covariance = self.problem.network.observations.covariance_mm2

    def at(self, x: Array) -> tuple[Array, csr_array]:
        """(2 n,) residuals and (2 n, unknowns) derivatives, in standard deviations, at changes x of the start."""
        step = np.zeros(len(self.problem.unknowns))
        step[self.numbering.free] = x
        linear = linearise(self.numbering, self.covariance, self.problem.step_state(self.first, step))
        assert linear is not None
        by = -np.linalg.solve(linear.by_observation, linear.rows.root @ linear.rows.matrix) / SIGMA_MM
        used = np.broadcast_to((self.numbers != ABSENT)[:, None, :], by.shape)
        rows = np.broadcast_to(np.arange(2 * len(by)).reshape(-1, 2, 1), by.shape)
        columns = np.broadcast_to(self.numbers[:, None, :], by.shape)
        shape = 2 * len(by), len(x)
        return linear.v_mm.ravel() / SIGMA_MM, csr_array((by[used], (rows[used], columns[used])), shape=shape)

    def of_camera(self, jacobian: csr_array) -> Array:
        """The columns of the covariance that are the camera's."""
        scale = diags_array(1.0 / np.sqrt((jacobian**2).sum(axis=0)))
        normal = (scale @ jacobian.T @ jacobian @ scale).tocsc()
        factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        camera = self.numbering.numbers[self.problem.unknowns.camera["K"]]
        unit = np.zeros((len(self.numbering.free), int((camera != ABSENT).sum())))
        unit[camera[camera != ABSENT], np.arange(unit.shape[1])] = 1.0
        return np.asarray(factor.solve(unit))


def scipy(scene: Scene) -> Figures:
    """Trust region with LSMR on the same residuals and their analytic sparse Jacobian; then the camera's covariance."""
    problem = SparseProblem(scene)
    begin = time.process_time()

    def patient(**_: Any) -> None:
        if time.process_time() - begin > PATIENCE_S:
            raise StopIteration

    zero = np.zeros(len(problem.numbering.free))
    solve: Any = least_squares
    found = solve(
        lambda x: problem.at(x)[0], zero, lambda x: problem.at(x)[1], x_scale="jac", method="trf",
        tr_solver="lsmr", tr_options={"atol": 1e-10, "btol": 1e-10},
        ftol=1e-10, xtol=1e-10, gtol=1e-10, max_nfev=5000, callback=lambda intermediate_result: patient(),
    )  # fmt: skip
    seconds = time.process_time() - begin
    says = f"{found.nfev} evaluations" + ("" if found.status > 0 else ", stopped before it converged")
    _, more = _timed(lambda: problem.of_camera(found.jac))
    return {
        "seconds": seconds, "covariance_seconds": more, "mib": _peak_mib(), "vpv": 2.0 * float(found.cost),
        "finished": found.status > 0, "says": f"{says}; covariance of the camera alone",
    }  # fmt: skip


def ceres(scene: Scene) -> Figures:
    """COLMAP's bundle adjustment by Ceres, and its covariance of camera, images and points by the Schur complement."""
    import pycolmap

    unit = 1.0 / SIGMA_MM  # pixels of unit weight
    parameters = unit * np.array([FOCAL_MM * 1.005, 0.0, 0.0, 0.0, 0.0])
    block = pycolmap.Reconstruction()
    block.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="RADIAL", width=1, height=1, params=parameters)
    )
    config = pycolmap.BundleAdjustmentConfig()
    tracks: dict[int, Any] = {}
    for number_, (image, (inside, places)) in enumerate(zip(scene.network.images, scene.seen, strict=True), 1):
        start = scene.start.exterior[image.name]
        rotation = FLIP @ rotation_from_angles(start[3:])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ start[:3])
        marks = pycolmap.Point2DList([pycolmap.Point2D(place * (unit, -unit)) for place in places])
        shown = pycolmap.Image(image_id=number_, camera_id=1, name=image.name, points2D=marks)
        block.add_image_with_trivial_frame(shown, pose)
        config.add_image(number_)
        for place, i in enumerate(inside):
            tracks.setdefault(int(i), pycolmap.Track()).add_element(number_, place)
    numbers = {i: block.add_point3D(scene.start.points[str(i)], track) for i, track in tracks.items()}
    for i, number_ in numbers.items():
        if scene.network.points[i].X is not None:
            block.points3D[number_].xyz = scene.points[i]
            config.add_constant_point(number_)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations = 1, 100
    solver.function_tolerance = 1e-12
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, block)
    summary, seconds = _timed(adjuster.solve)
    wanted = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.ALL)
    covariance, more = _timed(lambda: pycolmap.estimate_ba_covariance(wanted, block, adjuster))
    return {
        "seconds": seconds, "covariance_seconds": more, "mib": _peak_mib(),
        "vpv": 2.0 * summary.ceres_summary.final_cost,
        "says": "everything" if covariance is not None else "its covariance failed",
    }  # fmt: skip


PROGRAMS: dict[tuple[str, str], Callable[..., Figures]] = {
    ("known", "reseau"): lambda views: reseau(make_board(views)),
    ("known", "start"): lambda views: start(make_board(views)),
    ("known", "nothing"): lambda views: nothing(make_board(views)),
    ("known", "opencv"): lambda views: opencv(make_board(views)),
    ("unknown", "reseau"): lambda images, points: reseau(unknown(images, points)),
    ("unknown", "scipy"): lambda images, points: scipy(unknown(images, points)),
    ("strip", "reseau"): lambda images, control=CONTROL_EVERY: reseau(strip(images, control)),
    ("strip", "scipy"): lambda images: scipy(strip(images)),
    ("strip", "ceres"): lambda images: ceres(strip(images)),
    ("unknown", "ceres"): lambda images, points: ceres(unknown(images, points)),
}

if __name__ == "__main__":
    main()

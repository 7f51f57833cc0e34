"""Time and memory of large adjustments compared with OpenCV, SciPy and Ceres, each in its own process with one thread.

python -m benchmarks scale                                                          the whole table
python -m benchmarks scale --case unknown --program ceres --images 60 --points 5000 --json

Cases: "known", a board of 100 known points, from approximate values; "free", the same without any, not even a principal
distance (`--flat`: points in a plane); "unknown", an aerial block; "strip". cpu_seconds include the adjustment with all
its covariances, and in "free" the approximate values; vpv is the weighted sum of squared residuals.

Ceres is measured if pycolmap, which includes it, is installed.
"""

import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from adjust.functional_model.lens import Prior
from adjust.functional_model.rotation import rotation_from_angles
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import linearise
from adjust.problem.network import Exterior
from adjust.problem.problem import ABSENT, number
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment
from benchmarks.harness import Row
from benchmarks.large_networks import (
    CONTROL_EVERY,
    FLIP,
    FOCAL_MM,
    FRAME_MM,
    SIGMA_MM,
    LargeScene,
    make_board,
    strip,
    unknown,
)

Array = NDArray[np.float64]
Figures = dict[str, Any]

OWN_PROCESS = True
COLUMNS = {
    "case": "", "program": "", "images": "", "points": "", "observations": "", "cpu_seconds": ".3f",
    "covariance_seconds": ".3f", "tests_seconds": ".2f", "mib": ".0f", "vpv": ".6f", "says": "",
}  # fmt: skip
VIEWS, VIEWS_OF_RESEAU_ALONE = (20, 50, 200, 1000), (4000,)
NETWORKS = ((60, 5000), (200, 20000), (500, 50000))  # images and unknown points
STRIPS, STRIPS_OF_RESEAU_ALONE, HANGING = (500,), (1000, 2000, 4000), 1000  # images
LEAST_SCIPY_IMAGES = 200  # largest number of images for SciPy, which takes minutes
PATIENCE_S = 300.0  # s, limit of the CPU time of SciPy
GUESS = 2.0  # principal distance in units of the true one, for programs that require one
OFF = 1.005  # the same where it is given
PIXELS_PER_MM = 10.0


def cells() -> Iterator[Row]:
    for views in (*VIEWS, *VIEWS_OF_RESEAU_ALONE):
        for program in ("reseau", "opencv") if views in VIEWS else ("reseau",):
            yield {"case": "known", "program": program, "images": views}
            yield {"case": "free", "program": program, "images": views}
    for images, points in NETWORKS:
        for program in ("reseau", "ceres", *(("scipy",) if images <= LEAST_SCIPY_IMAGES else ())):
            yield {"case": "unknown", "program": program, "images": images, "points": points}
    for images in (*STRIPS, *STRIPS_OF_RESEAU_ALONE):
        for program in ("reseau", "ceres") if images in STRIPS else ("reseau",):
            yield {"case": "strip", "program": program, "images": images}
    yield {"case": "hanging strip", "program": "reseau", "images": HANGING}


def case(case: str, program: str, images: int, points: int = 0, flat: bool = False) -> Row:
    """Measure one program on one network."""
    scene = {
        "known": lambda: make_board(images, 0.0 if flat else 0.05),
        "free": lambda: make_board(images, 0.0 if flat else 0.05),
        "unknown": lambda: unknown(images, points),
        "strip": lambda: strip(images, CONTROL_EVERY),
        "hanging strip": lambda: strip(images, 0),
    }[case]()
    programs: dict[str, Callable[[LargeScene], Figures]] = {
        "reseau": reseau_from_points if case == "free" else reseau,
        "opencv": lambda scene: opencv(scene, free=case == "free", flat=flat),
        "scipy": scipy,
        "ceres": ceres,
    }
    return {"observations": len(scene.network.observations), **programs[program](scene)}


def report(rows: Sequence[Row]) -> Iterator[str]:
    """Yield, for networks adjusted by several programs, the time of the first one relative to each other one, and
    whether they reached the same minimum."""
    networks: dict[tuple[object, ...], list[Row]] = {}
    for row in rows:
        networks.setdefault((row["case"], row["images"], row.get("points")), []).append(row)
    for (name, images, _), of_network in networks.items():
        first, *others = of_network
        for other in others:
            same = "the same" if abs(other["vpv"] / first["vpv"] - 1.0) < 1e-6 else "another"
            ratio = first["cpu_seconds"] / other["cpu_seconds"]
            yield f"{name}, {images} images: {ratio:.2f} of the time of {other['program']}, {same} minimum"


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.process_time()
    result = work()
    return result, time.process_time() - begin


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def reseau(scene: LargeScene) -> Figures:
    """Measure reseau with the covariance of camera, images and points; residuals, tests and reliability separately."""
    result, seconds = _timed(lambda: adjust(scene.network, scene.start))
    assert result.converged
    cameras = [name for name in result.names if name.startswith("IO.")]
    starts = {first: [i for i, name in enumerate(result.names) if name.endswith(first)] for first in (".X0", ".X")}
    images, points = (np.add.outer(starts[first], np.arange(size)) for first, size in ((".X0", 6), (".X", 3)))
    of_each = result.cofactor.parts
    _, more = _timed(lambda: (result.cofactor.variances, result.cofactor_of(cameras), of_each(images), of_each(points)))
    figures = {"cpu_seconds": seconds + more, "covariance_seconds": more, "mib": _peak_mib(), "vpv": result.vpv}
    _, tests = _timed(lambda: (result.residuals, result.groups, result.reliability, result.suspects, result.warnings))
    return figures | {"tests_seconds": tests, "mib_with_tests": _peak_mib()}


def reseau_from_points(scene: LargeScene, c: Prior | None = None, options: Options | None = None) -> Figures:
    """Measure approximate values and adjustment with only the points given, and a principal distance or not even
    that."""
    cameras = tuple(replace(each, principal_distance_mm=c, x0_mm=None, y0_mm=None) for each in scene.network.cameras)

    def adjusted() -> Adjustment:
        result = adjust(replace(scene.network, cameras=cameras), None, options)
        assert len(result.cofactor.variances)  # OpenCV computes them, too
        return result

    result, seconds = _timed(adjusted)
    return {"cpu_seconds": seconds, "mib": _peak_mib(), "vpv": result.vpv, "c_mm": result.value("IO.K.c")}


def opencv(scene: LargeScene, free: bool, flat: bool) -> Figures:
    """Measure OpenCV's calibration with its standard deviations. free: without a principal distance, or with a wrong
    one for points in relief, which require one."""
    cv2.setNumThreads(1)
    model = [scene.points[inside].astype(np.float32) for inside, _ in scene.visible]
    imaged = [pixels.astype(np.float32) for pixels in pixels_of_images(scene)]
    size, c = int(PIXELS_PER_MM * FRAME_MM), PIXELS_PER_MM * FOCAL_MM * (GUESS if free else OFF)
    start = np.array([[c, 0.0, size / 2], [0.0, c, size / 2], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | (0 if free and flat else cv2.CALIB_USE_INTRINSIC_GUESS)
    found, seconds = _timed(
        lambda: cv2.calibrateCameraExtended(model, imaged, (size, size), start, np.zeros(5), flags=flags)
    )
    vpv = found[0] ** 2 * sum(map(len, imaged)) / (PIXELS_PER_MM * SIGMA_MM) ** 2
    return {"cpu_seconds": seconds, "mib": _peak_mib(), "vpv": vpv, "c_mm": float(found[1][0, 0]) / PIXELS_PER_MM}


def pixels_of_images(scene: LargeScene) -> list[Array]:
    """Pixel coordinates (m, 2) of the marks of each image, y down."""
    return [(places * (1.0, -1.0) + FRAME_MM / 2) * PIXELS_PER_MM for _, places in scene.visible]


class SparseProblem:
    """Residuals of a scene and their analytic sparse Jacobian, in SciPy's form."""

    def __init__(self, scene: LargeScene) -> None:
        exterior = np.full(6, np.inf)
        exterior[3:] = 1e6  # nearly free, so that angles are additive unknowns
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
        """Columns of the covariance for the camera parameters."""
        scale = diags_array(1.0 / np.sqrt((jacobian**2).sum(axis=0)))
        normal = (scale @ jacobian.T @ jacobian @ scale).tocsc()
        factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        camera = self.numbering.numbers[self.problem.unknowns.camera["K"]]
        unit = np.zeros((len(self.numbering.free), int((camera != ABSENT).sum())))
        unit[camera[camera != ABSENT], np.arange(unit.shape[1])] = 1.0
        return np.asarray(factor.solve(unit))


def scipy(scene: LargeScene) -> Figures:
    """Measure SciPy: trust region with LSMR and the analytic sparse Jacobian, then the covariance of the camera."""
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
        "cpu_seconds": seconds + more, "covariance_seconds": more, "mib": _peak_mib(), "vpv": 2.0 * float(found.cost),
        "says": f"{says}; covariance of the camera alone",
    }  # fmt: skip


def ceres(scene: LargeScene) -> Figures:
    """Measure COLMAP's bundle adjustment by Ceres, with the covariance of camera, images and points by the Schur
    complement."""
    import pycolmap

    unit = 1.0 / SIGMA_MM  # pixels of unit weight
    parameters = unit * np.array([FOCAL_MM * 1.005, 0.0, 0.0, 0.0, 0.0])
    block = pycolmap.Reconstruction()
    block.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="RADIAL", width=1, height=1, params=parameters)
    )
    config = pycolmap.BundleAdjustmentConfig()
    tracks: dict[int, Any] = {}
    for number_, (image, (inside, places)) in enumerate(zip(scene.network.images, scene.visible, strict=True), 1):
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
        "cpu_seconds": seconds + more, "covariance_seconds": more, "mib": _peak_mib(),
        "vpv": 2.0 * summary.ceres_summary.final_cost,
        "says": "everything" if covariance is not None else "its covariance failed",
    }  # fmt: skip

"""Validity of the standard deviations of board calibrations: differences between two random halves of the images.

Each set is split 40 times into two halves, which are calibrated separately: by this program with an unmodelled error
and the larger of the standard deviations of the model and by leaving out images, by `cv2.calibrateCameraExtended`
and by mrcal (Debian's package) with the same corners. A difference over the root of the sum of both claimed variances
should have standard deviation 1: the figures are 1.48 times the median of its absolute value. All splits of a set share
its images: `range` is the 90 % interval of the figure for correct variances, by simulation with as many images.
--corners FOLDER keeps the measured corners.
"""

import json
import pickle
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Prior
from adjust.problem.camera import Camera
from adjust.problem.network import Image, Network, ObjectPoint
from adjust.problem.observations import Observations
from adjust.solution.adjustment import adjust_unmodelled
from benchmarks.harness import DATA, Row
from benchmarks.peers import SYSTEM_PYTHON
from measure.boards.measure import measure_board, one_definition
from measure.boards.specs import ChessboardSpec
from measure.scans.opening import open_scan
from pipeline.calibration.intrinsics import LensModel, camera_intrinsics, free_lens
from pipeline.calibration.pictures import CameraPictures
from pipeline.results.comparator_file import read_comparator

Array = NDArray[np.float64]
QUANTITIES = ("fx", "fy", "cx", "cy", "k1")
COLUMNS = {"set": "s", "pictures": "d", "lens": "s", "range": "s", "all": ".2f"} | dict.fromkeys(QUANTITIES, ".2f")
CLAIMS = ("ours", "model", "opencv", "mrcal")
COLUMNS |= dict.fromkeys(CLAIMS[1:], ".2f")
SPLITS, SIMULATIONS = 40, 2000
PIXEL_MM = 0.005
SEED = 1
GIVEN_PX = 0.02  # px, assumed standard deviation of published corners
ROBUST = 1.4826


MRCAL = """
import json, sys, numpy as np, mrcal
task, found = json.load(sys.stdin), []
for each in task["tasks"]:
    observed = np.array(each["observed"])
    count = len(observed)
    inputs = dict(
        intrinsics=np.array([each["lens"]]), extrinsics_rt_fromref=np.zeros((0, 6)), points=None,
        frames_rt_toref=np.array(each["poses"]), observations_board=observed,
        indices_frame_camintrinsics_camextrinsics=np.array([(k, 0, -1) for k in range(count)], np.int32),
        observations_point=None, indices_point_camintrinsics_camextrinsics=None,
        lensmodel="LENSMODEL_" + task["model"], imagersizes=np.array([task["size"]], np.int32),
        calibration_object_spacing=each["spacing"], do_optimize_intrinsics_core=True,
        do_optimize_intrinsics_distortions=True, do_optimize_extrinsics=False, do_optimize_frames=True,
        do_optimize_calobject_warp=False, do_apply_regularization=True, do_apply_outlier_rejection=True, verbose=False)
    for _ in range(3):
        mrcal.optimize(**inputs)
    _, residuals, by_state, _ = mrcal.optimizer_callback(**inputs)
    by_state, unit = by_state.toarray(), np.ones(by_state.shape[1])
    mrcal.unpack_state(unit, **inputs)
    used = 2 * int((observed[..., 2] > 0).sum())
    variance = (residuals**2).sum() / (used - len(unit))
    sigmas = unit * np.sqrt(variance * np.diag(np.linalg.inv(by_state.T @ by_state)))
    found.append((inputs["intrinsics"][0][:5].tolist(), sigmas[:5].tolist()))
print(json.dumps(found))
"""


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of an image: board points (n, 3), and places (n, 2), px, y down, with covariances (n, 2, 2)."""

    points: Array
    places_px: Array
    covariance_px2: Array


@dataclass(frozen=True)
class BoardSet:
    """Images of one camera. corners: returns the corners of each image."""

    size_px: tuple[int, int]
    lens: LensModel
    corners: Callable[[], Sequence[Corners]]


def measure_pattern(pattern: str, spec: ChessboardSpec) -> list[Corners]:
    """Measure the corners of images by this program."""
    marks, points = [], spec.object_points()
    for path in sorted(DATA.glob(pattern)):
        with open_scan(path) as scan:
            marks.append(measure_board(scan, spec).marks)
    found = []
    for each in one_definition(marks):
        measured_marks = [mark for mark in each if mark.status.is_observation]
        if len(measured_marks) >= 4:
            places = np.array([mark.center_px for mark in measured_marks])
            covariances = np.array([mark.covariance.px2 for mark in measured_marks if mark.covariance is not None])
            found.append(Corners(np.array([points[mark.point] for mark in measured_marks]), places, covariances))
    return found


def published(name: str) -> list[Corners]:
    """Read the corners measured by Bouguet's toolbox from its result file."""
    from scipy.io import loadmat

    found = loadmat(DATA / "chessboards" / "bouguet" / name)
    numbers = sorted(int(key[2:]) for key in found if key.startswith("x_") and key[2:].isdigit())
    pairs = [(found[f"X_{number}"].T, found[f"x_{number}"].T) for number in numbers]
    pairs = [(points, places) for points, places in pairs if places.shape[1] == 2 and np.isfinite(places).all()]
    return [Corners(points, places, np.tile(GIVEN_PX**2 * np.eye(2), (len(points), 1, 1))) for points, places in pairs]


def listed(folder: Path, pitch_mm: float) -> list[Corners]:
    """Read corners from a comparator.csv."""
    lines = (folder / "points.csv").read_text(encoding="utf-8").splitlines()[1:]
    points = {line.split(",")[0]: [float(value) for value in line.split(",")[1:4]] for line in lines}
    by_image: dict[str, list[Any]] = {}
    for mark in read_comparator(folder / "comparator.csv"):
        if mark.status.is_observation:
            by_image.setdefault(mark.image, []).append(mark)
    found = []
    for marks in by_image.values():
        places = np.array([mark.xy_mm for mark in marks]) * [1.0, -1.0] / pitch_mm
        sigmas = np.array([mark.sigma_mm for mark in marks]) / pitch_mm
        covariances = sigmas[:, :, None] * sigmas[:, None] * np.eye(2)
        found.append(Corners(np.array([points[mark.point] for mark in marks]), places, covariances))
    return found


BOUGUET = "chessboards/bouguet/Image*.tif"
VGA: dict[str, Callable[[], Sequence[Corners]]] = {
    "OpenCV left": partial(measure_pattern, "chessboards/opencv/left[01]*.jpg", ChessboardSpec(9, 6, 25.0)),
    "OpenCV right": partial(measure_pattern, "chessboards/opencv/right[01]*.jpg", ChessboardSpec(9, 6, 25.0)),
    "Bouguet left": partial(published, "Calib_Results_left.mat"),
    "Bouguet right": partial(published, "Calib_Results_right.mat"),
    "Bouguet, 25 pictures": partial(measure_pattern, BOUGUET, ChessboardSpec(13, 12, 30.0)),
    "BoofCV": partial(measure_pattern, "circles/boofcv/*_Chess/frame*.jpg", ChessboardSpec(6, 4, 30.0)),
}
CARND = partial(listed, DATA.parent / "reports" / "calibration" / "carnd_34", 0.01)
SETS = {name: BoardSet((640, 480), "opencv4", corners) for name, corners in VGA.items()}
SETS |= {"carnd_34": BoardSet((1280, 960), "opencv5", CARND)}


def cells() -> Iterator[dict[str, Any]]:
    for name in SETS:
        yield {"set": name}


def case(set: str, seed: int, corners: str | None = None) -> dict[str, Any]:
    """Evaluate the splits of one set. corners: folder that keeps the measured corners."""
    chosen = SETS[set]
    pictures = kept_corners(set, None if corners is None else Path(corners))
    rng = np.random.default_rng(seed)
    scores: dict[str, list[Array]] = {claim: [] for claim in CLAIMS}
    orders, half = [rng.permutation(len(pictures)) for _ in range(SPLITS)], len(pictures) // 2
    halves = [[pictures[each] for each in part] for order in orders for part in (order[:half], order[half:])]
    by_mrcal = calibrate_mrcal(chosen, halves)
    found = [calibrated(chosen, part) for part in halves]
    for k in range(0, len(halves), 2):
        if found[k] is None or found[k + 1] is None:
            continue
        both = [{**(found[each] or {}), "mrcal": by_mrcal[each]} for each in (k, k + 1)]
        for claim in CLAIMS:
            (a, a_sigma), (b, b_sigma) = (each[claim] for each in both)
            scores[claim].append((a - b) / np.hypot(a_sigma, b_sigma))
    sizes = {claim: np.abs(np.array(each)) for claim, each in scores.items()}
    low, high = honest_range(len(pictures))
    return {
        "pictures": len(pictures),
        "lens": chosen.lens,
        "range": f"{low:.2f} to {high:.2f}",
        "all": ROBUST * float(np.median(sizes["ours"])),
        **{name: ROBUST * float(np.median(sizes["ours"][:, place])) for place, name in enumerate(QUANTITIES)},
        **{claim: ROBUST * float(np.median(sizes[claim])) for claim in CLAIMS[1:]},
        "splits": len(sizes["ours"]),
        "sizes": {claim: each.tolist() for claim, each in sizes.items()},
    }


def report(rows: Sequence[Row]) -> Iterator[str]:
    for claim in CLAIMS:
        sizes = np.concatenate([np.array(row["sizes"][claim]) for row in rows])
        each = ", ".join(f"{name} {ROBUST * np.median(sizes[:, place]):.2f}" for place, name in enumerate(QUANTITIES))
        yield f"pooled, {claim}: {ROBUST * np.median(sizes):.2f} ({each})"


def kept_corners(name: str, folder: Path | None) -> Sequence[Corners]:
    path = None if folder is None else folder / f"{name}.pickle"
    if path is None:
        return SETS[name].corners()
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(SETS[name].corners()))
    return list(pickle.loads(path.read_bytes()))


def calibrated(chosen: BoardSet, pictures: Sequence[Corners]) -> Mapping[str, tuple[Array, Array]] | None:
    """Values and standard deviations of QUANTITIES by each method; None without a solution."""
    network = board_network(chosen, pictures)
    result = adjust_unmodelled(network)
    if not result.converged:
        return None
    images = CameraPictures("camera", *chosen.size_px, None, tuple(image.name for image in network.images))
    camera = camera_intrinsics(result, images, PIXEL_MM, left_out={}, lens=None, pitch_um=None, check=None)
    values = np.array([camera.values[name].value for name in QUANTITIES])
    return {
        "ours": (values, np.array([camera.values[name].sigma for name in QUANTITIES])),
        "model": (values, np.array([camera.values[name].sigma_model for name in QUANTITIES])),
        "opencv": calibrate_opencv(chosen, pictures),
    }


def board_network(chosen: BoardSet, pictures: Sequence[Corners]) -> Network:
    points = np.unique(np.concatenate([each.points for each in pictures]), axis=0)
    names = {tuple(point): f"p{number}" for number, point in enumerate(points.tolist())}
    counts = [len(each.points) for each in pictures]
    free = Prior(chosen.size_px[0] * PIXEL_MM, np.inf)
    width_mm, height_mm = (size * PIXEL_MM for size in chosen.size_px)
    camera = Camera(
        "camera", free, None, None, free_lens(chosen.lens, square_pixels=False),
        center_mm=(width_mm / 2, -height_mm / 2), frame_mm=(width_mm, height_mm),
    )  # fmt: skip
    xy_mm = np.concatenate([each.places_px for each in pictures]) * [PIXEL_MM, -PIXEL_MM]
    turned = np.array([[1.0, -1.0], [-1.0, 1.0]]) * PIXEL_MM**2
    return Network(
        cameras=(camera,),
        images=tuple(Image(f"i{number}", "camera", "none") for number in range(len(pictures))),
        points=tuple(ObjectPoint(name, *(Prior(value, 0.0) for value in point)) for point, name in names.items()),
        observations=Observations(
            image=tuple(f"i{number}" for number, count in enumerate(counts) for _ in range(count)),
            point=tuple(names[tuple(point)] for each in pictures for point in each.points.tolist()),
            kind=tuple("target" for _ in range(sum(counts))),
            xy_mm=xy_mm,
            covariance_mm2=np.concatenate([each.covariance_px2 for each in pictures]) * turned,
        ),
    )


def run_opencv(chosen: BoardSet, pictures: Sequence[Corners]) -> Any:
    flags = cv2.CALIB_FIX_K3 if chosen.lens == "opencv4" else 0
    points, places = ([np.asarray(part, np.float32) for part in each] for each in zip(
        *((each.points * [1, 1, 0], each.places_px) for each in pictures), strict=True
    ))  # fmt: skip
    return cv2.calibrateCameraExtended(points, places, chosen.size_px, np.eye(3), np.zeros(5), flags=flags)


def calibrate_opencv(chosen: BoardSet, pictures: Sequence[Corners]) -> tuple[Array, Array]:
    found = run_opencv(chosen, pictures)
    matrix, distortion, deviations = found[1], np.ravel(found[2]), np.ravel(found[5]).astype(np.float64)
    values = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], distortion[0]])
    return values, deviations[:5]


def calibrate_mrcal(chosen: BoardSet, halves: Sequence[Sequence[Corners]]) -> list[tuple[Array, Array]]:
    """Calibrate each half by mrcal from OpenCV's solution, in the system's interpreter; NaN where it has no mrcal."""
    tasks = []
    for pictures in halves:
        found = run_opencv(chosen, pictures)
        xy = [np.unique(np.concatenate([each.points[:, axis] for each in pictures])) for axis in (0, 1)]
        observed, poses = np.full((len(pictures), len(xy[1]), len(xy[0]), 3), -1.0), []
        for grid, each, turn, shift in zip(observed, pictures, found[3], found[4], strict=True):
            row, column = (np.searchsorted(xy[axis], each.points[:, axis]) for axis in (1, 0))
            grid[row, column] = np.column_stack([each.places_px, np.ones(len(row))])
            poses.append(
                [*turn[:, 0], *(shift[:, 0] + cv2.Rodrigues(turn)[0] @ [float(xy[0][0]), float(xy[1][0]), 0.0])]
            )
        lens = [*found[1][[0, 1, 0, 1], [0, 1, 2, 2]], *np.ravel(found[2])[: int(chosen.lens[-1])]]
        tasks.append(
            {"observed": observed.tolist(), "poses": poses, "lens": lens, "spacing": float(xy[0][1] - xy[0][0])}
        )
    task = json.dumps({"size": chosen.size_px, "model": chosen.lens.upper(), "tasks": tasks})
    done = subprocess.run([SYSTEM_PYTHON, "-c", MRCAL], input=task, capture_output=True, text=True, check=False)
    if "ModuleNotFoundError" in done.stderr:
        return [(np.full(5, np.nan), np.full(5, np.nan))] * len(halves)
    return [(np.array(values), np.array(sigmas)) for values, sigmas in json.loads(done.stdout)]


@cache
def honest_range(pictures: int) -> tuple[float, float]:
    """90 % interval of the figure of one quantity for correct variances, by simulation: each image contributes an
    independent normal value, and a half is estimated by their mean."""
    rng, figures = np.random.default_rng(0), []
    half = pictures // 2
    for _ in range(SIMULATIONS):
        values = rng.normal(size=pictures)
        orders = np.array([rng.permutation(pictures) for _ in range(SPLITS)])
        first, second = values[orders[:, :half]].mean(axis=1), values[orders[:, half:]].mean(axis=1)
        sizes = np.abs(first - second) / np.sqrt(1.0 / half + 1.0 / (pictures - half))
        figures.append(ROBUST * float(np.median(sizes)))
    low, high = np.percentile(figures, (5, 95))
    return float(low), float(high)

"""Robust initial values of orientations with gross errors, compared with OpenCV's RANSAC and USAC.

Orientations of aerial images from 12 or 40 points, a fraction of which is elsewhere in the frame. Correct is an
orientation that projects the true points to within 10 standard deviations (one image), or is correct to 0.03 rad (two).
RANSAC requires a threshold: once it is set to the noise, and once to the distortion of an unknown lens. The searches of
`adjust` estimate it.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from adjust.initial_values.model_formation import relative_poses
from adjust.initial_values.pose import Pose
from adjust.initial_values.resection import resect
from benchmarks.harness import Row

Array = NDArray[np.float64]
Found = Sequence[Pose]

SEED, C_MM, HALF_MM, SIGMA_MM = 5, 150.0, 110.0, 0.005
GATES_MM = {"3 sigma": 3 * SIGMA_MM, "0.15 mm": 0.15}
RIGHT_RAD = 0.03
CAMERA = np.diag([C_MM, C_MM, 1.0])
FLIP = np.diag([1.0, -1.0, -1.0])  # between camera axes with y up and viewing direction -z, and OpenCV's


def pose(rng: np.random.Generator) -> Pose:
    """Random pose about 1000 m above the field, tilted by a few degrees."""
    turn = cv2.Rodrigues(rng.normal(0.0, [0.08, 0.08, 1.0]))[0]
    return Pose(np.asarray(turn, float), np.array([*rng.normal(0.0, 100.0, 2), 1000.0]))


def view_points(of: Pose, xyz: Array) -> Array:
    """(n, 2) image coordinates of points (n, 3), mm, y up."""
    u, v, w = of.rotation @ (xyz - of.center).T
    return np.stack([-C_MM * u / w, -C_MM * v / w], axis=1)


def add_errors(xy_mm: Array, share: float, rng: np.random.Generator) -> Array:
    xy_mm = xy_mm + rng.normal(0.0, SIGMA_MM, xy_mm.shape)
    wrong = rng.permutation(len(xy_mm))[: round(share * len(xy_mm))]
    xy_mm[wrong] = rng.uniform(-HALF_MM, HALF_MM, (len(wrong), 2))
    return xy_mm


def pose_from_opencv(rotation: Array, shift: Array) -> Pose:
    turned = FLIP @ rotation
    return Pose(turned, -rotation.T @ shift.ravel())


def resected(xyz: Array, xy_mm: Array, rng: np.random.Generator) -> Found:
    found = resect(xyz, xy_mm, C_MM)
    return [] if found is None else [found.pose]


def solved_pnp(gate_mm: float, usac: bool, xyz: Array, xy_mm: Array, _rng: np.random.Generator) -> Found:
    pixels = xy_mm * [1.0, -1.0]
    try:
        if usac:
            params = cv2.UsacParams()
            params.threshold, params.maxIterations, params.confidence = gate_mm, 5000, 0.9999
            params.score = cv2.SCORE_METHOD_MAGSAC
            done, _, turn, shift, _ = cv2.solvePnPRansac(xyz, pixels, CAMERA, None, params=params)
        else:
            done, turn, shift, _ = cv2.solvePnPRansac(
                xyz, pixels, CAMERA, None, iterationsCount=5000, reprojectionError=gate_mm, confidence=0.9999
            )
    except cv2.error:
        return []
    return [pose_from_opencv(np.asarray(cv2.Rodrigues(turn)[0]), np.asarray(shift))] if done else []


def essential(gate_mm: float, usac: bool, first: Array, second: Array, _rng: np.random.Generator) -> Found:
    method = cv2.USAC_MAGSAC if usac else cv2.RANSAC
    one, other = first * [1.0, -1.0], second * [1.0, -1.0]
    matrix, inside = cv2.findEssentialMat(one, other, CAMERA, method, 0.9999, gate_mm)
    if matrix is None or matrix.shape != (3, 3):
        return []
    _, rotation, shift, _ = cv2.recoverPose(matrix, one, other, CAMERA, mask=inside)
    turn = np.asarray(rotation, float)
    return [Pose(FLIP @ turn @ FLIP, FLIP @ (-turn.T @ np.asarray(shift, float)).ravel())]


def from_rays(first: Array, second: Array, rng: np.random.Generator) -> Found:
    """Relative poses as `approximate` uses them: all candidates, which it tries in the block."""
    one, other = (np.column_stack([each, np.full(len(each), -C_MM)]) for each in (first, second))
    return relative_poses(one, other, rng)


def one_image(method: Callable[..., Found], points: int, share: float, relief: float, number: int) -> bool:
    rng = np.random.default_rng([SEED, number])
    xyz = np.column_stack([rng.uniform(-600.0, 600.0, (points, 2)), rng.uniform(0.0, relief, points)])
    true = pose(rng)
    clean = view_points(true, xyz)
    found = method(xyz, add_errors(clean, share, rng), rng)
    return any(np.sqrt(np.mean((view_points(each, xyz) - clean) ** 2)) < 10 * SIGMA_MM for each in found)


def two_images(method: Callable[..., Found], points: int, share: float, relief: float, number: int) -> bool:
    rng = np.random.default_rng([SEED, number])
    xyz = np.column_stack([rng.uniform(-600.0, 600.0, (points, 2)), rng.uniform(0.0, relief, points)])
    true = [pose(rng), pose(rng)]
    true[1].center[0] += 600.0
    found = method(
        *(add_errors(view_points(each, xyz), wrong, rng) for each, wrong in zip(true, (0.0, share), strict=True)), rng
    )
    rotation = true[1].rotation @ true[0].rotation.T
    base = true[0].rotation @ (true[1].center - true[0].center)
    return any(
        _angle(each.rotation @ rotation.T) < RIGHT_RAD
        and base @ each.center / np.linalg.norm(base) / np.linalg.norm(each.center) > np.cos(RIGHT_RAD)
        for each in found
    )


def _angle(rotation: Array) -> float:
    return float(np.linalg.norm(cv2.Rodrigues(rotation)[0]))


STUDIES = {"resection": (one_image, resected, solved_pnp), "relative orientation": (two_images, from_rays, essential)}
METHODS = {
    "own": None,
    **{f"{name}, {text}": (gate, name == "USAC") for name in ("RANSAC", "USAC") for text, gate in GATES_MM.items()},
}
COLUMNS = {"study": "", "points": "d", "share": ".0%", "relief_m": "g", "method": "", "right": "d", "ms": ".1f"}


def cells() -> Iterator[Row]:
    for study, relief_m in product(STUDIES, (200.0, 0.0)):
        for points, share in ((12, 0.0), (12, 1 / 4), (12, 1 / 3), (40, 1 / 3)):
            for method in METHODS:
                yield {"study": study, "points": points, "share": share, "relief_m": relief_m, "method": method}


def case(study: str, points: int, share: float, relief_m: float, method: str, count: int = 60) -> Row:
    """Number of correct orientations of `count`, and CPU time per orientation, ms."""
    run, own, theirs = STUDIES[study]
    options = METHODS[method]
    found = own if options is None else partial(theirs, *options)
    start = time.process_time()
    right = sum(run(found, points, share, relief_m, number) for number in range(count))
    return {"right": right, "ms": 1000 * (time.process_time() - start) / count}

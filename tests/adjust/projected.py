"""Networks of known points as OpenCV projects them into images: nothing of them comes from the code under test."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adjust.functional_model.lens import Distortion, Prior
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Image, Network, ObjectPoint, Transformation
from adjust.problem.observations import ObservationKind, Observations

Array = NDArray[np.float64]

C_MM, X0_MM, Y0_MM = 152.0, 0.05, -0.03
MARKS_MM = {
    str(i + 1): 106.0 * np.array(xy) for i, xy in enumerate([(1, -1), (-1, -1), (-1, 1), (1, 1), (-1, 0), (1, 0)])
}


@dataclass(frozen=True)
class Truth:
    network: Network
    rotations: dict[str, Array]
    centers: dict[str, Array]
    points: dict[str, Array]


def simulated(
    xyz: Array,
    stations: Sequence[tuple[float, float, float, float, float, float]],
    *,
    kind: Transformation = "affine",
    mirrored: bool = False,
    noise_mm: float = 0.005,
    outliers: float = 0.0,
    distortion: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    seed: int = 1,
) -> Truth:
    """A network of known points as OpenCV projects them, scanned with any turn; all points within 115 mm are seen."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[str, str, ObservationKind, Array]] = []
    rotations, centers = {}, {}
    for number, station in enumerate(stations):
        image = f"f{number + 1}"
        rotation = Rotation.from_euler("XYZ", station[3:]).as_matrix().T
        rotations[image], centers[image] = rotation, np.array(station[:3])
        projected = camera_coordinates(xyz, rotation, centers[image], distortion)
        marks = np.array(list(MARKS_MM.values()))
        scan = scan_from_camera(kind, mirrored, rng)
        inside = np.flatnonzero((np.abs(projected) < 115.0).all(axis=1))
        targets = projected[inside] @ scan[0].T + scan[1] + rng.normal(0.0, noise_mm, (len(inside), 2))
        wrong = rng.random(len(inside)) < outliers
        targets[wrong] += rng.uniform(-40.0, 40.0, (int(wrong.sum()), 2))
        fiducials = marks @ scan[0].T + scan[1] + rng.normal(0.0, noise_mm, marks.shape)
        rows += [(image, f"t{k}", "target", xy) for k, xy in zip(inside, targets, strict=True)]
        if kind != "none":
            rows += [(image, name, "fiducial", xy) for name, xy in zip(MARKS_MM, fiducials, strict=True)]
    names = [f"k{i}" for i in (1, 2)] + ["p1", "p2"]
    camera = Camera(
        "rc20",
        Prior(C_MM, 1.0),
        Prior(X0_MM, 1.0),
        Prior(Y0_MM, 1.0),
        Distortion("opencv", {name: Prior(value) for name, value in zip(names, distortion, strict=True)}),
        {name: Fiducial(Prior(x, 1.0), Prior(y, 1.0)) for name, (x, y) in MARKS_MM.items()} if kind != "none" else {},
    )
    points = tuple(ObjectPoint(f"t{k}", *(Prior(float(v)) for v in row)) for k, row in enumerate(xyz))
    observations = Observations(
        tuple(row[0] for row in rows),
        tuple(row[1] for row in rows),
        tuple(row[2] for row in rows),
        np.array([row[3] for row in rows]),
        np.tile(np.eye(2) * 0.005**2, (len(rows), 1, 1)),
    )
    images = tuple(Image(name, "rc20", kind) for name in rotations)
    return Truth(
        Network((camera,), images, points, observations),
        rotations,
        centers,
        {p.id: xyz[k] for k, p in enumerate(points)},
    )


def camera_coordinates(xyz: Array, rotation: Array, center: Array, distortion: Sequence[float]) -> Array:
    """Camera coordinates (n, 2), y up, by cv2.projectPoints; far outside the frame what is behind the camera."""
    downward = np.diag([1.0, -1.0, -1.0]) @ rotation
    matrix = np.array([[C_MM, 0.0, X0_MM], [0.0, C_MM, -Y0_MM], [0.0, 0.0, 1.0]])
    projected, _ = cv2.projectPoints(
        xyz, cv2.Rodrigues(downward)[0], -downward @ center, matrix, np.array(distortion, dtype=np.float64)
    )
    in_front = ((xyz - center) @ downward.T)[:, 2] > 0
    return np.where(in_front[:, None], projected.reshape(-1, 2) * [1.0, -1.0], 1e6)


def scan_from_camera(kind: Transformation, mirrored: bool, rng: np.random.Generator) -> tuple[Array, Array]:
    """A scan turned anyhow on the bed (2, 2), (2,): stretched by some per mille if affine, mirrored if asked."""
    if kind == "none":
        return np.eye(2), np.zeros(2)
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    stretch = np.eye(2) + (rng.normal(0.0, 2e-3, (2, 2)) if kind == "affine" else np.zeros((2, 2)))
    return turn @ stretch @ np.diag([-1.0 if mirrored else 1.0, 1.0]), rng.uniform(50.0, 150.0, 2)


def field(relief_m: float, seed: int = 5, n: int = 40) -> Array:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 3)) * [900.0, 900.0, relief_m]


CONVERGENT = [
    (0.0, 0.0, 1530.0, 0.0, 0.0, 0.0),
    (700.0, 100.0, 1400.0, -0.07, 0.45, 1.6),
    (-600.0, 80.0, 1600.0, -0.05, -0.4, 3.1),
    (50.0, 700.0, 1480.0, -0.45, 0.03, -1.6),
    (-80.0, -650.0, 1650.0, 0.4, -0.05, 0.4),
]
VERTICAL = [
    (-300.0, 0.0, 1530.0, 0.02, -0.03, 0.1),
    (300.0, 20.0, 1500.0, -0.03, 0.01, 2.9),
    (0.0, 200.0, 1550.0, 0.0, 0.03, -1.5),
]

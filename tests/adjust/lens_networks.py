"""Networks of the families of industrial bundles, Zhang's skew and OpenCV's fisheye, as the renderer projects them."""

import numpy as np
from numpy.typing import NDArray
from simulated import digital_network

from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.rotation import rotation_from_angles
from adjust.problem.camera import Camera
from adjust.problem.network import Network
from synthetic_images.projection import camera_from_object
from synthetic_images.scene import Distortion as SceneDistortion
from synthetic_images.scene import SceneCamera

Array = NDArray[np.float64]

R0_MM = 13.0
SIGMA_MM = 0.0004
LENSES: dict[str, tuple[float, dict[str, float]]] = {  # principal distance in mm, parameters
    "aicon": (28.8, {"a1": -1.1e-4, "a2": 1.5e-7, "b1": 5.8e-6, "b2": -8.6e-6, "c1": -7e-5, "c2": -3.1e-5}),
    "australis": (28.8, {"k1": 1.1e-4, "k2": -1.2e-7, "p1": 5.8e-6, "p2": -8.6e-6, "b1": -7e-5, "b2": -3.1e-5}),
    "opencv": (28.8, {"k1": -0.09, "k2": 0.1, "p1": 2e-4, "p2": -1e-4, "b1": 4e-4, "b2": -3e-4}),
    "opencv_fisheye": (11.0, {"k1": 0.03, "k2": -0.01, "b1": 4e-4, "b2": -3e-4}),
}
POSES = [(0.0, 0.0, 0.1), (0.5, 0.1, 1.6), (-0.5, 0.2, 3.1), (0.1, 0.5, -1.5), (-0.1, -0.5, 0.8), (0.3, -0.3, 2.3)]


def scene_camera(name: str) -> SceneCamera:
    c, values = LENSES[name]
    return SceneCamera("L", (80.0, 80.0), c, (0.12, -0.07), SceneDistortion(name, values, R0_MM))  # type: ignore[arg-type]


def make_network(name: str, rng: np.random.Generator | None = None) -> Network:
    """Six views of a deep field, 36 mm x 24 mm, known points; the lens free and unknown, c given roughly."""
    camera, (c, values) = scene_camera(name), LENSES[name]
    half = np.array([18.0, 12.0])
    reach = half.max() / c if name != "opencv_fisheye" else 4.0
    field = np.random.default_rng(1).uniform(-1.0, 1.0, (120, 3)) * [reach, reach, 0.4]
    rows = []
    for i, angles in enumerate(POSES):
        back = rotation_from_angles(np.array(angles)).T @ np.array([0.0, 0.0, 1.3])
        projected = camera_from_object(camera, (*back, *angles), field)
        rows += [(f"i{i}", f"t{k}", projected[k]) for k in np.flatnonzero((np.abs(projected) < half).all(axis=1))]
    if rng is not None:
        noise = rng.normal(0.0, SIGMA_MM, (len(rows), 2))
        rows = [(*row[:2], row[2] + error) for row, error in zip(rows, noise, strict=True)]
    free, unknown = dict.fromkeys(values, Prior(0.0, np.inf)), Prior(0.0, np.inf)
    lens = Camera("L", Prior(c * 1.03, np.inf), unknown, unknown, Distortion(name, free, r0_mm=R0_MM))
    return digital_network(lens, rows, {f"t{k}": xyz for k, xyz in enumerate(field)}, SIGMA_MM)

"""A project of four frames whose truth is known by formulas of its own, adjusted, to be handed to other programs."""

import math
from pathlib import Path

import numpy as np
import tifffile
from networks import Truth, affine, camera_point, rotation, simulated, torlegard
from numpy.typing import NDArray
from simulated_project import write_project

from adjust.problem.network import Network
from pipeline.cli import DONE, LOOK, run

Array = NDArray[np.float64]

PITCH_MM = 0.1
SIZE_PX = 2500
IMAGES = range(4)
MIRRORED = 2
LENS = {"k3": 4e-8, "k5": -1e-12, "p1": 8e-8, "p2": -6e-8}
TRUTH = Truth(distortion=LENS, mirrored=(False, False, True, False), middle_mm=(125.0, -125.0))
POINTS = np.random.default_rng(8).uniform((-700.0, -700.0, -150.0), (700.0, 700.0, 150.0), (100, 3))


def adjusted_project(folder: Path, truth: Truth = TRUTH, crs: str = "", kind: str = "affine") -> Path:
    """project.toml of an adjusted project, with scans that have a size and nothing in them."""
    network, _ = simulated(np.random.default_rng(1), truth, kind, points=POINTS, noise=False)
    return make_project(network, folder, crs)


def make_project(network: Network, folder: Path, crs: str = "") -> Path:
    """The same of a network of four images f0 to f3."""
    path = write_project(network, folder)
    text = path.read_text(encoding="utf-8")
    more = f'crs = "{crs}"\n' if crs else ""
    text = text.replace("[object]\n", f"[object]\n{more}")
    path.write_text(f'scans = ["scans/*.tif"]\npitch_um = {1000.0 * PITCH_MM}\n{text}', encoding="utf-8")
    comparator = folder / "comparator.csv"
    marks = comparator.read_text(encoding="utf-8")
    comparator.write_text(f"# comparator coordinates, reseau\n{marks}", encoding="utf-8")
    (folder / "scans").mkdir()
    for i in IMAGES:
        empty = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
        tifffile.imwrite(folder / "scans" / f"f{i}.tif", empty, compression="deflate")
    assert run(["adjust", str(path)]) in (DONE, LOOK)  # a network may show points beyond its frame
    return path


def camera_mm(image: int, truth: Truth = TRUTH) -> Array:
    """Where the points (100, 2) are in the camera."""
    return camera_point(truth, image, POINTS)


def ideal_mm(image: int, truth: Truth = TRUTH) -> Array:
    """The same without the lens."""
    u, v, w = rotation(*truth.attitudes[image]) @ (POINTS - np.array(truth.stations[image])).T
    return np.column_stack([truth.x0 - truth.c * u / w, truth.y0 - truth.c * v / w])


def scan_px(image: int, places_mm: Array, truth: Truth = TRUTH) -> Array:
    """Columns and rows (n, 2) of camera places in the scan."""
    a1, a2, a3, b1, b2, b3 = affine(truth, image, "affine")
    comparator = np.linalg.solve(np.array([[a2, a3], [b2, b3]]), (places_mm - (a1, b1)).T).T
    return np.asarray(comparator * (1.0, -1.0) / PITCH_MM)


def frame_px(image: int, places_mm: Array, ideal: bool = False, truth: Truth = TRUTH) -> Array:
    """Columns and rows (n, 2) of camera places in the resampled frame: its pixels lie at whole multiples of the pitch,
    and it holds the whole outline of the scan."""
    side = np.linspace(-0.5, SIZE_PX - 0.5, 65)
    edge = np.concatenate(
        [np.stack(np.broadcast_arrays(side, end), 1) for end in (side[0], side[-1])]
        + [np.stack(np.broadcast_arrays(end, side), 1) for end in (side[0], side[-1])]
    )
    x, y = (edge * (PITCH_MM, -PITCH_MM)).T
    a1, a2, a3, b1, b2, b3 = affine(truth, image, "affine")
    outline = np.column_stack([a1 + a2 * x + a3 * y, b1 + b2 * x + b3 * y])
    if ideal:
        outline = outline - np.column_stack(torlegard(truth, *outline.T))
    left = PITCH_MM * math.ceil(outline[:, 0].min() / PITCH_MM)
    top = PITCH_MM * math.floor(outline[:, 1].max() / PITCH_MM)
    return np.asarray((places_mm - (left, top)) * (1.0, -1.0) / PITCH_MM)

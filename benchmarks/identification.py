"""Identification of targets without orientation, by simulated frames: rates of correct, refused and wrong, and time.

Fields of 20, 100 and 500 points, planar (jittered lattice) and spatial (random in a box); frames from random directions
and distances with random roll; 0, 10 or 20 % of the points missing and as many false marks; principal distance wrong by
2 %, or unknown (--unknown: 0.6 to 4 frame diagonals); radial distortion unknown; noise of 0.5 px.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from adjust.initial_values.pose import Pose
from adjust.target_identification.naming import Names, name_marks
from benchmarks.harness import Row

Array = NDArray[np.float64]

C_MM, HALF_MM, PITCH_MM = 50.0, np.array([18.0, 12.0]), 0.006
SIGMA_PX = 0.5
ZOOMS = 0.52, 3.5  # range of an unknown principal distance relative to C_MM: 0.6 to 4 frame diagonals


@dataclass(frozen=True, eq=False)
class TargetFrame:
    """Simulated frame. xyz, normals: (n, 3) field; xy_mm: (m, 2) marks; point: (m,) true index of each, -1 for a false
    mark."""

    xyz: Array
    normals: Array
    xy_mm: Array
    point: NDArray[np.intp]


def planar(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Planar lattice, each point shifted by up to a third of the spacing."""
    columns = int(np.ceil(np.sqrt(1.5 * n)))
    row, column = np.divmod(np.arange(n), columns)
    xy = np.stack([column, row], axis=1) + rng.uniform(-0.33, 0.33, (n, 2))
    xyz = np.column_stack([(xy - xy.mean(axis=0)) / columns, np.zeros(n)])
    return xyz, np.tile([0.0, 0.0, 1.0], (n, 1))


def spatial(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random points in a box half as deep as wide, with unknown normals."""
    xyz = rng.uniform(-0.5, 0.5, (n, 3)) * (1.0, 0.7, 0.5)
    return xyz, np.full((n, 3), np.nan)


def frame(xyz: Array, normals: Array, share: float, rng: np.random.Generator, zoom: float = 1.0) -> TargetFrame:
    """Simulate a frame from within 45 degrees of the z axis, roughly filled by the field. share: of missing points and
    false marks; zoom: factor of both distance and principal distance."""
    tilt, around, roll = rng.uniform(0.0, np.pi / 4), rng.uniform(0.0, 2 * np.pi), rng.uniform(0.0, 2 * np.pi)
    sight = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])
    right = np.cross([np.cos(roll), np.sin(roll), 0.3], sight)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(sight, right), sight])
    pose = Pose(rotation, sight * zoom * rng.uniform(1.3, 2.2) + rng.normal(0.0, 0.03, 3))
    camera = (xyz - pose.center) @ rotation.T
    p = camera[:, :2] / -camera[:, 2:]
    p *= 1.0 + rng.uniform(-0.03, 0.03) * (p**2).sum(axis=1, keepdims=True) / 0.18 * zoom**2
    xy = C_MM * zoom * (1.0 + rng.normal(0.0, 0.02)) * p + rng.normal(0.0, SIGMA_PX * PITCH_MM, p.shape)
    view = np.flatnonzero((np.abs(xy) < HALF_MM).all(axis=1) & (camera[:, 2] < 0.0))
    kept = view[rng.random(len(view)) >= share]
    false = rng.uniform(-HALF_MM, HALF_MM, (round(share * len(view)), 2))
    marks, point = np.concatenate([xy[kept], false]), np.concatenate([kept, np.full(len(false), -1)])
    order = rng.permutation(len(marks))
    return TargetFrame(xyz, normals, marks[order], point[order])


def named(one: TargetFrame, c_mm: float | None) -> Names | str:
    return name_marks(one.xyz, one.normals, one.xy_mm, (-HALF_MM, HALF_MM), c_mm, SIGMA_PX * PITCH_MM)


def verdict(one: TargetFrame, names: Names | str) -> str:
    """Outcome: "right" if at least 80 % of the visible points are identified, "few" if fewer; "wrong" if more than one
    identification in fifty is wrong."""
    if isinstance(names, str):
        return "refused"
    good = sum(one.point[mark] == point for point, mark in names.mark.items())
    if len(names.mark) - good > max(0.02 * len(names.mark), 1):
        return "wrong"
    return "right" if good >= 0.8 * (one.point >= 0).sum() else "few"


OUTCOMES = ("right", "few", "refused", "wrong")
COLUMNS = {
    "count": "d",
    "field": "",
    "percent": "d",
    **dict.fromkeys(OUTCOMES, "d"),
    "median_s": ".2f",
    "longest_s": ".2f",
}


def cells(points: tuple[int, ...] = (20, 100, 500), shares: tuple[int, ...] = (0, 10, 20)) -> Iterator[Row]:
    """Numbers of points, fields, and per cent of missing points and false marks."""
    for count, field, percent in product(points, ("planar", "spatial"), shares):
        yield {"count": count, "field": field, "percent": percent}


def case(count: int, field: str, percent: int, seed: int, frames: int = 50, unknown: bool = False) -> Row:
    outcomes, seconds = [], []
    for index in range(frames):
        rng = np.random.default_rng([seed, count, field == "planar", percent, index])
        points = (planar if field == "planar" else spatial)(count, rng)
        zoom = np.exp(rng.uniform(*np.log(ZOOMS))) if unknown else 1.0
        one = frame(*points, percent / 100, rng, zoom)
        start = time.process_time()
        names = named(one, None if unknown else C_MM)
        seconds.append(time.process_time() - start)
        outcomes.append(verdict(one, names))
    counts = {each: outcomes.count(each) for each in OUTCOMES}
    return {**counts, "median_s": np.median(seconds), "longest_s": max(seconds)}

"""Large simulated networks: a board in many views, an aerial block and a strip, projected by OpenCV."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.rotation import rotation_from_angles
from adjust.problem.camera import Camera
from adjust.problem.network import Approximations, Image, Network, ObjectPoint
from adjust.problem.observations import Observations

Array = NDArray[np.float64]
VisiblePoints = tuple[NDArray[np.intp], Array]  # of an image: indices of points, and their places (m, 2), mm, y up

SIGMA_MM = 0.005
FOCAL_MM, FRAME_MM = 100.0, 200.0
ESTIMATED = {"known": ("k1", "k2", "p1", "p2", "k3"), "unknown": ("k1", "k2")}
TRUE = {"k1": -0.05, "k2": 0.02}
FLIP = np.diag([1.0, -1.0, -1.0])  # from axes with y up and viewing direction -z to OpenCV's
POINTS_AN_IMAGE, CONTROL_EVERY = 50, 10  # of a strip: points per image, images between known points


@dataclass(frozen=True)
class LargeScene:
    """Network to adjust, with its data for other programs.

    points: (p, 3); visible: by image, indices of the points and their places (m, 2), mm, y up.
    """

    network: Network
    start: Approximations
    points: Array
    visible: list[VisiblePoints]


def make_board(views: int, relief: float = 0.05) -> LargeScene:
    """Board of 100 points with some relief, all visible in each view."""
    rng = np.random.default_rng(views)
    grid = (np.arange(10) - 4.5) * 0.1
    plan = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    points = np.column_stack([plan, relief * rng.normal(size=len(plan))])
    angles = np.column_stack([rng.uniform(-0.5, 0.5, (views, 2)), rng.uniform(-3.0, 3.0, views)])
    offset = np.column_stack([0.1 * rng.normal(size=(views, 2)), np.full(views, -1.2)])
    stations = -np.einsum("nij,ni->nj", rotation_from_angles(angles), offset)
    return _scene(rng, points, stations, angles, "known", np.zeros(len(points)), 0.002)


def unknown(images: int, points: int) -> LargeScene:
    """Aerial block of 60 % overlap along and across, attitudes within a few degrees, one point in a hundred known."""
    rng = np.random.default_rng(images)
    across = int(np.sqrt(images / 2))
    base, height = 0.4 * FRAME_MM, 1.0 * FOCAL_MM
    place = np.array([(i * base, j * base) for i in range(images // across) for j in range(across)])
    low, high = place.min(axis=0) - 0.3 * base, place.max(axis=0) + 0.3 * base
    xyz = np.column_stack([rng.uniform(low, high, (points, 2)), rng.uniform(-10.0, 10.0, points)])
    stations = np.column_stack([place, np.full(len(place), height)]) + rng.normal(size=(len(place), 3))
    angles = (
        0.05 * rng.normal(size=(len(place), 3))
        + np.array([0.0, 0.0, 1.0]) * rng.integers(0, 4, (len(place), 1)) * np.pi / 2
    )
    sigma = np.where(np.arange(points) % 100 == 0, 0.0, np.inf)
    return _scene(rng, xyz, stations, angles, "unknown", sigma, 0.02)


def strip(images: int, control: int = CONTROL_EVERY) -> LargeScene:
    """Strip of 60 % overlap, fifty points per image, with known points every `control` images; 0: only at the start."""
    rng = np.random.default_rng(images)
    base, height = 0.4 * FRAME_MM, 1.0 * FOCAL_MM
    stations = np.column_stack([base * np.arange(images), np.zeros(images), np.full(images, height)])
    per_base = int(0.4 * POINTS_AN_IMAGE)
    along = base * (np.arange(images * per_base) / per_base - 0.5)
    across = rng.uniform(-0.4 * FRAME_MM, 0.4 * FRAME_MM, len(along))
    xyz = np.column_stack([along, across, rng.uniform(-10.0, 10.0, len(along))])
    turns = rng.integers(0, 4, images) * np.pi / 2
    angles = 0.02 * rng.normal(size=(images, 3)) + np.outer(turns, (0.0, 0.0, 1.0))
    every = per_base * control // 2
    known = np.arange(len(along)) % every == 0 if control else along < 1.5 * base
    sigma = np.where(known, 0.0, np.inf)
    return _scene(rng, xyz, stations + rng.normal(size=(images, 3)), angles, "unknown", sigma, 0.02)


def _scene(
    rng: np.random.Generator, points: Array, stations: Array, angles: Array, task: str, sigma: Array, error: float
) -> LargeScene:
    """Scene with noisy projections by OpenCV. error: sigma of the approximate values, object units; angles have a
    hundredth of it, rad."""
    projected = _projected(rng, points, stations, angles)
    network = _network(points, sigma, ESTIMATED[task], projected)
    start = Approximations(
        {"K": np.array([FOCAL_MM * 1.005, 0.0, 0.0])},
        {
            image.name: np.concatenate(
                [station + error * rng.normal(size=3), angle + 0.01 * error * rng.normal(size=3)]
            )
            for image, station, angle in zip(network.images, stations, angles, strict=True)
        },
        {},
        {str(i): xyz + error * rng.normal(size=3) for i, xyz in enumerate(points)},
    )
    return LargeScene(network, start, points, projected)


def _projected(rng: np.random.Generator, points: Array, stations: Array, angles: Array) -> list[VisiblePoints]:
    """Project the points into each image; points in fewer than two images are left out."""
    matrix = np.diag([FOCAL_MM, FOCAL_MM, 1.0])
    lens = np.array([TRUE["k1"], TRUE["k2"], 0.0, 0.0, 0.0])
    view = []
    for station, rotation in zip(stations, FLIP @ rotation_from_angles(angles), strict=True):
        vector = cv2.Rodrigues(rotation)[0]
        near = np.flatnonzero((np.abs(points - station) < 2.0 * FRAME_MM).all(axis=1))
        projected = cv2.projectPoints(points[near], vector, -rotation @ station, matrix, lens)[0].reshape(-1, 2)
        shown = (np.abs(projected) < FRAME_MM / 2).all(axis=1)
        inside = near[shown]
        places = projected[shown] * (1.0, -1.0) + SIGMA_MM * rng.normal(size=(len(inside), 2))
        view.append((inside, places))
    rays = np.bincount(np.concatenate([inside for inside, _ in view]), minlength=len(points))
    return [(inside[rays[inside] > 1], places[rays[inside] > 1]) for inside, places in view]


def _network(points: Array, sigma: Array, estimated: Sequence[str], visible: Sequence[VisiblePoints]) -> Network:
    """Network with points of sigma 0 known; the other points, the camera and the estimated distortion are free."""
    names = [f"i{i}" for i in range(len(visible))]
    free = {name: Prior(0.0, np.inf) for name in estimated}
    free_point = Prior(FOCAL_MM, np.inf), Prior(0.0, np.inf), Prior(0.0, np.inf)
    return Network(
        (Camera("K", *free_point, Distortion("opencv", free)),),
        tuple(Image(name, "K", "none") for name in names),
        tuple(
            ObjectPoint(str(i), *(Prior(float(x)) if s == 0.0 else None for x in xyz))
            for i, (xyz, s) in enumerate(zip(points, sigma, strict=True))
        ),
        Observations(
            tuple(name for name, (inside, _) in zip(names, visible, strict=True) for _ in inside),
            tuple(str(i) for inside, _ in visible for i in inside),
            tuple("target" for inside, _ in visible for _ in inside),
            np.concatenate([places for _, places in visible]),
            np.tile(SIGMA_MM**2 * np.eye(2), (sum(len(inside) for inside, _ in visible), 1, 1)),
        ),
    )

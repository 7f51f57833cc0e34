"""Convergence from poor approximate values, or from none, for five types of networks.

Attitudes are rotated by 30 degrees around random axes, stations shifted by 20 % of their distance in random directions,
the principal distance is wrong by 20 %, and unknown points by 20 % of their distance. The correct minimum is that
reached from the true values; iterations: median and maximum. Then without approximate values, with gross errors of up
to a tenth of the frame in some of the targets and robust estimation (igg3): correct is a result within five standard
deviations of that minimum.
"""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Lens, Prior
from adjust.functional_model.projection import ImageModel
from adjust.functional_model.rotation import angles_from_rotation, rotation_from_angles, rotation_from_vector
from adjust.functional_model.transformation import Film
from adjust.problem.camera import Camera, Fiducial
from adjust.problem.network import Approximations, Image, Network, ObjectPoint
from adjust.problem.observations import ObservationKind, Observations
from adjust.solution.adjustment import Options, adjust
from adjust.solution.result import Adjustment
from benchmarks.harness import Row as TableRow

Array = NDArray[np.float64]
Ended = tuple[str, int]
Row = tuple[str, str, ObservationKind, Array]  # image, point, kind, place in mm

ANGLE_DEG = 30.0
SHARE = 0.2  # errors as a fraction of distances
SAME = 1e-3  # standard deviations; largest difference of results at the same minimum
STARTS = {
    "attitude": {"attitude"},
    "station": {"station"},
    "both": {"attitude", "station"},
    "everything": {"attitude", "station", "c", "point"},
}
GROSS_PERCENT = (0, 5, 20)
GROSS = 0.1  # largest gross error, fraction of the targets' extent in the images
NEAR = 5.0  # standard deviations; largest difference of correct robust results
FIDUCIALS = {"1": (106.0, -106.0), "2": (-106.0, -106.0), "3": (-106.0, 106.0), "4": (106.0, 106.0)}


@dataclass(frozen=True)
class StartScene:
    """Simulated network with its true values. options: of the adjustment, with the datum."""

    network: Network
    truth: Approximations
    options: Options


COLUMNS = {"network": "", "start": "", "right": ".1%", "iterations": "", "cpu_s": ".3f", "others": ""}


def cells() -> Iterator[TableRow]:
    for network in scenes():
        yield from ({"network": network, "start": start} for start in (*STARTS, *GROSS_PERCENT))


def case(network: str, start: str | int, runs: int = 100) -> TableRow:
    """Rate of correct results, and the outcome of the others. start: errors of the approximate values, or per cent of
    gross errors without approximate values."""
    scene, right = right_adjustment(network)
    ends, iterations, begin = Counter[str](), [], time.process_time()
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        if isinstance(start, str):
            end, count = outcome(scene, right, poor_start(scene, STARTS[start], rng), SAME)
        else:
            end, count = outcome(spoilt(scene, start, rng), right, None, NEAR)
        ends[end] += 1
        iterations += [count] if end == "right" else []
    return {
        "right": ends.pop("right", 0) / runs,
        "iterations": f"{np.median(iterations):.0f}, {max(iterations)}" if iterations else None,
        "cpu_s": (time.process_time() - begin) / runs,
        "others": ", ".join(f"{end} {count}" for end, count in ends.most_common()),
    }


@cache
def right_adjustment(network: str) -> tuple[StartScene, Adjustment]:
    scene = scenes()[network]
    return scene, adjust(scene.network, scene.truth, scene.options)


def outcome(scene: StartScene, right: Adjustment, start: Approximations | None, near: float) -> Ended:
    """Outcome of an adjustment, and its iterations. near: tolerance around the correct values, standard deviations."""
    try:
        result = adjust(scene.network, start, scene.options)
    except AdjustmentError as error:
        return f"refused ({str(error).split(',')[0][:40]})", 0
    if not result.converged:
        return result.termination, result.iterations
    names = [name for name in right.names if name.startswith("IO.") and right.sigma(name) > 0.0]
    off = max(abs(result.value(name) - right.value(name)) / right.sigma(name) for name in names)
    same = off < near and (near > SAME or abs(result.vpv - right.vpv) < SAME * right.vpv)
    return "right" if same else "other minimum", result.iterations


def spoilt(scene: StartScene, percent: int, rng: np.random.Generator) -> StartScene:
    """Add gross errors to some of the targets of a scene, with robust estimation."""
    observations = scene.network.observations
    targets = np.flatnonzero(~observations.is_fiducial)
    wrong = rng.permutation(targets)[: len(targets) * percent // 100]
    xy_mm = observations.xy_mm.copy()
    xy_mm[wrong] += GROSS * np.ptp(xy_mm[targets], axis=0) * rng.uniform(-1.0, 1.0, (len(wrong), 2))
    network = replace(scene.network, observations=replace(observations, xy_mm=xy_mm))
    return replace(scene, network=network, options=replace(scene.options, robust="igg3" if percent else False))


def poor_start(scene: StartScene, errors: set[str], rng: np.random.Generator) -> Approximations:
    """True values with errors added."""
    truth = scene.truth
    known = {point.id: point for point in scene.network.points}
    middle = np.mean(list(truth.points.values()), axis=0)
    distance = float(np.mean([np.linalg.norm(e[:3] - middle) for e in truth.exterior.values()]))
    exterior = {}
    for name, values in truth.exterior.items():
        turn = rotation_from_vector(np.deg2rad(ANGLE_DEG) * direction(rng)) if "attitude" in errors else np.eye(3)
        shift = SHARE * distance * direction(rng) if "station" in errors else np.zeros(3)
        angles = angles_from_rotation(turn @ rotation_from_angles(values[3:]))
        exterior[name] = np.concatenate([values[:3] + shift, angles])
    wrong_c = 1.0 + SHARE * rng.choice([-1.0, 1.0]) if "c" in errors else 1.0
    points = {
        id_: np.where(
            [prior is None or prior.sigma > 0 for prior in (known[id_].X, known[id_].Y, known[id_].Z)],
            xyz + ("point" in errors) * SHARE * distance * direction(rng),
            xyz,
        )
        for id_, xyz in truth.points.items()
    }
    interior = {name: values * [wrong_c, 1.0, 1.0] for name, values in truth.interior.items()}
    return replace(truth, exterior=exterior, points=points, interior=interior)


def direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def scenes() -> dict[str, StartScene]:
    """The five types of networks: aerial ones in metres, those of a digital camera in units of half a metre."""
    rng = np.random.default_rng(2)
    plan = np.stack(np.meshgrid(np.linspace(-800, 800, 6), np.linspace(-800, 800, 5)), axis=-1).reshape(-1, 2)
    relief = np.column_stack([plan + rng.uniform(-60, 60, plan.shape), rng.uniform(-150, 150, len(plan))])
    across = np.stack(np.meshgrid(np.linspace(-0.6, 0.6, 8), np.linspace(-0.45, 0.45, 6)), axis=-1).reshape(-1, 2)
    board = np.column_stack([across, np.zeros(len(across))])
    cloud = rng.uniform(-0.5, 0.5, (40, 3))
    convergent = [
        looking_at_origin([x, y, 1500.0], kappa)
        for x, y, kappa in ((0, 0, 0.1), (700, 50, 1.6), (-700, -60, 3.1), (60, 700, -1.5), (-40, -700, 0.8))
    ]
    around = [
        looking_at_origin([2 * np.cos(a) * np.sin(z), 2 * np.sin(a) * np.sin(z), 2 * np.cos(z)], kappa)
        for a, z, kappa in (
            (0.1, 0.6, 0),
            (1.2, 0.7, 1.5),
            (2.3, 0.5, 3),
            (3.4, 0.7, -1.6),
            (4.6, 0.6, 0.2),
            (5.6, 0.4, 1.7),
        )
    ]
    strips = [
        np.array([600.0 * i - 900, 450.0 * j - 225, 1500, *rng.normal(0, 0.02, 2), 3.1 * (j % 2)])
        for j in range(2)
        for i in range(4)
    ]
    crosswise = [
        np.array([0.0, 0.0, 1500.0, 0.01, -0.02, 0.0]),
        np.array([400.0, 30.0, 1480.0, -0.02, 0.01, 1.5]),
        np.array([30.0, 420.0, 1520.0, 0.02, 0.02, 3.0]),
    ]
    return {
        "five images": film_scene(rng, convergent, relief[::2], "fixed"),
        "self-calibration": digital_scene(rng, around, cloud, "unknown"),
        "planar board": digital_scene(rng, around, board, "fixed"),
        "heights only": film_scene(rng, crosswise, relief, "heights"),
        "aerial block": film_scene(rng, strips, relief, "control"),
    }


@dataclass(frozen=True)
class Optics:
    """Camera with its true lens. lens: (7,) distortion parameters; half_mm: half the side of the frame; sigma_mm: of a
    measured coordinate."""

    camera: Camera
    lens: Array
    half_mm: float
    sigma_mm: float

    @property
    def interior(self) -> Array:
        """(3,) true principal distance and point."""
        distance = self.camera.principal_distance_mm
        return np.array([0.0 if distance is None else distance.value, 0.1, -0.1])


def film_scene(rng: np.random.Generator, exteriors: list[Array], xyz: Array, known: str) -> StartScene:
    """Scene of a film camera of 153 mm. known: object points that are known, "fixed" (all), "heights" or "control"
    (four)."""
    free = () if known == "heights" else ("k3", "k5", "p1", "p2")
    camera = Camera(
        "K",
        Prior(153.0, 5.0),
        Prior(0.0, 1.0),
        Prior(0.0, 1.0),
        Distortion("torlegard", {name: Prior(0.0, np.inf) for name in free}),
        {id_: Fiducial(Prior(x, 1.0), Prior(y, 1.0)) for id_, (x, y) in FIDUCIALS.items()},
    )
    lens = np.array([1.5e-7, -4e-12, 0.0, 8e-7, -6e-7, 0.0, 0.0]) if free else np.zeros(7)
    films = [
        Film("affine", np.array([3.0, np.cos(turn), -np.sin(turn), -2.0, np.sin(turn), np.cos(turn)]), np.zeros(2))
        for turn in 0.3 + np.arange(len(exteriors))
    ]
    return simulated(rng, Optics(camera, lens, 115.0, 0.005), exteriors, films, make_points(xyz, known))


def digital_scene(rng: np.random.Generator, exteriors: list[Array], xyz: Array, known: str) -> StartScene:
    """Scene of a digital camera of 8 mm with "fixed" or "unknown" object points."""
    nothing = Prior(0.0, np.inf)
    camera = Camera("K", Prior(8.0, np.inf), nothing, nothing, Distortion("brown", {"k1": nothing, "k2": nothing}))
    lens = np.array([1e-3, -2e-5, 0.0, 0.0, 0.0, 0.0, 0.0])
    films = [Film("none", np.empty(0), np.zeros(2))] * len(exteriors)
    return simulated(rng, Optics(camera, lens, 5.0, 0.0003), exteriors, films, make_points(xyz, known))


def make_points(xyz: Array, known: str) -> list[tuple[ObjectPoint, Array]]:
    """Object points with their priors, and their true places (3,)."""
    corners = {int(np.argmax(xyz[:, :2] @ np.array(corner))) for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1))}
    sigmas = {"fixed": (0.0, 0.0, 0.0), "unknown": (np.inf,) * 3, "heights": (np.inf, np.inf, 0.05)}
    by_point = [sigmas.get(known, sigmas["fixed" if j in corners else "unknown"]) for j in range(len(xyz))]
    return [
        (ObjectPoint(f"p{j}", *(Prior(float(value), s) for value, s in zip(place, by_point[j], strict=True))), place)
        for j, place in enumerate(xyz)
    ]


def simulated(
    rng: np.random.Generator,
    optics: Optics,
    exteriors: list[Array],
    films: list[Film],
    points: list[tuple[ObjectPoint, Array]],
) -> StartScene:
    """Simulate observations, with errors, of the points that at least two images show."""
    xyz = np.array([place for _, place in points])
    pairs = list(zip(exteriors, films, strict=True))
    rows = [row for i, (exterior, film) in enumerate(pairs) for row in exposed(optics, f"i{i}", exterior, film, xyz)]
    shown = Counter(point for _, point, kind, _ in rows if kind == "target")
    rows = [row for row in rows if row[2] == "fiducial" or shown[row[1]] > 1]
    observations = Observations(
        tuple(row[0] for row in rows),
        tuple(row[1] for row in rows),
        tuple(row[2] for row in rows),
        np.array([row[3] + rng.normal(0.0, optics.sigma_mm, 2) for row in rows]),
        np.tile(optics.sigma_mm**2 * np.eye(2), (len(rows), 1, 1)),
    )
    images = tuple(Image(f"i{i}", "K", film.transformation) for i, film in enumerate(films))
    kept = [(point, place) for point, place in points if shown[point.id] > 1]
    truth = Approximations(
        interior={"K": optics.interior},
        exterior={f"i{i}": exterior for i, exterior in enumerate(exteriors)},
        transformation={f"i{i}": film.parameters for i, film in enumerate(films)},
        points={point.id: place for point, place in kept},
    )
    first = kept[0][0]
    held = all(prior is not None and prior.sigma == 0 for prior in (first.X, first.Y, first.Z))
    network = Network((optics.camera,), images, tuple(point for point, _ in kept), observations)
    return StartScene(network, truth, Options(datum="control" if held else "minimal"))


def exposed(optics: Optics, image: str, exterior: Array, film: Film, xyz: Array) -> list[Row]:
    """Error-free observations of the points (n, 3) within an image's frame, and of its fiducials."""
    camera, rotation = optics.camera, rotation_from_angles(exterior[3:])
    model = ImageModel(Lens(camera.distortion, optics.interior, optics.lens), rotation, exterior[:3], film)
    xy, projected = model.camera_from_object(xyz)
    comparator = model.comparator_from_camera(xy)[0]
    inside = np.flatnonzero(projected & (np.abs(xy) < optics.half_mm).all(axis=1))
    rows: list[Row] = [(image, f"p{j}", "target", comparator[j]) for j in inside]
    for id_, mark in camera.fiducials.items():
        place = np.array([mark.x_mm.value, mark.y_mm.value])
        rows.append((image, id_, "fiducial", model.comparator_from_camera(place[None])[0][0]))
    return rows


def looking_at_origin(station: list[float], kappa: float) -> Array:
    """Exterior orientation (6,) of a camera that points at the origin."""
    back = np.array(station) / np.linalg.norm(station)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(back, right), back])
    turn = rotation_from_angles(np.array([0.0, 0.0, kappa]))
    return np.concatenate([station, angles_from_rotation(turn @ level)])

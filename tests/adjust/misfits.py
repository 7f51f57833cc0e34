"""Networks of a digital camera whose model lacks something, the effect a multiple of what its test detects.

Flat boards for even seeds, deep fields for odd ones; projected term by term, nothing of it comes from the code under
test but the scale of the effect: v'Pv of a network without noise grows with its square.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from simulated import digital_network

from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Distortion, Prior
from adjust.functional_model.rotation import angles_from_rotation, rotation_from_angles
from adjust.problem.camera import Camera
from adjust.problem.network import Exterior, Network
from adjust.problem.tested import Probabilities
from adjust.solution.adjustment import adjust

Array = NDArray[np.float64]

C_MM, HALF_MM, SIGMA_MM = 10.0, np.array([6.4, 4.8]), 0.001
MIDDLE_MM = np.array([6.4, -4.8])  # of the picture, in the comparator
NOTHING, NOISE = "nothing", "noise too small"
MANY = 3.0  # times what a test detects
LENS = {"k1": -0.22, "k2": 0.11, "p1": 4e-4, "p2": -3e-4, "k3": -0.02}


@dataclass(frozen=True)
class Scene:
    """What a network is projected from: points (p, 3), stations and rotations; groups (m,): the images that differ."""

    points: Array
    rotations: Array
    stations: Array
    point_mm: Array
    groups: NDArray[np.bool_]


@dataclass(frozen=True)
class Effects:
    """What the pictures have and the model does not, in the unit of each."""

    b1: float = 0.0
    radial: float = 0.0
    tangential: float = 0.0
    zoom: float = 0.0
    crop: float = 0.0
    scale: float = 0.0
    bend: float = 0.0
    noise: float = 1.0
    pitch: float = 1.0
    object_unit: float = 1.0
    mirrored: bool = False
    y_down: bool = False


@dataclass(frozen=True)
class Kind:
    """A misfit: its effect of size 1, the free parameters of the lens, how many unknowns its test has, the words.

    boards, fields: which of them; sized: whether it has a size; c_given, stations_given, frame_given: what else the
    network knows.
    """

    effect: Callable[[float], Effects]
    words: tuple[str, ...]
    free: tuple[str, ...] = ("k1", "k2", "p1", "p2", "k3")
    lens: dict[str, float] = field(default_factory=lambda: LENS)
    size: int = 1
    boards: bool = True
    fields: bool = True
    sized: bool = True
    c_given: bool = False
    stations_given: bool = False
    frame_given: bool = False


def scene(seed: int, flat: bool) -> Scene:
    rng = np.random.default_rng([36, seed])
    count = int(rng.integers(6, 11))
    if flat:
        columns, rows = int(rng.integers(6, 10)), int(rng.integers(5, 8))
        x, y = np.meshgrid(np.arange(columns) * 25.0, np.arange(rows) * 25.0)
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    else:
        points = rng.uniform(-1.0, 1.0, (40, 3)) * [120.0, 90.0, 80.0]
    middle = points.mean(axis=0)
    angles = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(-np.pi, np.pi, count)])
    rotations = rotation_from_angles(angles)
    extent = np.linalg.norm(np.ptp(points[:, :2], axis=0))
    distance = rng.uniform(1.0, 1.6, count) * extent * C_MM / (2.0 * HALF_MM[1])
    aim = middle + rng.uniform(-0.12, 0.12, (count, 3)) * extent
    stations = aim + distance[:, None] * np.einsum("nji,j->ni", rotations, [0.0, 0.0, 1.0])
    groups = np.zeros(count, dtype=bool)
    groups[rng.permutation(count)[: max(2, count // 3)]] = True
    return Scene(points, rotations, stations, MIDDLE_MM + rng.normal(0.0, 0.1, 2), groups)


def network(made: Scene, effects: Effects, kind: Kind, rng: np.random.Generator | None) -> Network:
    """The network as it is given: square pixels, one c, one size, the lens of `kind.free`; rng None: no noise."""
    names, places = [], []
    for i, (rotation, station) in enumerate(zip(made.rotations, made.stations, strict=True)):
        projected = _projected(made, effects, kind, i, rotation, station)
        inside = np.flatnonzero((np.abs(projected - MIDDLE_MM) < HALF_MM).all(axis=1))
        names += [(f"im{i:02d}", f"p{k}") for k in inside]
        places.append(projected[inside])
    xy_mm = np.concatenate(places)
    if rng is not None:
        xy_mm = xy_mm + rng.normal(0.0, SIGMA_MM * effects.noise, xy_mm.shape)
    xy_mm = effects.pitch * xy_mm * [1.0, -1.0 if effects.y_down else 1.0]
    given = {name: Prior(0.0, np.inf) for name in kind.free}
    middle = effects.pitch * MIDDLE_MM * [1.0, -1.0 if effects.y_down else 1.0]
    c = Prior(C_MM, 0.005) if kind.c_given else None
    frame = (float(2.0 * HALF_MM[0]), float(2.0 * HALF_MM[1])) if kind.frame_given else (0.0, 0.0)
    camera = Camera("cam", c, None, None, Distortion("opencv", given), {}, (float(middle[0]), float(middle[1])), frame)
    exterior = _exteriors(made) if kind.stations_given else {}
    rows = [(*name, xy) for name, xy in zip(names, xy_mm, strict=True)]
    points = {f"p{k}": effects.object_unit * xyz for k, xyz in enumerate(made.points)}
    given_network = digital_network(camera, rows, points, effects.pitch * SIGMA_MM)
    images = tuple(replace(image, exterior=exterior.get(image.name)) for image in given_network.images)
    return replace(given_network, images=images)


def _exteriors(made: Scene) -> dict[str, Exterior]:
    """Stations and attitudes as they are known beforehand, roughly."""
    rows = zip(made.stations, made.rotations, strict=True)
    return {
        f"im{i:02d}": Exterior(np.concatenate([station + 10.0, angles_from_rotation(rotation) + 0.02]))
        for i, (station, rotation) in enumerate(rows)
    }


def _projected(made: Scene, effects: Effects, kind: Kind, image: int, rotation: Array, station: Array) -> Array:
    """Comparator coordinates (p, 2) in mm, y up; the lens is OpenCV's, y down."""
    points = made.points.copy()
    low, high = points.min(axis=0), points.max(axis=0)
    relative = (2.0 * points - low - high)[:, :2] / (high - low)[:2]
    points[:, 2] += effects.bend * (1.0 - relative[:, 0] ** 2)
    u, v, w = rotation @ (points - station).T
    x, y = -u / w, v / w
    lens = dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0) | kind.lens
    r2 = x**2 + y**2
    radial = 1.0 + lens["k1"] * r2 + lens["k2"] * r2**2 + lens["k3"] * r2**3 + effects.radial * r2**2
    p1, p2 = lens["p1"] + effects.tangential, lens["p2"] - effects.tangential
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2)
    yd = y * radial + p1 * (r2 + 2.0 * y**2) + 2.0 * p2 * x * y
    c, own = C_MM, float(made.groups[image])
    c += own * effects.zoom
    at = np.stack([c * xd * (1.0 + effects.b1), -c * yd], axis=1) + made.point_mm
    at[:, 0] += own * effects.crop
    at[:, 1] += 0.7 * own * effects.crop
    if effects.mirrored and image == int(np.argmax(made.groups)):
        at[:, 0] = 2.0 * MIDDLE_MM[0] - at[:, 0]
    return np.asarray(at * (1.0 + own * effects.scale))


KINDS = {
    NOTHING: Kind(lambda e: Effects(), ()),
    "pixels not square": Kind(lambda e: Effects(b1=1e-3 * e), ("pixels of camera cam are not square",)),
    "two principal distances": Kind(lambda e: Effects(zoom=0.05 * e), ("another principal distance",)),
    "sizes: scaled": Kind(lambda e: Effects(scale=0.01 * e), ("images of different sizes in one camera (scaled)",)),
    "sizes: cropped": Kind(
        lambda e: Effects(crop=0.05 * e), ("images of different sizes in one camera (cropped)",), size=2
    ),
    "lens: no radial term": Kind(
        lambda e: Effects(radial=0.01 * e), ("have a radial pattern",), free=(), lens={}, size=2
    ),
    "lens: k1 alone": Kind(
        lambda e: Effects(radial=0.05 * e), ("have a radial pattern",), free=("k1", "p1", "p2"),
        lens={"k1": -0.2, "p1": 4e-4}, size=2
    ),
    "lens: no decentering": Kind(
        lambda e: Effects(tangential=5e-4 * e), ("have a tangential pattern",), free=("k1", "k2"),
        lens={"k1": -0.2, "k2": 0.1}, size=2
    ),
    "board bent": Kind(lambda e: Effects(bend=0.5 * e), ("is not flat",), size=2, fields=False),
    "pitch ten times too large": Kind(
        lambda e: Effects(pitch=10.0), ("principal distance of camera cam is not the 10 mm",), sized=False, c_given=True
    ),
    "mm for m, stations in m": Kind(
        lambda e: Effects(object_unit=1000.0), ("points are 1000 times too large",), sized=False, stations_given=True
    ),
    "one image mirrored": Kind(lambda e: Effects(mirrored=True), ("is mirrored",), sized=False),
    "one image mirrored, frame_mm": Kind(
        lambda e: Effects(mirrored=True), ("is mirrored",), sized=False, frame_given=True
    ),
    "y downward, frame_mm": Kind(
        lambda e: Effects(y_down=True), ("points down",), sized=False, frame_given=True
    ),
    NOISE: Kind(lambda e: Effects(noise=1.0 + 0.5 * e), ("too small everywhere",)),
}  # fmt: skip


def draw_network(name: str, seed: int, many: float = MANY) -> Network:
    """A network of a kind, its effect so many times what its test detects, with either sign."""
    kind = KINDS[name]
    flat = kind.boards and (seed % 2 == 0 or not kind.fields)
    made = scene(seed, flat)
    rng = np.random.default_rng([37, seed])
    sign = 1.0 if rng.random() < 0.5 else -1.0
    return network(made, kind.effect((sign if name != NOISE else 1.0) * _size(name, kind, made, many)), kind, rng)


def _size(name: str, kind: Kind, made: Scene, many: float) -> float:
    if name == NOTHING or not kind.sized:
        return 1.0
    wanted = float((many * Probabilities().noncentrality(kind.size)) ** 2)
    if name == NOISE:
        count = 2 * len(network(made, Effects(), kind, None).observations)
        return 2.0 * float(np.sqrt(1.0 + many * 4.13 * np.sqrt(2.0 / count)) - 1.0)  # of the test of v'Pv
    size = 1.0
    for _ in range(2):
        result = adjust(network(made, kind.effect(size), kind, None))
        size *= float(np.sqrt(wanted / result.vpv))
    return size


def describe(given: Network) -> tuple[list[str], float]:
    """What a user is told to look at, and sigma0; nan where nothing is adjusted."""
    try:
        result = adjust(given)
    except AdjustmentError as error:
        return [str(error)], np.nan
    causes = [each.cause for each in result.explanations]
    suspects = [f"{each.tested.name} is suspect" for each in result.suspects]
    return [*causes, *result.warnings, *suspects], result.sigma0


def outcome(name: str, sentences: list[str]) -> str:
    """named: what is wrong, and nothing else; misleading: anything else; unnamed: nothing."""
    words = KINDS[name].words
    wrong = [each for each in sentences if not any(word in each for word in words)]
    if wrong:
        return "misleading"
    return "named" if sentences or not words else "unnamed"

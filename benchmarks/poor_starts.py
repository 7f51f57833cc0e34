"""From how poor a start the adjustment still finds its minimum: random starts of five kinds of networks.

python benchmarks/poor_starts.py [RUNS]

Attitudes are turned by 30 degrees about random axes, stations shifted by 20 % of their distance in random directions,
the principal distance is wrong by 20 %, and unknown points by 20 % of their distance. The right minimum is that from
the truth.
"""

import sys
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adjust.adjustment import Options, adjust
from adjust.errors import AdjustmentError
from adjust.families import parameter_names
from adjust.network import (
    Approximations,
    Camera,
    Distortion,
    Fiducial,
    Image,
    Network,
    ObjectPoint,
    ObservationKind,
    Observations,
    Prior,
)
from adjust.projection import ImageModel
from adjust.result import Adjustment
from adjust.rotation import angles_from_rotation, rotation_from_angles, rotation_from_vector

Array = NDArray[np.float64]

ANGLE_DEG = 30.0
SHARE = 0.2  # of distances
SIGMA_MM = 0.005
SAME = 1e-3  # standard deviations within which two results are one
FIDUCIALS = {"1": (106.0, -106.0), "2": (-106.0, -106.0), "3": (-106.0, 106.0), "4": (106.0, 106.0)}


@dataclass(frozen=True)
class Scene:
    """A network with the truth it was simulated from, and how its object space is held."""

    network: Network
    truth: Approximations
    options: Options = Options()


def main() -> None:
    """One line a network: how many starts of each kind of error come to the right minimum, and where the others end."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{'network':18} {'start':12} {'right':>7} {'iterations':>11} {'seconds':>8}  others")
    for name, scene in scenes().items():
        right = adjust(scene.network, scene.truth, scene.options)
        for errors in ({"attitude"}, {"station"}, {"attitude", "station"}, {"attitude", "station", "c", "point"}):
            study(name, scene, right, errors, runs)


def study(name: str, scene: Scene, right: Adjustment, errors: set[str], runs: int) -> None:
    """Adjust from random starts and print what becomes of them."""
    ends: Counter[str] = Counter()
    iterations = []
    begin = time.perf_counter()
    for seed in range(runs):
        end, count = outcome(scene, right, poor_start(scene, errors, np.random.default_rng(seed)))
        ends[end] += 1
        if end == "right":
            iterations.append(count)
    took = (time.perf_counter() - begin) / runs
    share = ends.pop("right", 0) / runs
    others = ", ".join(f"{end} {count}" for end, count in ends.most_common())
    label = "all" if "c" in errors else "+".join(sorted(errors))[:12]
    median = f"{np.median(iterations):.0f}, {max(iterations)}" if iterations else ""
    print(f"{name:18} {label:12} {share:7.1%} {median:>11} {took:8.3f}  {others}", flush=True)


def outcome(scene: Scene, right: Adjustment, start: Approximations) -> tuple[str, int]:
    """Where an adjustment ends, and its iterations."""
    try:
        result = adjust(scene.network, start, scene.options)
    except AdjustmentError as error:
        return f"refused ({str(error).split(',')[0][:40]})", 0
    if not result.converged:
        return result.termination, result.iterations
    sigma = np.sqrt(np.maximum(result.cofactor_of([n for n in right.names if n.startswith("IO.")]).diagonal(), 1e-30))
    names = [n for n in right.names if n.startswith("IO.")]
    off = max(abs(result.value(n) - right.value(n)) / s for n, s in zip(names, sigma, strict=True))
    return ("right" if off < SAME and abs(result.vpv - right.vpv) < SAME * right.vpv else "other minimum"), result.iterations


def poor_start(scene: Scene, errors: set[str], rng: np.random.Generator) -> Approximations:
    """The truth, spoilt."""
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


def scenes() -> dict[str, Scene]:
    """The five kinds of networks."""
    rng = np.random.default_rng(2)
    aerial = {"k3": 1.5e-7, "k5": -4e-12, "p1": 8e-7, "p2": -6e-7}
    close = {"k1": 1e-3, "k2": -2e-5}
    plan = np.stack(np.meshgrid(np.linspace(-800, 800, 6), np.linspace(-800, 800, 5)), axis=-1).reshape(-1, 2)
    relief = np.column_stack([plan + rng.uniform(-60, 60, plan.shape), rng.uniform(-150, 150, len(plan))])
    convergent = [look_at(np.array([x, y, 1500.0]), k) for x, y, k in
                  ((0, 0, 0.1), (700, 50, 1.6), (-700, -60, 3.1), (60, 700, -1.5), (-40, -700, 0.8))]
    strip = [exterior_of([600.0 * i - 900, 450.0 * j - 225, 1500], rng.normal(0, 0.02, 2), 3.1 * (j % 2))
             for j in range(2) for i in range(4)]
    sphere = [look_at(2.0 * np.array([np.cos(a) * np.sin(z), np.sin(a) * np.sin(z), np.cos(z)]), k)
              for a, z, k in ((0.1, 0.6, 0), (1.2, 0.7, 1.5), (2.3, 0.5, 3.0), (3.4, 0.7, -1.6), (4.6, 0.6, 0.2), (5.6, 0.4, 1.7))]
    cloud = rng.uniform(-0.5, 0.5, (40, 3))
    board = np.column_stack([np.stack(np.meshgrid(np.linspace(-0.6, 0.6, 8), np.linspace(-0.45, 0.45, 6)), -1).reshape(-1, 2), np.zeros(48)])
    crosswise = [exterior_of([0, 0, 1500], (0.01, -0.02), 0.0), exterior_of([400, 30, 1480], (-0.02, 0.01), 1.5), exterior_of([30, 420, 1520], (0.02, 0.02), 3.0)]
    return {
        "five images": scene(rng, convergent, relief[::2], "fixed", film=True, distortion=aerial),
        "self-calibration": scene(rng, sphere, cloud, "unknown", film=False, distortion=close, options=Options(datum="minimal")),
        "planar board": scene(rng, sphere, board, "fixed", film=False, distortion=close),
        "heights only": scene(rng, crosswise, relief, "heights", film=True, distortion={}, options=Options(datum="minimal")),
        "aerial block": scene(rng, strip, relief, "control", film=True, distortion=aerial),
    }


def scene(rng: np.random.Generator, exteriors: list[Array], xyz: Array, known: str, film: bool, distortion: Mapping[str, float], options: Options = Options()) -> Scene:
    """Simulated observations. known: of the object points, "fixed", "unknown", "heights" or four "control" points."""
    family, c, kind = ("torlegard", 153.0, "affine") if film else ("brown", 8.0, "none")
    sigma = SIGMA_MM if film else 0.0003
    model_distortion = Distortion(family, {name: Prior(value, np.inf) for name, value in distortion.items()})

    values = np.array([distortion.get(name, 0.0) for name in parameter_names(family)])
    films = [np.array([3.0, np.cos(t), -np.sin(t), -2.0, np.sin(t), np.cos(t)]) for t in 0.3 + np.arange(len(exteriors))]
    if not film:
        films = [np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0])] * len(exteriors)
    rows: list[tuple[str, str, ObservationKind, Array]] = []
    for i, exterior in enumerate(exteriors):
        model = ImageModel(model_distortion, np.array([c, 0.1, -0.1]), values, rotation_from_angles(exterior[3:]), exterior[:3], films[i])
        xy, seen = model.camera_from_object(xyz)
        half = 115.0 if film else 5.0
        for j in np.flatnonzero(seen & (np.abs(xy) < half).all(axis=1)):
            rows.append((f"i{i}", f"p{j}", "target", model.comparator_from_camera(xy[j])))
        if film:
            rows += [(f"i{i}", id_, "fiducial", model.comparator_from_camera(np.array(place))) for id_, place in FIDUCIALS.items()]
    control = {int(np.argmax(xyz[:, :2] @ np.array(corner))) for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1))}
    camera = Camera("K", *((Prior(c, 5.0), Prior(0.0, 1.0), Prior(0.0, 1.0)) if film else (Prior(c, np.inf), Prior(0.0, np.inf), Prior(0.0, np.inf))),
        Distortion(family, {name: Prior(0.0, np.inf) for name in distortion}),
        {id_: Fiducial(Prior(x, 1.0), Prior(y, 1.0)) for id_, (x, y) in FIDUCIALS.items()} if film else {})
    seen_twice = Counter(row[1] for row in rows if row[2] == "target")
    rows = [row for row in rows if row[2] == "fiducial" or seen_twice[row[1]] > 1]

    def prior(j: int, axis: int) -> Prior:
        fixed = known == "fixed" or (known == "control" and j in control)
        return Prior(xyz[j, axis], 0.0 if fixed else 0.05 if known == "heights" and axis == 2 else np.inf)

    points = tuple(ObjectPoint(f"p{j}", *(prior(j, axis) for axis in range(3))) for j in range(len(xyz)) if seen_twice[f"p{j}"] > 1)
    network = Network(
        (camera,), tuple(Image(f"i{i}", "K", kind) for i in range(len(exteriors))), points,
        Observations(tuple(r[0] for r in rows), tuple(r[1] for r in rows), tuple(r[2] for r in rows),
                     np.array([r[3] + rng.normal(0.0, sigma, 2) for r in rows]), np.tile(sigma**2 * np.eye(2), (len(rows), 1, 1))))
    truth = Approximations(
        {"K": np.array([c, 0.0, 0.0])}, {f"i{i}": e for i, e in enumerate(exteriors)},
        {f"i{i}": f if film else np.empty(0) for i, f in enumerate(films)}, {f"p{j}": xyz[j] for j in range(len(xyz)) if seen_twice[f"p{j}"] > 1})
    return Scene(network, truth, options)


def exterior_of(station: list[float], tilt: Array | tuple[float, float], kappa: float) -> Array:
    return np.array([*station, *tilt, kappa])


def look_at(station: Array, kappa: float) -> Array:
    """The exterior orientation of a camera that looks at the origin."""
    back = station / np.linalg.norm(station)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(back, right), back])
    turn = rotation_from_angles(np.array([0.0, 0.0, kappa]))
    return np.concatenate([station, angles_from_rotation(turn @ level)])


if __name__ == "__main__":
    main()

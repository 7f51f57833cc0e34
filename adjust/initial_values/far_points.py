"""Given points that lie far from where the images see them: slips of the pen in a list of coordinates."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.functional_model.sight import Sight
from adjust.initial_values.frames import frames_of
from adjust.initial_values.intersection import intersect
from adjust.initial_values.resection import Pose, image_distances
from adjust.problem.problem import Problem

Array = NDArray[np.float64]

MOST_FAR = 0.25  # part of the given points: where more lie far off, who is to say which are right
FEWEST_IMAGES = 2  # whose rays meet at a place


@dataclass(frozen=True)
class FarPoint:
    """A given point that its images see elsewhere.

    place (3,): where its rays meet, in object units; miss_mm: from its marks to the images of the given coordinates,
    the median of its images, inf behind them; others_mm: the same of the other given points, at most.
    """

    name: str
    images: int
    place: Array
    miss_mm: float
    others_mm: float


def far_points(problem: Problem, family: float) -> list[FarPoint]:
    """The given points whose coordinates miss their marks as no other one comes near, the farthest first.

    By the orientations from which the adjustment starts: resections, which lack the distortion that is not known yet,
    so that nothing is said of the distribution of what good points miss by but that its variance is finite. The largest
    of many is then more than family^(-1/2) times as large as the next (10 times with 0.01) with the probability
    `family` at most, for that is so where its tail falls with the square of the distance (the spacings of Pareto's
    distribution: B. C. Arnold, Pareto Distributions, 1983). All before the last such gap are far, if their rays meet.
    Empty where more than MOST_FAR are.
    """
    sights = _sights(problem)
    rays = _rays_of_given(problem, sights)
    if not rays:
        return []
    miss = {name: float(np.median([ray.distance_mm for ray in seen])) for name, seen in rays.items()}
    noise = float(np.median([sight.sigma_mm for sight in sights.values()]))
    falling = sorted(miss, key=lambda name: (-miss[name], name))
    limits = [max(miss[name], noise) / np.sqrt(family) for name in falling]  # for those before each
    gaps = [k for k in range(1, int(MOST_FAR * len(falling)) + 1) if miss[falling[k - 1]] > limits[k]]
    if not gaps:
        return []
    far, others, limit = falling[: gaps[-1]], miss[falling[gaps[-1]]], limits[gaps[-1]]
    places = _places({name: rays[name] for name in far})
    return [
        FarPoint(name, len(rays[name]), places[name], miss[name], others)
        for name in far
        if max(ray.missed_by_mm(places[name]) for ray in rays[name]) < limit
    ]


@dataclass(frozen=True)
class _Ray:
    """Of an image to a given point: its station (3,), its direction (3,), the principal distance, and how far from its
    mark the point would appear.
    """

    center: Array
    direction: Array
    c_mm: float
    distance_mm: float

    def missed_by_mm(self, place: Array) -> float:
        """How far from the mark a place (3,) would appear, across the ray; inf where it is nowhere in front of it."""
        offset, along = place - self.center, self.direction / np.linalg.norm(self.direction)
        depth = float(offset @ along)
        return self.c_mm * float(np.linalg.norm(offset - depth * along)) / depth if depth > 0.0 else np.inf


def _rays_of_given(problem: Problem, sights: Mapping[str, Sight]) -> dict[str, list[_Ray]]:
    """The rays of every point that is given in X, Y and Z and seen in some images."""
    unknowns, start = problem.unknowns, problem.start()
    given = {id: unknowns.given[at] for id, at in unknowns.point.items() if np.isfinite(unknowns.sigma[at]).all()}
    rays = defaultdict(list)
    for image, rotation in zip(problem.network.images, start.rotations, strict=True):
        if image.name not in sights:
            continue
        sight, center = sights[image.name], start.values[unknowns.exterior[image.name][:3]]
        rows = [row for row, name in enumerate(sight.points) if name in given]
        xyz = np.array([given[sight.points[row]] for row in rows]).reshape(-1, 3)
        pose = Pose(rotation, center)
        distances = image_distances(pose, xyz, sight.xy_mm[rows], sight.principal_distance_mm)
        for row, distance in zip(rows, distances, strict=True):
            ray = _Ray(center, sight.rays[row] @ rotation, sight.principal_distance_mm, float(distance))
            rays[sight.points[row]].append(ray)
    return {name: seen for name, seen in sorted(rays.items()) if len(seen) >= FEWEST_IMAGES}


def _sights(problem: Problem) -> dict[str, Sight]:
    """By image name, of those that show object points: freed of the distortion as far as it is known beforehand."""
    network, unknowns = problem.network, problem.unknowns
    transformation = {name: unknowns.start[at] for name, at in unknowns.transformation.items()}
    frames = frames_of(network, transformation, problem.mirrored)
    sights = {}
    for name, at in unknowns.camera.items():
        interior, known = np.split(unknowns.start[at], [3])
        sights.update(frames.sights(network.camera_by_name[name], interior, known))
    return sights


def _places(rays: Mapping[str, list[_Ray]]) -> dict[str, Array]:
    """Where the rays of each point meet (3,), nan where they do not."""
    rows = [(number, ray) for number, seen in enumerate(rays.values()) for ray in seen]
    points, _ = intersect(
        np.array([ray.center for _, ray in rows]),
        np.array([ray.direction for _, ray in rows]),
        np.array([number for number, _ in rows], dtype=np.intp),
        np.full((len(rays), 3), np.nan),
    )
    return dict(zip(rays, points, strict=True))

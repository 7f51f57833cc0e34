"""Coordinate blunders of given points, too large for an adjustment that treats the coordinates as observations."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array
from adjust.functional_model.lens import Lens, Prior
from adjust.initial_values.frames import camera_frames
from adjust.initial_values.pose import Pose, Sight, image_distances, intersect
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.problem.parameter import Parameter
from adjust.problem.problem import Problem
from adjust.solution.options import Options
from adjust.solution.result import Adjustment

MOST_FAR = 0.25  # fraction of the given points: if more are far off, the correct ones cannot be identified
FEWEST_IMAGES = 2  # images needed for an intersection
ENOUGH = 5  # points needed to identify a wrong one: the resection without it is still redundant


class FarPoint(NamedTuple):
    """Given point whose rays meet elsewhere."""

    name: str  # id of the point
    images: int  # number of images that show it
    place: Array  # (3,) intersection of its rays, in object units
    # median distance in the images of its marks from the projected given coordinates; inf behind the cameras
    miss_mm: float
    others_mm: float  # largest such distance of the other given points


def far_points(problem: Problem, family: float) -> list[FarPoint]:
    """Find given points that miss their marks by far more than all others, farthest first.

    The orientations at the start of the adjustment are used: resections without the distortion, which is not known yet.
    Therefore only a finite variance of the misses of good points is assumed. The largest of many is then more than
    family^(-1/2) times as large as the next (10 times with 0.01) with the probability `family` at most, as holds for a
    tail that falls with the square of the distance (the spacings of Pareto's distribution: B. C. Arnold, Pareto
    Distributions, 1983). All points before the last such gap are far, if their rays meet. Empty where more than
    MOST_FAR of the points are far.
    """
    sights = _sights(problem)
    rays = {name: own for name, own in _rays_of_given(problem, sights).items() if len(own) >= FEWEST_IMAGES}
    if not rays:
        return []
    miss = {name: float(np.median(own[:, -1])) for name, own in rays.items()}
    noise = float(np.median([sight.sigma_mm for sight in sights.values()]))
    falling = sorted(miss, key=lambda name: (-miss[name], name))
    limits = [max(miss[name], noise) / np.sqrt(family) for name in falling]  # for the points before each
    gaps = [k for k in range(1, int(MOST_FAR * len(falling)) + 1) if miss[falling[k - 1]] > limits[k]]
    found = []
    for name in falling[: gaps[-1]] if gaps else ():
        centers, directions, c_mm, _ = np.split(rays[name], [3, 6, 7], axis=1)
        numbers = np.zeros(len(centers), dtype=np.intp)
        (place,), _ = intersect(centers, directions, numbers, np.full((1, 3), np.nan))
        along = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        offsets = place - centers
        depths = (offsets * along).sum(axis=1)
        across_mm = c_mm[:, 0] * np.linalg.norm(offsets - depths[:, None] * along, axis=1)
        if (depths > 0.0).all() and (across_mm < limits[gaps[-1]] * depths).all():
            found.append(FarPoint(name, len(centers), place, miss[name], miss[falling[gaps[-1]]]))
    return found


def _rays_of_given(problem: Problem, sights: Mapping[str, Sight]) -> dict[str, Array]:
    """Rays (m, 8) of every point given in X, Y and Z: station, direction, principal distance, and how far the projected
    point misses its mark."""
    unknowns, start = problem.unknowns, problem.start()
    given = {id_: unknowns.given[at] for id_, at in unknowns.point.items() if np.isfinite(unknowns.sigma[at]).all()}
    rays = dict[str, list[Array]]()
    for image, rotation in zip(problem.network.images, start.rotations, strict=True):
        if (sight := sights.get(image.name)) is None:
            continue
        center, c = start.values[unknowns.exterior[image.name][:3]], sight.principal_distance_mm
        known = [row for row, name in enumerate(sight.points) if name in given]
        xyz = np.array([given[sight.points[row]] for row in known]).reshape(-1, 3)
        distances = image_distances(Pose(rotation, center), xyz, sight.xy_mm[known], c)
        for row, distance in zip(known, distances, strict=True):
            ray = np.array([*center, *(sight.rays[row] @ rotation), c, distance])
            rays.setdefault(sight.points[row], []).append(ray)
    return {name: np.array(own) for name, own in sorted(rays.items())}


def _sights(problem: Problem) -> dict[str, Sight]:
    """Image points by image name, for images with object points, corrected for the distortion known beforehand."""
    network, unknowns = problem.network, problem.unknowns
    transformation = {name: unknowns.start[at] for name, at in unknowns.transformation.items()}
    frames, sights = camera_frames(network, transformation, problem.mirrored), dict[str, Sight]()
    for name, at in unknowns.camera.items():
        interior, known = np.split(unknowns.start[at], [3])
        sights |= frames.sights(name, Lens(network.camera_by_name[name].distortion, interior, known))
    return sights


def free_points(network: Network, start: Approximations, far: Sequence[FarPoint]) -> tuple[Network, Approximations]:
    """Remove the priors of far points from a network; start them where their rays meet."""
    places = {each.name: each.place for each in far}

    def freed(point: ObjectPoint) -> ObjectPoint:
        return ObjectPoint(point.id, *(Prior(each.value, np.inf) for each in point.priors if each))

    points = tuple(freed(point) if point.id in places else point for point in network.points)
    return replace(network, points=points), replace(start, points={**start.points, **places})


def coordinate_slips(
    network: Network, far: Sequence[FarPoint], without: Adjustment, options: Options
) -> list[tuple[FarPoint, str]]:
    """Select the far points that contradict an adjustment `without` their coordinates significantly, with sentences.

    The quadratic form of the difference between given and adjusted coordinates is chi-square with 3 degrees of freedom.
    The critical value holds for the maximum over all given points at the level `family`, and is multiplied by sigma0²
    where that is larger than 1. Empty where that adjustment has no solution.
    """
    given, scale = network.known_places, max(without.sigma0, 1.0)
    critical = float(options.probabilities.critical(np.array([3]), len(given))[0]) * scale**2
    found = []
    for each in far if without.converged else ():
        coordinates, point = [Parameter.point(each.name, axis) for axis in "XYZ"], network.point_by_id[each.name]
        place, cofactor = without.values_of(coordinates), without.cofactor_of(coordinates)
        variances = [prior.sigma**2 for prior in point.priors if prior]
        weight: Array = np.asarray(np.linalg.inv(cofactor + np.diag(variances)), dtype=np.float64)

        def passes(xyz: Array, place: Array = place, weight: Array = weight) -> bool:
            return bool((xyz - place) @ weight @ (xyz - place) <= critical)

        if not passes(given[each.name]):
            sigma = scale * float(np.sqrt(np.diag(cofactor).max()))
            found.append((each, _sentence(each, place, sigma, given, passes)))
    return found


def _sentence(
    far: FarPoint, place: Array, sigma: float, given: Mapping[str, Array], passes: Callable[[Array], bool]
) -> str:
    """Describe a blunder by the point's place (3,) without its given coordinates, and their difference from it."""
    own = given[far.name]
    off, digits = own - place, max(0, 1 - int(np.floor(np.log10(sigma))))
    at = ", ".join(f"{axis} = {value:.{digits}f}" for axis, value in zip("XYZ", place, strict=True))
    by = ", ".join(f"{axis} by {value:+.{digits}f}" for axis, value in zip("XYZ", off, strict=True))
    missed = f"{far.miss_mm:.3g} mm from its marks" if np.isfinite(far.miss_mm) else "behind the camera"
    # Clerical errors that explain the coordinates; told where there is exactly one.
    readings = [
        (own[[j if k == i else i if k == j else k for k in range(3)]], f"{'XYZ'[i]} and {'XYZ'[j]} look exchanged.")
        for i, j in combinations(range(3), 2)
    ]
    readings += [(own * (1.0 - 2.0 * np.eye(3)[i]), f"The sign of {'XYZ'[i]} looks wrong.") for i in range(3)]
    readings += [(xyz, f"It lies where point {id_} is given.") for id_, xyz in given.items() if id_ != far.name]
    causes = [cause for xyz, cause in readings if passes(xyz)]
    guess = f" {causes[0]}" if len(causes) == 1 else ""
    return (
        f"Control point {far.name} is not where it is given: its rays from {far.images} images meet at {at}, "
        f"{np.linalg.norm(off):.{digits}f} away ({by}). What is given lies {missed} in the images, every other given "
        f"point within {far.others_mm:.2g} mm.{guess} Correct its coordinates, or its number among the marks; with "
        f"snooping = true the adjustment does without them."
    )


def few_points(network: Network) -> list[str]:
    """Remark on an adjustment without a solution where too few points are given to check each other."""
    named = sorted(name for name in network.known_places if name in network.observed_points)
    if len(named) != ENOUGH - 1:
        return []
    return [
        f"The points {', '.join(named)} alone are given in X, Y and Z: if the coordinates of one of the {len(named)} "
        f"are wrong, nothing tells which. Check all of them, or give another point."
    ]

"""Given points with coordinate blunders: their rays meet far from where they are given."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array
from adjust.errors import AdjustmentError
from adjust.functional_model.lens import Prior
from adjust.initial_values.mismatches import started_rays
from adjust.initial_values.pose import intersect
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.problem.problem import Problem, number
from adjust.quality.critical_values import Probabilities
from adjust.solution.result import Adjustment

MOST_FAR = 0.25  # fraction of the given points: if more are far off, the correct ones cannot be identified
FEWEST_IMAGES = 2  # images needed for an intersection


class CoordinateBlunder(NamedTuple):
    """Given point whose rays meet elsewhere."""

    name: str  # id of the point
    images: int  # number of images that show it
    place: Array  # (3,) intersection of its rays, in object units
    # median distance in the images of its marks from the projected given coordinates; inf behind the cameras
    miss_mm: float
    others_mm: float  # largest such distance of the other given points
    sentence: str = ""  # where the point contradicts the observations significantly


def find_coordinate_blunders(
    network: Network,
    start: Approximations,
    solve: Callable[[Network, Approximations], Adjustment],
    probabilities: Probabilities,
) -> list[CoordinateBlunder]:
    """Find the given points that contradict an adjustment without their coordinates significantly, with sentences.

    The quadratic form of the difference between given and adjusted coordinates is chi-square with 3 degrees of freedom.
    The critical value holds for the maximum over all given points at the level `family`, and is multiplied by sigma0²
    where that is larger than 1. Empty where that adjustment has no solution.
    """
    far = {each.name: each for each in _far_points(number(network, start), probabilities.family)}
    if not far:
        return []
    points = tuple(
        ObjectPoint(point.id, *(Prior(each.value, np.inf) for each in point.priors if each))
        if point.id in far
        else point
        for point in network.points
    )
    places = {name: each.place for name, each in far.items()}
    try:
        without = solve(replace(network, points=points), replace(start, points={**start.points, **places}))
    except AdjustmentError:  # the adjustment cannot start without these points
        return []
    given, scale, found = network.known_places, max(without.sigma0, 1.0), list[CoordinateBlunder]()
    critical = float(probabilities.critical(np.array([3]), len(given))[0]) * scale**2
    for each in far.values() if without.converged else ():
        at, point = without.run.problem.unknowns.point[each.name], network.point_by_id[each.name]
        place, cofactor = without.values[at], without.cofactor.part(at)
        variances = [prior.sigma**2 for prior in point.priors if prior]
        weight: Array = np.asarray(np.linalg.inv(cofactor + np.diag(variances)), dtype=np.float64)

        def passes(xyz: Array, place: Array = place, weight: Array = weight) -> bool:
            return bool((xyz - place) @ weight @ (xyz - place) <= critical)

        if not passes(given[each.name]):
            sigma = scale * float(np.sqrt(np.diag(cofactor).max()))
            found.append(each._replace(sentence=_sentence(each, place, sigma, given, passes)))
    return found


def _far_points(problem: Problem, family: float) -> list[CoordinateBlunder]:
    """Find given points that miss their marks by far more than all others, farthest first.

    The orientations at the start of the adjustment are used: resections without the distortion, which is not known yet.
    Therefore only a finite variance of the misses of good points is assumed. The largest of many is then more than
    family^(-1/2) times as large as the next (10 times with 0.01) with the probability `family` at most, as holds for a
    tail that falls with the square of the distance (the spacings of Pareto's distribution: B. C. Arnold, Pareto
    Distributions, 1983). All points before the last such gap are far, if their rays meet. Empty where more than
    MOST_FAR of the points are far.
    """
    rays, unknowns, rows = started_rays(problem), problem.unknowns, defaultdict[str, list[int]](list)
    given = {id_: unknowns.given[at] for id_, at in unknowns.point.items() if np.isfinite(unknowns.sigma[at]).all()}
    for row in np.flatnonzero(rays.scale_mm > 0.0).tolist():
        rows[problem.network.observations.point[row]].append(row)
    shown = {name: np.array(rows[name]) for name in sorted(given) if len(rows[name]) >= FEWEST_IMAGES}
    if not shown:
        return []
    miss = {name: float(np.median(rays.misses_mm(own, given[name]))) for name, own in shown.items()}
    falling = sorted(miss, key=lambda name: (-miss[name], name))
    limits = [max(miss[name], rays.sigma_mm) / np.sqrt(family) for name in falling]  # for the points before each
    gaps = [k for k in range(1, int(MOST_FAR * len(falling)) + 1) if miss[falling[k - 1]] > limits[k]]
    found = []
    for name in falling[: gaps[-1]] if gaps else ():
        own = shown[name]
        numbers = np.zeros(len(own), dtype=np.intp)
        (place,), _ = intersect(rays.centers[own], rays.directions[own], numbers, np.full((1, 3), np.nan))
        if (rays.misses_mm(own, place) < limits[gaps[-1]]).all():
            found.append(CoordinateBlunder(name, len(own), place, miss[name], miss[falling[gaps[-1]]]))
    return found


def _sentence(
    far: CoordinateBlunder, place: Array, sigma: float, given: Mapping[str, Array], passes: Callable[[Array], bool]
) -> str:
    """Describe a blunder by the point's place (3,) without its given coordinates, and their difference from it."""
    own = given[far.name]
    off, digits = own - place, max(0, 1 - int(np.floor(np.log10(sigma))))
    at = ", ".join(f"{axis} = {value:.{digits}f}" for axis, value in zip("XYZ", place, strict=True))
    by = ", ".join(f"{axis} by {value:+.{digits}f}" for axis, value in zip("XYZ", off, strict=True))
    missed = f"{far.miss_mm:.3g} mm from its marks" if np.isfinite(far.miss_mm) else "behind the camera"
    # Clerical errors that explain the coordinates; reported where there is exactly one.
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

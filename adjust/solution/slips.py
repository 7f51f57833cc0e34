"""Slips among the given coordinates of points: too large for an adjustment that takes them for observations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from adjust.initial_values.far_points import FarPoint
from adjust.problem.camera import Prior
from adjust.problem.network import Approximations, Network, ObjectPoint
from adjust.problem.parameter import Parameter
from adjust.problem.result import Adjustment
from adjust.solution.options import Options

Array = NDArray[np.float64]

ENOUGH = 5  # points from which on a resection without a wrong one has a check of its own, and tells which one it is


@dataclass(frozen=True)
class Slip:
    """A given point that contradicts all that is known without its coordinates, beyond chance.

    place (3,): where it then is; sigma: its largest standard deviation; off (3,): given less that; explained: the slip
    that would do it, in words, or empty.
    """

    far: FarPoint
    place: Array
    sigma: float
    off: Array
    explained: str

    @property
    def sentence(self) -> str:
        far, distance = self.far, float(np.linalg.norm(self.off))
        digits = max(0, 1 - int(np.floor(np.log10(self.sigma))))
        at = ", ".join(f"{axis} = {value:.{digits}f}" for axis, value in zip("XYZ", self.place, strict=True))
        by = ", ".join(f"{axis} by {value:+.{digits}f}" for axis, value in zip("XYZ", self.off, strict=True))
        missed = f"{far.miss_mm:.3g} mm beside its marks" if np.isfinite(far.miss_mm) else "behind the camera"
        guess = f" {self.explained}" if self.explained else ""
        return (
            f"Control point {far.name} is not where it is given: its rays from {far.images} images meet at {at}, "
            f"{distance:.{digits}f} away ({by}). What is given lies {missed} in the images, every other given point "
            f"within {far.others_mm:.2g} mm.{guess} Correct its coordinates, or its number among the marks; with "
            f"snooping = true the adjustment does without them."
        )


def freed(network: Network, start: Approximations, far: Sequence[FarPoint]) -> tuple[Network, Approximations]:
    """The network with nothing known of the far points' coordinates, and its start with them where their rays meet."""
    places = {each.name: each.place for each in far}
    points = tuple(_unknown(point) if point.id in places else point for point in network.points)
    return replace(network, points=points), replace(start, points={**start.points, **places})


def _unknown(point: ObjectPoint) -> ObjectPoint:
    return ObjectPoint(point.id, *(Prior(each.value, np.inf) for each in (point.X, point.Y, point.Z) if each))


def slips(network: Network, far: Sequence[FarPoint], without: Adjustment, options: Options) -> list[Slip]:
    """Which of the far points are slips, by an adjustment `without` their coordinates; none where that has no solution.

    The difference of given and adjusted coordinates over its covariance is chi-square with 3 degrees of freedom. What
    any of all given points exceeds with the probability `family` is beyond chance; where the observations are worse
    than given the limit rises with sigma0².
    """
    if not without.converged:
        return []
    given = _given(network)
    critical = float(options.probabilities.critical(np.array([3]), len(given))[0]) * max(without.sigma0, 1.0) ** 2
    found = []
    for each in far:
        coordinates = [Parameter.point(each.name, axis) for axis in "XYZ"]
        place, cofactor = without.values_of(coordinates), without.cofactor_of(coordinates)
        covariance = cofactor + _given_covariance(network.point_by_id[each.name])
        test = _Test(place, np.asarray(np.linalg.inv(covariance), dtype=np.float64), critical)
        if not test.passes(given[each.name]):
            off = given[each.name] - place
            sigma = max(without.sigma0, 1.0) * float(np.sqrt(np.diag(cofactor).max()))
            found.append(Slip(each, place, sigma, off, _explanation(each.name, given, test)))
    return found


def few_points(network: Network) -> list[str]:
    """What is to be said of an adjustment without a solution where too few points are given to check one another."""
    seen = sorted(name for name in _given(network) if name in network.observed_points)
    if len(seen) != ENOUGH - 1:
        return []
    return [
        f"The points {', '.join(seen)} alone are given in X, Y and Z: if the coordinates of one of the {len(seen)} are "
        f"wrong, nothing tells which. Check all of them, or give another point."
    ]


def _given(network: Network) -> dict[str, Array]:
    """The coordinates (3,) of the points that are given in X, Y and Z."""
    priors = {point.id: [each for each in (point.X, point.Y, point.Z) if each] for point in network.points}
    return {
        id: np.array([each.value for each in three])
        for id, three in priors.items()
        if len(three) == 3 and all(np.isfinite(each.sigma) for each in three)
    }


def _given_covariance(point: ObjectPoint) -> Array:
    return np.diag([each.sigma**2 for each in (point.X, point.Y, point.Z) if each])


@dataclass(frozen=True)
class _Test:
    """Whether coordinates (3,) can be those of an adjusted place."""

    place: Array
    weight: Array
    critical: float

    def passes(self, xyz: Array) -> bool:
        return bool((xyz - self.place) @ self.weight @ (xyz - self.place) <= self.critical)


def _explanation(name: str, given: Mapping[str, Array], test: _Test) -> str:
    """The slip of the pen after which the coordinates would be the given ones, where there is one such."""
    own = given[name]
    told = []
    for i, j in combinations(range(3), 2):
        other = own.copy()
        other[[i, j]] = own[[j, i]]
        if test.passes(other):
            told.append(f"{'XYZ'[i]} and {'XYZ'[j]} look exchanged.")
    for i in range(3):
        other = own.copy()
        other[i] = -own[i]
        if test.passes(other):
            told.append(f"The sign of {'XYZ'[i]} looks wrong.")
    told += [f"It lies where point {id} is given." for id, xyz in given.items() if id != name and test.passes(xyz)]
    return told[0] if len(told) == 1 else ""

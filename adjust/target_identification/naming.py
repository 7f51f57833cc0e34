"""Identify the object points of an image's marks without a known orientation.

Hypothesise and test: three neighbouring object points are matched to three neighbouring marks. The resulting poses are
tested on the surrounding points, the best ones are grown over the whole image, and the result is accepted only if its
expected number of false alarms is small (a contrario: Desolneux, Moisan and Morel 2008). Then other identifications of
the same marks are tried. One of two is accepted if its points lie much closer to the marks; a field that looks the same
from another side is reported as ambiguous.

Where the principal distance is unknown, a few widely spaced ones are tried: the neighbourhood of three points looks
nearly the same with any, and growing finds the right one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb
from operator import attrgetter

import numpy as np

from adjust.array_types import Array, Indices
from adjust.initial_values.pose import Pose
from adjust.initial_values.resection import resect
from adjust.target_identification.naming_hypotheses import (
    Cluster,
    Poses,
    clusters,
    mark_triples,
    point_triples,
    promising,
)
from adjust.target_identification.unnamed_marks import OF_POSE, Grown, Marks, View, grow, log10_of_chance

LEAST_POINTS = 5
MOST_LOG10_CHANCE = -6.0
LEAST_SHARE = 0.4  # fraction of the expected points that must be identified
ALIKE_SHARE = 0.7  # fraction of the identified marks above which an alternative may be as good
TOLD_LOG10 = 6.0  # log10 of the likelihood ratio that decides between two identifications
MOST_POSES = 1_000_000  # largest number of poses tried, to limit the time
MOST_LOG10_CHANCE_OF_CODES = -3.0  # for agreeing codes; a weaker limit, since few hypotheses are tested
LEAST_CODES = 4  # three always agree with some pose
KNOWN_SIGMA = 0.05  # relative standard deviation of a known principal distance
# Unknown principal distance, in diagonals of the frame, usual ones first; the largest error is a factor of 1.41:
UNKNOWN, UNKNOWN_SIGMA = (1.2, 0.6, 2.4, 0.3, 4.8), 0.3
OTHER_CLUSTERS = 8  # clusters tried as other points; if each is found with p = 0.5, one case in 256 is missed


@dataclass(frozen=True, eq=False)
class Names:
    """Identified marks of an image."""

    mark: dict[int, int]  # index of the mark by index of the object point
    pose: Pose  # exterior orientation
    # principal_distance_mm, radial: of the view; images are p (1 + radial p²), p in principal distances
    principal_distance_mm: float
    radial: float
    expected: int  # number of points that the image should show
    log10_chance: float  # log10 of the expected number of false alarms
    gate_mm: float  # largest distance of a mark from the predicted place of its point


def name_marks(
    xyz: Array,
    normals: Array,
    xy_mm: Array,
    frame_mm: tuple[Array, Array],
    principal_distance_mm: float | None,
    sigma_mm: float,
    codes: Mapping[int, int] | None = None,
) -> Names | str:
    """Identify the marks of an image of known points; returns a sentence on the reason where this fails.

    The result is deterministic.

    Parameters
    ----------
    xyz : (n, 3) object points.
    normals : (n, 3) directions in which the points face, nan where unknown.
    xy_mm : (m, 2) ideal coordinates of the marks relative to the principal point, y up.
    frame_mm : lower and upper corner (2,) of the searched area.
    principal_distance_mm : correct to some percent, or None.
    sigma_mm : standard deviation of the marks.
    codes : point (index) by mark (index), where codes were read; they need not all be correct. The pose that agrees
        with most of them identifies the other marks. A mark whose code contradicts its identification is left out.
    """
    n, m = len(xyz), len(xy_mm)
    if codes is None and min(n, m) < LEAST_POINTS:
        return f"{m} marks and {n} points are too few: {LEAST_POINTS} that agree are needed"
    if codes is not None and len(codes) < LEAST_CODES:
        return f"{len(codes)} coded targets were recognised, and {LEAST_CODES} are needed"
    origin, size = xyz.mean(axis=0), float(np.linalg.norm(np.ptp(xyz, axis=0)))
    diagonal = float(np.linalg.norm(frame_mm[1] - frame_mm[0]))
    tried = [(share * diagonal, UNKNOWN_SIGMA) for share in UNKNOWN]
    if principal_distance_mm is not None:
        tried = [(principal_distance_mm, KNOWN_SIGMA)]
    searches = []
    for c, c_sigma in tried:
        marks = Marks(xy_mm / c, frame_mm[0] / c, frame_mm[1] / c, sigma_mm / c, c, c_sigma)
        searches.append(_Search(origin, size, (xyz - origin) / size, normals, marks))
    return _named_by_pattern(searches) if codes is None else _named_by_codes(searches, codes)


def _named_by_pattern(searches: Sequence["_Search"]) -> Names | str:
    search, found = _first(searches)
    if found is None:
        n, m = len(search.xyz), len(search.marks.places)
        return f"the {m} marks found do not make the pattern that the {n} points would from any side"
    found, alike = search.likeliest(found)
    if alike is not None:
        return (
            f"the points look the same from another side, or moved on, as a regular grid does: {len(found.mark)} marks "
            f"agree with one naming, {len(alike.mark)} with another one, and about as closely"
        )
    return search.names(found)


def _first(searches: Sequence["_Search"]) -> tuple["_Search", Grown | None]:
    """Return the first accepted identification, the most significant one of several principal distances."""
    # The clusters that need the fewest trials come first.
    most = MOST_LOG10_CHANCE - np.log10(len(searches))
    tried = 0
    for cluster in searches[0].clusters:
        believed = []
        for search in searches:
            poses = search.poses(cluster.triple[None], mark_triples(cluster, search.marks))
            tried += poses.tried
            if (found := next(iter(search.grown(poses)), None)) is not None and found.log10_chance < most:
                believed.append((search, found))
        if believed:
            return min(believed, key=lambda one: one[1].log10_chance)
        if tried > MOST_POSES * len(searches):
            break
    return searches[0], None


def _named_by_codes(searches: Sequence["_Search"], codes: Mapping[int, int]) -> Names | str:
    grown = [(search, one) for search in searches if (one := search.grow_codes(codes)) is not None]
    if not grown:
        return f"the {len(codes)} coded targets recognised lie on one line and do not orient the image"
    search, best = min(grown, key=lambda one: one[1].log10_chance)
    if best.log10_chance + np.log10(len(searches)) > MOST_LOG10_CHANCE_OF_CODES:
        right = _right_codes(best, codes)
        return f"{right} of the {len(codes)} coded targets recognised fit their points, which may be a false alarm"
    numbers = set(codes.values())
    named = {
        point: mark
        for point, mark in best.mark.items()
        if codes.get(mark, point) == point and (mark in codes or point not in numbers)
    }
    return search.names(replace(best, mark=named))


def _right_codes(grown: Grown, codes: Mapping[int, int]) -> int:
    """Number of codes that agree with an identification."""
    return sum(grown.mark.get(point) == mark for mark, point in codes.items())


@dataclass(frozen=True, eq=False)
class _Search:
    """Search with one principal distance.

    xyz, normals (n, 3): points relative to their centre `origin`, in units of the field's size; marks: in units of the
    principal distance.
    """

    origin: Array
    size: float
    xyz: Array
    normals: Array
    marks: Marks

    @cached_property
    def clusters(self) -> list[Cluster]:
        """Clusters to start with."""
        return clusters(self.xyz, self.normals, len(self.marks.places) / len(self.xyz))

    def names(self, found: Grown) -> Names:
        """Convert a result to object units and mm."""
        view, c = found.view, self.marks.c
        pose = Pose(view.rotation, self.origin - self.size * view.rotation.T @ view.shift)
        of_view = pose, c * (1.0 + view.scale), view.radial
        return Names(found.mark, *of_view, found.expected, found.log10_chance, found.gate * c)

    def grow_codes(self, codes: Mapping[int, int]) -> Grown | None:
        """Grow the pose that most codes agree with, and compute its false-alarm rate; None for codes on one line."""
        marks, coded, points = self.marks, np.array(list(codes)), np.array(list(codes.values()))
        found = resect(self.xyz[points], marks.places[coded], 1.0, marks.sigma)
        if found is None:
            return None
        view, agree = View(found.pose.rotation, -found.pose.rotation @ found.pose.center), found.inliers
        grown = grow(view, points[agree], coded[agree], self.xyz, self.normals, marks)
        chance = min(np.pi * (2.0 * grown.gate) ** 2 / float(np.prod(marks.greatest - marks.least)), 1.0)
        tests = float(comb(len(codes), OF_POSE))
        return replace(grown, log10_chance=log10_of_chance(_right_codes(grown, codes), len(codes), chance, tests))

    def poses(self, points: Indices, named: Indices) -> Poses:
        return promising(self.xyz, self.normals, self.marks, points, named)

    def grown(self, poses: Poses) -> list[Grown]:
        """Identifications of enough marks, the most significant first."""
        grown = [
            grow(View(rotation, shift), *named, self.xyz, self.normals, self.marks)
            for rotation, shift, named in zip(poses.rotations, poses.shifts, poses.named, strict=True)
        ]
        enough = [one for one in grown if len(one.mark) >= LEAST_SHARE * one.expected and len(one.mark) >= LEAST_POINTS]
        return sorted(enough, key=attrgetter("log10_chance"))

    def likeliest(self, found: Grown) -> tuple[Grown, Grown | None]:
        """Return the most significant of an identification and its alternatives, and a rival as good, if any."""
        others = self._others(found)
        best = min([found, *others], key=attrgetter("log10_chance"))
        rivals = others if best is found else [found, *self._others(best)]
        return best, next((one for one in rivals if _is_alike(one, best)), None)

    def _others(self, found: Grown) -> list[Grown]:
        """Alternative identifications of the image: identified clusters matched to other points."""
        named = [cluster for cluster in self.clusters if all(int(point) in found.mark for point in cluster.triple)]
        others: list[Grown] = []
        for cluster in named[:OTHER_CLUSTERS]:
            marks = np.array([[found.mark[int(point)] for point in cluster.triple]])
            others += self.grown(self.poses(point_triples(cluster, self.xyz), marks))
        return [one for one in others if len(found.mark.items() & one.mark.items()) < 0.5 * len(one.mark)]


def _is_alike(other: Grown, best: Grown) -> bool:
    """Whether another identification explains about as many marks about as closely."""
    # The number of marks alone does not decide: for a grid shifted by one step, the points lost at one end may be as
    # many as those missed by chance.
    closer = 2 * len(other.mark) * np.log10(other.gate / best.gate)  # likelihood of two coordinates each
    return len(other.mark) >= ALIKE_SHARE * len(best.mark) and bool(closer < TOLD_LOG10)

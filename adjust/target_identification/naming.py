"""Which mark of an image is which object point, where nothing is known of the image's orientation.

Hypothesis and test. Three object points that lie close together are taken to be three marks that do; the poses from
which they would be are tested on the points about them, the best ones grow over the whole image, and what has grown is
believed only if chance would hardly do as well (a contrario: Desolneux, Moisan and Morel 2008). Then it is tried
whether the same marks could bear other names. Of two namings the one counts whose points come far closer to the marks;
a field that looks the same from another side has none, and that is said.

Where the principal distance is not known, either, some far apart are tried: what lies about three points looks nearly
the same with any, and the growing finds the right one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb
from operator import attrgetter

import numpy as np

from adjust.array_types import Array
from adjust.initial_values.pose import Pose
from adjust.initial_values.resection import resect
from adjust.target_identification.naming_growth import OF_POSE, Grown, View, grow, log10_of_chance
from adjust.target_identification.naming_hypotheses import (
    Cluster,
    Poses,
    clusters,
    mark_triples,
    point_triples,
    promising,
)
from adjust.target_identification.unnamed_marks import Marks

LEAST_POINTS = 5
MOST_LOG10_CHANCE = -6.0
LEAST_SHARE = 0.4  # of the points that the image should show
ALIKE_SHARE = 0.7  # of the named marks, from which on other names may explain the image as well
TOLD_LOG10 = 6.0  # of the likelihood, by which marks must lie closer to their points in one naming than in another
MOST_POSES = 1_000_000  # that are tried: they bound the time
MOST_LOG10_CHANCE_OF_CODES = -3.0  # of codes that agree: they were not chosen among many
LEAST_CODES = 4  # three always give a pose
KNOWN_SIGMA = 0.05  # of a principal distance that is known, relative
# Where it is not known, over the frame's diagonal, the usual ones first; none is farther off than a factor of 1.41:
UNKNOWN, UNKNOWN_SIGMA = (1.2, 0.6, 2.4, 0.3, 4.8), 0.3
OTHER_CLUSTERS = 8  # named clusters that are tried as other points: with half of them seen, one case in 256 escapes


@dataclass(frozen=True, eq=False)
class Names:
    """mark: the mark (index) of each object point (index) that has one. pose, principal_distance_mm, radial: from which
    they are seen so, images being p (1 + radial p²), p in principal distances; expected: how many points the image
    should show; log10_chance: of the expected number of agreements as good by chance; gate_mm: how far marks may lie
    from their points' places."""

    mark: dict[int, int]
    pose: Pose
    principal_distance_mm: float
    radial: float
    expected: int
    log10_chance: float
    gate_mm: float


def name_marks(
    xyz: Array,
    normals: Array,
    xy_mm: Array,
    frame_mm: tuple[Array, Array],
    principal_distance_mm: float | None,
    sigma_mm: float,
) -> Names | str:
    """Name the marks of an image of known points; or why they have no names.

    xyz (n, 3), normals (n, 3): where the points face, nan where that is not known; xy_mm (m, 2): ideal coordinates of
    the marks about the principal point, y up, sigma_mm each; frame_mm: the least and the greatest (2,) that were
    searched; principal_distance_mm: right to some percent, or None. The same input gives the same names.
    """
    n, m = len(xyz), len(xy_mm)
    if min(n, m) < LEAST_POINTS:
        return f"{m} marks and {n} points are too few: {LEAST_POINTS} that agree are needed"
    search, found = _first(_searches(xyz, normals, xy_mm, frame_mm, principal_distance_mm, sigma_mm))
    if found is None:
        return f"the {m} marks found do not make the pattern that the {n} points would from any side"
    found, alike = search.likeliest(found)
    if alike is not None:
        return (
            f"the points look the same from another side, or moved on, as a regular grid does: {len(found.mark)} marks "
            f"agree with one naming, {len(alike.mark)} with another one, and about as closely"
        )
    return search.names(found)


def name_coded(
    xyz: Array,
    normals: Array,
    xy_mm: Array,
    frame_mm: tuple[Array, Array],
    principal_distance_mm: float | None,
    sigma_mm: float,
    codes: Mapping[int, int],
) -> Names | str:
    """The same where codes say which points (by index) some of the marks (by index) are; not all of them need be right.

    The pose that most codes agree with names the other marks. A mark whose code says another point has no name.
    """
    if len(codes) < LEAST_CODES:
        return f"{len(codes)} coded targets were recognised, and {LEAST_CODES} are needed"
    searches = _searches(xyz, normals, xy_mm, frame_mm, principal_distance_mm, sigma_mm)
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
    """How many codes agree with a naming."""
    return sum(grown.mark.get(point) == mark for mark, point in codes.items())


@dataclass(frozen=True, eq=False)
class _Search:
    """xyz, normals (n, 3) in units of the field's size about its middle, origin; the marks, in units of a principal
    distance."""

    origin: Array
    size: float
    xyz: Array
    normals: Array
    marks: Marks

    @cached_property
    def clusters(self) -> list[Cluster]:
        """To begin with."""
        return clusters(self.xyz, self.normals, len(self.marks.places) / len(self.xyz))

    def names(self, found: Grown) -> Names:
        """In the units of the object and mm."""
        view, c = found.view, self.marks.c
        pose = Pose(view.rotation, self.origin - self.size * view.rotation.T @ view.shift)
        of_view = pose, c * (1.0 + view.scale), view.radial
        return Names(found.mark, *of_view, found.expected, found.log10_chance, found.gate * c)

    def grow_codes(self, codes: Mapping[int, int]) -> Grown | None:
        """What the pose that most codes agree with grows to, and how likely the codes would agree by chance; None where
        they are on one line."""
        marks, coded, points = self.marks, np.array(list(codes)), np.array(list(codes.values()))
        found = resect(self.xyz[points], marks.places[coded], 1.0, marks.sigma)
        if found is None:
            return None
        view, agree = View(found.pose.rotation, -found.pose.rotation @ found.pose.center), found.inliers
        grown = grow(view, points[agree], coded[agree], self.xyz, self.normals, marks)
        chance = min(np.pi * (2.0 * grown.gate) ** 2 / float(np.prod(marks.greatest - marks.least)), 1.0)
        tests = float(comb(len(codes), OF_POSE))
        return replace(grown, log10_chance=log10_of_chance(_right_codes(grown, codes), len(codes), chance, tests))

    def grow_cluster(self, cluster: Cluster) -> tuple[Grown | None, int]:
        """The likeliest naming that one cluster leads to, if it leads to any, and how many poses were tried."""
        triples = mark_triples(cluster, self.marks)
        poses = promising(self.xyz, self.normals, self.marks, cluster.triple[None], triples)
        return next(iter(self._grown(poses)), None), poses.tried

    def likeliest(self, found: Grown) -> tuple[Grown, Grown | None]:
        """Of a naming and the others that the image may have the one that chance makes least likely; and another one
        that explains the image as well, if there is one."""
        others = self._others(found)
        best = min([found, *others], key=attrgetter("log10_chance"))
        rivals = others if best is found else [found, *self._others(best)]
        return best, next((one for one in rivals if _is_alike(one, best)), None)

    def _others(self, found: Grown) -> list[Grown]:
        """Other namings of the image: named clusters taken for other points."""
        named = [cluster for cluster in self.clusters if all(int(point) in found.mark for point in cluster.triple)]
        others = []
        for cluster in named[:OTHER_CLUSTERS]:
            named_marks = np.array([[found.mark[int(point)] for point in cluster.triple]])
            poses = promising(self.xyz, self.normals, self.marks, point_triples(cluster, self.xyz), named_marks)
            for grown in self._grown(poses):
                same = sum(found.mark.get(point) == mark for point, mark in grown.mark.items())
                if same < 0.5 * len(grown.mark):
                    others.append(grown)
        return others

    def _grown(self, poses: Poses) -> list[Grown]:
        grown = [
            grow(View(rotation, shift), *named, self.xyz, self.normals, self.marks)
            for rotation, shift, named in zip(poses.rotations, poses.shifts, poses.named, strict=True)
        ]
        enough = [one for one in grown if len(one.mark) >= LEAST_SHARE * one.expected and len(one.mark) >= LEAST_POINTS]
        return sorted(enough, key=attrgetter("log10_chance"))


def _searches(
    xyz: Array,
    normals: Array,
    xy_mm: Array,
    frame_mm: tuple[Array, Array],
    principal_distance_mm: float | None,
    sigma_mm: float,
) -> list[_Search]:
    """One with the principal distance, or with each that is tried where it is not known."""
    origin, size = xyz.mean(axis=0), float(np.linalg.norm(np.ptp(xyz, axis=0)))
    diagonal = float(np.linalg.norm(frame_mm[1] - frame_mm[0]))
    tried = [(share * diagonal, UNKNOWN_SIGMA) for share in UNKNOWN]
    if principal_distance_mm is not None:
        tried = [(principal_distance_mm, KNOWN_SIGMA)]
    assumed = (Marks.from_mm(xy_mm, *frame_mm, sigma_mm, c, c_sigma) for c, c_sigma in tried)
    return [_Search(origin, size, (xyz - origin) / size, normals, marks) for marks in assumed]


def _is_alike(other: Grown, best: Grown) -> bool:
    """Whether another naming explains about as many marks about as closely. How many it explains does not decide: of a
    grid moved on by a step, what chance left out at one end is as many as what it left out anywhere."""
    closer = 2 * len(other.mark) * np.log10(other.gate / best.gate)  # likelihood of two coordinates each
    return len(other.mark) >= ALIKE_SHARE * len(best.mark) and bool(closer < TOLD_LOG10)


def _first(searches: Sequence[_Search]) -> tuple[_Search, Grown | None]:
    """The first naming that is believed, the clusters that need fewest trials first; the likeliest, if several
    principal distances lead to one."""
    most = MOST_LOG10_CHANCE - np.log10(len(searches))
    tried = 0
    for cluster in searches[0].clusters:
        believed = []
        for search in searches:
            found, count = search.grow_cluster(cluster)
            tried += count
            if found is not None and found.log10_chance < most:
                believed.append((search, found))
        if believed:
            return min(believed, key=lambda one: one[1].log10_chance)
        if tried > MOST_POSES * len(searches):
            break
    return searches[0], None

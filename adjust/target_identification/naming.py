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
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import comb
from operator import attrgetter

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from adjust.array_types import Array, Indices, Mask
from adjust.functional_model.projection import ray_by_orientation
from adjust.functional_model.rotation import rotation_from_vector
from adjust.initial_values.pose import Pose, refined_poses, triple_poses
from adjust.initial_values.resection import resect

_CELLS = 600  # cells of the look-up table along each side of the frame
_COARSE_CELLS = 60  # cells of the density table along each side
_CROWD = 6  # nearest marks from which the local density is estimated
_ROUNDS = 25  # of assignment and adjustment in turns
_GATE_SIGMAS = 3.5  # distance of a mark from a prediction, above which it is another's
_MOST_PROBABLE = 0.1  # largest probability of a random mark in a point's gate; otherwise not identified yet
_PRIOR_RADIAL = 0.1  # standard deviation of k1: 10 % of the radius for rays at 45 degrees
_ROBUST = 2.0  # in standard deviations, limit of Huber's weight function
_BEFORE = -1e-6  # z of a point before the camera, in units of its distance
OF_POSE = 3  # points that agree with some pose whatever they are
LEAST_POINTS = 5
MOST_LOG10_FALSE_ALARMS = -6.0
LEAST_SHARE = 0.4  # fraction of the expected points that must be identified
ALIKE_SHARE = 0.7  # fraction of the identified marks above which an alternative may be as good
DISTINCT_LOG10 = 6.0  # log10 of the likelihood ratio that decides between two identifications
MOST_POSES = 1_000_000  # largest number of poses tried, to limit the time
MOST_LOG10_FALSE_ALARMS_OF_CODES = -3.0  # for agreeing codes; a weaker limit, since few hypotheses are tested
LEAST_CODES = 4  # three always agree with some pose
KNOWN_SIGMA = 0.05  # relative standard deviation of a known principal distance
# Unknown principal distance, in diagonals of the frame, usual ones first; the largest error is a factor of 1.41:
UNKNOWN, UNKNOWN_SIGMA = (1.2, 0.6, 2.4, 0.3, 4.8), 0.3
OTHER_CLUSTERS = 8  # clusters tried as other points; if each is found with p = 0.5, one case in 256 is missed
_NEARBY = 6  # nearest points in space, two of which form a cluster with a point
_RANK_SHARE = 0.8  # quantile of the ranks over the directions
_SLENDER = 0.25  # width over length of a triangle below which its pose is poor
_ABOUT = 16  # points around a cluster that test it ...
_FARTHER = 40  # ... and that test it again after a fit to them
_DETECTED = 0.75  # assumed detection rate of points in the frame
_REACH, _LATER_REACH = 0.07, 0.02  # gate over the distance from the cluster, for a pose of three marks and a fitted one
_NOISE = 3.0  # gate in standard deviations of a mark
_SELF_REACH = 1.3  # factor on the distances in a cluster for points confused with it
_KEPT, _RETURNED = 96, 6  # best namings that are extended, and that are returned
_CHUNK = 20_000  # hypotheses tested at a time, to limit memory
# Viewing directions for the ranks of neighbours in the image: unit vectors distributed over the sphere (Fibonacci)
_HEIGHTS, _AZIMUTHS = 1.0 - (np.arange(24) + 0.5) / 12.0, np.pi * (1.0 + np.sqrt(5.0)) * (np.arange(24) + 0.5)
_WIDTHS = np.sqrt(1.0 - _HEIGHTS**2)
_DIRECTIONS = np.column_stack([_WIDTHS * np.cos(_AZIMUTHS), _WIDTHS * np.sin(_AZIMUTHS), _HEIGHTS])


@dataclass(frozen=True, eq=False)
class Marks:
    """Marks of an image, at least one; all lengths in principal distances."""

    places: Array  # (m, 2) ideal image coordinates relative to the principal point, y up
    # least, greatest: (2,) corners of the searched area
    least: Array
    greatest: Array
    sigma: float  # standard deviation of one coordinate
    c: float  # principal distance, mm
    c_sigma: float  # its relative standard deviation

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.places)

    @cached_property
    def _nearest_of_cell(self) -> Indices:
        """Look-up table of the nearest mark."""
        return np.asarray(self.tree.query(self._centres(_CELLS))[1], dtype=np.intp)

    @cached_property
    def _density_of_cell(self) -> Array:
        """Look-up table of the density of marks, from the distance of the k-th nearest mark."""
        mean = len(self.places) / float(np.prod(self.greatest - self.least))
        crowd = min(_CROWD, self.tree.n)
        reach = np.asarray(self.tree.query(self._centres(_COARSE_CELLS), k=[crowd])[0])[:, 0]
        return np.asarray(np.maximum(crowd / (np.pi * np.maximum(reach, 1e-12) ** 2), mean))

    def _centres(self, cells: int) -> Array:
        """(cells², 2) centres of the cells, row by row."""
        share = (np.arange(cells) + 0.5) / cells
        x, y = (self.least + share[:, None] * (self.greatest - self.least)).T
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def inside(self, places: Array) -> Mask:
        """Mask of places (..., 2) inside the searched area."""
        return np.asarray(((places >= self.least) & (places <= self.greatest)).all(axis=-1))

    def nearest(self, places: Array) -> Indices:
        """Nearest mark of each place (..., 2), to the resolution of the look-up table."""
        return self._nearest_of_cell[self._cell(places, _CELLS)]

    def probability(self, places: Array, reach: Array) -> Array:
        """Probability of a mark within reach (...) of places (..., 2), for random marks of this density (Poisson)."""
        density = self._density_of_cell[self._cell(places, _COARSE_CELLS)]
        return np.asarray(-np.expm1(-density * np.pi * np.square(reach)))

    def _cell(self, places: Array, cells: int) -> Indices:
        share = (places - self.least) / (self.greatest - self.least)
        with np.errstate(invalid="ignore"):
            cell = np.clip(np.nan_to_num(share * cells), 0, cells - 1).astype(np.intp)
        return np.asarray(cell[..., 1] * cells + cell[..., 0], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class View:
    """Projection: camera = R X + t; images are (1 + scale) p (1 + radial p²), p in principal distances."""

    rotation: Array
    shift: Array
    scale: float = 0.0
    radial: float = 0.0

    def images(self, xyz: Array) -> Array:
        """(n, 2) images of points (n, 3); nan behind the camera."""
        p = self._ideal(xyz)
        return np.asarray((1.0 + self.scale) * p * (1.0 + self.radial * (p**2).sum(axis=1, keepdims=True)))

    def derivatives(self, xyz: Array) -> Array:
        """(n, 2, 8) derivatives with respect to a small rotation, a shift in the camera frame, scale and radial."""
        p = self._ideal(xyz)
        r2 = (p**2).sum(axis=1)
        by_ideal = (1.0 + self.radial * r2)[:, None, None] * np.eye(2) + 2 * self.radial * p[:, :, None] * p[:, None]
        by_pose = (1.0 + self.scale) * by_ideal @ ray_by_orientation(p, -1.0 / self._camera(xyz)[:, 2])
        by_scale = p * (1.0 + self.radial * r2)[:, None]
        by_radial = (1.0 + self.scale) * p * r2[:, None]
        return np.concatenate([by_pose, by_scale[:, :, None], by_radial[:, :, None]], axis=2)

    def _camera(self, xyz: Array) -> Array:
        camera = xyz @ self.rotation.T + self.shift
        camera[:, 2] = np.where(camera[:, 2] < _BEFORE, camera[:, 2], np.nan)
        return np.asarray(camera)

    def _ideal(self, xyz: Array) -> Array:
        camera = self._camera(xyz)
        return np.asarray(camera[:, :2] / -camera[:, 2:])


@dataclass(frozen=True, eq=False)
class Grown:
    """Result of growing a pose."""

    view: View  # fitted projection
    mark: dict[int, int] = field(default_factory=dict)  # mark of each identified point
    gate: float = 0.0  # largest distance of a mark from the predicted place of its point, in principal distances
    expected: int = 0  # number of points that the frame should show
    log10_false_alarms: float = 0.0  # log10 of the expected number of false alarms over all possible hypotheses


@dataclass(frozen=True, eq=False)
class Cluster:
    """Three neighbouring points.

    triple (3,): points. ranks (2,): number of nearest marks of the first point's mark among which the others are
    sought.
    """

    triple: Indices
    ranks: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Names:
    """Identified marks of an image."""

    mark: dict[int, int]  # index of the mark by index of the object point
    pose: Pose  # exterior orientation
    # principal_distance_mm, radial: of the view; images are p (1 + radial p²), p in principal distances
    principal_distance_mm: float
    radial: float
    expected: int  # number of points that the image should show
    log10_false_alarms: float  # log10 of the expected number of false alarms
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
    """Take the first accepted identification, the most significant one of several principal distances."""
    most = MOST_LOG10_FALSE_ALARMS - np.log10(len(searches))
    accepted: list[tuple[_Search, Grown]] = []
    tried = 0
    for cluster in searches[0].clusters:  # those that need the fewest trials come first
        for search in searches:
            grown, count = search.grown(cluster.triple[None], mark_triples(cluster, search.marks))
            tried += count
            if grown and grown[0].log10_false_alarms < most:
                accepted.append((search, grown[0]))
        if accepted or tried > MOST_POSES * len(searches):
            break
    if not accepted:
        n, m = len(searches[0].xyz), len(searches[0].marks.places)
        return f"the {m} marks found do not make the pattern that the {n} points would from any side"
    search, found = min(accepted, key=lambda one: one[1].log10_false_alarms)
    others = search.others(found)
    best = min([found, *others], key=attrgetter("log10_false_alarms"))
    for other in others if best is found else [found, *search.others(best)]:
        # The number of marks alone does not decide: for a grid shifted by one step, the points lost at one end may be
        # as many as those missed by chance.
        closer = 2 * len(other.mark) * np.log10(other.gate / best.gate)  # likelihood of two coordinates each
        if len(other.mark) >= ALIKE_SHARE * len(best.mark) and closer < DISTINCT_LOG10:
            return (
                f"the points look the same from another side, or moved on, as a regular grid does: {len(best.mark)} "
                f"marks agree with one naming, {len(other.mark)} with another one, and about as closely"
            )
    return search.names(best)


def _named_by_codes(searches: Sequence["_Search"], codes: Mapping[int, int]) -> Names | str:
    """Take the pose that most codes agree with, if its expected number of false alarms is small."""
    coded, points = np.array(list(codes)), np.array(list(codes.values()))
    tests = float(comb(len(codes), OF_POSE))
    candidates = []
    for search in searches:
        marks = search.marks
        if (found := resect(search.xyz[points], marks.places[coded], 1.0, marks.sigma)) is None:
            continue
        view, agree = View(found.pose.rotation, -found.pose.rotation @ found.pose.center), found.inliers
        grown = grow(view, points[agree], coded[agree], search.xyz, search.normals, marks)
        probability = min(np.pi * (2.0 * grown.gate) ** 2 / float(np.prod(marks.greatest - marks.least)), 1.0)
        right = sum(grown.mark.get(point) == mark for mark, point in codes.items())
        grown = replace(grown, log10_false_alarms=log10_expected_alarms(right, len(codes), probability, tests))
        candidates.append((search, grown, right))
    if not candidates:
        return f"the {len(codes)} coded targets recognised lie on one line and do not orient the image"
    search, best, right = min(candidates, key=lambda one: one[1].log10_false_alarms)
    if best.log10_false_alarms + np.log10(len(searches)) > MOST_LOG10_FALSE_ALARMS_OF_CODES:
        return f"{right} of the {len(codes)} coded targets recognised fit their points, which may be a false alarm"
    numbers = set(codes.values())
    named = {
        point: mark
        for point, mark in best.mark.items()
        if codes.get(mark, point) == point and (mark in codes or point not in numbers)
    }
    return search.names(replace(best, mark=named))


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
        return Names(found.mark, *of_view, found.expected, found.log10_false_alarms, found.gate * c)

    def grown(self, points: Indices, named: Indices) -> tuple[list[Grown], int]:
        """Identifications of enough marks, the most significant first, from three points (k or 1, 3) matched to three
        marks (k or 1, 3); and the number of poses tried."""
        starts, tried = promising(self.xyz, self.normals, self.marks, points, named)
        grown = [grow(*start, self.xyz, self.normals, self.marks) for start in starts]
        enough = [one for one in grown if len(one.mark) >= LEAST_SHARE * one.expected and len(one.mark) >= LEAST_POINTS]
        return sorted(enough, key=attrgetter("log10_false_alarms")), tried

    def others(self, found: Grown) -> list[Grown]:
        """Alternative identifications of the image: identified clusters matched to other points."""
        named = [cluster for cluster in self.clusters if all(int(point) in found.mark for point in cluster.triple)]
        others: list[Grown] = []
        for cluster in named[:OTHER_CLUSTERS]:
            marks = np.array([[found.mark[int(point)] for point in cluster.triple]])
            others += self.grown(point_triples(cluster, self.xyz), marks)[0]
        return [one for one in others if len(found.mark.items() & one.mark.items()) < 0.5 * len(one.mark)]


def clusters(xyz: Array, normals: Array, marks_per_point: float) -> list[Cluster]:
    """Choose clusters to start with, those that need fewest hypotheses first, at most one for each first point."""
    near = _next(xyz, min(_NEARBY, len(xyz) - 1))
    ranks = _ranks(xyz, normals, near) * max(marks_per_point, 1.0) + 2.0
    first, second = np.triu_indices(near.shape[1], 1)
    cost = ranks[:, first] * ranks[:, second]
    along, across = xyz[near[:, first]] - xyz[:, None], xyz[near[:, second]] - xyz[:, None]
    longest = np.maximum(np.maximum((along**2).sum(2), (across**2).sum(2)), ((along - across) ** 2).sum(2))
    cost[np.linalg.norm(np.cross(along, across), axis=2) < _SLENDER * longest] = np.inf
    best = np.argmin(cost, axis=1)
    least = cost[np.arange(len(xyz)), best]
    # Clusters without common points come first: what occludes one cluster does not affect the next.
    apart: list[Cluster] = []
    later: list[Cluster] = []
    used: set[int] = set()
    for i in np.argsort(least, kind="stable")[: np.isfinite(least).sum()]:
        pair = [first[best[i]], second[best[i]]]
        cluster = Cluster(np.array([i, *near[i, pair]]), (int(ranks[i, pair[0]]), int(ranks[i, pair[1]])))
        own = set(cluster.triple.tolist())
        (later if own & used else apart).append(cluster)
        used |= own
    return apart + later


def _next(xyz: Array, count: int) -> Indices:
    """(n, count) nearest neighbours of each point."""
    index = np.asarray(cKDTree(xyz).query(xyz, k=np.arange(1, count + 2))[1])
    others = index != np.arange(len(xyz))[:, None]
    others[others.all(axis=1), -1] = False  # of coincident points any may count as the point itself
    return np.asarray(index[others].reshape(len(xyz), count), dtype=np.intp)


def _ranks(xyz: Array, normals: Array, near: Indices) -> Array:
    """(n, k) rank of each near point among a point's neighbours in the image, for most viewing directions."""
    n = len(xyz)
    ranks = []
    for direction in _DIRECTIONS:
        towards = normals @ direction
        if np.isfinite(towards).all() and (towards > 0.3).mean() < 0.5:
            continue
        flat = xyz @ np.linalg.svd(direction[None])[2][1:].T
        own = np.linalg.norm(flat[near] - flat[:, None], axis=2)
        tree = cKDTree(flat)
        ranks.append(np.stack([tree.query_ball_point(flat, reach, return_length=True) for reach in own.T], axis=1))
    return np.quantile(ranks, _RANK_SHARE, axis=0) if ranks else np.full(near.shape, float(n - 1))


def mark_triples(cluster: Cluster, marks: Marks) -> Indices:
    """(k, 3) possible marks of a cluster: any mark and two of its nearest neighbours."""
    m = len(marks.places)
    first, second = (min(rank, m - 1) for rank in cluster.ranks)
    near = _next(marks.places, max(first, second))
    b, c = (grid.ravel() for grid in np.meshgrid(np.arange(first), np.arange(second), indexing="ij"))
    b, c = b[b != c], c[b != c]
    heads = np.repeat(np.arange(m), len(b))
    return np.stack([heads, near[:, b].ravel(), near[:, c].ravel()], axis=1)


def point_triples(cluster: Cluster, xyz: Array) -> Indices:
    """(k, 3) points that a cluster could be confused with: any point, and two as near to it."""
    head, *others = xyz[cluster.triple]
    reach = [float(np.linalg.norm(other - head)) for other in others]
    tree = cKDTree(xyz)
    triples = [
        (a, b, c)
        for a, place in enumerate(xyz)
        for b in tree.query_ball_point(place, _SELF_REACH * reach[0])
        for c in tree.query_ball_point(place, _SELF_REACH * reach[1])
        if len({a, b, c}) == 3
    ]
    return np.array(triples, dtype=np.intp).reshape(-1, 3)


Start = tuple["View", Indices, Indices]  # a pose, and the points about its cluster that agree with it, and their marks


def promising(xyz: Array, normals: Array, marks: Marks, points: Indices, named: Indices) -> tuple[list[Start], int]:
    """Find the poses that best explain the surroundings of three points (k or 1, 3) as three marks (k or 1, 3).

    Returns the best ones first, and the number of poses tried.
    """
    count = max(len(points), len(named))
    about = _nearest_points(xyz, points, _ABOUT)
    kept: list[tuple[Array, Array, Indices, Array]] = []
    tried = 0
    for start in range(0, count, _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, count))
        own, own_marks = _rows(points, rows), _rows(named, rows)
        rotations, shifts, triple = triple_poses(xyz[own], marks.places[own_marks])
        tried += len(triple)
        stations = -np.einsum("kji,kj->ki", rotations, shifts)
        towards = np.einsum("kpi,kpi->kp", normals[own[triple]], stations[:, None] - xyz[own[triple]])
        facing = ~(towards <= 0.0).any(axis=1)  # all three points; unknown directions count as facing
        rotations, shifts, triple = rotations[facing], shifts[facing], triple[facing]
        anchors = marks.places[own_marks[triple]].mean(axis=1)
        evidence, _, _ = _test_poses(rotations, shifts, xyz[_rows(about, rows)[triple]], anchors, marks, _REACH)
        best = np.argsort(-evidence, kind="stable")[:_KEPT]
        kept.append((rotations[best], shifts[best], rows[triple[best]], evidence[best]))
    rotations, shifts, triple, evidence = (np.concatenate(part) for part in zip(*kept, strict=True))
    best = np.argsort(-evidence, kind="stable")[:_KEPT]
    rotations, shifts, triple = rotations[best], shifts[best], triple[best]
    own, own_marks = _rows(points, triple), _rows(named, triple)
    anchors = marks.places[own_marks].mean(axis=1)
    for count_about, reach in ((_ABOUT, _REACH), (_FARTHER, _LATER_REACH)):
        ring = _rows(_nearest_points(xyz, points, count_about), triple)
        _, nearest, hit = _test_poses(rotations, shifts, xyz[ring], anchors, marks, reach)
        fitted = np.concatenate([own, ring], axis=1), np.concatenate([own_marks, nearest], axis=1)
        weights = np.concatenate([np.ones(own.shape), hit], axis=1)
        rotations, shifts = refined_poses(rotations, shifts, xyz[fitted[0]], marks.places[fitted[1]], weights)
    ring = _rows(_nearest_points(xyz, points, _FARTHER), triple)
    evidence, nearest, hit = _test_poses(rotations, shifts, xyz[ring], anchors, marks, _LATER_REACH)
    best = np.argsort(-evidence, kind="stable")[:_RETURNED]
    starts: list[Start] = []
    for i in best:
        agreeing = np.append(own[i], ring[i, hit[i]]), np.append(own_marks[i], nearest[i, hit[i]])
        starts.append((View(rotations[i], shifts[i]), *agreeing))
    return starts, tried


def _rows(table: Indices, rows: Indices) -> Indices:
    """Select rows of a table, which may have one row for all."""
    return table[rows] if len(table) > 1 else np.broadcast_to(table, (len(rows), table.shape[1]))


def _nearest_points(xyz: Array, points: Indices, count: int) -> Indices:
    """(k, count) nearest points of clusters, without the clusters' own points."""
    count = min(count, len(xyz) - 3)
    near = np.asarray(cKDTree(xyz).query(xyz[points].mean(axis=1), k=np.arange(1, count + 4))[1])
    own = (near[:, :, None] == points[:, None, :]).any(axis=2)
    order = np.argsort(own, axis=1, kind="stable")[:, :count]
    return np.asarray(np.take_along_axis(near, order, axis=1), dtype=np.intp)


def _test_poses(
    rotations: Array, shifts: Array, points: Array, anchors: Array, marks: Marks, reach: float
) -> tuple[Array, Indices, Mask]:
    """Log-likelihood ratios (k,) of poses; for each of the points (k, p, 3) the nearest mark and whether it agrees."""
    camera = points @ np.swapaxes(rotations, 1, 2) + shifts[:, None]
    places = camera[..., :2] / np.where(camera[..., 2:] < 0.0, -camera[..., 2:], np.nan)
    nearest = marks.nearest(places)
    gate = _NOISE * marks.sigma + reach * np.linalg.norm(places - anchors[:, None], axis=2)
    hit = np.linalg.norm(places - marks.places[nearest], axis=2) <= gate
    probability = np.clip(marks.probability(places, gate), 1e-9, _DETECTED)
    gain = np.where(hit, np.log(_DETECTED / probability), np.log((1.0 - _DETECTED) / (1.0 - probability)))
    return np.where(marks.inside(places), gain, 0.0).sum(axis=1), nearest, hit & marks.inside(places)


def grow(view: View, points: Indices, named: Indices, xyz: Array, normals: Array, marks: Marks) -> Grown:
    """Fit and identify alternately until nothing changes, from points (k,) identified as marks named (k,).

    The gates follow from the covariance of the last fit. Any three points matched to any three marks give a pose. The
    others must agree, each with the probability that its gate contains a mark by chance.
    """
    sigma = marks.sigma
    for _ in range(_ROUNDS):
        if len(points) <= OF_POSE:
            return Grown(view)
        view, sigma, covariance = _fit_view(view, xyz[points], marks.places[named], marks)
        before = points, named
        points, named = _near(view, xyz, normals, marks, sigma, covariance)
        if np.array_equal(points, before[0]) and np.array_equal(named, before[1]):
            break
    gate, shown = _GATE_SIGMAS * sigma, np.flatnonzero(_shown_points(view, xyz, normals, marks))
    agreeing = min(len(points), len(shown))
    if agreeing <= OF_POSE:
        return Grown(view)
    # A pose fitted to all points may differ by the gate from that of three points: twice the gate.
    probability = float(marks.probability(view.images(xyz[shown]), np.full(len(shown), 2.0 * gate)).mean())
    log10_false_alarms = log10_expected_alarms(
        agreeing, len(shown), probability, (float(len(xyz)) * len(marks.places)) ** OF_POSE
    )
    mark = dict(zip(points.tolist(), named.tolist(), strict=True))
    return Grown(view, mark, gate, len(shown), log10_false_alarms)


def _near(
    view: View, xyz: Array, normals: Array, marks: Marks, sigma: float, covariance: Array
) -> tuple[Indices, Indices]:
    """Points and their marks: nearest neighbours within gates that rarely contain a mark by chance."""
    shown = np.flatnonzero(_shown_points(view, xyz, normals, marks))
    places, by = view.images(xyz[shown]), view.derivatives(xyz[shown])
    predicted = np.einsum("nij,jk,nik->ni", by, covariance, by).sum(axis=1)
    gate = _GATE_SIGMAS * np.sqrt(sigma**2 + predicted)
    plain = marks.probability(places, gate) < _MOST_PROBABLE
    shown, places, gate = shown[plain], places[plain], gate[plain]
    if not len(shown):
        return shown, shown
    distance, nearest = (np.asarray(found) for found in marks.tree.query(places))
    order = np.argsort(distance, kind="stable")
    _, firsts = np.unique(nearest[order], return_index=True)
    kept = np.zeros(len(shown), bool)
    kept[order[firsts]] = True
    kept &= distance <= gate
    return shown[kept], nearest[kept].astype(np.intp)


def _shown_points(view: View, xyz: Array, normals: Array, marks: Marks) -> Mask:
    """Mask of points inside the searched area that face the camera, or whose direction is unknown."""
    station = -view.rotation.T @ view.shift
    facing = ~(np.einsum("ni,ni->n", normals, station - xyz) <= 0.0)
    return np.asarray(marks.inside(view.images(xyz)) & facing)


def _fit_view(view: View, xyz: Array, places: Array, marks: Marks) -> tuple[View, float, Array]:
    """Fit a view by robust least squares."""
    # Returns the view, the standard deviation of the marks and the covariance of the parameters.
    priors = np.diag([0.0] * 6 + [marks.c_sigma**-2, _PRIOR_RADIAL**-2])
    sigma = marks.sigma
    normal = np.eye(8)
    for _ in range(5):
        residuals = places - view.images(xyz)
        off = np.linalg.norm(np.nan_to_num(residuals, nan=1.0), axis=1)
        redundancy = max(2 * len(xyz) - 6, 1) / (2 * len(xyz))
        # The median of lengths of two normal coordinates is 1.18 of their standard deviation.
        sigma = max(float(np.median(off)) / 1.1774 / np.sqrt(redundancy), marks.sigma)
        weights = np.minimum(1.0, _ROBUST * sigma / np.maximum(off, 1e-300)) / sigma**2
        by = np.nan_to_num(view.derivatives(xyz))
        weighted = by * weights[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, by) + priors
        right = np.einsum("nij,ni->j", weighted, np.nan_to_num(residuals))
        right -= priors @ np.array([0.0] * 6 + [view.scale, view.radial])
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
        step = scale * np.linalg.lstsq(normal * np.outer(scale, scale), scale * right, rcond=1e-13)[0]
        turn = rotation_from_vector(step[:3])
        shift = turn @ view.shift + step[3:6]
        view = View(turn @ view.rotation, shift, view.scale + step[6], view.radial + step[7])
        if np.abs(by @ step).max() < 0.01 * sigma:
            break
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
    covariance = np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-13) * np.outer(scale, scale)
    return view, sigma, covariance


def log10_expected_alarms(agreeing: int, expected: int, probability: float, tests: float) -> float:
    """log10 of the expected number of poses with so many agreeing points under the null hypothesis (binomial).

    Three of the points always agree, with up to four poses for each of the possible tests.
    """
    with np.errstate(divide="ignore"):  # underflow gives -inf
        of_pose = float(np.log10(bdtrc(agreeing - OF_POSE - 1, expected - OF_POSE, probability)))
    return of_pose + float(np.log10(4.0 * tests))

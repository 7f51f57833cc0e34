"""Hypotheses for the identification of marks: match three neighbouring points to three neighbouring marks.

The surrounding points test the resulting poses.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from adjust.array_types import Array, Indices, Mask
from adjust.initial_values.pose import refined_poses, triple_poses
from adjust.target_identification.unnamed_marks import Marks

_NEARBY = 6  # nearest points in space, two of which form a cluster with a point
_RANK_SHARE = 0.8  # quantile of the ranks over the directions
_SLENDER = 0.25  # width over length of a triangle below which its pose is poor
_ABOUT = 16  # points around a cluster that test it ...
_FARTHER = 40  # ... and that test it again after a fit to them
_DETECTED = 0.75  # assumed detection rate of points in the frame
_REACH, _LATER_REACH = 0.07, 0.02  # gate over the distance from the cluster, for a pose of three marks and a fitted one
_NOISE = 3.0  # gate in standard deviations of a mark
_SELF_REACH = 1.3  # factor on the distances in a cluster for points confused with it
_KEPT, _RETURNED = 96, 6
_CHUNK = 20_000  # hypotheses tested at a time, to limit memory
# Viewing directions for the ranks of neighbours in the image: unit vectors distributed over the sphere (Fibonacci)
_HEIGHTS, _AZIMUTHS = 1.0 - (np.arange(24) + 0.5) / 12.0, np.pi * (1.0 + np.sqrt(5.0)) * (np.arange(24) + 0.5)
_WIDTHS = np.sqrt(1.0 - _HEIGHTS**2)
_DIRECTIONS = np.column_stack([_WIDTHS * np.cos(_AZIMUTHS), _WIDTHS * np.sin(_AZIMUTHS), _HEIGHTS])


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses, camera = R X + t, best first."""

    # rotations, shifts: (k, 3, 3), (k, 3)
    rotations: Array
    shifts: Array
    # for each pose the agreeing points around the cluster (indices) and their marks
    named: list[tuple[Indices, Indices]]
    tried: int  # number of poses tested


@dataclass(frozen=True, eq=False)
class Cluster:
    """Three neighbouring points.

    triple (3,): points. ranks (2,): number of nearest marks of the first point's mark among which the others are
    sought.
    """

    triple: Indices
    ranks: tuple[int, int]


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


def promising(xyz: Array, normals: Array, marks: Marks, points: Indices, named: Indices) -> Poses:
    """Find the poses that best explain the surroundings of three points (k or 1, 3) as three marks (k or 1, 3)."""
    count = max(len(points), len(named))
    about = _nearest_points(xyz, points, _ABOUT)
    kept: list[tuple[Array, Array, Indices, Array]] = []
    tried = 0
    for start in range(0, count, _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, count))
        own, own_marks = _rows(points, rows), _rows(named, rows)
        rotations, shifts, of = triple_poses(xyz[own], marks.places[own_marks])
        tried += len(of)
        stations = -np.einsum("kji,kj->ki", rotations, shifts)
        towards = np.einsum("kpi,kpi->kp", normals[own[of]], stations[:, None] - xyz[own[of]])
        facing = ~(towards <= 0.0).any(axis=1)  # all three points; unknown directions count as facing
        rotations, shifts, of = rotations[facing], shifts[facing], of[facing]
        anchors = marks.places[own_marks[of]].mean(axis=1)
        evidence, _, _ = _tested(rotations, shifts, xyz[_rows(about, rows)[of]], anchors, marks, _REACH)
        best = np.argsort(-evidence, kind="stable")[:_KEPT]
        kept.append((rotations[best], shifts[best], rows[of[best]], evidence[best]))
    rotations, shifts, of, evidence = (np.concatenate(part) for part in zip(*kept, strict=True))
    best = np.argsort(-evidence, kind="stable")[:_KEPT]
    rotations, shifts, of = rotations[best], shifts[best], of[best]
    own, own_marks = _rows(points, of), _rows(named, of)
    anchors = marks.places[own_marks].mean(axis=1)
    for count_about, reach in ((_ABOUT, _REACH), (_FARTHER, _LATER_REACH)):
        ring = _rows(_nearest_points(xyz, points, count_about), of)
        _, nearest, hit = _tested(rotations, shifts, xyz[ring], anchors, marks, reach)
        fitted = np.concatenate([own, ring], axis=1), np.concatenate([own_marks, nearest], axis=1)
        weights = np.concatenate([np.ones(own.shape), hit], axis=1)
        rotations, shifts = refined_poses(rotations, shifts, xyz[fitted[0]], marks.places[fitted[1]], weights)
    ring = _rows(_nearest_points(xyz, points, _FARTHER), of)
    evidence, nearest, hit = _tested(rotations, shifts, xyz[ring], anchors, marks, _LATER_REACH)
    best = np.argsort(-evidence, kind="stable")[:_RETURNED]
    agreeing = [(np.append(own[i], ring[i, hit[i]]), np.append(own_marks[i], nearest[i, hit[i]])) for i in best]
    return Poses(rotations[best], shifts[best], agreeing, tried)


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


def _tested(
    rotations: Array, shifts: Array, points: Array, anchors: Array, marks: Marks, reach: float
) -> tuple[Array, Indices, Mask]:
    """Log-likelihood ratios (k,) of poses; for each of the points (k, p, 3) the nearest mark and whether it agrees."""
    camera = points @ np.swapaxes(rotations, 1, 2) + shifts[:, None]
    places = camera[..., :2] / np.where(camera[..., 2:] < 0.0, -camera[..., 2:], np.nan)
    nearest = marks.nearest(places)
    gate = _NOISE * marks.sigma + reach * np.linalg.norm(places - anchors[:, None], axis=2)
    hit = np.linalg.norm(places - marks.places[nearest], axis=2) <= gate
    chance = np.clip(marks.chance(places, gate), 1e-9, _DETECTED)
    gain = np.where(hit, np.log(_DETECTED / chance), np.log((1.0 - _DETECTED) / (1.0 - chance)))
    return np.where(marks.inside(places), gain, 0.0).sum(axis=1), nearest, hit & marks.inside(places)

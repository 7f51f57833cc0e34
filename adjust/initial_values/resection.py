"""Resection in space: poses of images from their known points, of many images at once, gross errors tolerated.

Candidates are the poses from triples of points (P3P), whether the field is flat or deep. The best of them by least
trimmed squares (Rousseeuw and Van Driessen 2006) are refined on the half of the points that they explain best, and the
best of these on all points that agree. A few triples do where most points agree on a pose; where they do not, many are
tried.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.initial_values.p3p import triple_poses
from adjust.initial_values.pose import KnownField, Pose, refined_distance, refined_poses, squared_residuals

MAX_TRIPLES = 120  # enough for one free of gross errors among them when every third point is wrong
FEWEST_QUICK = 16  # points of an image, half of which show whether they agree
WORSE = 3.0  # times the usual standard deviation that residuals may have where points agree
TYPICAL = 10  # images from which on their median tells what a lens that is not known yet leaves everywhere
LARGEST_TYPICAL = 0.01  # of that, in principal distances: where most images leave more, all may be wrong
REJECTION = 13.8  # 0.1 % point of the squared residual's chi-square (2) distribution, in sigma²
IMPLAUSIBLE = 0.05  # residuals, in principal distances, of a pose whose points cannot be the ones they are named
EXACT = 1e-12  # squared residual of three points that are met
SAME_PLACE = 1e-4  # poses nearer than this, in extents of the points, are one
LINE = 1e-5  # width over length of points that lie on a line, about which a camera may turn
POINTS_AT_ONCE = 20_000


class Effort(NamedTuple):
    """triples of every image; of their poses, tested on so many points, those that are refined, and how often.

    The two minima of a flat field must both be among these.
    """

    triples: int
    points: int
    refined: int
    rounds: int


QUICK, THOROUGH = Effort(5, 30, 2, 1), Effort(MAX_TRIPLES, 200, 16, 2)


@dataclass(frozen=True)
class Resection:
    """A pose and how well it explains the points.

    inliers (n,): the points that agree; sigma_mm: the robust standard deviation of one image coordinate.
    """

    pose: Pose
    inliers: Mask
    sigma_mm: float


def resect_images(fields: Sequence[KnownField], principal_distances_mm: Sequence[float]) -> list[Pose | None]:
    """The poses of images from their known points; None where these give none, or several.

    Parameters
    ----------
    fields : sequence of KnownField
        Three points of an image at least; of three their only pose is taken.
    principal_distances_mm : sequence of float
        Of the images.
    """
    poses: list[Pose | None] = []
    found = resections(fields, principal_distances_mm)
    for field, c, resection in zip(fields, principal_distances_mm, found, strict=True):
        if len(field.xyz) == 3:
            candidates = three_point_poses(field.xyz, field.xy_mm, c)
            poses.append(candidates[0] if len(candidates) == 1 else None)
        else:
            poses.append(None if resection is None or resection.sigma_mm > IMPLAUSIBLE * c else resection.pose)
    return poses


def resect(xyz: Array, xy_mm: Array, principal_distance_mm: float, floor_mm: float = 1e-4) -> Resection | None:
    """The pose that explains most of the points best; None where the points decide none (all on one line, say).

    xyz (n, 3) object points, flat or not, n >= 4; xy_mm (n, 2) ideal image coordinates about the principal point, y up.
    floor_mm: residuals this small are never gross.
    """
    return _resected([KnownField(xyz, xy_mm, floor_mm)], np.array([principal_distance_mm]), THOROUGH)[0]


def resections(
    fields: Sequence[KnownField], principal_distances_mm: Sequence[float], only_quick: bool = False
) -> list[Resection | None]:
    """The resections of images of four points and more; None for the others, and where the points decide none.

    Points agree where most residuals are as large as the standard deviations say, or as those of most images are: a
    lens that is not known yet leaves some everywhere. only_quick: images whose points do not agree are not tried again.
    """
    c = np.array(principal_distances_mm, dtype=np.float64)
    found: list[Resection | None] = [None] * len(fields)
    quick = [i for i, field in enumerate(fields) if len(field.xyz) >= (4 if only_quick else FEWEST_QUICK)]
    for i, each in zip(quick, _resected([fields[i] for i in quick], c[quick], QUICK), strict=True):
        found[i] = each
    if only_quick:
        return found
    sigmas = [each.sigma_mm / c[i] for i, each in enumerate(found) if each is not None]
    typical = float(np.median(sigmas)) if len(sigmas) >= TYPICAL else 0.0
    typical = typical if typical < LARGEST_TYPICAL else 0.0
    again = [
        i
        for i, (field, each) in enumerate(zip(fields, found, strict=True))
        if len(field.xyz) >= 4 and (each is None or each.sigma_mm > WORSE * max(field.sigma_mm, typical * c[i]))
    ]
    for i, each in zip(again, _resected([fields[i] for i in again], c[again], THOROUGH), strict=True):
        found[i] = each
    return found


def three_point_poses(xyz: Array, xy_mm: Array, principal_distance_mm: float) -> list[Pose]:
    """All poses (up to four) from which three points appear where they are observed. xyz (3, 3), xy_mm (3, 2)."""
    field = _Fields.from_fields([KnownField(xyz, xy_mm, 0.0)], np.array([principal_distance_mm]))
    rotations, shifts, of = triple_poses(field.points, field.tangents)
    points, tangents = field.points[of], field.tangents[of]
    rotations, shifts = refined_poses(rotations, shifts, points, tangents, np.ones(points.shape[:2]))
    exact = squared_residuals(rotations, shifts, points, tangents).max(axis=1) < EXACT
    poses: list[Pose] = []
    for rotation, shift in zip(rotations[exact], shifts[exact], strict=True):
        pose = field.pose(0, rotation, shift)
        if all(np.linalg.norm(pose.center - other.center) > SAME_PLACE * field.size[0] for other in poses):
            poses.append(pose)
    return poses


def distance_together(
    fields: Sequence[KnownField], found: Sequence[Resection | None], principal_distance_mm: float
) -> tuple[float, float] | None:
    """The principal distance in mm by least squares over all images that were resected with one nearby, and the
    standard deviation of its logarithm; None where there is none.
    """
    pairs = [(field, each) for field, each in zip(fields, found, strict=True) if each is not None]
    if not pairs:
        return None
    batch = _Fields.from_fields([field for field, _ in pairs], np.full(len(pairs), principal_distance_mm))
    rotations = np.array([each.pose.rotation for _, each in pairs])
    centers = (np.array([each.pose.center for _, each in pairs]) - batch.origin) / batch.size[:, None]
    weights = np.zeros(batch.present.shape)
    for own, (_, each) in zip(weights, pairs, strict=True):
        own[: len(each.inliers)] = each.inliers
    xy_mm, sigma_mm = batch.tangents * principal_distance_mm, max(field.sigma_mm for field, _ in pairs)
    shifts = -np.einsum("kij,kj->ki", rotations, centers)
    try:
        return refined_distance(rotations, shifts, batch.points, xy_mm, weights, principal_distance_mm, sigma_mm)
    except np.linalg.LinAlgError:
        return None


@dataclass(frozen=True, eq=False)
class _Fields:
    """Fields of k images: points (k, n, 3) in units of their extent about their mean, tangents (k, n, 2), and which are
    present (k, n), those of an image first.

    origin (k, 3), size (k,): the way back; c (k,) in mm; floor (k,): least standard deviation of a tangent.
    """

    points: Array
    tangents: Array
    present: Mask
    origin: Array
    size: Array
    c: Array
    floor: Array

    @classmethod
    def from_fields(cls, fields: Sequence[KnownField], c: Array) -> "_Fields":
        counts = np.array([len(field.xyz) for field in fields])
        points, tangents = np.zeros((len(fields), counts.max(), 3)), np.zeros((len(fields), counts.max(), 2))
        origin, size = np.empty((len(fields), 3)), np.empty(len(fields))
        for k, field in enumerate(fields):
            origin[k] = field.xyz.mean(axis=0)
            size[k] = max(float(np.linalg.norm(np.ptp(field.xyz, axis=0))), np.finfo(float).tiny)
            points[k, : counts[k]], tangents[k, : counts[k]] = (field.xyz - origin[k]) / size[k], field.xy_mm / c[k]
        present = np.arange(counts.max()) < counts[:, None]
        return cls(points, tangents, present, origin, size, c, np.array([field.sigma_mm for field in fields]) / c)

    @property
    def counts(self) -> Indices:
        """(k,)"""
        return np.asarray(self.present.sum(axis=1))

    def pose(self, k: int, rotation: Array, shift: Array) -> Pose:
        """Of one image, in object units."""
        return Pose(rotation, self.origin[k] - self.size[k] * rotation.T @ shift)

    def sample(self, most: int) -> "_Fields":
        """The same of so many points an image, drawn at random, where it has more."""
        if self.present.shape[1] <= most:
            return self
        drawn = (np.random.default_rng(0).random(most) * self.counts[:, None]).astype(np.intp)
        at = np.arange(len(drawn))[:, None], drawn
        present = np.ones(drawn.shape, dtype=bool)
        return _Fields(self.points[at], self.tangents[at], present, self.origin, self.size, self.c, self.floor)

    def squared(self, rotations: Array, shifts: Array, image: Indices) -> Array:
        """Squared residuals (c, n) of poses of some images (c,); inf of points that are not present."""
        squared = squared_residuals(rotations, shifts, self.points[image], self.tangents[image])
        return np.where(self.present[image], squared, np.inf)

    def triples(self, most: int) -> Indices:
        """Triples of points (k, m, 3), all of them or the first of those drawn that are not slender: such give poor
        poses."""
        counts = self.counts
        if comb(int(counts.max()), 3) <= MAX_TRIPLES:
            every = np.array(list(combinations(range(int(counts[0])), 3)), dtype=np.intp)
            return np.broadcast_to(every, (len(counts), *every.shape))
        drawn = (np.random.default_rng(0).random((4 * most, 3)) * counts[:, None, None]).astype(np.intp)
        a, b, c = np.moveaxis(self.tangents[np.arange(len(counts))[:, None, None], drawn], 2, 0)
        area = np.abs((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])
        slender = (area == 0.0) | (area < 0.5 * np.median(area, axis=1, keepdims=True))
        return np.take_along_axis(drawn, np.argsort(slender, axis=1, kind="stable")[:, :most, None], axis=1)

    def candidates(self, effort: Effort) -> tuple[Array, Array, Indices]:
        """The best poses of triples: rotations (c, 3, 3), shifts (c, 3), image by image (c,)."""
        triples = self.triples(effort.triples)
        image = np.repeat(np.arange(len(triples)), triples.shape[1])
        at = image[:, None], triples.reshape(-1, 3)
        rotations, shifts, of = triple_poses(self.points[at], self.tangents[at])
        best = self.best(rotations, shifts, image[of], effort.refined)
        return rotations[best], shifts[best], image[of][best]

    def best(self, rotations: Array, shifts: Array, image: Indices, most: int) -> Indices:
        """Of every image the poses of least trimmed squares, up to a number of them."""
        cost = np.sort(self.squared(rotations, shifts, image), axis=1).cumsum(axis=1)
        half = _trimmed_counts(self.counts[image])
        order = np.lexsort((cost[np.arange(len(cost)), half - 1], image))
        return order[np.arange(len(order)) - np.searchsorted(image[order], image[order]) < most]


def _batches(fields: Sequence[KnownField]) -> Iterator[Indices]:
    """Images of about as many points, some at a time; of as many where all their triples are taken."""
    counts = np.array([len(field.xyz) for field in fields], dtype=np.intp)
    order = np.argsort(-counts, kind="stable")
    while len(order):
        largest = int(counts[order[0]])
        fewest = largest if comb(largest, 3) <= MAX_TRIPLES else max(largest // 2, 11)
        alike = int((counts[order[: max(1, POINTS_AT_ONCE // largest)]] >= fewest).sum())
        yield order[:alike]
        order = order[alike:]


def _resected(fields: Sequence[KnownField], c: Array, effort: Effort) -> list[Resection | None]:
    """The resections of all fields, of four points and more each, with the same effort."""
    found: list[Resection | None] = [None] * len(fields)
    for some in _batches(fields):
        batch = _Fields.from_fields([fields[i] for i in some], c[some])
        sample = batch.sample(effort.points)
        rotations, shifts, image = sample.candidates(effort)
        for _ in range(effort.rounds):
            squared = sample.squared(rotations, shifts, image)
            rank = np.argsort(np.argsort(squared, axis=1, kind="stable"), axis=1, kind="stable")
            kept = (rank < _trimmed_counts(sample.counts[image])[:, None]).astype(np.float64)
            rotations, shifts = refined_poses(rotations, shifts, sample.points[image], sample.tangents[image], kept)
        best = sample.best(rotations, shifts, image, 1)
        rotations, shifts, image = rotations[best], shifts[best], image[best]
        squared = batch.squared(rotations, shifts, image)
        sigma = np.maximum(_robust_sigmas(squared, batch.counts[image]), batch.floor[image])
        inliers = squared < REJECTION * sigma[:, None] ** 2
        points, weights = batch.points[image], inliers.astype(np.float64)
        rotations, shifts = refined_poses(rotations, shifts, points, batch.tangents[image], weights)
        middle = (weights[..., None] * points).sum(axis=1, keepdims=True) / weights.sum(axis=1)[:, None, None]
        extents = np.linalg.svd(weights[..., None] * (points - middle), compute_uv=False)
        for row in np.flatnonzero(extents[:, 1] >= LINE * extents[:, 0]):
            k, count = int(image[row]), len(fields[some[image[row]]].xyz)
            pose = batch.pose(k, rotations[row], shifts[row])
            found[some[k]] = Resection(pose, inliers[row, :count], float(sigma[row] * batch.c[k]))
    return found


def _trimmed_counts(counts: Indices) -> Indices:
    """The numbers of residuals that least trimmed squares keeps, for poses of three points."""
    return (counts + 4) // 2


def _robust_sigmas(squared: Array, counts: Indices) -> Array:
    """Standard deviations (k,) of a coordinate from the smallest half of chi-square (2) distributed squares (k, n).

    Of these, counts (k,) are there, the others are infinite.
    """
    half = _trimmed_counts(counts)
    left_out = 1 - half / counts
    with np.errstate(divide="ignore", invalid="ignore"):
        truncation = 1 + np.where(left_out > 0, left_out * np.log(left_out) / (1 - left_out), 0.0)
    sums = np.take_along_axis(np.cumsum(np.sort(squared, axis=1), axis=1), half[:, None] - 1, axis=1)[:, 0]
    return np.asarray(np.sqrt(sums / np.maximum(2 * half - 6, 1) / truncation))

"""Resection in space: the exterior orientation of one image from its known points, gross errors tolerated."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.initial_values.dlt import closed_form_poses
from adjust.initial_values.p3p import triple_poses
from adjust.initial_values.pose import (
    REJECTION,
    KnownField,
    Pose,
    residual_distances,
    robust_sigmas,
    trimmed_count,
)
from adjust.initial_values.pose_refinement import refined_poses, squared_residuals

IMPLAUSIBLE = 0.05  # residuals, in principal distances, of a pose whose points cannot be the ones they are named
MAX_TRIPLES = 120  # enough for one free of gross errors among them when every third point is wrong
MAX_SCORED_POINTS = 200
REFINED_CANDIDATES = 16  # poses kept for the refinement: the two minima of a flat field must both be among them
EXACT = 1e-12  # squared residual of three points that are met
SAME_PLACE = 1e-4  # poses nearer than this, in extents of the points, are one
LINE = 1e-5  # width over length of points that lie on a line, about which a camera may turn


@dataclass(frozen=True)
class Resection:
    """A pose and how well it explains the points.

    distances_mm (n,): from observed to projected points, inf behind the camera; inliers (n,): the points that agree;
    sigma_mm: the robust standard deviation of one image coordinate.
    """

    pose: Pose
    distances_mm: Array
    inliers: Mask
    sigma_mm: float


def resect_images(fields: Iterable[KnownField], principal_distances_mm: Sequence[float]) -> list[Pose | None]:
    """The poses of images from their known points; None where these give none, or several.

    Parameters
    ----------
    fields : iterable of KnownField
        Three points of an image at least.
    principal_distances_mm : sequence of float
        Of the images.

    Notes
    -----
    Candidates and choice: homographies and direct linear transformations of all images at once, refined, where the
    points agree on one (`dlt`); of the others the least trimmed squares over poses from triples (P3P), one by one; of
    three points their only pose. Seeded alike for every image, so that their order does not matter.
    """
    fields = list(fields)
    poses = closed_form_poses(fields, principal_distances_mm)
    for i, (field, c) in enumerate(zip(fields, principal_distances_mm, strict=True)):
        if poses[i] is None and len(field.xyz) == 3:
            candidates = three_point_poses(field.xyz, field.xy_mm, c)
            poses[i] = candidates[0] if len(candidates) == 1 else None
        elif poses[i] is None:
            resection = resect(field.xyz, field.xy_mm, c, np.random.default_rng(0), field.sigma_mm)
            poses[i] = None if resection is None or resection.sigma_mm > IMPLAUSIBLE * c else resection.pose
    return poses


def resect(
    xyz: Array, xy_mm: Array, principal_distance_mm: float, rng: np.random.Generator, floor_mm: float = 1e-4
) -> Resection | None:
    """The pose that explains most of the points best; None where the points decide none (all on one line, say).

    xyz (n, 3) object points, flat or not, n >= 4; xy_mm (n, 2) ideal image coordinates about the principal point, y up.
    Poses from triples of points are ranked by the sum of the smallest half of the squared residuals (least trimmed
    squares: Rousseeuw and Van Driessen 2006) and refined on that half. floor_mm: residuals this small are never gross.
    """
    field = _Field.from_points(xyz, xy_mm, principal_distance_mm)
    triples = _triples(field.tangents, rng)
    rotations, shifts, _ = triple_poses(field.points[triples], field.tangents[triples])
    if not len(rotations):
        return None
    scored = rng.permutation(len(xyz))[:MAX_SCORED_POINTS] if len(xyz) > MAX_SCORED_POINTS else np.arange(len(xyz))
    rotations, shifts = _best_pose(rotations, shifts, field.points[scored], field.tangents[scored])
    squared = squared_residuals(rotations, shifts, field.points, field.tangents)
    sigma = max(float(robust_sigmas(squared, np.array([len(xyz)]))[0]), floor_mm / field.c)
    inliers = squared[0] < REJECTION * sigma**2
    if _are_collinear(field.points[inliers]):
        return None
    return _refined_resection(rotations, shifts, field, inliers, sigma * field.c)


def refine(resection: Resection, xyz: Array, xy_mm: Array, principal_distance_mm: float) -> Resection:
    """The same image on the same inliers with another principal distance, by least squares."""
    field = _Field.from_points(xyz, xy_mm, principal_distance_mm)
    rotations = resection.pose.rotation[None]
    shifts = -rotations @ ((resection.pose.center - field.origin) / field.size)
    return _refined_resection(rotations, shifts, field, resection.inliers, resection.sigma_mm)


def three_point_poses(xyz: Array, xy_mm: Array, principal_distance_mm: float) -> list[Pose]:
    """All poses (up to four) from which three points appear where they are observed. xyz (3, 3), xy_mm (3, 2)."""
    field = _Field.from_points(xyz, xy_mm, principal_distance_mm)
    rotations, shifts, _ = triple_poses(field.points[None], field.tangents[None])
    rotations, shifts = refined_poses(rotations, shifts, field.points, field.tangents, np.ones((len(rotations), 3)))
    exact = squared_residuals(rotations, shifts, field.points, field.tangents).max(axis=1) < EXACT
    poses: list[Pose] = []
    for rotation, shift in zip(rotations[exact], shifts[exact], strict=True):
        pose = field.pose(rotation, shift)
        if all(np.linalg.norm(pose.center - other.center) > SAME_PLACE * field.size for other in poses):
            poses.append(pose)
    return poses


@dataclass(frozen=True)
class _Field:
    """Points in units of their extent about their mean, image coordinates as tangents, and the way back."""

    points: Array
    tangents: Array
    origin: Array
    size: float
    c: float

    @classmethod
    def from_points(cls, xyz: Array, xy_mm: Array, c: float) -> "_Field":
        origin, size = xyz.mean(axis=0), max(float(np.linalg.norm(np.ptp(xyz, axis=0))), np.finfo(float).tiny)
        return cls((xyz - origin) / size, xy_mm / c, origin, size, c)

    def pose(self, rotation: Array, shift: Array) -> Pose:
        return Pose(rotation, self.origin - self.size * rotation.T @ shift)


def _triples(tangents: Array, rng: np.random.Generator) -> Indices:
    """Triples of points (m, 3), the slender ones left out: they give poor poses."""
    n = len(tangents)
    if comb(n, 3) <= MAX_TRIPLES:
        return np.array(list(combinations(range(n), 3)), dtype=np.intp)
    triples = rng.integers(0, n, (4 * MAX_TRIPLES, 3))
    a, b, c = (tangents[triples[:, i]] for i in range(3))
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    large = (area > 0) & (area >= 0.5 * np.median(area))
    return np.asarray(triples[large][:MAX_TRIPLES])


def _best_pose(rotations: Array, shifts: Array, points: Array, tangents: Array) -> tuple[Array, Array]:
    """The pose (1, 3, 3), (1, 3) of the least trimmed squares, the most promising ones refined first."""
    order = np.argsort(_trimmed_cost(rotations, shifts, points, tangents), kind="stable")[:REFINED_CANDIDATES]
    rotations, shifts = rotations[order], shifts[order]
    for _ in range(2):
        kept = _half_weights(squared_residuals(rotations, shifts, points, tangents))
        rotations, shifts = refined_poses(rotations, shifts, points, tangents, kept)
    best = int(np.argmin(_trimmed_cost(rotations, shifts, points, tangents)))
    return rotations[[best]], shifts[[best]]


def _half_weights(squared: Array) -> Array:
    """Weights (k, n): 1 for the smallest residuals of each pose."""
    weights = np.zeros_like(squared)
    h = trimmed_count(squared.shape[1])
    np.put_along_axis(weights, np.argsort(squared, axis=1, kind="stable")[:, :h], 1.0, axis=1)
    return weights


def _trimmed_cost(rotations: Array, shifts: Array, points: Array, tangents: Array) -> Array:
    half = trimmed_count(len(points))
    squared = squared_residuals(rotations, shifts, points, tangents)
    return np.asarray(np.partition(squared, half - 1, axis=1)[:, :half].sum(axis=1))


def _are_collinear(points: Array) -> bool:
    length, width = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[:2]
    return bool(width < LINE * length)


def _refined_resection(rotations: Array, shifts: Array, field: _Field, inliers: Mask, sigma_mm: float) -> Resection:
    """The one pose (1, 3, 3), (1, 3) fitted to its inliers, back in object units."""
    rotations, shifts = refined_poses(rotations, shifts, field.points, field.tangents, inliers[None].astype(np.float64))
    squared = squared_residuals(rotations, shifts, field.points, field.tangents)[0]
    pose = field.pose(rotations[0], shifts[0])
    return Resection(pose, residual_distances(squared, field.c), inliers, sigma_mm)

"""Intersection: object points from the rays of images whose exterior orientation is known."""

import numpy as np

from adjust.array_types import Array, Indices, Mask

ITERATIONS = 16
SMALLEST_ANGLE = 1e-12
WEAKEST = 1e-8  # smallest eigenvalue of the normal matrix that still gives a point: rays 0.01 degrees apart


def intersect(centers: Array, directions: Array, point: Indices, known: Array) -> tuple[Array, Array]:
    """Points nearest to their rays by angle, robustly: one gross error among several rays does no harm.

    centers, directions (m, 3): a row a ray, directions of any length, pointing away from the camera; point (m,) says
    which point each belongs to; known (p, 3) holds coordinates that are given, nan where they are sought.
    Returns the points (p, 3), nan where the rays give none, and the determination (p,): the smallest eigenvalue of the
    normal matrix of unit rays, about half the squared angle between two rays; 0 where there is no point.
    """
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    sought: Mask = np.isnan(known)
    normal = np.where(sought[:, :, None] & sought[:, None, :], _sums(across, point, len(known)), 0.0)
    normal += np.where(sought, 0.0, 1e6)[:, :, None] * np.eye(3)  # a given coordinate is no unknown
    determination = np.linalg.eigvalsh(normal)[:, 0]
    usable: Mask = determination > WEAKEST
    weights = np.ones(len(point))
    for iteration in range(ITERATIONS):
        points = _nearest(across * weights[:, None, None], centers, point, known, usable)
        offset = points[point] - centers
        distance = np.linalg.norm(offset, axis=1)
        angle = np.linalg.norm(np.einsum("mij,mj->mi", across, offset), axis=1) / distance
        scale = 2.0 * (np.nanmedian(angle) if usable.any() else 1.0) + SMALLEST_ANGLE
        # first the sum of angles, which has one minimum, then the Cauchy function, which forgets the gross errors
        power = 1.0 if iteration < ITERATIONS // 2 else 2.0
        weights = np.nan_to_num(1.0 / (distance**2 * (angle**power + scale**power)), nan=0.0)
        weights /= np.max(weights, initial=np.finfo(float).tiny)
    in_front = np.einsum("mi,mi->m", points[point] - centers, directions) > 0
    majority = np.bincount(point, np.where(in_front, 1.0, -1.0), len(known)) > 0
    good = np.logical_and(usable, majority)
    return np.where(good[:, None], points, np.nan), np.where(good, determination, 0.0)


def _sums(values: Array, point: Indices, count: int) -> Array:
    """The sums (p, ...) of values (m, ...) of every point."""
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, point, values)
    return sums


def _nearest(across: Array, centers: Array, point: Indices, known: Array, usable: Mask) -> Array:
    """Weighted least-squares points (p, 3), given coordinates kept; nan where not usable."""
    normal = _sums(across, point, len(known))
    right = _sums(np.einsum("mij,mj->mi", across, centers), point, len(known))
    given = ~np.isnan(known)
    values = np.where(given, known, 0.0)
    right = np.where(given, values, right - np.einsum("pij,pj->pi", normal, values))
    normal = np.where(given[:, :, None] | given[:, None, :], np.eye(3), normal)
    points = np.full(known.shape, np.nan)
    solvable = usable & (np.linalg.det(normal) != 0.0)  # of rays that all lost their weight nothing is left
    if solvable.any():
        points[solvable] = np.linalg.solve(normal[solvable], right[solvable][..., None])[..., 0]
    return points

"""Spatial intersection: object points from the rays of oriented images."""

import numpy as np

from adjust.array_types import Array, Indices, Mask

ITERATIONS = 16
SMALLEST_ANGLE = 1e-12
WEAKEST = 1e-8  # least eigenvalue of the normal matrix of a usable point: rays 0.01 degrees apart


def intersect(centers: Array, directions: Array, point: Indices, known: Array) -> tuple[Array, Array]:
    """Intersect rays robustly, minimising angles; one gross error among several rays does no harm.

    Parameters
    ----------
    centers, directions : (m, 3) rays; directions of any length, pointing away from the camera.
    point : (m,) number of the point of each ray.
    known : (p, 3) given coordinates, nan where they are to be determined.

    Returns
    -------
    points : (p, 3), nan where the rays do not determine a point.
    determination : (p,) smallest eigenvalue of the normal matrix of unit rays, about half the squared angle between two
        rays; 0 where there is no point.
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
        # First the sum of angles, which has a single minimum; then the Cauchy function, which rejects gross errors.
        power = 1.0 if iteration < ITERATIONS // 2 else 2.0
        weights = np.nan_to_num(1.0 / (distance**2 * (angle**power + scale**power)), nan=0.0)
        weights /= np.max(weights, initial=np.finfo(float).tiny)
    in_front = np.einsum("mi,mi->m", points[point] - centers, directions) > 0
    majority = np.bincount(point, np.where(in_front, 1.0, -1.0), len(known)) > 0
    good = np.logical_and(usable, majority)
    return np.where(good[:, None], points, np.nan), np.where(good, determination, 0.0)


def _sums(values: Array, point: Indices, count: int) -> Array:
    """Sums (p, ...) over each point's values (m, ...)."""
    sums = np.zeros((count, *values.shape[1:]))
    np.add.at(sums, point, values)
    return sums


def _nearest(across: Array, centers: Array, point: Indices, known: Array, usable: Mask) -> Array:
    """Weighted least-squares points (p, 3) with given coordinates fixed; nan where not usable."""
    normal = _sums(across, point, len(known))
    right = _sums(np.einsum("mij,mj->mi", across, centers), point, len(known))
    given = ~np.isnan(known)
    values = np.where(given, known, 0.0)
    right = np.where(given, values, right - np.einsum("pij,pj->pi", normal, values))
    normal = np.where(given[:, :, None] | given[:, None, :], np.eye(3), normal)
    points = np.full(known.shape, np.nan)
    solvable = usable & (np.linalg.det(normal) != 0.0)  # singular if all rays lost their weight
    if solvable.any():
        points[solvable] = np.linalg.solve(normal[solvable], right[solvable][..., None])[..., 0]
    return points

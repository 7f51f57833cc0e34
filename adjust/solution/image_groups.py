"""Two groups of a camera's images with different interior orientations.

With orientation and film of one image eliminated from its rows, the shift (c, x0', y0') of that image alone has normal
equations N d = g. Separate shifts of two groups lower v'Pv by the sum of g' N⁻¹ g of both. The best partition is found
by weighted two-means, started from the best thresholds of the shifts in some directions.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from adjust.array_types import Array, Mask
from adjust.least_squares.equations import Numbering
from adjust.least_squares.iteration import linearise
from adjust.quality.run import Run

MOST_TURNS = 20  # iterations of two-means
FLAT = 1e-9  # fraction of the largest eigenvalue below which a direction is undetermined
DRAWS = 4000  # simulated sets of images
DIRECTIONS = 4  # directions in which groups are searched: c, x0', y0', scale of the whole image


@dataclass(frozen=True)
class ImageGroups:
    """Partition of images.

    images: names in the smaller group; count: number of all images; choices: natural logarithm of the number of
    partitions; p_scatter: computes the p-value of so clear a partition of images whose interior orientations scatter
    normally.
    """

    images: tuple[str, ...]
    count: int
    choices: float
    p_scatter: Callable[[], float]


def two_groups(run: Run, camera: str) -> ImageGroups | None:
    """Find the partition of a camera's images that lowers v'Pv most; None with fewer than three images."""
    names, normal, right = _shifts(run, camera)
    if len(names) < 3:
        return None
    interior = run.end.state.values[run.problem.unknowns.camera[camera][:3]]
    along = np.vstack([np.eye(3), interior / np.linalg.norm(interior)])
    single = (right @ along.T) / np.maximum(np.einsum("di,mij,dj->md", along, normal, along), 1e-300)
    starts = [_threshold(normal, right, shift) for shift in np.hstack([_solved(normal, right), single]).T]

    def gain(mask: Mask) -> float:
        """Decrease of v'Pv with separate shifts of two groups."""
        return float(sum(quadratic(normal[some].sum(axis=0), right[some].sum(axis=0)) for some in (mask, ~mask)))

    mask = max((_two_means(normal, right, start) for start in starts), key=gain)
    smaller = mask if 2 * mask.sum() <= len(names) else ~mask
    images = tuple(name for name, is_in in zip(names, smaller, strict=True) if is_in)
    choices = (len(names) - 1) * float(np.log(2.0)) + float(np.log(DIRECTIONS))
    return ImageGroups(images, len(names), choices, partial(_scatter_probability, normal, right, mask))


def _shifts(run: Run, camera: str) -> tuple[list[str], Array, Array]:
    """Names of a camera's images, and normal equations (m, 3, 3), (m, 3) of c, x0' and y0' of each image alone."""
    problem, covariance = run.weighting.applied(run.problem)
    sigma = problem.unknowns.sigma.copy()
    sigma[problem.unknowns.camera[camera][:3]] = np.inf
    freed = replace(problem, unknowns=replace(problem.unknowns, sigma=sigma))
    at = linearise(Numbering(freed), covariance, run.end.state)
    exterior, _, film, of_camera, *_ = freed.parts
    own = [*range(freed.parts.width)[exterior.columns], *range(freed.parts.width)[film.columns]]
    wanted = [of_camera.columns.start + int(np.flatnonzero(of_camera.members == k)[0]) for k in range(3)]
    names, normal, right = [], [], []
    order = np.argsort(problem.image_numbers, kind="stable")
    counts = np.bincount(problem.image_numbers, minlength=len(problem.network.images))
    for image, rows in zip(problem.network.images, np.split(order, np.cumsum(counts)[:-1]), strict=True):
        if at is None or image.camera != camera or problem.is_fiducial[rows].all():
            continue
        matrix = at.rows.matrix[rows].reshape(2 * len(rows), -1)
        shift, discrepancy = matrix[:, wanted], at.rows.right[rows].ravel()
        basis = _basis(matrix[:, own])
        shift = shift - basis @ (basis.T @ shift)
        names.append(image.name)
        normal.append(shift.T @ shift)
        right.append(shift.T @ (discrepancy - basis @ (basis.T @ discrepancy)))
    return names, np.array(normal).reshape(-1, 3, 3), np.array(right).reshape(-1, 3)


def _basis(columns: Array) -> Array:
    """Orthonormal basis of the column space."""
    if not columns.shape[1]:
        return columns
    left, size, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    return left[:, size > FLAT * size[0]]


def _threshold(normal: Array, right: Array, shift: Array) -> Mask:
    """Mask of images whose shift (m,) lies above the best threshold."""
    order = np.argsort(shift, kind="stable")
    below = np.cumsum(normal[order], axis=0)[:-1], np.cumsum(right[order], axis=0)[:-1]
    above = normal.sum(axis=0) - below[0], right.sum(axis=0) - below[1]
    mask = np.ones(len(order), dtype=bool)
    mask[order[: np.argmax(quadratic(*below) + quadratic(*above)) + 1]] = False
    return mask


def _two_means(normal: Array, right: Array, mask: Mask) -> Mask:
    for _ in range(MOST_TURNS):
        shifts = [_solved(normal[some].sum(axis=0), right[some].sum(axis=0)) for some in (mask, ~mask)]
        own, other = (right @ shift - 0.5 * ((normal @ shift) @ shift) for shift in shifts)
        moved = own > other
        if (moved == mask).all() or moved.all() or not moved.any():
            return mask
        mask = moved
    return mask


def _scatter_probability(normal: Array, right: Array, mask: Mask) -> float:
    """p-value of the partition's clearness along the difference of its groups, by simulation of normal scatter."""
    # The variance between images is that of DerSimonian and Laird's method of moments (1986).
    one, other = (_solved(normal[some].sum(axis=0), right[some].sum(axis=0)) for some in (mask, ~mask))
    weight = np.einsum("i,mij,j->m", one - other, normal, one - other)
    known = weight > 0.0
    weight, shift = weight[known], (right @ (one - other))[known] / weight[known]
    total = weight.sum()
    scatter = float((weight * (shift - (weight * shift).sum() / total) ** 2).sum())
    between = max(0.0, scatter - len(weight) + 1.0) / (total - (weight**2).sum() / total)
    drawn = np.random.default_rng(0).normal(size=(DRAWS, len(weight))) * np.sqrt(between + 1.0 / weight)
    return float(np.mean(_clearness(drawn, weight) >= _clearness(shift[None], weight)))


def _clearness(shifts: Array, weight: Array) -> Array:
    """(n,) fractions of the weighted sums of squares of shifts (n, m) that lie between the groups of their best
    partitions."""
    order = np.argsort(shifts, axis=1)
    weights, ordered = weight[order], np.take_along_axis(shifts, order, axis=1)
    total = weight.sum()
    centred = ordered - (weights * ordered).sum(axis=1, keepdims=True) / total
    below = np.cumsum(weights, axis=1)[:, :-1]
    between = np.cumsum(weights * centred, axis=1)[:, :-1] ** 2 * (1.0 / below + 1.0 / (total - below))
    return np.asarray(between.max(axis=1) / (weights * centred**2).sum(axis=1))


def quadratic(normal: Array, right: Array) -> Array:
    """g' N⁻¹ g of one system (k, k), (k,) or of many."""
    return np.asarray((right * _solved(normal, right)).sum(axis=-1))


def _solved(normal: Array, right: Array) -> Array:
    """N⁻¹ g of one system (k, k), (k,) or of many."""
    return np.asarray((np.linalg.pinv(normal, rcond=FLAT, hermitian=True) @ right[..., None])[..., 0])

"""Robust fit of the film transformation of one image to its fiducial marks."""

from itertools import combinations
from math import comb

import numpy as np

from adjust.array_types import Array, Indices
from adjust.functional_model.transformation import (
    Congruent,
    FilmKind,
    Identity,
    Projective,
    film_kind,
    least_marks,
    marks_needed,
    simpler,
)
from adjust.linear_algebra.small_matrices import applied
from adjust.problem.network import Transformation

MOST_SUBSETS = 100
GROSS = 13.8  # squared distance, in variances of a coordinate, above which a mark is an outlier (0.1 % point)
PLAINLY = 0.01  # ratio of the squared residuals, mirrored over upright, below which a scan is mirrored
LEAST_VARIANCE_MM2 = 1e-4  # of a coordinate: film deformation and scanner errors reach this
LATTICE = np.stack(np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 8)]), axis=-1).reshape(-1, 2)


def fit_transformation(transformation: Transformation, comparator_mm: Array, camera_mm: Array) -> tuple[Array, bool]:
    """Fit a film transformation to fiducial marks, robustly against gross errors.

    Parameters
    ----------
    comparator_mm, camera_mm : (n, 2) measured and calibrated coordinates of the same marks, at least `fewest_marks`.

    Returns
    -------
    Parameters in the order of `film_parameter_names`, and whether the scan is mirrored.

    Notes
    -----
    Least squares on all marks if they agree; otherwise on the inliers of a least-trimmed-squares estimate over minimal
    subsets. A projective transformation is fitted to its equations multiplied by the denominator. With too few marks
    for the transformation, the simpler one of its family that they determine is fitted instead. A scan is mirrored if a
    mirrored similarity has far smaller residuals; two marks, or marks on a line, do not decide this and count as
    upright.
    """
    if transformation == "none":
        return np.zeros(0), False
    mirrored = _is_mirrored(comparator_mm, camera_mm)
    kind = film_kind(transformation, mirrored)
    if marks_needed(transformation) > len(comparator_mm) and (lower := simpler(transformation)):
        parameters, _ = fit_transformation(lower, comparator_mm, camera_mm)
        lattice = comparator_mm.mean(axis=0) + _half(comparator_mm) * LATTICE
        return _fit(kind, lattice, film_kind(lower, mirrored).apply(parameters, lattice)), mirrored
    return _robust_fit(kind, comparator_mm, camera_mm)[0], mirrored


def _is_mirrored(comparator_mm: Array, camera_mm: Array) -> bool:
    """Decide whether a scan is mirrored: quickly if all marks agree, else by robust fits, upright and mirrored."""
    if len(comparator_mm) < 3:
        return False
    kinds = [film_kind("similarity", mirrored) for mirrored in (False, True)]
    if _agree(_squared(kinds[0], _fit(kinds[0], comparator_mm, camera_mm), comparator_mm, camera_mm)):
        return False
    upright, mirrored = (_robust_fit(kind, comparator_mm, camera_mm)[1] for kind in kinds)
    return mirrored < PLAINLY * upright


def _robust_fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> tuple[Array, float]:
    """Fit by least trimmed squares; returns the parameters and the trimmed sum of squared distances."""
    n, fewest = len(comparator_mm), least_marks(kind)
    half = (n + fewest + 1) // 2
    best = _fit(kind, comparator_mm, camera_mm)
    squared = _squared(kind, best, comparator_mm, camera_mm)
    best_cost = float(np.sort(squared)[:half].sum())
    if half == n or _agree(squared):
        return best, best_cost
    kept = _subsets(n, fewest)
    for _ in range(3):
        candidates = _fit(kind, comparator_mm[kept], camera_mm[kept])
        squared = _squared(kind, candidates[:, None], comparator_mm, camera_mm)
        kept = np.argsort(squared, axis=1, kind="stable")[:, :half]
    costs = np.take_along_axis(squared, kept, axis=1).sum(axis=1)
    if costs.min() < best_cost:
        best, best_cost = candidates[costs.argmin()], float(costs.min())
    variance = best_cost / (2 * half - len(kind.names))
    agree = _squared(kind, best, comparator_mm, camera_mm) < GROSS * max(variance, LEAST_VARIANCE_MM2)
    return _fit(kind, comparator_mm[agree], camera_mm[agree]), best_cost


def _agree(squared: Array) -> bool:
    """Whether all residuals are within what film deformation and scanner errors explain."""
    return bool((squared < GROSS * LEAST_VARIANCE_MM2).all())


def _subsets(n: int, size: int) -> Indices:
    """(subsets, size): all subsets of n marks, or MOST_SUBSETS random ones if there are more."""
    if comb(n, size) <= MOST_SUBSETS:
        return np.array(list(combinations(range(n), size)))
    generator = np.random.default_rng(0)
    return np.array([generator.permutation(n)[:size] for _ in range(MOST_SUBSETS)])


def _squared(kind: FilmKind, parameters: Array, comparator_mm: Array, camera_mm: Array) -> Array:
    with np.errstate(all="ignore"):  # a subset of poor geometry may map other marks to infinity
        squared = ((kind.apply(parameters, comparator_mm) - camera_mm) ** 2).sum(axis=-1)
    return np.where(np.isfinite(squared), squared, np.inf)


def _fit(kind: FilmKind, comparator_mm: Array, camera_mm: Array) -> Array:
    """Least-squares parameters (..., u) of centred marks (..., n, 2); of minimum norm where they are rank-deficient."""
    center, half = comparator_mm.mean(axis=-2, keepdims=True), _half(comparator_mm)
    target = camera_mm.mean(axis=-2, keepdims=True)
    moved, count = camera_mm - target, len(kind.names)
    match kind:
        case Identity():
            return np.zeros((*half.shape, 0))
        case Congruent():
            return _congruent(kind, comparator_mm - center, moved, center[..., 0, :], target[..., 0, :])
        case Projective():
            return _projective((comparator_mm - center) / half[..., None, None], moved, center, half, target)
    nothing = np.zeros(count)
    design = kind.design(nothing, comparator_mm, center, half[..., None])
    centred = _solved(design, moved)
    parameters = applied(kind.centred_jacobian(nothing, center[..., 0, :], half), centred)
    parameters[..., [kind.names.index("a1"), kind.names.index("b1")]] += target[..., 0, :]
    return parameters


def _solved(design: Array, values: Array) -> Array:
    """Minimum-norm least-squares solution (..., u); design (..., n, 2, u), values (..., n, 2)."""
    rows = design.reshape(*design.shape[:-3], -1, design.shape[-1])
    smallest = max(rows.shape[-2:]) * float(np.finfo(np.float64).eps)  # relative to the largest one, as lstsq
    inverse: Array = np.linalg.pinv(rows, rcond=smallest).astype(np.float64)
    return applied(inverse, values.reshape(*values.shape[:-2], -1))


def _half(xy_mm: Array) -> Array:
    """(...) half the longer side of the bounding box of marks (..., n, 2); 1 where it is 0."""
    half = np.ptp(xy_mm, axis=-2).max(axis=-1) / 2.0
    return np.where(half > 0.0, half, 1.0)


def _congruent(kind: Congruent, xy: Array, moved: Array, center: Array, target: Array) -> Array:
    m = -1.0 if kind.mirrored else 1.0
    (x, y), (u, v) = np.moveaxis(xy, -1, 0), np.moveaxis(moved, -1, 0)
    turn = np.zeros((*center.shape[:-1], 3))
    turn[..., 2] = np.arctan2((x * v - m * y * u).sum(axis=-1), (x * u + m * y * v).sum(axis=-1))
    turn[..., :2] = target - kind.apply(turn, center)
    return turn


def _projective(xy: Array, moved: Array, center: Array, half: Array, target: Array) -> Array:
    """Solve x' (1 + c1 x + c2 y) = a1 + a2 x + a3 y, and likewise for y', after Hartley's normalisation."""
    size = _half(moved)[..., None, None]
    rows = np.zeros((*xy.shape, 8))
    for row in (0, 1):
        rows[..., row, 3 * row] = 1.0
        rows[..., row, 3 * row + 1 : 3 * row + 3] = xy
        rows[..., row, 6:] = -xy * moved[..., row, None] / size
    solved = _solved(rows, moved / size)
    unit = np.concatenate([solved, np.ones_like(solved[..., :1])], axis=-1)[..., [1, 2, 0, 4, 5, 3, 6, 7, 8]]
    matrix = _scaled(size[..., 0, 0], target[..., 0, :]) @ unit.reshape(*half.shape, 3, 3)
    matrix = matrix @ np.linalg.inv(_scaled(half, center[..., 0, :]))
    flat = (matrix / matrix[..., 2:, 2:]).reshape(*half.shape, 9)
    return np.asarray(flat[..., [2, 0, 1, 5, 3, 4, 6, 7]])


def _scaled(size: Array, origin: Array) -> Array:
    """Homogeneous matrices (..., 3, 3) that scale by size (...) and then shift to origin (..., 2)."""
    matrix = np.zeros((*size.shape, 3, 3))
    matrix[..., [0, 1], [0, 1]], matrix[..., :2, 2], matrix[..., 2, 2] = size[..., None], origin, 1.0
    return matrix

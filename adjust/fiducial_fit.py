"""The film transformation of one image from its fiducial marks, gross errors tolerated."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from adjust.network import Transformation
from adjust.transformation import affine_from_parameters, apply_affine
from adjust.validation import FIDUCIALS_NEEDED

Array = NDArray[np.float64]

MOST_SUBSETS = 100
GROSS = 13.8  # squared distance, in variances of a coordinate, beyond which a mark is left out (0.1 % point)


def fit_transformation(kind: Transformation, comparator_mm: Array, camera_mm: Array) -> tuple[Array, bool]:
    """Parameters of the transformation in the order of `adjust.transformation.NAMES`; whether the scan is mirrored.

    comparator_mm, camera_mm (n, 2): the same marks, at least `adjust.validation.FIDUCIALS_NEEDED[kind]`. Fitted by
    least squares to those marks that the least trimmed squares over the smallest subsets find in agreement. A scan is
    mirrored where a mirrored fit leaves less; two marks cannot tell, and are taken as not mirrored.
    """
    if kind == "none":
        return np.zeros(0), False
    fits = [_robust_fit(kind, comparator_mm, camera_mm, mirrored) for mirrored in (False, True)]
    mirrored = kind != "affine" and len(comparator_mm) > 2 and fits[1][1] < fits[0][1]
    parameters = fits[int(mirrored)][0]
    if kind == "affine":
        return parameters, bool(parameters[1] * parameters[5] < parameters[2] * parameters[4])
    return parameters, mirrored


def _robust_fit(kind: Transformation, comparator_mm: Array, camera_mm: Array, mirrored: bool) -> tuple[Array, float]:
    """Parameters, and the trimmed sum of squared distances that chose them."""
    n, fewest = len(comparator_mm), FIDUCIALS_NEEDED[kind]
    half = (n + fewest + 1) // 2
    best, best_cost = _fit(kind, comparator_mm, camera_mm, mirrored), np.inf
    subsets = list(combinations(range(n), fewest))
    for subset in subsets[:: 1 + len(subsets) // MOST_SUBSETS]:
        candidate = _fit(kind, comparator_mm[list(subset)], camera_mm[list(subset)], mirrored)
        for _ in range(2):
            kept = np.argsort(_squared(kind, candidate, comparator_mm, camera_mm, mirrored), kind="stable")[:half]
            candidate = _fit(kind, comparator_mm[kept], camera_mm[kept], mirrored)
        cost = float(np.sort(_squared(kind, candidate, comparator_mm, camera_mm, mirrored))[:half].sum())
        if cost < best_cost:
            best, best_cost = candidate, cost
    redundancy = 2 * half - 2 * fewest
    if redundancy <= 0 or half == n:
        return _fit(kind, comparator_mm, camera_mm, mirrored), best_cost
    agree = _squared(kind, best, comparator_mm, camera_mm, mirrored) < GROSS * max(best_cost / redundancy, 1e-4)
    return _fit(kind, comparator_mm[agree], camera_mm[agree], mirrored), best_cost


def _squared(kind: Transformation, parameters: Array, comparator_mm: Array, camera_mm: Array, mirrored: bool) -> Array:
    affine = affine_from_parameters(kind, parameters, mirrored)
    return np.asarray(((apply_affine(affine, comparator_mm) - camera_mm) ** 2).sum(axis=1))


def _fit(kind: Transformation, comparator_mm: Array, camera_mm: Array, mirrored: bool) -> Array:
    """Least squares; collinear or coinciding marks give the solution of least norm."""
    m = -1.0 if mirrored else 1.0
    center, target = comparator_mm.mean(axis=0), camera_mm.mean(axis=0)
    x, y = (comparator_mm - center).T
    u, v = (camera_mm - target).T
    if kind == "affine":
        linear = np.linalg.lstsq(np.stack([x, y], axis=1), np.stack([u, v], axis=1))[0].T
    else:  # u = p x - m q y, v = q x + m p y
        p, q = (x * u + m * y * v).sum(), (x * v - m * y * u).sum()
        size = np.hypot(p, q) if kind == "congruent" else (x**2 + y**2).sum()
        p, q = (p / size, q / size) if size > 0 else (1.0, 0.0)
        linear = np.array([[p, -m * q], [q, m * p]])
    a1, b1 = target - linear @ center
    match kind:
        case "affine":
            return np.array([a1, linear[0, 0], linear[0, 1], b1, linear[1, 0], linear[1, 1]])
        case "similarity":
            return np.array([a1, b1, p, q])
        case _:
            return np.array([a1, b1, np.arctan2(q, p)])

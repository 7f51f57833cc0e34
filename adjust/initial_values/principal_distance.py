"""An approximate principal distance from images of known points, where the camera brings none."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.initial_values.dlt import KnownField, principal_distance_together
from adjust.initial_values.resection import Resection, refine, resect

Array = NDArray[np.float64]

GRID = np.geomspace(0.35, 16.0, 14)  # principal distances tried, in radii of the imaged field: 140 to 7 degrees
COARSE_IMAGES = 5
FINE_IMAGES = 12
LARGEST_RELATIVE_SIGMA = 0.15


def find_principal_distance(fields: Sequence[KnownField]) -> float | None:
    """The principal distance in mm with which resections of all images leave the least; None where they do not tell.

    In closed form, where all points agree. Otherwise every image is resected with principal distances on a logarithmic
    grid, and the sum of the squared residuals is then minimised about the best. They do not tell when the minimum is so
    flat that the principal distance has a standard deviation above 15 %: a flat field parallel to the image, where a
    change of it is a change of the height.
    """
    fields = sorted((f for f in fields if len(f.xyz) >= 4), key=lambda f: -len(f.xyz))[:FINE_IMAGES]
    if not fields:
        return None
    together = principal_distance_together(fields)
    if together is not None and together[1] < LARGEST_RELATIVE_SIGMA:
        return together[0]
    radius = max(float(np.linalg.norm(f.xy_mm, axis=1).max()) for f in fields)
    costs = [_trimmed_cost(fields[:COARSE_IMAGES], c) for c in GRID * radius]
    found = float(GRID[int(np.argmin(costs))] * radius)
    step = GRID[1] / GRID[0]
    for width in (step**2, step):
        resections = _resections(fields, found)
        if not resections:
            return None
        found = _minimum(fields, resections, found, width)
    return found if _relative_sigma(fields, _resections(fields, found), found) < LARGEST_RELATIVE_SIGMA else None


def _resections(fields: Sequence[KnownField], c: float) -> dict[int, Resection]:
    """The resections, by the number of the image, that succeed; a fixed seed keeps results repeatable."""
    attempts = {i: resect(f.xyz, f.xy_mm, c, np.random.default_rng(i), f.sigma_mm) for i, f in enumerate(fields)}
    return {i: resection for i, resection in attempts.items() if resection is not None}


def _trimmed_cost(fields: Sequence[KnownField], c: float) -> float:
    resections = _resections(fields, c)
    return sum(len(fields[i].xyz) * r.sigma_mm**2 for i, r in resections.items()) if resections else np.inf


def _minimum(fields: Sequence[KnownField], resections: dict[int, Resection], c: float, width: float) -> float:
    from scipy.optimize import minimize_scalar  # takes longer to import than most adjustments

    logarithm = minimize_scalar(
        lambda s: _cost(fields, resections, float(np.exp(s))),
        bounds=(np.log(c / width), np.log(c * width)),
        method="bounded",
        options={"xatol": 1e-4},
    ).x
    return float(np.exp(logarithm))


def _cost(fields: Sequence[KnownField], resections: dict[int, Resection], c: float) -> float:
    """Sum of squared residuals in mm² of the points that agreed."""
    total = 0.0
    for i, resection in resections.items():
        moved = refine(resection, fields[i].xyz, fields[i].xy_mm, c)
        total += float((moved.distances_mm[moved.inliers] ** 2).sum())
    return total


def _relative_sigma(fields: Sequence[KnownField], resections: dict[int, Resection], c: float) -> float:
    """Standard deviation of ln c from the curvature of the sum of squares."""
    delta = 0.03
    lower, middle, upper = (_cost(fields, resections, c * float(np.exp(s))) for s in (-delta, 0.0, delta))
    curvature = (lower - 2 * middle + upper) / delta**2
    redundancy = sum(2 * int(r.inliers.sum()) - 6 for r in resections.values()) - 1
    noise = max(middle / max(redundancy, 1), max(f.sigma_mm for f in fields) ** 2)
    return float(np.sqrt(2 * noise / curvature)) if curvature > 0 else np.inf

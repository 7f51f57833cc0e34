"""What looks wrong in a solved adjustment without contradicting it by itself: swapped numbers, images without check."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from adjust.network import Observations
from adjust.result import Residuals

Array = NDArray[np.float64]

GROSS = 20.0  # a-priori standard deviations from which on a residual can be that of another mark
NEARER = 0.5  # of the distance of two marks that each may lie from where the other is expected
UNCHECKED = 1e-6  # redundancy of all targets of an image that is none


def suspicions(observations: Observations, residuals: Residuals) -> list[str]:
    """Sentences on marks whose numbers may be swapped, and on images whose orientation nothing checks."""
    found = []
    images = np.array(observations.image)
    fiducial = np.array(observations.kind) == "fiducial"
    gross = _is_gross(observations, residuals.v_mm)
    for name in dict.fromkeys(observations.image):
        of_image = images == name
        for kind in (False, True):
            rows = [int(row) for row in np.flatnonzero(of_image & (fiducial == kind) & gross)]
            crossed = ((i, j) for i, j in combinations(rows, 2) if _cross(observations, residuals, i, j))
            found += [_swapped(observations, i, j) for i, j in crossed]
        targets = of_image & ~fiducial
        if targets.any() and residuals.redundancy[targets].sum() < UNCHECKED:
            found.append(
                f"Nothing checks the orientation of image {name}: its {int(targets.sum())} targets just determine it, "
                f"and an error of one of them would not show. Measure more targets in it."
            )
    return found


def _is_gross(observations: Observations, v_mm: Array) -> NDArray[np.bool_]:
    sigma = np.sqrt(np.trace(observations.covariance_mm2, axis1=1, axis2=2) / 2)
    return np.asarray(np.linalg.norm(v_mm, axis=1) > GROSS * sigma)


def _cross(observations: Observations, residuals: Residuals, i: int, j: int) -> bool:
    """Whether two marks each lie where the other is expected."""
    xy, v = observations.xy_mm, residuals.v_mm
    apart = np.linalg.norm(xy[i] - xy[j])
    off = max(np.linalg.norm(xy[i] + v[i] - xy[j]), np.linalg.norm(xy[j] + v[j] - xy[i]))
    return bool(off < NEARER * apart)


def _swapped(observations: Observations, i: int, j: int) -> str:
    what = "fiducial marks" if observations.kind[i] == "fiducial" else "points"
    first, second = sorted((observations.point[i], observations.point[j]))
    return (
        f"The {what} {first} and {second} of image {observations.image[i]} each lie "
        f"where the other is expected: their numbers may be swapped."
    )

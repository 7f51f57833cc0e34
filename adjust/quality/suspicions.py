"""What looks wrong in an adjustment without contradicting it by itself: swapped numbers, images without check."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from adjust.problem.observations import Observations
from adjust.problem.result import Residuals

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

GROSS = 20.0  # a-priori standard deviations from which on a residual can be that of another mark
NEARER = 0.5  # of the distance of two marks that each may lie from where the other is expected
UNCHECKED = 1e-6  # redundancy of all targets of an image that is none


def is_gross(observations: Observations, v_mm: Array) -> NDArray[np.bool_]:
    """(n,) Whether residuals (n, 2) can be those of other marks."""
    sigma = np.sqrt(np.trace(observations.covariance_mm2, axis1=1, axis2=2) / 2)
    return np.asarray(np.linalg.norm(v_mm, axis=1) > GROSS * sigma)


def swapped_numbers(observations: Observations, v_mm: Array) -> list[str]:
    """Sentences on marks of which each lies where residuals (n, 2) expect the other. Most marks of an image must speak
    for where it looks: one that starts upside down has all of its marks swapped.
    """
    found = []
    gross = is_gross(observations, v_mm)
    for rows in _rows_by_image(observations).values():
        fiducial = observations.is_fiducial[rows]
        for kind in (False, True):
            marks = rows[fiducial == kind]
            pairs = combinations([int(row) for row in marks[gross[marks]]], 2)
            crossed = [(i, j) for i, j in pairs if _cross(observations, v_mm, i, j)]
            if 2 * len({row for pair in crossed for row in pair}) < len(marks):
                found += [_swapped(observations, i, j) for i, j in crossed]
    return found


def unchecked_orientations(observations: Observations, residuals: Residuals) -> list[str]:
    """Sentences on images whose orientation no redundant target checks."""
    found = []
    for name, rows in _rows_by_image(observations).items():
        targets = rows[~observations.is_fiducial[rows]]
        if len(targets) and residuals.redundancy[targets].sum() < UNCHECKED:
            found.append(
                f"Nothing checks the orientation of image {name}: its {len(targets)} targets just determine it, "
                f"and an error of one of them would not show. Measure more targets in it."
            )
    return found


def _rows_by_image(observations: Observations) -> dict[str, Indices]:
    """The rows of every image, in their order; images in the order in which they come."""
    number = {name: i for i, name in enumerate(dict.fromkeys(observations.image))}
    of = np.array([number[name] for name in observations.image], dtype=np.intp)
    rows = np.split(np.argsort(of, kind="stable"), np.cumsum(np.bincount(of))[:-1])
    return dict(zip(number, rows, strict=True))


def _cross(observations: Observations, v: Array, i: int, j: int) -> bool:
    """Whether two marks each lie where the other is expected."""
    xy = observations.xy_mm
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

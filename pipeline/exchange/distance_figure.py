"""Figure of fiducials of which a certificate gives only distances: approximate coordinates for the adjustment."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.distance import pdist

from adjust.problem.camera import FiducialDistance
from pipeline.types import Array

STARTS = 20  # random figures: some minima are figures with a fiducial on the wrong side of others
LEAST_SINGULAR = 1e-3  # of the distances' derivatives: below, a fiducial can move without changing a distance
AS_GOOD = 25.0  # difference of chi-squares up to which another figure is not ruled out
ALIKE_MM = 1.0  # largest difference of the distances in figures that are the same
FIRST_RAD = -0.75 * np.pi  # direction of the first fiducial from the middle: lower left


def figure_from_distances(ids: Sequence[str], distances: Sequence[FiducialDistance]) -> Array | None:
    """Coordinates whose distances are the given ones, by least squares, about their middle.

    Distances tell neither rotation nor reflection: the first fiducial lies at the lower left, and the next one that is
    not opposite to it on the way clockwise from there.

    Parameters
    ----------
    ids : names of n fiducials.
    distances : distances between them.

    Returns
    -------
    (n, 2) array or None
        Coordinates, mm; None if the distances do not determine the figure.
    """
    if len(ids) < 3 or len(distances) < 2 * len(ids) - 3:
        return None
    start = np.array([ids.index(one.start) for one in distances])
    end = np.array([ids.index(one.end) for one in distances])
    given_mm, sigma_mm = np.array([(one.value_mm, one.sigma_mm) for one in distances]).T

    def residuals(flat: Array) -> Array:
        xy = flat.reshape(-1, 2)
        return np.asarray((np.linalg.norm(xy[end] - xy[start], axis=1) - given_mm) / sigma_mm)

    rng = np.random.default_rng(0)
    starts = rng.normal(0.0, given_mm.mean(), (STARTS, 2 * len(ids)))
    best, *others = sorted((least_squares(residuals, each) for each in starts), key=lambda solution: solution.cost)
    singular = np.linalg.svd(np.asarray(best.jac) * sigma_mm[:, None], compute_uv=False)
    as_good = [each for each in others if 2 * (each.cost - best.cost) < AS_GOOD]
    figure, *figures = (each.x.reshape(-1, 2) for each in (best, *as_good))
    apart_mm = max((float(np.abs(pdist(each) - pdist(figure)).max()) for each in figures), default=0.0)
    if singular[2 * len(ids) - 4] < LEAST_SINGULAR or apart_mm > ALIKE_MM:
        return None
    return _turned(figure)


def _turned(xy_mm: Array) -> Array:
    """The figure with its first fiducial at the lower left and the next ones clockwise from there."""
    complex_mm = (xy_mm - xy_mm.mean(axis=0)) @ [1.0, 1j]
    complex_mm = complex_mm / complex_mm[0] * abs(complex_mm[0])
    off_axis = complex_mm[np.abs(complex_mm.imag) > 0.1 * np.abs(complex_mm)]
    if len(off_axis) and off_axis[0].imag > 0:
        complex_mm = complex_mm.conj()
    complex_mm = complex_mm * np.exp(1j * FIRST_RAD)
    return np.column_stack([complex_mm.real, complex_mm.imag])

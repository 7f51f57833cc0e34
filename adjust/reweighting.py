"""What changes the weights between adjustments: robust estimation and variance components."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adjust.problem import Problem
from adjust.result import Residuals

Array = NDArray[np.float64]

HUBER = 2.0  # standardised length of a residual pair, per axis, from which on a mark loses weight
MEDIAN_LENGTH = np.sqrt(np.log(2.0))  # the median of that length for normally distributed errors
STANDSTILL = 1e-3  # relative change of weights or variances that is none
CHECKED = 1e-6  # redundancy below which nothing checks a mark
LEAST_REDUNDANCY = 1.0  # a group with less redundancy keeps its variance


@dataclass(frozen=True)
class Weighting:
    """Factors on the given covariances: weights (n,) of robust estimation, variance factors of the two groups."""

    weights: Array
    target: float = 1.0
    fiducial: float = 1.0

    def covariance(self, problem: Problem) -> Array:
        """The covariances (n, 2, 2) in mm² that an adjustment is to use."""
        group = np.where(problem.is_fiducial, self.fiducial, self.target)
        return problem.network.observations.covariance_mm2 * (group / self.weights)[:, None, None]

    def differs(self, other: "Weighting") -> bool:
        """Whether another weighting is another one."""
        here = np.array([*self.weights, self.target, self.fiducial])
        there = np.array([*other.weights, other.target, other.fiducial])
        return bool((np.abs(here - there) > STANDSTILL * there).any())


def robust_weights(covariance_mm2: Array, result: Residuals, weights: Array) -> Array:
    """Huber's weights (n,) of marks: 1, or HUBER over the standardised length t of the residual where that is larger.

    t² = v'Pv / r, with P before any reduction and r the mark's redundancy (0 to 2), over the square of the scale that
    the median of all t gives: t² is 1 on the average. A mark without redundancy keeps its weight. Source: P. J. Huber,
    Robust Statistics, 1981.
    """
    full = covariance_mm2 * weights[:, None, None]
    vpv = (np.linalg.solve(full, result.v_mm[..., None])[..., 0] * result.v_mm).sum(axis=1)
    redundancy = result.redundancy.sum(axis=1)
    checked = redundancy > CHECKED
    t = np.sqrt(vpv[checked] / redundancy[checked])
    scale = float(np.median(t)) / MEDIAN_LENGTH if len(t) else 0.0
    reduced = np.ones(len(weights))
    if scale > 0.0:
        reduced[checked] = HUBER / np.maximum(t / scale, HUBER)
    return reduced


def variance_factor(covariance_mm2: Array, result: Residuals, members: NDArray[np.bool_]) -> float:
    """v'Pv over the redundancy of a group, the factor that its variances lack (Förstner's estimate)."""
    v = result.v_mm[members]
    vpv = (np.linalg.solve(covariance_mm2[members], v[..., None])[..., 0] * v).sum()
    redundancy = result.redundancy[members].sum()
    return float(vpv / redundancy) if redundancy > LEAST_REDUNDANCY and vpv > 0.0 else 1.0

"""Weights between adjustments: robust estimation, variance components, rejected observations."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.linear_algebra.small_matrices import laid_out
from adjust.problem.problem import Problem
from adjust.problem.tested import TestedUnits

WeightFunction = Literal["huber", "igg3"]

STANDARD = 2.0  # standardised length, per coordinate, above which an observation is down-weighted
LOST = 4.5  # the same, above which the redescending function gives no weight
MEDIAN_LENGTH = np.sqrt(np.log(2.0))  # median of that length for a pair of normally distributed errors
STANDSTILL = 1e-3  # change of a weight, or relative change of a variance, at convergence
NO_WEIGHT = 1e-12  # stands for zero weight: not an observation


@dataclass(frozen=True)
class Weighting:
    """Factors on the given precision: weights (N,) of all tested units, variance factors by group."""

    weights: Array
    factors: Mapping[str, float] = field(default_factory=dict)

    def applied(self, problem: Problem) -> tuple[Problem, Array]:
        """Apply the factors: the problem with new standard deviations of priors, and covariances (n, 2, 2), mm²."""
        units = TestedUnits(problem)
        count = len(problem.network.observations)
        variance = self.variances(units)
        sigma = problem.unknowns.sigma.copy()
        for pair, factor in zip(units.positions.T, np.sqrt(np.tile(variance[count:], (2, 1))), strict=True):
            sigma[pair[pair >= 0]] *= factor[pair >= 0]
        covariance = laid_out(problem.network.observations.covariance_mm2) * variance[:count, None, None]
        if (variance[count:] == 1.0).all():
            return problem, covariance
        return replace(problem, unknowns=replace(problem.unknowns, sigma=sigma)), covariance

    def variances(self, units: TestedUnits) -> Array:
        """(N,) factors on the given variances."""
        by_group = np.ones(len(units))
        for group, factor in self.factors.items():
            by_group[units.groups == group] = factor
        return by_group / self.weights

    def differs(self, other: "Weighting") -> bool:
        """Whether two weightings differ beyond the convergence limit."""
        here, there = (np.array(list(each.factors.values())) for each in (self, other))
        if (np.abs(self.weights - other.weights) > STANDSTILL).any() or len(here) != len(there):
            return True
        return bool((np.abs(here - there) > STANDSTILL * there).any())

    @property
    def used(self) -> Mask:
        """(N,) mask of the units with weight."""
        return np.asarray(self.weights > NO_WEIGHT)


def robust_weights(statistic: Array, sizes: Indices, observed: int, function: WeightFunction) -> Array:
    """Robust weights (N,) from the test statistics.

    t² = statistic / sizes is a squared standardised length per coordinate with the mean 1. It refers to the given
    weights and includes the redundancy, so that leverage points are not spared. t is divided by the robust scale of the
    image points, the first `observed` units; for priors by at least 1. With k = 2 and K = 4.5:

    huber: 1 up to k, then k / t. A gross error has the influence of an error of k sigma (P. J. Huber, Robust
    Statistics, 1981).
    igg3: 1 up to k, then k / t times ((K - t) / (K - k))², and 0 from K on: gross errors have no influence, good
    observations keep their weight (Y. Yang, L. Song, T. Xu, Robust estimator for correlated observations based on
    bifactor equivalent weights, Journal of Geodesy 76, 2002).

    Unchecked units keep their weight.
    """
    checked = sizes > 0
    t = np.sqrt(statistic / np.maximum(sizes, 1))
    scale = robust_scale(statistic[:observed], sizes[:observed])
    t[:observed] /= scale
    t[observed:] /= max(1.0, scale)
    weights = STANDARD / np.maximum(t, STANDARD)
    if function == "igg3":
        weights *= np.clip((LOST - t) / (LOST - STANDARD), 0.0, 1.0) ** 2
    return np.where(checked, np.maximum(weights, NO_WEIGHT), 1.0)


def robust_scale(statistic: Array, sizes: Indices) -> float:
    """Robust standard deviation of unit weight from the median statistic of pairs; 1 without pairs."""
    t = np.sqrt(statistic[sizes == 2] / 2.0)
    scale = float(np.median(t)) / MEDIAN_LENGTH if len(t) else 0.0
    return scale if scale > 0.0 else 1.0

"""What changes the weights between adjustments: robust estimation, variance components, observations taken out."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from adjust.array_types import Array, Indices, Mask
from adjust.linear_algebra.small_matrices import laid_out
from adjust.problem.problem import Problem
from adjust.problem.tested import TestedUnits

WeightFunction = Literal["huber", "igg3"]

STANDARD = 2.0  # standardised length of a contradiction, per coordinate, from which on an observation loses weight
LOST = 4.5  # ... and from which on the redescending function leaves it none
MEDIAN_LENGTH = np.sqrt(np.log(2.0))  # the median of that length for a pair of normally distributed errors
STANDSTILL = 1e-3  # change of a weight, or relative change of a variance, that is none
NO_WEIGHT = 1e-12  # stands for none: what has no more than this has no influence and is no observation


@dataclass(frozen=True)
class Weighting:
    """Factors on what is given: weights (N,) of everything that is tested, variance factors by group."""

    weights: Array
    factors: Mapping[str, float] = field(default_factory=dict)

    def applied(self, problem: Problem) -> tuple[Problem, Array]:
        """The problem with the standard deviations of its priors, and the covariances (n, 2, 2) in mm², to be used."""
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
        """(N,) the factors on the given variances."""
        by_group = np.ones(len(units))
        for group, factor in self.factors.items():
            by_group[units.groups == group] = factor
        return by_group / self.weights

    def differs(self, other: "Weighting") -> bool:
        """Whether another weighting is another one."""
        here, there = (np.array(list(each.factors.values())) for each in (self, other))
        if (np.abs(self.weights - other.weights) > STANDSTILL).any() or len(here) != len(there):
            return True
        return bool((np.abs(here - there) > STANDSTILL * there).any())

    @property
    def used(self) -> Mask:
        """(N,) what takes part."""
        return np.asarray(self.weights > NO_WEIGHT)


def robust_weights(statistic: Array, sizes: Indices, observed: int, function: WeightFunction) -> Array:
    """Weights (N,) by what everything contradicts the others by.

    t² = statistic / sizes is the square of a standardised length per coordinate, 1 on the average: the statistic is
    that of the observation as it was given, redundancy and all, so that one with leverage is not spared. t is over the
    scale that the median of the image points, the first `observed` ones, gives; that of priors over no less than 1.
    With k = 2 and K = 4.5:

    huber: 1, and k / t from k on. A gross error keeps the influence of one of k sigma. (P. J. Huber, Robust
    Statistics, 1981.)
    igg3: the same times ((K - t) / (K - k))² from k on, and nothing from K on: gross errors have no influence at all,
    good observations keep their whole weight. (Y. Yang, L. Song, T. Xu, Robust estimator for correlated observations
    based on bifactor equivalent weights, Journal of Geodesy 76, 2002.)

    What nothing checks keeps its weight.
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
    """The standard deviation of unit weight that the median of pairs' statistics gives; 1 where there is none."""
    t = np.sqrt(statistic[sizes == 2] / 2.0)
    scale = float(np.median(t)) / MEDIAN_LENGTH if len(t) else 0.0
    return scale if scale > 0.0 else 1.0

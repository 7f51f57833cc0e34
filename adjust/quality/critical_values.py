"""Units of the tests for gross errors, critical values of the tests, and the units' weights between adjustments.

Weights are those of robust estimation, variance components and rejected observations.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from adjust.array_types import Array, Indices, Mask
from adjust.linear_algebra.small_matrices import laid_out
from adjust.problem.parameter import Parameter
from adjust.problem.problem import ABSENT, Problem

STANDARD = 2.0  # standardised length, per coordinate, above which an observation is down-weighted
LOST = 4.5  # the same, above which the redescending function gives no weight
MEDIAN_LENGTH = np.sqrt(np.log(2.0))  # median of that length for a pair of normally distributed errors
STANDSTILL = 1e-3  # change of a weight, or relative change of a variance, at convergence
NO_WEIGHT = 1e-12  # stands for zero weight: not an observation


@dataclass(frozen=True)
class Probabilities:
    """Error probabilities of the tests.

    Attributes
    ----------
    alpha : significance level of a single test.
    power : probability of detecting an error of the smallest detectable size (Baarda's alpha0 and beta0).
    family : family-wise significance level: probability that any good observation of an adjustment is rejected.
    """

    alpha: float = 0.001
    power: float = 0.80
    family: float = 0.01

    def __post_init__(self) -> None:
        for word, value in (("alpha", self.alpha), ("power", self.power), ("family", self.family)):
            if not 0.0 < value < 1.0:
                raise ValueError(f"the probability {word} must lie between 0 and 1, not {value}")
        if self.power <= self.alpha:
            raise ValueError(f"the power ({self.power}) must be larger than alpha ({self.alpha})")

    def noncentrality(self, size: int) -> float:
        """delta0: shift in standard deviations that a test of `size` coordinates detects with the probability `power`.

        It is 4.13 for one coordinate with the usual probabilities. Source: W. Baarda, A Testing Procedure for Use in
        Geodetic Networks, 1968.
        """
        return float(np.sqrt(special.chndtrinc(special.chdtri(size, self.alpha), size, 1.0 - self.power)))

    def critical(self, sizes: Indices, tests: int) -> Array:
        """Critical values of the squared test statistics, chi-square with `sizes` degrees of freedom, of several tests.

        The level `family` is divided evenly over the tests (Sidak).
        """
        return np.asarray(special.chdtri(np.maximum(sizes, 1), _sidak(self.family, tests)), dtype=np.float64)

    def critical_tau(self, redundancy: int, tests: int = 1) -> float:
        """Critical value of Pope's tau, the standardised residual over sigma0 of the same adjustment; inf: no test.

        One test has the level alpha, several share `family`. Source: A. J. Pope, The Statistics of Residuals and the
        Detection of Outliers, NOAA Technical Report 65, 1976.
        """
        if redundancy < 2:
            return np.inf
        alpha = self.alpha if tests == 1 else _sidak(self.family, tests)
        t = special.stdtrit(redundancy - 1, 1.0 - 0.5 * alpha)
        return float(t * np.sqrt(redundancy / (redundancy - 1 + t**2)))


def _sidak(family: float, tests: int) -> float:
    """Level of each of several independent tests with the family-wise level `family`."""
    return float(-np.expm1(np.log1p(-family) / max(tests, 1)))


_NAMES = {
    "datum": "given fiducial {point}{alone} (camera {owner})",
    "control": "control point {point}{alone}",
    "interior": "given{alone} (camera {owner})",
    "scanner": "given{alone} (scanner {owner})",
    "board": "given{alone} (board {owner})",
    "exterior": "given{alone} of image {owner}",
}
PRIOR_GROUPS = tuple(_NAMES)


@dataclass(frozen=True)
class Tested:
    """Unit of a test: one image point or one given quantity, rejected as a whole."""

    # "target", "tie", "fiducial" or "join" in an image; "datum" (given place of a fiducial), "control" (given object
    # coordinate), "interior", "scanner", "board" or "exterior" (given element)
    group: str
    owner: str  # image, camera, scanner or board; empty for object points
    point: str  # id; empty for the elements
    coordinates: tuple[str, ...]  # x and y if tested jointly, else a single one

    @property
    def name(self) -> str:
        """Description: "target 45 in image f1", "given fiducial 7 (camera RC20)", "control point 12 Z"."""
        alone = f" {self.coordinates[0]}" if len(self.coordinates) == 1 else ""
        words = _NAMES.get(self.group, "{group} {point}{alone} in image {owner}")
        return words.format(group=self.group, point=self.point, owner=self.owner, alone=alone)

    def coordinate_name(self, axis: int) -> str:
        """Description of one coordinate: "target 45 x in image f1"."""
        return replace(self, coordinates=(self.coordinates[axis % len(self.coordinates)],)).name


@dataclass(frozen=True)
class TestedUnits:
    """All units of a problem: its observations in order, then its priors."""

    problem: Problem

    def __len__(self) -> int:
        return len(self.problem.network.observations) + len(self.positions)

    @cached_property
    def positions(self) -> Indices:
        """(m, 2) positions of the unknowns with priors, ABSENT as the second of single ones."""
        unknowns = self.problem.unknowns
        given = unknowns.has_prior
        shared = dict.fromkeys(tuple(pair) for pair in unknowns.fiducial.values())  # cameras may share marks
        pairs = [pair for pair in shared if given[list(pair)].all()]
        paired = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        given[paired] = False
        alone = np.flatnonzero(given)
        return np.concatenate([paired, np.column_stack([alone, np.full(len(alone), ABSENT)])])

    @cached_property
    def sizes(self) -> Indices:
        """(N,) number of coordinates of each unit."""
        observed = np.full(len(self.problem.network.observations), 2)
        return np.concatenate([observed, (self.positions != ABSENT).sum(axis=1)])

    @cached_property
    def groups(self) -> NDArray[np.str_]:
        """(N,) group of each unit."""
        parameters = self.problem.unknowns.parameters
        given = [_group(parameters[position]) for position in self.positions[:, 0]]
        return np.array([*self.problem.network.observations.kind, *given], dtype=np.str_)

    def named(self) -> tuple[Tested, ...]:
        """All units with their names."""
        observations = self.problem.network.observations
        rows = zip(observations.kind, observations.image, observations.point, strict=True)
        observed = [Tested(kind, image, point, ("x", "y")) for kind, image, point in rows]
        parameters, given = self.problem.unknowns.parameters, []
        for pair in self.positions:
            keys = [parameters[i] for i in pair if i != ABSENT]
            coordinates = tuple(each.quantity for each in keys)
            given.append(Tested(_group(keys[0]), keys[0].owner, keys[0].id, coordinates))
        return (*observed, *given)


def _group(parameter: Parameter) -> str:
    return {"fiducial": "datum", "point": "control"}.get(parameter.kind, parameter.kind)


WeightFunction = Literal["huber", "igg3"]


@dataclass(frozen=True)
class Weighting:
    """Factors on the given precision: weights (N,) of all tested units, variance factors by group."""

    weights: Array
    factors: Mapping[str, float] = field(default_factory=dict)

    def apply(self, problem: Problem) -> tuple[Problem, Array]:
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

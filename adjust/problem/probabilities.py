"""Significance levels and power of the tests of observations, and the critical values."""

from dataclasses import dataclass

import numpy as np
from scipy import special

from adjust.array_types import Array, Indices


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

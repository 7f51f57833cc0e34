"""The probabilities of the tests of observations, and the critical values that follow from them."""

from dataclasses import dataclass

import numpy as np
from scipy import special

from adjust.array_types import Array, Indices


@dataclass(frozen=True)
class Probabilities:
    """alpha: that a single good observation fails its test, and power: that an error of the smallest detectable size
    is detected by it (Baarda's alpha0 and beta0). family: that any one of all good observations of an adjustment is
    called suspect.
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
        """delta0: the shift, in standard deviations, of a test of `size` coordinates that `power` detects.

        Of one coordinate 4.13 with the usual probabilities. Source: W. Baarda, A Testing Procedure for Use in Geodetic
        Networks, 1968.
        """
        return float(np.sqrt(special.chndtrinc(special.chdtri(size, self.alpha), size, 1.0 - self.power)))

    def critical(self, sizes: Indices, tests: int) -> Array:
        """What the squared test statistic of each of so many tests may reach, chi-square of `sizes` coordinates.

        The probability `family` is shared out evenly (Sidak).
        """
        return np.asarray(special.chdtri(np.maximum(sizes, 1), _sidak(self.family, tests)), dtype=np.float64)

    def critical_tau(self, redundancy: int, tests: int = 1) -> float:
        """What Pope's tau, the standardised residual over sigma0 of the same adjustment, may reach; inf: no test.

        One test with the probability alpha, many share `family`. Source: A. J. Pope, The Statistics of Residuals and
        the Detection of Outliers, NOAA Technical Report 65, 1976.
        """
        if redundancy < 2:
            return np.inf
        alpha = self.alpha if tests == 1 else _sidak(self.family, tests)
        t = special.stdtrit(redundancy - 1, 1.0 - 0.5 * alpha)
        return float(t * np.sqrt(redundancy / (redundancy - 1 + t**2)))


def _sidak(family: float, tests: int) -> float:
    """The probability for each of so many independent tests where that of any one failing is `family`."""
    return float(-np.expm1(np.log1p(-family) / max(tests, 1)))

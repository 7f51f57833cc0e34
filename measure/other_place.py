"""A mark's place by another method, beside the matched one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OtherPlace:
    """offset_px (2,): the other place less the matched one; covariance_px2 (2, 2): of that difference."""

    offset_px: Array
    covariance_px2: Array

    @property
    def sigmas(self) -> float:
        """The length of the difference in its own standard deviations."""
        return float(np.sqrt(self.offset_px @ np.linalg.solve(self.covariance_px2, self.offset_px)))

    @property
    def chance(self) -> float:
        """The probability that noise alone makes the difference as long."""
        return float(stats.chi2.sf(self.sigmas**2, 2))

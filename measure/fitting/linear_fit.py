"""A fit linearised at its solution: from it follows what else the same grey values say, a second place for example."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.noise.noise import NoiseModel, correlated
from measure.noise.pixel_sums import products

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LinearFit:
    """residuals (height, width), where used; design (unknowns, height, width): derivatives of the model by the
    unknowns, the first two the place by column and row, the last four gain, offset and slopes of the ground; by_grey,
    alike: derivatives of the fitted unknowns by the grey values; noise: of these. All images are
    multiplied by steadiness (height, width), so that their noise is alike everywhere."""

    residuals: Array
    used: Mask
    design: Array
    by_grey: Array
    noise: NoiseModel
    steadiness: Array

    def covariance(self, by_grey: Array) -> Array:
        """(n, n) that the noise gives to n figures, whose derivatives by the grey values are (n, height, width)."""
        white = self.noise.variance_dn2 * by_grey
        covariance = products(by_grey, white if self.noise.is_white else correlated(by_grey, self.noise))
        return np.asarray((covariance + covariance.T) / 2)

"""What the place of a notch is uncertain by where a landscape lies in it.

A notch is cut into the frame's border and exposed as the frame is: its light is no more even than the terrain.
A slope of that light is a shift of the edges where it ends, and leaves little else in a small notch. How uneven it may
be, the frame beside the notch shows.
"""

import numpy as np
from numpy.typing import NDArray

from measure.noise.noise import NoiseModel, autocovariance, correlated
from measure.noise.pixel_sums import products

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_PX = 400  # of the frame beside the notch: fewer do not tell how uneven it is


def covariance_of_landscape(light: Array, beside: Mask, moved: Array) -> Array:
    """(2, 2) px2 of a place, for a landscape in the mark that varies as beside it.

    light (height, width): grey values, and beside, alike, which of them show the frame; moved (2, height, width) of the
    mark's window: derivatives of its column and row by the grey values, as much of them as its light has part in.
    """
    if beside.sum() < _LEAST_PX:
        return np.zeros((2, 2))
    reach = max(moved.shape[1:])
    lags = autocovariance(np.where(beside, light - light[beside].mean(), 0.0), beside, reach)
    # The noise of single pixels counts already; what neighbours have in common is the landscape.
    lags[reach, reach] = max(lags[reach, reach + 1], 0.0)
    landscape = NoiseModel(float(lags[reach, reach]), lags, 1.0)
    covariance = products(moved, correlated(moved, landscape))
    sizes, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)  # far lags are chance, and may leave less than nothing

"""The sandwich covariance of a fit: how well it is known where its residuals are larger in one place than in another.

What a chip leaves of another picture is no noise alone: detail that was sampled too coarsely returns at the edges,
which are what tells the place. A covariance that takes residuals as alike everywhere promises too much there. This one
asks each pixel what it left and how much that weighs, and its neighbours whether they left the same (Conley, 1999, GMM
estimation with cross sectional dependence).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ALIKE_PX = 1.0  # standard deviation of the weights by distance: what is sampled too coarsely is alike no farther


def sandwich_covariance(inverse: Array, weights: Array, residuals: Array, used: Mask) -> Array:
    """(unknowns, unknowns) covariance of an adjustment that has `sum weights * residuals = 0` over the pixels used.

    inverse: (unknowns, unknowns) of its normal matrix; weights: (unknowns, height, width), weighted derivatives;
    residuals, used: (height, width).
    """
    shares = weights * np.where(used, residuals, 0.0)
    about = gaussian_filter(shares, (0.0, _ALIKE_PX, _ALIKE_PX), mode="constant") * (2 * np.pi * _ALIKE_PX**2)
    scatter = np.einsum("ihw,jhw->ij", about, shares)
    return np.asarray(inverse @ ((scatter + scatter.T) / 2) @ inverse.T)

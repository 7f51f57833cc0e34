"""What lossy compression takes from a mark's place.

JPEG rounds the fine detail of every 8 x 8 pixels, a mark's edges and the grain alike. Residuals show most of it, so
that a standard deviation from them is nearly right; what is lost of the edges themselves they do not show. The grain
that is left is the compression's own making, and no weights are taken from it.
"""

import numpy as np
from numpy.typing import NDArray

from measure.scan import Scan

Array = NDArray[np.float64]

LOSSY_SIGMA_PX = 0.01  # rms of what the residuals do not show, of marks at quality 50 to 95 (benchmarks/marks.py)


def with_loss(covariance_px2: Array, scan: Scan) -> Array:
    """A mark's covariance (2, 2) and what the scan's compression adds to it."""
    return covariance_px2 + LOSSY_SIGMA_PX**2 * np.eye(2) if scan.is_lossy else covariance_px2

"""What lossy compression takes from a mark's place.

JPEG rounds the fine detail of every 8 x 8 pixels, a mark's edges and the grain alike. Residuals show most of it, so
that a standard deviation from them is right, where the mark's contrast is many of the file's rounding steps; what faint
marks lose of their edges they do not show. The grain that is left is the compression's own making, and no weights are
taken from it.
"""

import numpy as np
from numpy.typing import NDArray

from measure.scans.scan import Scan

Array = NDArray[np.float64]

_LOST_PX = 0.25  # times the square of step over contrast: rms of what residuals do not show (benchmarks/marks.py)
_MOST_LOST_PX = 1.0  # where the contrast is hardly two steps, there is nothing left to measure


def with_loss(covariance_px2: Array, scan: Scan, contrast_dn: float) -> Array:
    """The covariance (2, 2) of a mark of that contrast and what the scan's compression adds to it."""
    lost = min(_LOST_PX * (scan.rounding_step_dn / max(abs(contrast_dn), 1e-9)) ** 2, _MOST_LOST_PX)
    return covariance_px2 + lost**2 * np.eye(2)

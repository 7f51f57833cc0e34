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


def covariance_of_compression(scan: Scan, contrast_dn: float) -> Array:
    """(2, 2) px2: what the scan's compression adds to the covariance of a mark of that contrast."""
    lost = min(_LOST_PX * (scan.rounding_step_dn / max(abs(contrast_dn), 1e-9)) ** 2, _MOST_LOST_PX)
    return np.asarray(lost**2 * np.eye(2))

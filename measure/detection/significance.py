"""False alarms of detections: expected numbers under the null hypothesis that noise alone responds.

A single response is compared with a Gaussian field, whose variance and slopes come from the noise around it. A
constellation of marks is compared with the share of other places that respond as strongly, whatever their distribution.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, ndtr

from measure.array_types import Array


def expected_peaks(strength: float, slopes: Array, radius_px: float) -> float:
    """Expected number of peaks of a Gaussian field of unit variance in a circle that exceed a strength.

    slopes (2, 2): covariance of the field's gradient.

    Notes
    -----
    Expected Euler characteristic of the excursion set: terms of a point, of the circle's edge and of its area (Adler
    1981, The Geometry of Random Fields; Worsley 1996).
    """
    edge = np.pi * radius_px * np.sqrt(np.trace(slopes) / 2) / (2 * np.pi)
    area = np.pi * radius_px**2 * np.sqrt(max(np.linalg.det(slopes), 0.0)) * max(strength, 1.0) / (2 * np.pi) ** 1.5
    return float(ndtr(-strength) + (edge + area) * np.exp(-(strength**2) / 2))


def chance_of_marks(found: int | NDArray[np.integer], marks: int, share: float | Array) -> Array:
    """Probability that at least so many marks respond by chance, each as a share of other places does (binomial)."""
    return np.asarray(bdtrc(np.subtract(found, 1), marks, share), np.float64)


def share_of_places(hits: int, places: int) -> float:
    """Share by Laplace's rule of succession: no hit among sixty places does not mean a rate of zero."""
    return (hits + 1) / (places + 2)

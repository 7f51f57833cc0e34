"""What pictures say of a tone curve: the one estimate from what other unknowns leave, of marks and of edges.

In light the two sides of a blurred edge are alike; under a wrong curve one of them is softer. That is left over when
place, blur and contrast are fitted, and by how much tells the curve: one more linear estimate from the residuals. With
the departures d of the curve the residuals of a fit are r + H d - D x. The score H'r of what D leaves of H grows with d
by N and has the covariance S that the noise gives it: N' S^-1 N is the information, also where the noise is not white.
"""

from dataclasses import dataclass

import numpy as np

from measure.array_types import Array
from measure.tone.curve import Tone, ToneInformation

_SINGULAR = 1e-12  # of the normal matrix of unknowns of one size: less is rounding of its sums


@dataclass(frozen=True, eq=False)
class ToneScore:
    """Of one picture, or of many along the first axes: left (..., k, pixels) of the changes by the departures, beside
    the unknowns; value (..., k), the score; normal (..., k, k), by which it grows with the departures; by_unknown
    (..., unknowns, k), by which each departure moves the unknowns."""

    left: Array
    value: Array
    normal: Array
    by_unknown: Array

    def information(self, covariance: Array, tone: Tone) -> ToneInformation:
        """Of all pictures together, fitted by a tone curve; covariance (k, k): of the sum of their scores."""
        count = self.value.shape[-1]
        normal, value = self.normal.reshape(-1, count, count).sum(axis=0), self.value.reshape(-1, count).sum(axis=0)
        return ToneInformation.from_score(normal, value + normal @ tone.mean, covariance)


def tone_score(
    design: Array, changes: Array, residuals: Array, priors: Array | None = None, departures: Array | None = None
) -> ToneScore:
    """Score the departures of a tone curve beside the unknowns of fits.

    Parameters
    ----------
    design : (..., unknowns, pixels)
        Derivatives of the model by its unknowns; 0 in pixels that do not count.
    changes : (..., k, pixels)
        Of the light, by the departures, alike.
    residuals : (..., pixels)
        What the fits leave.
    priors, departures : (unknowns,), optional
        Weights of what was known of the unknowns before, and how far the fit departs from that, which are residuals
        like those of pixels.

    Returns
    -------
    ToneScore
    """
    columns, wanted = design.swapaxes(-1, -2), changes.swapaxes(-1, -2)
    if priors is not None:  # a row each
        columns = np.concatenate([columns, np.diag(np.sqrt(priors))])
        wanted = np.concatenate([wanted, np.zeros((len(priors), wanted.shape[-1]))])
    # All unknowns are brought to one size: beside a strong prior the others would pass for nothing.
    size = np.maximum(np.linalg.norm(columns, axis=-2, keepdims=True), 1e-300)
    columns = columns / size
    across = columns.swapaxes(-1, -2)
    inverse = np.linalg.pinv(across @ columns, rcond=_SINGULAR, hermitian=True)
    by_unknown = inverse @ (across @ wanted) / size.swapaxes(-1, -2)
    left = changes - by_unknown.swapaxes(-1, -2) @ design
    value = -(left @ residuals[..., None])[..., 0]
    if priors is not None and departures is not None:
        value = value - by_unknown.T @ (priors * departures)
    return ToneScore(left, value, left @ changes.swapaxes(-1, -2), by_unknown)

"""Score of a tone curve from the residuals of fits of marks and edges, with their other unknowns eliminated.

In linear light both sides of a blurred edge are symmetric; under a wrong curve one side is softer. The asymmetry
remains after place, blur and contrast are fitted, and gives a linear estimate of the curve from the residuals. With the
departures d of the curve, the residuals of a fit are r + H d - D x. Let L be the part of H orthogonal to D. The score
L'r grows with d by N = L'H and has the covariance S of the noise. N' S^-1 N is the information, also for correlated
noise.
"""

from dataclasses import dataclass

import numpy as np

from measure.array_types import Array
from measure.tone.curve import Tone, ToneInformation

_SINGULAR = 1e-12  # relative eigenvalue of the normalised normal matrix below which it is numerical rounding


@dataclass(frozen=True, eq=False)
class ToneScore:
    """Score of one image, or of several along the first axes.

    Attributes
    ----------
    left : (..., k, pixels) derivatives by the departures, after elimination of the unknowns.
    value : (..., k) score.
    normal : (..., k, k) derivatives of the score with respect to the departures.
    by_unknown : (..., unknowns, k) derivatives of the unknowns with respect to the departures.
    """

    left: Array
    value: Array
    normal: Array
    by_unknown: Array

    def information(self, covariance: Array, tone: Tone) -> ToneInformation:
        """Pool the information of all images, fitted with a tone curve. covariance (k, k): of the sum of the scores."""
        count = self.value.shape[-1]
        normal, value = self.normal.reshape(-1, count, count).sum(axis=0), self.value.reshape(-1, count).sum(axis=0)
        return ToneInformation.from_score(normal, value + normal @ tone.mean, covariance)


def tone_score(
    design: Array, changes: Array, residuals: Array, priors: Array | None = None, departures: Array | None = None
) -> ToneScore:
    """Score the departures of a tone curve, with the unknowns of the fits eliminated.

    Parameters
    ----------
    design : (..., unknowns, pixels)
        Derivatives of the model with respect to its unknowns; 0 in unused pixels.
    changes : (..., k, pixels)
        Derivatives of the light with respect to the departures; 0 in unused pixels.
    residuals : (..., pixels)
        Residuals of the fits.
    priors, departures : (unknowns,), optional
        Weights of the priors of the unknowns, and deviations of the fit from them, treated as residuals of
        pseudo-observations.

    Returns
    -------
    ToneScore
    """
    columns, wanted = design.swapaxes(-1, -2), changes.swapaxes(-1, -2)
    if priors is not None:  # a row each
        columns = np.concatenate([columns, np.diag(np.sqrt(priors))])
        wanted = np.concatenate([wanted, np.zeros((len(priors), wanted.shape[-1]))])
    # Normalise the columns; otherwise a strong prior would make all others numerically zero.
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

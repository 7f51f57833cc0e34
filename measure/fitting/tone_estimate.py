"""What a mark's picture says of the tone curve, and how far another curve moves the mark.

In light the two sides of a blurred edge are alike; under a wrong curve one of them is softer. That is left over when
place, blur and contrast are fitted, and by how much tells the curve: one more linear estimate from the residuals.
"""

import numpy as np
from numpy.typing import NDArray

from measure.fitting.linear_fit import LinearFit
from measure.noise.pixel_sums import combined, products
from measure.scans.told_tone import ToldTone
from measure.scans.tone import SaidOfTone, Tone

Array = NDArray[np.float64]

_LEAST_VARIANCE = 1e-9  # of a combination of departures that the picture hardly shows, over that of the others


def told_tone(fit: LinearFit, drawn: Array, tone: Tone, full_scale_dn: float) -> ToldTone:
    """Beside the unknowns of a linearised fit. drawn (height, width): its picture, in light.

    With the departures d the residuals are r + H d - D x. The score H'r of what D leaves of H grows with d by N and has
    the covariance S that the noise gives it: N' S^-1 N is the information, also where the noise is not white. H is
    taken at the drawn light: at the observed one, it would go along with the noise.
    """
    changes = tone.changes(drawn, full_scale_dn) * fit.used
    left = (changes - combined(products(changes, fit.design), fit.by_grey)) * fit.used
    normal = products(left, changes)
    score = -products(left, np.where(fit.used, fit.residuals, 0.0)[None])[:, 0]
    covariance = fit.covariance(left)
    covariance += _LEAST_VARIANCE * max(float(np.trace(covariance)), 1e-30) * np.eye(len(covariance))
    said = SaidOfTone.by_score(normal, score + normal @ tone.mean, covariance)
    codes = tone.code(np.quantile(drawn[fit.used], (0.0, 1.0)), full_scale_dn) / full_scale_dn
    return ToldTone(said, products(fit.by_grey[:2], changes), float(codes[0]), float(codes[1]))

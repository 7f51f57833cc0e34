"""The rotation and scale that a mark's own picture gives, where it was matched with those of the frame.

A wedge's or a notch's edges hardly tell its scale from its place, so the frame gives it. But what touches an edge moves
the place as it changes that scale, and leaves no other trace: both are in the picture, and may be compared.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.fitting.linear_fit import LinearFit
from measure.noise.pixel_sums import combined, products

Array = NDArray[np.float64]

_OWN = 0.9  # of what is known of rotation and scale: where the picture gives so much, little is the frame's


@dataclass(frozen=True, eq=False)
class OwnShape:
    """change (2,): scale and rotation (rad) by the picture alone, less those of the frame, and sigma (2,), their
    standard deviations; on_place (2, 2): px by which the place would follow, did the match not keep to the frame's."""

    change: Array
    sigma: Array
    on_place: Array


def own_shape(fit: LinearFit, shape: slice, strain: slice, departures: Array) -> OwnShape | None:
    """What the picture says of the two unknowns of a shape, None where they were its own anyway, or it says nothing.

    shape: which unknowns of the fit these are; strain: those of stretch and shear, which stay held by the frame;
    departures (unknowns,): of the match from what the frame gave.
    """
    told = products(fit.by_grey, fit.design)
    if np.diag(told)[shape].min() > _OWN:
        return None
    let_go = told.copy()  # as if no other unknown were held: each column is how far that unknown itself decides
    let_go[:, strain] = np.eye(len(told))[:, strain]
    try:
        freed = np.asarray(np.linalg.inv(let_go), float)[shape]
    except np.linalg.LinAlgError:
        return None
    by_noise = combined(freed, fit.by_grey)
    variance = np.diag(fit.covariance(by_noise))
    if not np.all(variance > 0):
        return None
    change = products(by_noise, np.where(fit.used, fit.residuals, 0.0)[None])[:, 0]
    return OwnShape(change + freed @ told @ departures, np.sqrt(variance), -told[:2, shape])

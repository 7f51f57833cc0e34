"""The rotation and scale that a mark's own picture gives, where it was matched with those of the frame.

A wedge's or a notch's edges hardly tell its scale from its place, so the frame gives it. But what touches an edge moves
the place as it changes that scale, and leaves no other trace: both are in the picture, and may be compared.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.noise import NoiseModel, correlated
from measure.pixel_sums import combined, products

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_OWN = 0.9  # of what is known of rotation and scale: where the picture gives so much, little is the frame's


@dataclass(frozen=True, eq=False)
class OwnShape:
    """change (2,): scale and rotation (rad) by the picture alone, less those of the frame, and sigma (2,), their
    standard deviations; on_place (2, 2): px by which the place would follow, did the match not keep to the frame's."""

    change: Array
    sigma: Array
    on_place: Array


def own_shape(
    residuals: Array, used: Mask, design: Array, by_grey: Array, noise: NoiseModel, shape: slice, departures: Array
) -> OwnShape | None:
    """What the picture says of the two unknowns of a shape, None where they were its own anyway, or it says nothing.

    residuals (height, width), where used; design (unknowns, height, width): derivatives of the model by the unknowns,
    the first two by column and row; by_grey, alike: derivatives of the unknowns by the grey values; departures
    (unknowns,): of the match from the frame.
    """
    told = products(by_grey, design)
    if np.diag(told)[shape].min() > _OWN:
        return None
    try:
        by_noise = combined(np.asarray(np.linalg.inv(told), float)[shape], by_grey)
    except np.linalg.LinAlgError:
        return None
    smeared = noise.variance_dn2 * by_noise if noise.is_white else correlated(by_noise, noise)
    variance = np.diag(products(by_noise, smeared))
    if not np.all(variance > 0):
        return None
    change = products(by_noise, np.where(used, residuals, 0.0)[None])[:, 0]
    return OwnShape(change + departures[shape], np.sqrt(variance), -told[:2, shape])

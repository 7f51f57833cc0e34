"""A second place of a disk: where it lies if its paint may grow lighter or darker from one side to the other.

Dust on one side of a small disk, soft at its edge, moves the disk as it moves an edge, and leaves of itself only that
the disk is darker on that side. A disk whose contrast may slope takes that up. Noise moves both places; what it cannot
explain of their difference is no disk's.
"""

import numpy as np
from numpy.typing import NDArray

from measure.noise import NoiseModel, correlated
from measure.other_place import OtherPlace
from measure.picture_model import GREY
from measure.pixel_sums import combined, products

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def sloping_place(residuals: Array, used: Mask, design: Array, by_grey: Array, noise: NoiseModel) -> OtherPlace | None:
    """The place with two more unknowns, the contrast's slopes, in one step from the fit; None where they are not told
    from the others.

    residuals (height, width), where used; design (unknowns, height, width): derivatives of the model by the unknowns,
    the first two by column and row, the last by gain, offset and slopes of the ground; by_grey, alike: derivatives of
    the unknowns by the grey values.
    """
    sloping = design[-GREY] * design[-2:] * used
    left = (sloping - combined(products(sloping, design), by_grey)) * used  # by what the match has taken up
    normal = products(left, sloping)
    if not np.linalg.cond(normal) < 1e6:
        return None
    by_noise = combined(-products(by_grey[:2], sloping) @ np.linalg.inv(normal), left)
    smeared = noise.variance_dn2 * by_noise if noise.is_white else correlated(by_noise, noise)
    covariance = products(by_noise, smeared)
    covariance = (covariance + covariance.T) / 2
    if not np.all(np.linalg.eigvalsh(covariance) > 0):
        return None
    return OtherPlace(np.asarray(products(by_noise, residuals[None])[:, 0]), np.asarray(covariance))

"""A second opinion on a matched mark's place: where its edges lie, by the grey values' second derivative across them.

Least-squares matching weighs grey values by how fast the mark's picture changes. An edge detector (Haralick, 1984,
Digital step edges from zero crossing of second directional derivatives) asks instead where the second derivative across
an edge, under a Gaussian, passes through nothing. Summed round the mark that gives a place of its own: gain, offset and
whatever is smooth have no part in it, and a mark whose opposite edges are alike needs no drawing for it. Noise moves
both places, in part together; what it cannot explain of their difference is damage or a mark unlike its drawing.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.noise import NoiseModel, correlated
from measure.other_place import OtherPlace
from measure.pixel_sums import combined, products

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SMOOTHING = 1.5  # times the scan's blur: noise of about 1.3 times the match's, while a line's two edges stay apart
_LEAST_SMOOTHING_PX = 1.0  # below it pixels sample the derivative too coarsely


def edge_place(
    residuals: Array, used: Mask, design: Array, by_grey: Array, noise: NoiseModel, blur_px: float
) -> OtherPlace | None:
    """The place by the edges, None where they do not give one.

    residuals (height, width), where used; design (unknowns, height, width): derivatives of the model by the unknowns,
    the first two by column and row; by_grey, alike: derivatives of the unknowns by the grey values.
    """
    weights = _weights(design[:2] * used, max(_SMOOTHING * blur_px, _LEAST_SMOOTHING_PX)) * used
    response = products(weights, design)
    turned = response[:, :2]
    if not np.linalg.cond(turned) < 1e6:
        return None
    # What noise the match has taken up already has left the residuals.
    left = weights - combined(response, by_grey)
    by_noise = combined(np.asarray(np.linalg.inv(turned)), left)
    smeared = noise.variance_dn2 * by_noise if noise.is_white else correlated(by_noise, noise)
    covariance = products(by_noise, smeared)
    covariance = (covariance + covariance.T) / 2
    if not np.all(np.linalg.eigvalsh(covariance) > 0):
        return None
    offset = np.linalg.solve(turned, products(weights, residuals[None])[:, 0])
    return OtherPlace(np.asarray(offset), np.asarray(covariance))


def _weights(slopes: Array, smoothing_px: float) -> Array:
    """(2, height, width): what each grey value counts in the sums, along columns and rows, of the second derivatives
    across the edges; slopes (2, height, width): of the mark's picture."""
    square = np.maximum((slopes**2).sum(axis=0), 1e-300)
    across = (slopes[0] ** 2 / square, 2 * slopes[0] * slopes[1] / square, slopes[1] ** 2 / square)
    smooth, slope, bend = _kernels(smoothing_px)
    along = ((bend, smooth), (slope, slope), (smooth, bend))
    return np.stack(
        [
            np.sum([_filtered(part * each, *pair) for each, pair in zip(across, along, strict=True)], axis=0)
            for part in slopes
        ]
    )


def _filtered(image: Array, along_cols: Array, along_rows: Array) -> Array:
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, along_cols, along_rows, borderType=cv2.BORDER_CONSTANT))


def _kernels(sigma_px: float) -> tuple[Array, Array, Array]:
    """A Gaussian and its first two derivatives; the second sums to nothing, so that an even ground has none."""
    reach = int(np.ceil(4 * sigma_px))
    place = np.arange(-reach, reach + 1.0)
    smooth = np.exp(-(place**2) / (2 * sigma_px**2))
    smooth /= smooth.sum()
    bend = (place**2 / sigma_px**2 - 1) * smooth / sigma_px**2
    return smooth, -place * smooth / sigma_px**2, bend - bend.mean()

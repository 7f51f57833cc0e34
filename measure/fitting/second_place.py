"""A second place of a mark, by another method, beside the matched one: by its edges, or with paint that slopes.

Both are linear in the residuals of the match, so that the covariance of their difference to the matched place is known:
noise moves both places, in part together. What it cannot explain is damage or a mark unlike its drawing.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from measure.fitting.linear_fit import LinearFit
from measure.fitting.picture_model import GREY
from measure.noise.pixel_sums import combined, products

Array = NDArray[np.float64]

_SMOOTHING = 1.5  # times the scan's blur: noise of about 1.3 times the match's, while a line's two edges stay apart
_LEAST_SMOOTHING_PX = 1.0  # below it pixels sample the derivative too coarsely
_WORST_CONDITION = 1e6  # of a normal matrix: beyond it double precision leaves no figure of a place in small windows


@dataclass(frozen=True, eq=False)
class SecondPlace:
    """offset_px (2,): the second place less the matched one; covariance_px2 (2, 2): of that difference."""

    offset_px: Array
    covariance_px2: Array

    @property
    def sigmas(self) -> float:
        """The length of the difference in its own standard deviations."""
        return float(np.sqrt(self.offset_px @ np.linalg.solve(self.covariance_px2, self.offset_px)))

    @property
    def chance(self) -> float:
        """The probability that noise alone makes the difference as long."""
        return float(chdtrc(2, self.sigmas**2))


def edge_place(fit: LinearFit, blur_px: float) -> SecondPlace | None:
    """The place by the mark's edges, None where they do not give one.

    Least-squares matching weighs grey values by how fast the mark's picture changes. An edge detector (Haralick, 1984,
    Digital step edges from zero crossing of second directional derivatives) asks instead where the second derivative
    across an edge, under a Gaussian, passes through nothing. Summed round the mark that gives a place of its own: gain,
    offset and whatever is smooth have no part in it, and a mark whose opposite edges are alike needs no drawing for it.
    """
    weights = across_edges(fit.design[:2] * fit.used, max(_SMOOTHING * blur_px, _LEAST_SMOOTHING_PX)) * fit.used
    response = products(weights, fit.design)
    by_place = response[:, :2]
    if not np.linalg.cond(by_place) < _WORST_CONDITION:
        return None
    # What noise the match has taken up already has left the residuals.
    left = weights - combined(response, fit.by_grey)
    offset = np.asarray(np.linalg.solve(by_place, products(weights, fit.residuals[None])[:, 0]), float)
    return _second_place(offset, fit.covariance(combined(np.asarray(np.linalg.inv(by_place)), left)))


def sloping_place(fit: LinearFit) -> SecondPlace | None:
    """The place with two more unknowns, slopes of the contrast, in one step from the fit; None where they are not told
    from the others.

    Dust on one side of a small disk, soft at its edge, moves the disk as it moves an edge, and leaves of itself only
    that the disk is darker on that side. A disk whose paint may grow lighter or darker across takes that up.
    """
    sloping = fit.design[-GREY] * fit.design[-2:] * fit.used
    left = (sloping - combined(products(sloping, fit.design), fit.by_grey)) * fit.used  # by what the match has taken up
    normal = products(left, sloping)
    if not np.linalg.cond(normal) < _WORST_CONDITION:
        return None
    by_noise = combined(-products(fit.by_grey[:2], sloping) @ np.linalg.inv(normal), left)
    return _second_place(products(by_noise, fit.residuals[None])[:, 0], fit.covariance(by_noise))


def _second_place(offset_px: Array, covariance_px2: Array) -> SecondPlace | None:
    """None where the noise's lags, which are noise themselves, make no covariance."""
    if not np.all(np.linalg.eigvalsh(covariance_px2) > 0):
        return None
    return SecondPlace(offset_px, covariance_px2)


def across_edges(slopes: Array, smoothing_px: float) -> Array:
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

"""A fit linearised at its solution: what else the same grey values say, a second place for example, and how well it is
known where residuals are uneven, and where the model bends.

Where a mark is not quite as it is drawn, what its fit leaves is no noise alone: a scanner's sharpening, film that is
uneven, detail that a chip was sampled too coarsely for lie at the edges, which are what tells the place. A covariance
that takes residuals as alike everywhere promises too much there. The sandwich covariance asks each pixel what it left
and how much that weighs, and its neighbours whether they left the same (Conley, 1999, GMM estimation with cross
sectional dependence). What it is larger by than noise makes it is a cause of its own.

Where a mark is soft and faint, its place, blur and contrast are unknown by so much that the picture bends within their
errors. Two terms of the second order count, both in what the picture's slopes change by as the mark moves:

- What of those changes no unknown takes up correlates with the noise, and turns the normal equations: the statistical
  curvature (Efron, 1975, Defining the curvature of a statistical problem). It is taken in its mean rather than from the
  residuals, as the observed information has it: so it is never negative, and what is damaged has no part in it.
- What the unknowns do take up changes with them how well the place is known: a mark that came out too sharp claims too
  much. The logarithm of the variance is as uncertain as they are, and its exponential on average larger by half the
  square of that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.ndimage import gaussian_filter

from measure.fitting.picture_model import GREY
from measure.noise.noise import NoiseModel, coloured, correlated
from measure.noise.pixel_sums import products

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ALIKE_PX = 1.5  # standard deviation of the weights by distance of what neighbours leave alike
_LEAST_SLOPE = 1e-3  # of a clipped grey value: what tells less tells nothing


@dataclass(frozen=True, eq=False)
class LinearFit:
    """residuals (height, width), where used; design (unknowns, height, width): derivatives of the model by the
    unknowns, the first two the place by column and row, the last four gain, offset and slopes of the ground; by_grey,
    alike: derivatives of the fitted unknowns by the grey values; noise: of these. All images are
    multiplied by steadiness (height, width), so that their noise is alike everywhere."""

    residuals: Array
    used: Mask
    design: Array
    by_grey: Array
    noise: NoiseModel
    steadiness: Array

    def covariance(self, by_grey: Array) -> Array:
        """(n, n) that the noise gives to n figures, whose derivatives by the grey values are (n, height, width)."""
        white = self.noise.variance_dn2 * by_grey
        covariance = products(by_grey, white if self.noise.is_white else correlated(by_grey, self.noise))
        return np.asarray((covariance + covariance.T) / 2)

    def unlike_drawing_px2(self, by_noise: Array) -> Array:
        """(2, 2) by which the place is known less well than by_noise, (2, 2) px2, says: by what is left at the mark's
        edges, and alike in neighbours, beyond the noise."""
        place, left = self.by_grey[:2], np.where(self.used, self.residuals, 0.0)[None]
        expected = self.covariance(place)
        if self.noise.is_grain:  # that weighed the fit: as if it were white, so that neighbours share none
            place, left = coloured(place, self.noise, 0.5), coloured(left, self.noise, -0.5)
            expected = products(place, place)
        shares = place * left
        about = gaussian_filter(shares, (0.0, _ALIKE_PX, _ALIKE_PX), mode="constant") * (2 * np.pi * _ALIKE_PX**2)
        more = products(about, shares) - expected
        sizes, axes = eigh((more + more.T) / 2, by_noise)
        axes = by_noise @ axes
        return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)


def second_order(design: Array, slopes: Array, used: Mask, covariance: Array, priors_dn2: Array) -> float:
    """By what share of itself the variance of a place is larger than a linearised adjustment has it.

    design (unknowns, height, width): derivatives of the model, the first two by column and row, the last four by the
    greys; slopes (height, width): their part in what clipped grey values tell, 1 elsewhere; used (height, width): the
    pixels that count; covariance (unknowns, unknowns); priors_dn2 (unknowns,): weights of the priors, that of a pixel
    being 1. The bends are compared pixel by pixel, with grain in the covariance only: its weights amplify them as no
    noise does."""
    moving = len(design) - GREY + 1  # all but the ground's
    among, seen = covariance[:moving, :moving], design * used
    # All that moves with the mark changes by its slope, against the move.
    whole = design[:moving] / np.maximum(slopes, _LEAST_SLOPE)
    changes = np.concatenate(np.gradient(whole, axis=(2, 1))) * (-slopes * used)
    normal, shared = products(seen, seen), products(seen, changes)
    inverse: Array = np.asarray(np.linalg.inv(normal + np.diag(priors_dn2)), float)
    taken_up = np.asarray(inverse @ shared, float)
    by_unknown = np.trace(taken_up[:2].reshape(2, 2, moving))  # of the variance's logarithm, negative
    both = taken_up.T @ shared
    left = products(changes, changes) - both - both.T + taken_up.T @ normal @ taken_up
    turning = np.einsum("jl,ijml->im", among, left.reshape(2, moving, 2, moving))
    by_noise = np.asarray(inverse @ normal @ inverse, float)
    curvature = np.trace(by_noise[:2, :2] @ turning) / 2
    # Lags that are noise themselves may leave the covariance of the other unknowns indefinite.
    return max(float(curvature + by_unknown @ among @ by_unknown / 2), 0.0)

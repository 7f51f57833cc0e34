"""Weights for grain: what the inverse of the noise's covariance matrix makes of a fit's derivatives.

Generalised least squares solves `B r = 0`, B being the derivatives times that inverse. Conjugate gradients give B to
some per cent in a few rounds without forming a matrix. B need not be exact: the estimate is unbiased with any, and its
covariance follows from the very B that was used.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from measure.noise.noise import NoiseModel, padded

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

_ROUNDS = 8  # of conjugate gradients, at most
_CLOSE = 0.03  # of a derivative: so little left costs a thousandth of the standard deviation
_WHITE = 0.02  # of the variance at least is taken as white: no film's grain is known better at the finest frequencies
_MISFIT = 0.003  # of the contrast: what the drawing itself gets wrong from pixel to pixel


def weighted(design: Array, used: Mask, noise: NoiseModel, contrast_dn: float) -> tuple[Array, Array]:
    """B and C B', each (unknowns, height, width) and 0 where not used: weighted derivatives, and the covariance matrix
    of the noise times them."""
    covariance = _Covariance(noise, used, max(_WHITE * noise.variance_dn2, (_MISFIT * contrast_dn) ** 2))
    # The columns are scaled for single precision, and all are solved at once.
    size = np.sqrt((design[:, used] ** 2).sum(axis=1))[:, None, None]
    right = (design * used / size).astype(np.float32)
    solution, product = np.zeros_like(right), np.zeros_like(right)
    # Columns that are close leave the rounds: those of a mark's edges are so at once, the ground's later.
    left, rest = np.arange(len(right)), right
    direction = ahead = covariance.roughly_inverse(rest)
    strength = _dots(rest, ahead)
    for _ in range(_ROUNDS):
        seen = covariance.times(direction)
        length = strength / np.maximum(_dots(direction, seen), 1e-30)
        solution[left] += length * direction
        product[left] += length * seen
        rest = rest - length * seen
        far = _dots(rest, rest)[:, 0, 0] >= _CLOSE**2  # of columns of unit length
        if not far.any():
            break
        left, rest, direction, before = left[far], rest[far], direction[far], strength[far]
        ahead = covariance.roughly_inverse(rest)
        strength = _dots(rest, ahead)
        direction = np.asarray(ahead + strength / np.maximum(before, 1e-30) * direction, np.float32)
    scale = size / covariance.scale_dn2
    return np.asarray(solution * scale, float), np.asarray(product * size, float)


class _Covariance:
    """The noise's covariance among the pixels used, in units of scale_dn2, applied by Fourier transforms."""

    def __init__(self, noise: NoiseModel, used: Mask, white_dn2: float) -> None:
        reach = noise.autocovariance_dn2.shape[0] // 2
        self.used = used.astype(np.float32)
        self.scale_dn2 = noise.variance_dn2
        self.shape = padded(used.shape, reach)
        kernel, index = np.zeros(self.shape, np.float32), np.arange(-reach, reach + 1)
        kernel[np.ix_(index, index)] = noise.autocovariance_dn2 / self.scale_dn2
        spectrum = np.asarray(fft.rfft2(kernel).real, np.float32)
        self.spectrum: Single = np.asarray(np.maximum(spectrum, white_dn2 / self.scale_dn2), np.float32)

    def times(self, images: Single) -> Single:
        return self._filtered(images, self.spectrum)

    def roughly_inverse(self, images: Single) -> Single:
        """As if the pixels used had no border."""
        return self._filtered(images, np.asarray(1 / self.spectrum, np.float32))

    def _filtered(self, images: Single, spectrum: Single) -> Single:
        height, width = self.used.shape
        smeared = fft.irfft2(fft.rfft2(images, s=self.shape) * spectrum, s=self.shape)
        return np.asarray(smeared[:, :height, :width] * self.used, np.float32)


def _dots(first: Single, second: Single) -> Single:
    return np.asarray(np.einsum("nij,nij->n", first, second)[:, None, None], np.float32)

"""Weights of pixels: by noise that grows with light, and for grain by what the inverse of the noise's covariance matrix
makes of a fit's derivatives.

A sensor's own noise is alike in light. What is added to grey values that are a power of light, or rounded or compressed
away of them, is alike in these, and in light the larger the more light there is; grain lies between. So the standard
deviation of noise is taken to grow as a power of light, from 0, alike in light, to that of noise alike in grey values
of a gamma of 2.2: the same however a file codes light. What seems to grow faster is no noise: it is a mark that is not
as drawn, and to weigh it down would fit less and less of it.

Generalised least squares solves `B r = 0`, B being the derivatives times that inverse. Conjugate gradients give B to
some per cent in a few rounds without forming a matrix. B need not be exact: the estimate is unbiased with any, and its
covariance follows from the very B that was used.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from measure.noise.noise import WHITE, NoiseModel, padded, robust_scale

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Single = NDArray[np.float32]

_POWER, _POWER_SIGMA, _MOST = 0.4, 0.25, 1 - 1 / 2.2  # of light: what is believed of any scan
_OTHER, _SAME = 0.5, 0.15  # of light's greatest change: from where noise differs, up to where it does not
_GREATEST = 0.98  # of the pixels change less than what is called the greatest change
_FEWEST = 12  # pixels that tell how noisy they are
_SCALE_VARIANCE = 1.36  # of the logarithm of a robust scale, times the number of values it is of
_LEAST = 0.1  # of light's logarithm: noise hardly changes with less
_DARKEST = 5e-4  # of full scale: nearer to black no scanner's noise is less

_ROUNDS = 8  # of conjugate gradients, at most
_CLOSE = 0.03  # of a derivative: so little left costs a thousandth of the standard deviation
_MISFIT = 0.003  # of the contrast: what the drawing itself gets wrong from pixel to pixel


def steadiness(residuals: Array, light: Array, ground: Mask, used: Mask) -> Array:
    """(height, width): the standard deviation of the ground's noise over that of each pixel.

    residuals (height, width): light that a fit left; light, alike: what it draws, of full scale; ground, used,
    alike: the ordinary pixels, and those that count. Damage hardly does: scales are medians.
    """
    at_ground = ground & used
    if not at_ground.any():
        return np.ones_like(residuals)
    light = np.maximum(light, _DARKEST)
    change = np.log(light / np.median(light[at_ground]))
    size = np.abs(change)
    greatest = float(np.quantile(size[used], _GREATEST))
    if greatest < _LEAST:
        return np.ones_like(residuals)
    same, other = at_ground & (size < _SAME * greatest), used & (size > _OTHER * greatest)
    power, weight = _POWER, _POWER_SIGMA**-2
    if same.sum() >= _FEWEST and other.sum() >= _FEWEST:
        scales = [max(robust_scale(residuals[group]), 1e-9) for group in (other, same)]
        apart = float(np.mean(change[other]) - np.mean(change[same]))
        told = apart**2 / (_SCALE_VARIANCE * (1 / same.sum() + 1 / other.sum()))
        power = (weight * power + told * float(np.log(scales[0] / scales[1])) / apart) / (weight + told)
    return np.asarray(np.exp(-np.clip(power, 0.0, _MOST) * change))


def weighted(design: Array, used: Mask, noise: NoiseModel, contrast_dn: float) -> tuple[Array, Array]:
    """B and C B', each (unknowns, height, width) and 0 where not used: weighted derivatives, and the covariance matrix
    of the noise times them."""
    covariance = _Covariance(noise, used, max(WHITE * noise.variance_dn2, (_MISFIT * contrast_dn) ** 2))
    # The columns are scaled for single precision, and all are solved at once.
    right = (design * used).astype(np.float32)
    size = np.sqrt(_dots(right, right))
    right /= size
    # Columns that are close leave the rounds: those of a mark's edges are so at once, the ground's later.
    solution, left, rests = np.zeros_like(right), np.arange(len(right)), right.copy()
    direction = ahead = covariance.roughly_inverse(right)
    strength = _dots(right, ahead)
    for _ in range(_ROUNDS):
        seen = covariance.times(direction)
        length = strength / np.maximum(_dots(direction, seen), 1e-30)
        solution[left] += length * direction
        rests[left] -= np.multiply(length, seen, out=seen)
        rest = rests[left]
        far = _dots(rest, rest)[:, 0, 0] >= _CLOSE**2  # of columns of unit length
        if not far.any():
            break
        left, rest, direction, before = left[far], rest[far], direction[far], strength[far]
        ahead = covariance.roughly_inverse(rest)
        strength = _dots(rest, ahead)
        direction *= strength / np.maximum(before, 1e-30)
        direction += ahead
    return solution * (size / covariance.scale_dn2).astype(float), (right - rests) * size.astype(float)


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

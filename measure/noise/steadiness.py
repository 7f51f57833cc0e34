"""Noise that grows with light: by how much, as the pixels of a fit show it.

A sensor's own noise is alike in light. What is added to grey values that are a power of light, or rounded or compressed
away of them, is alike in these, and in light the larger the more light there is; grain lies between. So the standard
deviation of noise is taken to grow as a power of light, from 0, alike in light, to that of noise alike in grey values
of a gamma of 2.2: the same however a file codes light. What seems to grow faster is no noise: it is a mark that is not
as drawn, and to weigh it down would fit less and less of it.
"""

import numpy as np
from numpy.typing import NDArray

from measure.noise.noise import robust_scale

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_POWER, _POWER_SIGMA, _MOST = 0.4, 0.25, 1 - 1 / 2.2  # of light: what is believed of any scan
_OTHER, _SAME = (
    0.5,
    0.15,
)  # of the greatest change of the slope's logarithm: from where it differs, up to where it does not
_GREATEST = 0.98  # of the pixels change less than what is called the greatest change
_FEWEST = 12  # pixels that tell how noisy they are
_SCALE_VARIANCE = 1.36  # of the logarithm of a robust scale, times the number of values it is of
_LEAST = 0.1  # of light's logarithm: noise hardly changes with less
_DARKEST = 5e-4  # of full scale: nearer to black no scanner's noise is less


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

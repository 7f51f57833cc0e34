"""Noise that grows with light: by how much, as the pixels of a fit show it.

A sensor's own noise is alike in light. What is added to grey values, or rounded or compressed away of them, is alike in
these, and in light as many times larger as light grows faster with them; grain lies between. So noise is taken to grow
as a power of that slope, from 0, alike in light, to 1, alike in grey values. What seems to grow faster is no noise: it
is a mark that is not as drawn, and to weigh it down would fit less and less of it.
"""

import numpy as np
from numpy.typing import NDArray

from measure.noise.noise import robust_scale

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_POWER, _POWER_SIGMA, _MOST = 0.75, 0.5, 1.0  # of the slope: what is believed of any scan
_OTHER, _SAME = (
    0.5,
    0.15,
)  # of the greatest change of the slope's logarithm: from where it differs, up to where it does not
_GREATEST = 0.98  # of the pixels change less than what is called the greatest change
_FEWEST = 12  # pixels that tell how noisy they are
_SCALE_VARIANCE = 1.36  # of the logarithm of a robust scale, times the number of values it is of
_LEAST = 0.05  # of the slope's logarithm: noise hardly changes with less


def steadiness(residuals: Array, slopes: Array, ground: Mask, used: Mask) -> Array:
    """(height, width): the standard deviation of the ground's noise over that of each pixel.

    residuals (height, width): light that a fit left; slopes, alike: by how much light grows with the grey value;
    ground, used, alike: the ordinary pixels, and those that count. Damage hardly does: scales are medians.
    """
    at_ground = ground & used
    if not at_ground.any():
        return np.ones_like(residuals)
    change = np.log(slopes / np.median(slopes[at_ground]))
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

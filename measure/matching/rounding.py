"""Grey values that were rounded in steps as coarse as their noise: each says only which interval its light lies in.

In more noise, rounding adds a twelfth of a step's square to the variance, and no more. In less it is a part of the
picture: along an even ground many neighbours are off by the same amount, which no mean takes out. There residuals are
taken from the likelihood of the intervals (grouped observations; Sheppard's corrections are its limit in much noise).
It is made greatest by scoring: least squares, again and again, of residuals that are the scores over what a grey value
tells in the mean.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

Array = NDArray[np.float64]

ROUNDING_VARIANCE = 1 / 12  # of evenly spread light less the number it is rounded to, in steps
_LOG_DENSITY = -0.5 * np.log(2 * np.pi)
# Of the noise, in steps: from what no drawing is exact to, to where the weights of grain gain more.
_SIGMAS = (0.1, 0.14, 0.2)
COARSEST_VARIANCE = ROUNDING_VARIANCE + _SIGMAS[-1] ** 2
_SAMPLES, _TAIL = 1001, 6.0


def rounding_step(grey: Array) -> float:
    """The step that all grey values are multiples of, from one another; 0 where there is none."""
    gaps = np.diff(np.unique(grey))
    step = float(gaps.min(initial=np.inf))
    return step if np.isfinite(step) and not np.any(gaps % step) else 0.0


def likely_sigma(residuals: Array) -> float:
    """The most likely standard deviation of the noise, from rounded grey values less their model (n,), in steps."""
    return max(_SIGMAS, key=lambda sigma: float(_log_chance(residuals, sigma).sum()))


def unrounded(residuals: Array, sigma: float) -> Array:
    """The residuals, alike, of least squares that make the likelihood of their intervals greatest, in steps."""
    return _scores(residuals, sigma) / _information(sigma)


def unrounded_variance(sigma: float) -> float:
    """The mean square of these where the model is right."""
    return sigma**2 / _information(sigma)


def _log_chance(residuals: Array, sigma: float) -> Array:
    """Of each interval, that noise about the model takes the light into it."""
    near = (np.abs(residuals) - 0.5) / sigma
    log_beyond = log_ndtr(-near)
    return np.asarray(log_beyond + np.log1p(-np.exp(log_ndtr(-near - 1 / sigma) - log_beyond)))


def _scores(residuals: Array, sigma: float) -> Array:
    """How far in the mean the light of each interval is off the model."""
    near, log_chance = (np.abs(residuals) - 0.5) / sigma, _log_chance(residuals, sigma)
    at_near, at_far = (np.exp(_LOG_DENSITY - end**2 / 2 - log_chance) for end in (near, near + 1 / sigma))
    return np.asarray(np.sign(residuals) * sigma * (at_near - at_far))


@cache
def _information(sigma: float) -> float:
    """What a rounded grey value tells of the model, 1 being what it would tell unrounded; the mean over all phases."""
    reach = 0.5 + _TAIL * sigma
    residuals = np.linspace(-reach, reach, _SAMPLES)
    chance = np.exp(_log_chance(residuals, sigma))
    return float((chance * _scores(residuals, sigma) ** 2).sum() / chance.sum() / sigma**2)

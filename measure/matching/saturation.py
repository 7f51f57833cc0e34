"""Saturation and clipping: grey values at the end of a scanner's range bound the light from one side only.

Such an observation is censored (Tobin, 1958, Estimation of relationships for limited dependent variables). Its
likelihood is the probability that noise takes it beyond the limit. It enters least squares as a residual whose square
is -2 log of that probability (a deviance residual): the ordinary residual where the model lies well within the range,
zero where it lies well beyond. No observation is excluded by a threshold, which would bias the rest.
Its information is the curvature of that likelihood.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, log_ndtr

from measure.array_types import Array, Mask
from measure.flags import NATURAL_END
from measure.noise.robust_estimation import robust_scale
from measure.scans.scan import Scan

Sides = NDArray[np.int8]

_BITS = (8, 10, 12, 14, 16)  # bit depths of scanners' converters; values are stored unchanged or shifted up
_LOG_DENSITY = -0.5 * np.log(2 * np.pi)  # log density of the standard normal distribution at 0
_TAIL = 2.0  # noise standard deviations below the maximum: the tail of the histogram
_LEAST_STEPS = 1.5  # grey-value steps per noise standard deviation; with less noise a uniform area piles up as well
_FEWEST = 20  # pixels; fewer clipped ones do not affect a fit
_GROSS = 3.5  # standard deviations beyond which a residual is damage
_SCALE_ROUNDS = 8  # iterations; each leaves at most two fifths of the error
_CLEAR = 3.0  # noise standard deviations between the model and a clipping limit
_TELLS = 0.5  # derivative of the residual above which it counts as an ordinary one


def clipped_sides(scan: Scan, col0: int, row0: int, width: int, height: int, weights: Sequence[float] | None) -> Sides:
    """Find the clipped grey values of a window.

    Parameters
    ----------
    weights : of the channels of a colour scan. None is negative, so a clipped channel of positive weight bounds the
        weighted sum.

    Returns
    -------
    (height, width) int8: 1 at the upper end of the scanner's range or where whites are clipped below it, -1 at the
    lower end, 0 elsewhere.
    """
    sides = np.zeros((height, width), np.int8)
    for channel in range(scan.channels):
        if weights is None or weights[channel] > 0:
            only = tuple(float(index == channel) for index in range(scan.channels))
            grey = scan.window(col0, row0, width, height, only)
            if grey.max() in _limits(scan.full_scale_dn) or _is_cut(grey):
                sides[grey == grey.max()] = 1
            sides[grey == 0] = -1
    return sides


class Censored(NamedTuple):
    """Deviance residuals of n clipped grey values.

    residuals: (n,); slopes: (n,) derivatives with respect to the ordinary residuals, 0 to 1; information: (n,) relative
    to an ordinary grey value, one to two times the squared slope.
    """

    residuals: Array
    slopes: Array
    information: Array


def censored(residuals: Array, sides: Sides, sigma_dn: float) -> Censored:
    """Compute the deviance residuals of clipped grey values. residuals (n,): grey value minus model; sides (n,):
    clipped end; sigma_dn: standard deviation of the noise."""
    within = sides * residuals / sigma_dn
    log_chance = np.asarray(log_ndtr(-within), dtype=float)
    hazard = _hazard(within, log_chance)
    size = np.sqrt(np.maximum(-2 * log_chance, 1e-300))
    slopes = np.minimum(hazard / size, 1.0)
    return Censored(sides * sigma_dn * size, slopes, np.clip(hazard * (hazard - within), slopes**2, 2 * slopes**2))


def noise_scale(residuals: Array, sides: Sides, start_dn: float, least_dn: float) -> float:
    """Estimate the standard deviation of the noise by maximum likelihood from residuals and sides (n,), some clipped.

    Returns at least least_dn; start_dn: rough initial value. The mean square of an observation's score (its residual
    if ordinary) equals its information in units of the variance. Residuals more than _GROSS standard deviations within
    the range are damage.
    """
    clipped = sides != 0
    ordinary, within = residuals[~clipped], (sides * residuals)[clipped]
    ordinary, within = ordinary[np.abs(ordinary) < _GROSS * start_dn], within[within < _GROSS * start_dn]
    squares, sigma = float(np.sum(ordinary**2)), max(start_dn, least_dn)
    for _ in range(_SCALE_ROUNDS):
        hazard = _hazard(within / sigma, log_ndtr(-within / sigma))
        information = np.sum(hazard * (hazard - within / sigma))
        variance = (squares + sigma**2 * np.sum(hazard**2)) / max(len(ordinary) + information, 1.0)
        sigma = max(float(np.sqrt(variance)), least_dn)
    return sigma


def clear_of_ends(drawn: Array, grey: Array, sides: Sides, sigma_dn: float) -> Mask:
    """(height, width) mask of pixels whose modelled value lies so far from the clipping limits that noise is not cut
    off."""
    clear = np.ones(drawn.shape, dtype=bool)
    for side in (1, -1):
        if np.any(sides == side):
            clear &= side * (grey[sides == side].mean() - drawn) > _CLEAR * sigma_dn
    return clear


def tells(slopes: Array) -> Mask:
    """Mask of residuals that have the full scatter of the noise and so can estimate it."""
    return np.asarray(slopes > _TELLS)


def _hazard(within: Array, log_chance: Array) -> Array:
    """Hazard function of the normal distribution: density over tail probability."""
    return np.asarray(np.exp(_LOG_DENSITY - within**2 / 2 - log_chance))


def _is_cut(grey: NDArray[np.floating]) -> bool:
    """Whether whites were clipped at the maximum. In the unclipped tail of a histogram, of the values within _TAIL
    noise standard deviations of the maximum, the maximum itself has at most a uniform share."""
    greatest = grey.max()
    pile = int((grey == greatest).sum())
    if pile < _FEWEST:
        return False
    both_below = (grey[:, 1:] < greatest) & (grey[:, :-1] < greatest)
    sigma = robust_scale(np.diff(grey.astype(float), axis=1)[both_below]) / np.sqrt(2)
    step = float(np.diff(np.unique(grey)).min(initial=np.inf))
    if both_below.sum() < _FEWEST or not sigma > _LEAST_STEPS * step:
        return False
    tail = int((grey >= greatest - _TAIL * sigma).sum())
    return bool(bdtrc(pile - 1, tail, step / (_TAIL * sigma)) < NATURAL_END)


def _limits(full_scale_dn: float) -> set[float]:
    full_bits = int(full_scale_dn).bit_length()
    limits = {full_scale_dn}
    for bits in _BITS:
        if bits < full_bits:
            limits |= {float(2**bits - 1), float((2**bits - 1) << (full_bits - bits))}
    return limits

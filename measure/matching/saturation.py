"""Grey values at the end of a scanner's range: they say only that there was at least, or at most, so much light.

Such an observation is censored (Tobin, 1958, Estimation of relationships for limited dependent variables): its
likelihood is the probability that noise takes it beyond the limit. Least squares take it in as a residual whose square
is -2 log of that probability (a deviance residual): where the model lies well within the range it is the ordinary one,
where it lies well beyond there is none, and nothing has to be left out by a threshold, which would bias what stays.
How much it tells of the model is the curvature of that likelihood.
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

_BITS = (8, 10, 12, 14, 16)  # of scanners' converters; their numbers are stored as they are, or moved up
_LOG_DENSITY = -0.5 * np.log(2 * np.pi)  # of the normal distribution at its middle
_TAIL = 2.0  # standard deviations below the greatest value
_LEAST_STEPS = 1.5  # of the scan's grey values in a standard deviation: in less noise an even ground is a pile as well
_FEWEST = 20  # pixels: fewer bend no fit
_GROSS = 3.5  # standard deviations: beyond it a residual is damage
_SCALE_ROUNDS = 8  # each leaves at most two fifths of what was wrong
_CLEAR = 3.0  # standard deviations of the noise
_TELLS = 0.5  # derivative of the residual, from which on it is a residual like the others


def clipped_sides(scan: Scan, col0: int, row0: int, width: int, height: int, weights: Sequence[float] | None) -> Sides:
    """(height, width): 1 where a grey value of the window is at the upper end of the scanner's range, or where whites
    were cut off below it, -1 at the lower end, 0 elsewhere. weights: of the channels of a colour scan; none is
    negative, so that a channel at its end, of those that count, is a limit of the whole."""
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
    """Of clipped grey values, each (n,): residuals; slopes, their derivatives by the ordinary ones, between 0 and 1;
    and information on the model, 1 being what an ordinary grey value tells: one to two times the slope's square."""

    residuals: Array
    slopes: Array
    information: Array


def censored(residuals: Array, sides: Sides, sigma_dn: float) -> Censored:
    """What clipped grey values say. residuals, sides (n,): grey value less model; sigma_dn: of the noise."""
    within = sides * residuals / sigma_dn
    log_chance = np.asarray(log_ndtr(-within), dtype=float)
    hazard = _hazard(within, log_chance)
    size = np.sqrt(np.maximum(-2 * log_chance, 1e-300))
    slopes = np.minimum(hazard / size, 1.0)
    return Censored(sides * sigma_dn * size, slopes, np.clip(hazard * (hazard - within), slopes**2, 2 * slopes**2))


def noise_scale(residuals: Array, sides: Sides, start_dn: float, least_dn: float) -> float:
    """The most likely standard deviation of noise, at least least_dn, from residuals and sides (n,), some of them
    clipped, and a rough one, start_dn.

    The score of an observation, its residual where it is ordinary, has on average the square that its information has,
    in units of the variance. What lies _GROSS standard deviations within the range is damage.
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
    """(height, width): where what is drawn lies so far from limits of what was clipped that noise goes either way."""
    clear = np.ones(drawn.shape, dtype=bool)
    for side in (1, -1):
        if np.any(sides == side):
            clear &= side * (grey[sides == side].mean() - drawn) > _CLEAR * sigma_dn
    return clear


def tells(slopes: Array) -> Mask:
    """Which residuals are as large as the noise makes them, and say how large it is."""
    return np.asarray(slopes > _TELLS)


def _hazard(within: Array, log_chance: Array) -> Array:
    """The density over the probability of what lies so many standard deviations within the range or beyond it."""
    return np.asarray(np.exp(_LOG_DENSITY - within**2 / 2 - log_chance))


def _is_cut(grey: NDArray[np.floating]) -> bool:
    """Whether the greatest value is where whites were cut off. Of the values within _TAIL standard deviations of the
    noise below it, the last one of a tail that falls by itself has no more than an even share."""
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

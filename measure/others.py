"""What the other marks of a frame tell of a figure that all of them share, and whether one mark's own is another."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
# The standard deviation of a figure from mark to mark, by the variance that so many marks show beyond their own.
Spread = Callable[[float, int], float]

_FEWEST = 3  # other marks
_CHANCE = 0.01  # of doubting any good mark of a frame


@dataclass(frozen=True)
class Told:
    """value: what the others tell, and sigma, its standard deviation for one more mark. differs: whether the mark's own
    figure is another, by more than chance."""

    value: float
    sigma: float
    differs: bool


def told_by_others(own: Array, sigma: Array, spread: Spread) -> list[Told | None]:
    """For each mark what the others tell, None where they are too few.

    own, sigma (n,): each mark's figure and its standard deviation, infinite where it has none.
    """
    return [_told(own, sigma, index, spread) for index in range(len(own))]


def _told(own: Array, sigma: Array, index: int, spread: Spread) -> Told | None:
    others = np.isfinite(sigma) & (np.arange(len(own)) != index)
    if others.sum() < _FEWEST:
        return None
    mean, mean_sigma, apart = _mean(own[others], sigma[others], spread)
    predicted = float(np.hypot(mean_sigma, apart))
    off = abs(own[index] - mean) / np.hypot(predicted, sigma[index])
    return Told(mean, predicted, bool(2 * stats.norm.sf(off) * len(own) < _CHANCE))


def _mean(values: Array, sigma: Array, spread: Spread) -> tuple[float, float, float]:
    """The weighted mean of values that differ by more than their standard deviations, its own standard deviation, and
    by how much more: by the moments of what they leave (DerSimonian and Laird, 1986)."""
    weights = 1 / sigma**2
    rest = values - weights @ values / weights.sum()
    beyond = weights @ rest**2 - (len(values) - 1)
    between = max(beyond / (weights.sum() - (weights**2).sum() / weights.sum()), 0.0)
    apart = spread(float(between), len(values))
    weights = 1 / (sigma**2 + apart**2)
    return float(weights @ values / weights.sum()), float(1 / np.sqrt(weights.sum())), apart

"""The blur that all marks of a scan share, for one lens and one scanner made it: what the others tell of each mark's.

A faint mark, or one on rough ground, hardly tells its own blur. Where noise makes its edges look sharp, its standard
deviation comes out as small as a sharp mark's. So it is matched with the others' blur as an observation, and where its
own is not theirs something else than noise is in its picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from measure.matching import Match
from measure.picture_model import PIXEL_VARIANCE_PX2

Array = NDArray[np.float64]

_SPREAD = 0.05  # of the logarithm: so much blur differs within a field, where too few marks show by how much
_TELLING = 0.05  # of the same: a standard deviation of the place is wrong by no more where its blur is known so well
_FEWEST = 3  # other marks
_CHANCE = 0.01  # of doubting any good mark of a frame


@dataclass(frozen=True)
class SharedBlur:
    """What the other marks tell of a mark's blur: blur_px, and sigma, the standard deviation of its logarithm, the
    pixel's share included. differs: whether the mark's own is another, by more than chance; else it is just poorly
    known."""

    blur_px: float
    sigma: float
    differs: bool


def shared_blurs(fits: Sequence[Match]) -> list[SharedBlur | None]:
    """For each mark what the others tell of its blur, None where they need not, for its own picture tells it well and
    it is as theirs, or where they are too few."""
    own = np.array([np.log(fit.blur_px**2 + PIXEL_VARIANCE_PX2) / 2 for fit in fits])
    sigma = np.array([fit.blur_sigma for fit in fits])
    return [_shared(own, sigma, index) for index in range(len(fits))]


def _shared(own: Array, sigma: Array, index: int) -> SharedBlur | None:
    others = np.isfinite(sigma) & (np.arange(len(own)) != index)
    if others.sum() < _FEWEST:
        return None
    mean, mean_sigma, spread = _mean(own[others], sigma[others])
    predicted = float(np.hypot(mean_sigma, spread))
    off = abs(own[index] - mean) / np.hypot(predicted, sigma[index])
    differs = bool(2 * stats.norm.sf(off) * len(own) < _CHANCE)
    if not differs and sigma[index] < _TELLING:
        return None
    return SharedBlur(float(np.sqrt(max(np.exp(2 * mean) - PIXEL_VARIANCE_PX2, 0.0))), predicted, differs)


def _mean(values: Array, sigma: Array) -> tuple[float, float, float]:
    """The weighted mean of values that differ by more than their standard deviations, its own standard deviation, and
    by how much more: by the moments of what they leave (DerSimonian and Laird, 1986), and at least by _SPREAD."""
    weights = 1 / sigma**2
    rest = values - weights @ values / weights.sum()
    beyond = weights @ rest**2 - (len(values) - 1)
    between = max(beyond / (weights.sum() - (weights**2).sum() / weights.sum()), 0.0)
    spread = float(np.hypot(np.sqrt(between), _SPREAD))
    weights = 1 / (sigma**2 + spread**2)
    return float(weights @ values / weights.sum()), float(1 / np.sqrt(weights.sum())), spread

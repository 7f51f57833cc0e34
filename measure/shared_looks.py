"""The looks that the marks of a scan share: one lens and one scanner blur them alike, and marks of one drawing have one
size.

A faint mark, or one on rough ground, hardly tells its own blur. Where noise makes its edges look sharp, its standard
deviation comes out as small as a sharp mark's. So it is matched with the others' blur as an observation, and where its
own is not theirs something else than noise is in its picture. A speck that covers a dot looks like a dot of another
size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.matching import Match
from measure.others import told_by_others
from measure.picture_model import PIXEL_VARIANCE_PX2

Array = NDArray[np.float64]

_BLUR_SPREAD = 0.05  # of the logarithm: so much blur differs within a field
_TELLING = 0.05  # of the same: a standard deviation of the place is wrong by no more where its blur is known so well
# Of the logarithm: so much exposure spreads the marks of a frame, as if two marks had shown it before. In three frames
# of ring-crosses it was 0.005 to 0.008, in four of a réseau 0.014 to 0.021.
_SIZE_SPREAD, _BEFORE = 0.03, 2


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
    return [
        None
        if told is None or not (told.differs or own_sigma > _TELLING)
        else SharedBlur(_without_pixel(told.value), told.sigma, told.differs)
        for told, own_sigma in zip(told_by_others(own, sigma, _blur_spread), sigma.tolist(), strict=True)
    ]


def odd_sizes(fits: Sequence[Match], linear: Array) -> list[float | None]:
    """How many times the others' size each mark has, of marks that are drawn alike and tell their own size; None where
    that is one, or where they are too few. linear: (2, 2) px per mm, of the frame."""
    own = np.array([np.log(np.linalg.det(fit.pixel_from_mark[:, :2]) / np.linalg.det(linear)) / 2 for fit in fits])
    told = told_by_others(own, np.array([fit.size_sigma for fit in fits]), _size_spread)
    return [
        None if each is None or not each.differs else float(np.exp(size - each.value))
        for size, each in zip(own.tolist(), told, strict=True)
    ]


def _blur_spread(shown: float, marks: int) -> float:
    return float(np.hypot(np.sqrt(shown), _BLUR_SPREAD))


def _size_spread(shown: float, marks: int) -> float:
    return float(np.sqrt((_BEFORE * _SIZE_SPREAD**2 + (marks - 1) * shown) / (_BEFORE + marks - 1)))


def _without_pixel(log_seen_px: float) -> float:
    return float(np.sqrt(max(np.exp(2 * log_seen_px) - PIXEL_VARIANCE_PX2, 0.0)))

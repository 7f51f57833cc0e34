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
from scipy import stats

from measure.matching import Match
from measure.others import told_by_others
from measure.picture_model import PIXEL_VARIANCE_PX2

Array = NDArray[np.float64]

_BLUR_SPREAD = 0.05  # of the logarithm: so much blur differs within a field
_TELLING = 0.05  # of the same: a standard deviation of the place is wrong by no more where its blur is known so well
# Of the logarithm: so much exposure spreads the marks of a frame, as if two marks had shown it before. In three frames
# of ring-crosses it was 0.005 to 0.008, in four of a réseau 0.014 to 0.021: this is their root mean square.
_SIZE_SPREAD, _BEFORE = 0.014, 2
# What covers or touches a round mark moves its radius by so much, rms, and the share of marks that something touches:
# of those with nothing cut out beside them, and with something.
_TOUCHED_PX, _WHOLE, _DAMAGED = 0.3, 0.01, 0.1
# What moves one place of an outline by d moves the mean radius by a share of d, and the centre by twice that share.
_AS_MUCH = 2.0


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


@dataclass(frozen=True)
class SharedSize:
    """A mark's size beside that of the others: ratio, and sigma, the standard deviation of the difference of their
    logarithms. differs: whether it is another by more than chance."""

    ratio: float
    sigma: float
    differs: bool

    def touched_px2(self, radius_px: float, is_damaged: bool) -> float:
        """The mean square of how far what may touch one side of a round mark has moved it, along a coordinate: of one
        that is touched, times the probability that it is. is_damaged: whether something was cut out beside it."""
        off_px, sigma_px = radius_px * np.log(self.ratio), radius_px * self.sigma
        widened_px = np.hypot(sigma_px, _TOUCHED_PX)
        share = _DAMAGED if is_damaged else _WHOLE
        touched = share * stats.norm.pdf(off_px, scale=widened_px)
        untouched = (1 - share) * stats.norm.pdf(off_px, scale=sigma_px)
        return float((_AS_MUCH * off_px) ** 2 / 2 * touched / (touched + untouched))


def shared_sizes(fits: Sequence[Match], linear: Array) -> list[SharedSize | None]:
    """The size of each mark beside the others', of marks that are drawn alike and tell their own; None where they are
    too few. linear: (2, 2) px per mm, of the frame."""
    own = np.array([np.log(np.linalg.det(fit.pixel_from_mark[:, :2]) / np.linalg.det(linear)) / 2 for fit in fits])
    sigma = np.array([fit.size_sigma for fit in fits])
    return [
        None
        if told is None
        else SharedSize(float(np.exp(size - told.value)), float(np.hypot(told.sigma, own_sigma)), told.differs)
        for size, own_sigma, told in zip(
            own.tolist(), sigma.tolist(), told_by_others(own, sigma, _size_spread), strict=True
        )
    ]


def _blur_spread(shown: float, marks: int) -> float:
    return float(np.hypot(np.sqrt(shown), _BLUR_SPREAD))


def _size_spread(shown: float, marks: int) -> float:
    return float(np.sqrt((_BEFORE * _SIZE_SPREAD**2 + (marks - 1) * shown) / (_BEFORE + marks - 1)))


def _without_pixel(log_seen_px: float) -> float:
    return float(np.sqrt(max(np.exp(2 * log_seen_px) - PIXEL_VARIANCE_PX2, 0.0)))

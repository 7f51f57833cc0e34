"""Each mark of a frame compared with the others: in blur, for one lens and one scanner blur them alike, and in size and
rotation, for marks of one drawing have one size.

A faint mark, or one on rough ground, hardly tells its own blur. Where noise makes its edges look sharp, its standard
deviation comes out as small as a sharp mark's. So it is matched with the others' blur as an observation, and where its
own is not theirs something else than noise is in its picture. A speck that covers a dot looks like a dot of another
size.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from measure.array_types import Array
from measure.flags import MARK_UNLIKE_THE_OTHERS, Code, Reason
from measure.matching.models import PIXEL_VARIANCE_PX2
from measure.results import MarkFit

# The standard deviation of a figure from mark to mark, by the variance that so many marks show exceedance their own.
_Spread = Callable[[float, int], float]

_FEWEST_BLURS = 3  # other marks: of fewer nobody knows by how much they differ
_FEWEST_SHAPES = 2  # the same: how much sizes differ is known beforehand, but not which of two marks is off
_BLUR_SPREAD = 0.05  # of the logarithm: so much blur differs within a field
_TELLING = 0.05  # of the same: a standard deviation of the place is wrong by no more where its blur is known so well
# By so much exposure spreads the marks of a frame in the logarithm of their size and, its edges being uneven, in
# rotation, as if two marks had shown it before. In three frames of ring-crosses it was 0.005 to 0.008, in four of a
# réseau 0.014 to 0.021: this is their root mean square.
_SIZE_SPREAD, _BEFORE = 0.014, 2
# The share of marks that something touches on one side: of those with nothing cut out beside them, and with something.
_WHOLE, _DAMAGED = 0.01, 0.03
# A speck is as large beside a large mark as beside a small one: it moves a round mark's mean outline by so much, rms,
# over its radius. Five dots of 0.15 mm that were touched had it moved by 8 um.
_SPECK_MM2 = 0.00125
_TOUCHED_PX = 0.3  # the same along the edges of wedges and notches, which landscape touches
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

    def is_confirmed(self, fit: MarkFit) -> bool:
        """Whether a match that took it as an observation comes out with such a blur: noise moves the estimate from an
        observation by the root of what it takes from its variance."""
        moved = _log_total_px(fit.blur_px) - _log_total_px(self.blur_px)
        off = abs(moved) / np.sqrt(max(self.sigma**2 - fit.blur_sigma**2, 1e-12))
        return bool(fit.blur_sigma < self.sigma and 2 * ndtr(-off) >= MARK_UNLIKE_THE_OTHERS)


def shared_blurs(fits: Sequence[MarkFit]) -> list[SharedBlur | None]:
    """For each mark what the others tell of its blur, None where they need not, for its own picture tells it well and
    it is as theirs, or where they are too few."""
    own = np.array([_log_total_px(fit.blur_px) for fit in fits])
    sigma = np.array([fit.blur_sigma for fit in fits])
    expected_blurs = _expect_from_others(own, sigma, blur_spread, _FEWEST_BLURS)
    return [
        None
        if expected is None or not (expected.differs or own_sigma > _TELLING)
        else SharedBlur(_remove_pixel(expected.value), expected.sigma, expected.differs)
        for expected, own_sigma in zip(expected_blurs, sigma.tolist(), strict=True)
    ]


@dataclass(frozen=True, eq=False)
class SharedShape:
    """A mark's shape beside that of the others: off (k,), the logarithm of its size less theirs, and its rotation (rad)
    too where the frame gave it; sigma (k,): standard deviations of these. differs: whether it is another by more than
    chance."""

    off: Array
    sigma: Array
    differs: bool

    def touched(self, spread: float, is_damaged: bool) -> float:
        """The probability that something touches the mark on one side, by as much as its shape speaks for it more than
        for what may happen to any mark. spread: of the figures of marks that are touched; is_damaged: whether something
        was cut out beside it."""
        share = _DAMAGED if is_damaged else _WHOLE
        touched = share * _density(self.off, np.hypot(self.sigma, spread))
        untouched = (1 - share) * _density(self.off, self.sigma)
        return max(touched / max(touched + untouched, 1e-300) - share, 0.0)


def unlike_others(size_ratio: float, turn_rad: float | None) -> Reason:
    """Why a mark is weak that has another size than the others, and another turn where the frame holds that."""
    larger = f"{size_ratio:.2f} times as large as the other marks"
    if turn_rad is None:
        figure = f"it is {larger}"
    else:
        figure = f"its edges make it {larger}, and turned by {np.degrees(turn_rad):.1f} degrees"
    return Reason(f"{figure}: something may cover or touch it", Code.SIZE, Code.COVERED)


def unlike_blur(ratio: float) -> Reason:
    """Why a mark is weak that has another blur than the others."""
    return Reason(f"its blur is {ratio:.2f} times that of the other marks", Code.BLUR)


def _density(off: Array, sigma: Array) -> float:
    """Of independent normal deviations."""
    return float(np.prod(np.exp(-0.5 * (off / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)))


@dataclass(frozen=True)
class Touch:
    """What may touch a mark: with which probability, and how far, px, it has then moved it: a normal distribution."""

    probability: float
    moved_px: float
    sigma_px: float

    @property
    def variance_px2(self) -> float:
        """Of a coordinate, whichever way it was moved."""
        return self.probability * (self.moved_px**2 + self.sigma_px**2) / 2

    def exceedance(self, px: float) -> float:
        """The probability that it was moved farther."""
        ends = (np.array([self.moved_px, -self.moved_px]) - px) / max(self.sigma_px, 1e-12)
        return self.probability * float(ndtr(ends).sum())


def touch_of_round(shape: SharedShape, radius_px: float, px_per_mm: float, is_damaged: bool) -> Touch:
    """Of a round mark, by its size."""
    spread = _SPECK_MM2 * px_per_mm**2 / radius_px**2
    prior, measured = spread**2, float(shape.sigma[0]) ** 2
    moved = _AS_MUCH * radius_px * abs(float(shape.off[0])) * prior / (prior + measured)
    sigma = _AS_MUCH * radius_px * float(np.sqrt(prior * measured / (prior + measured)))
    return Touch(shape.touched(spread, is_damaged), moved, sigma)


def touch_of_edges(shape: SharedShape, on_place: Array, middle_px: float, is_damaged: bool) -> Touch:
    """Of a wedge or a notch, whose place follows its own rotation and scale by on_place (2, k); middle_px: how far its
    edges are from its point, on average."""
    return Touch(shape.touched(_TOUCHED_PX / middle_px, is_damaged), float(np.hypot(*(on_place @ shape.off))), 0.0)


def shared_shapes(own: Array, sigma: Array) -> list[SharedShape | None]:
    """Compare the shapes of marks that are drawn alike, or are all held by the frame.

    Parameters
    ----------
    own, sigma : (n, k) of each mark the logarithm of its size, and where the frame held it its rotation (rad), with
        their standard deviations, inf where a mark does not tell it.

    Returns
    -------
    Each mark's shape beside that of the others, None where these are too few.
    """
    columns = [_expect_from_sound(*pair) for pair in zip(own.T, sigma.T, strict=True)]
    result: list[SharedShape | None] = []
    for figures, sigmas, each in zip(own, sigma, zip(*columns, strict=True), strict=True):
        expected = [one for one in each if one is not None]
        if len(expected) < len(figures):
            result.append(None)
            continue
        off = figures - [one.value for one in expected]
        off_sigma = np.hypot(sigmas, [one.sigma for one in expected])
        result.append(SharedShape(off, off_sigma, any(one.differs for one in expected)))
    return result


def _expect_from_sound(own: Array, sigma: Array) -> "list[_Expected | None]":
    """For each mark what the others let expect of one figure of its shape: those alone that do not differ themselves,
    where these are enough."""
    every = _expect_from_others(own, sigma, size_spread, _FEWEST_SHAPES)
    odd = np.array([each is not None and each.differs for each in every])
    sound = _expect_from_others(own, np.where(odd, np.inf, sigma), size_spread, _FEWEST_SHAPES)
    return [first if is_odd else again or first for first, again, is_odd in zip(every, sound, odd, strict=True)]


def blur_spread(shown: float, marks: int) -> float:
    """By which blurs differ, where so many of them show a variance beyond their own."""
    return float(np.hypot(np.sqrt(shown), _BLUR_SPREAD))


def size_spread(shown: float, marks: int) -> float:
    """By which sizes and turns differ, where so many of them show a variance beyond their own."""
    return float(np.sqrt((_BEFORE * _SIZE_SPREAD**2 + (marks - 1) * shown) / (_BEFORE + marks - 1)))


def _log_total_px(blur_px: float) -> float:
    """The logarithm of a blur with the pixel's share."""
    return float(np.log(blur_px**2 + PIXEL_VARIANCE_PX2) / 2)


def _remove_pixel(log_seen_px: float) -> float:
    return float(np.sqrt(max(np.exp(2 * log_seen_px) - PIXEL_VARIANCE_PX2, 0.0)))


@dataclass(frozen=True)
class _Expected:
    """value: what the others let expect, and sigma, its standard deviation for one more mark. differs: whether the
    mark's own figure is another, by more than chance."""

    value: float
    sigma: float
    differs: bool


def _expect_from_others(own: Array, sigma: Array, spread: _Spread, fewest: int) -> "list[_Expected | None]":
    """For each mark what the others let expect, None where they are fewer than so many.

    own, sigma (n,): each mark's figure and its standard deviation, infinite where it has none.
    """
    result: list[_Expected | None] = []
    for index in range(len(own)):
        others = np.isfinite(sigma) & (np.arange(len(own)) != index)
        if others.sum() < fewest:
            result.append(None)
            continue
        mean, mean_sigma, apart = mean_of_unlike(own[others], sigma[others], spread)
        predicted = float(np.hypot(mean_sigma, apart))
        off = abs(own[index] - mean) / np.hypot(predicted, sigma[index])
        result.append(_Expected(mean, predicted, bool(2 * ndtr(-off) * len(own) < MARK_UNLIKE_THE_OTHERS)))
    return result


def mean_of_unlike(values: Array, sigma: Array, spread: _Spread) -> tuple[float, float, float]:
    """The weighted mean of values that differ by more than their standard deviations, its own standard deviation, and
    by how much more: by the moments of what they leave (DerSimonian and Laird, 1986)."""
    weights = 1 / sigma**2
    rest = values - weights @ values / weights.sum()
    exceedance = weights @ rest**2 - (len(values) - 1)
    between = max(exceedance / (weights.sum() - (weights**2).sum() / weights.sum()), 0.0)
    apart = spread(float(between), len(values))
    weights = 1 / (sigma**2 + apart**2)
    return float(weights @ values / weights.sum()), float(1 / np.sqrt(weights.sum())), apart

"""Lossy compression: how coarsely a file rounds or was rounded before, and what that takes from a mark's place.

JPEG rounds the cosine coefficients of every 8 x 8 pixels to multiples of a step, each its own (ITU-T T.81): its tables
stand in the file (B.2.4.1). A TIFF or PNG file made of a JPEG keeps the coefficients so, to some tenths of a grey
value: with blocks begun where those of the JPEG began, and with no others, they lie on a comb. (The principle:
Neelamani et al., "JPEG compression history estimation for color images", IEEE Trans. Image Processing 15, 2006.)

The fine detail goes, a mark's edges and the grain alike. Residuals show most of it, so that a standard deviation from
them is right, where the mark's contrast is many of the file's rounding steps; what faint marks lose of their edges they
do not show. Nor that the two sides of an edge are more alike in grey values than a tone curve leaves them, for rounding
knows of no light: that is common to a scanner's marks, and does not average. The grain that is left is of the
compression's own making, and no weights are taken from it.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.special import ndtri, stdtrit

from measure.flags import JPEG_GRID, JPEG_STEP

Array = NDArray[np.float64]

BLOCK_PX = 8  # a side of a block (ITU-T T.81)
_PERIODS = 5  # coefficients (u, v) with 0 < u + v below it: up to two periods in a block, as blurred edges have them
_STEPS_DN = np.arange(2, 51)  # a step of 1 takes nothing away; 50 is that of quality 15
_BIN_DN = 0.25  # of coefficients: a tenth of the coarser steps
_LARGEST_DN = 150.0  # of a coefficient that is looked at: three times the largest step
_LOST_PX = 0.25  # times the square of step over contrast: rms of what residuals do not show (benchmarks/marks.py)
_TONE_LOST = 3.5  # times step over contrast, of what is not known of any curve (benchmarks/tone_said.py)
_MOST_LOST_PX = 1.0  # where the contrast is hardly two steps, there is nothing left to measure


def earlier_step_dn(grey: NDArray[np.floating]) -> float:
    """The mean step, in grey values, to which the coarser detail was rounded; 0 where nothing shows that it was.

    grey: (height, width), a part of the picture in grey values of 8 bits, neither resampled nor stretched since.
    """
    if min(grey.shape) < 2 * BLOCK_PX:
        return 0.0
    combs = _combs(_coefficients(grey))
    strength = combs.max(axis=2).sum(axis=1)
    best = int(strength.argmax())
    clearness, steps = combs[best].max(axis=1), _STEPS_DN[combs[best].argmax(axis=1)]
    if clearness.max() < _limit(JPEG_GRID, combs.size) or not _stands_out(strength[best], np.delete(strength, best)):
        return 0.0
    return float(steps[clearness > _limit(JPEG_STEP, len(_STEPS_DN))].mean())


def _coefficients(grey: NDArray[np.floating]) -> Array:
    """(places, blocks, coefficients): the coarser cosine coefficients of all blocks, for each of the 64 places where
    the first of them may begin."""
    waves = dct(np.eye(BLOCK_PX), axis=0, norm="ortho")[:_PERIODS]
    down = np.lib.stride_tricks.sliding_window_view(grey, BLOCK_PX, axis=0) @ waves.T
    both = np.lib.stride_tricks.sliding_window_view(down, BLOCK_PX, axis=1) @ waves.T
    periods = np.add.outer(range(_PERIODS), range(_PERIODS))
    coarse = both[..., (periods > 0) & (periods < _PERIODS)]  # no means: ground of one grey value is a comb of its own
    tall, wide = (side // BLOCK_PX for side in coarse.shape[:2])
    blocks = coarse[: tall * BLOCK_PX, : wide * BLOCK_PX].reshape(tall, BLOCK_PX, wide, BLOCK_PX, -1)
    return blocks.transpose(1, 3, 0, 2, 4).reshape(BLOCK_PX**2, tall * wide, -1)


def _combs(coefficients: Array) -> Array:
    """(places, coefficients, steps): how plainly they are multiples of each step, in standard deviations of chance.

    Coefficients below half a step count for nothing. Chance lays the others anywhere between two multiples, so that the
    cosine over the step is 0 in the mean, or below it: there are more small ones than large ones.
    """
    size = np.abs(coefficients)
    places, _, kinds = size.shape
    bins = int(_LARGEST_DN / _BIN_DN) + 1
    row = np.arange(places)[:, None, None] * kinds + np.arange(kinds)
    bin_of = np.minimum(np.rint(size / _BIN_DN), bins).astype(np.intp)  # the last bin holds what is too large
    counts = np.bincount((row * (bins + 1) + bin_of).ravel(), minlength=places * kinds * (bins + 1))
    counts = counts.reshape(places * kinds, bins + 1)[:, :bins].astype(float)
    centres = np.arange(bins)[:, None] * _BIN_DN
    counted = centres > _STEPS_DN / 2
    phases = np.cos(2 * np.pi * centres / _STEPS_DN) * counted
    clearness: Array = np.sqrt(2) * (counts @ phases) / np.sqrt(np.maximum(counts @ counted, 1))
    return clearness.reshape(places, kinds, -1)


def _limit(chance: float, looks: int) -> float:
    """The clearness that one of so many looks at no comb exceeds with that chance."""
    return -float(ndtri(chance / looks))


def _stands_out(strength: float, others: Array) -> bool:
    """Whether one of the places differs from all others as chance does not make it (Student's t)."""
    spread = others.std(ddof=1) * np.sqrt(1 + 1 / len(others))
    limit = -stdtrit(len(others) - 1, JPEG_GRID / (len(others) + 1))
    return bool(strength - others.mean() > limit * spread)


def covariance_of_compression(rounding_step_dn: float, contrast_dn: float) -> Array:
    """(2, 2) px2: what a scan's compression adds to the covariance of a mark of that contrast."""
    lost = min(_LOST_PX * (rounding_step_dn / max(abs(contrast_dn), 1e-9)) ** 2, _MOST_LOST_PX)
    return np.asarray(lost**2 * np.eye(2))


def tone_variance(rounding_step_dn: float, contrast_dn: float) -> float:
    """By how much a scan's compression makes a mark of that contrast speak of another tone curve than the scanner's:
    of each departure, in squares of what is not known of any curve; alike in all marks of a scanner."""
    return (_TONE_LOST * rounding_step_dn / max(abs(contrast_dn), 1e-9)) ** 2

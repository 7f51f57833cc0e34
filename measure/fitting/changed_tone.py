"""What a chip's place is uncertain by where its tones may have changed since it was learned.

An edge between dark and light is a slope of grey values. Light that is stronger than in the pictures that a chip was
learned from climbs that slope elsewhere: the film saturates, or what glows beside it does not grow as it does. Its half
tones then are lighter or darker between the same ends, and where all edges face one side that is a shift and leaves
next to nothing else.
"""

import numpy as np
from numpy.typing import NDArray

from measure.noise.pixel_sums import products

Array = NDArray[np.float64]

# Of the contrast and the logarithm of its change, how much half tones are off: anything between nothing and what a glow
# makes that stays as it is while the light changes, which is a half.
_BENT = 0.5 / np.sqrt(3)
_MOST = 1.0  # of that logarithm: more is another scanner's scale


def covariance_of_changed_tone(half_tones: Array, by_grey: Array, contrast_change: float) -> Array:
    """(2, 2) px2 of a place, for what the tones may have changed.

    half_tones (height, width): grey values, the picture's contrast in the middle between dark and light, none at both
    ends; by_grey (unknowns, height, width): the unknowns' derivatives by the grey values, column and row first.
    contrast_change: the contrast over that of the pictures that the chip was learned from.
    """
    bent = _BENT * min(abs(float(np.log(contrast_change))), _MOST)
    moved = bent * products(by_grey[:2], half_tones[None])
    return np.asarray(moved @ moved.T)

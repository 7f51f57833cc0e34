"""What a place is uncertain by that its residuals do not show: light that is uneven in the mark, tones that changed.

A notch is cut into the frame's border and exposed as the frame is: its light is no more even than the terrain.
A slope of that light is a shift of the edges where it ends, and leaves little else in a small notch. How uneven it may
be, the frame beside the notch shows.

An edge between dark and light is a slope of grey values. Light that is stronger than in the pictures that a chip was
learned from climbs that slope elsewhere: the film saturates, or what glows beside it does not grow as it does. Its half
tones then are lighter or darker between the same ends, and where all edges face one side that is a shift and leaves
next to nothing else.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.noise.noise import NoiseModel, autocovariance, correlated
from measure.noise.pixel_sums import products

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_PX = 400  # of the frame beside the notch: fewer do not tell how uneven it is
# Of the contrast and the logarithm of its change, how much half tones are off: anything between nothing and what a glow
# makes that stays as it is while the light changes, which is a half.
_BENT = 0.5 / np.sqrt(3)
_MOST = 1.0  # of that logarithm: more is another scanner's scale


def covariance_of_landscape(light: Array, beside: Mask, moved: Array) -> Array:
    """(n, n) of figures, column and row of a place for example, for a landscape in the mark that varies as beside it.

    light (height, width): grey values, and beside, alike, which of them show the frame; moved (n, height, width) of the
    mark's window: derivatives of the figures by the grey values, as much of them as its light has part in.
    """
    if beside.sum() < _LEAST_PX:
        return np.zeros((len(moved),) * 2)
    reach = max(moved.shape[1:])
    lags = autocovariance(np.where(beside, light - light[beside].mean(), 0.0), beside, reach)
    # The noise of single pixels counts already; what neighbours have in common is the landscape.
    lags[reach, reach] = max(lags[reach, reach + 1], 0.0)
    landscape = NoiseModel(float(lags[reach, reach]), lags, 1.0)
    covariance = products(moved, correlated(moved, landscape))
    sizes, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    return np.asarray((axes * np.maximum(sizes, 0.0)) @ axes.T)  # far lags are chance, and may leave less than nothing


@dataclass(frozen=True, eq=False)
class Landscape:
    """Where a mark shows one. light, beside: as `covariance_of_landscape` takes them; share (height, width): of it in
    the light of the mark's window."""

    light: Array
    beside: Mask
    share: Array

    def covariance(self, by_grey: Array) -> Array:
        """(n, n) of figures whose derivatives by the grey values are by_grey (n, height, width)."""
        return covariance_of_landscape(self.light, self.beside, by_grey * self.share)


def covariance_of_changed_tone(half_tones: Array, by_grey: Array, contrast_change: float) -> Array:
    """(2, 2) px2 of a place, for what the tones may have changed.

    half_tones (height, width): grey values, the picture's contrast in the middle between dark and light, none at both
    ends; by_grey (unknowns, height, width): the unknowns' derivatives by the grey values, column and row first.
    contrast_change: the contrast over that of the pictures that the chip was learned from.
    """
    bent = _BENT * min(abs(float(np.log(contrast_change))), _MOST)
    moved = bent * products(by_grey[:2], half_tones[None])
    return np.asarray(moved @ moved.T)

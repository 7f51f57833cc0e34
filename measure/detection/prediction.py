"""Where in a scan a mark is expected, and how it is expected to look there."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from measure.detection.correlation import WIDE, Surroundings
from measure.marks.shapes import Mark

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MarkPrediction:
    """pixel_from_mark: (2, 3), its last column the predicted place. search_px: the radius about it within which the
    mark is looked for. polarity: +1 for a mark lighter than its surroundings, -1 for a darker one. weights: of the
    scan's channels, None for its own. surroundings: what about the mark counts where it is looked for."""

    mark: Mark
    pixel_from_mark: Array
    search_px: float
    polarity: int
    weights: Sequence[float] | None = None
    surroundings: Surroundings = WIDE

    @property
    def linear(self) -> Array:
        """(2, 2) px per mm."""
        return self.pixel_from_mark[:, :2]

    @property
    def center_px(self) -> Array:
        """(2,) predicted."""
        return self.pixel_from_mark[:, 2]

    def moved(self, center_px: Array) -> Self:
        """The same at another place."""
        return replace(self, pixel_from_mark=np.column_stack([self.linear, center_px]))

"""A part of a scan that one thread looks at: its grey values at full resolution and reduced, with a margin about it."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.radiometry import Samples
from measure.scan import Scan, means, weighted

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Block:
    """col0, row0: the scan's place of its first pixel; samples (height, width, channels), margin_px of them on every
    side being the neighbours', or repeating the scan's edge."""

    scan: Scan
    col0: int
    row0: int
    margin_px: int
    samples: Samples

    @property
    def place_px(self) -> tuple[int, int]:
        """Column and row of the scan where it begins, its margin included."""
        return self.col0, self.row0

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height, its margin included."""
        return self.samples.shape[1], self.samples.shape[0]

    def windows(self, corners: NDArray[np.int64], side: int, every: int = 1) -> Image:
        """(n, side, side) grey values from columns and rows (n, 2) of the scan on, all of them in the block, or every
        so many of their columns and rows."""
        firsts = (corners - self.place_px).tolist()
        cut = [self.samples[top : top + side : every, left : left + side : every] for left, top in firsts]
        return weighted(np.stack(cut), self.scan.weights)

    def reductions(self, factors: Iterable[int]) -> dict[int, Image]:
        """Its grey values area-averaged by each factor, from the coarsest of the others that divides it; each
        halving of stored samples is right to half a grey value."""
        known: dict[int, Image] = {}
        for factor in sorted(factors):
            finer = [other for other in known if factor % other == 0]
            if finer:
                known[factor] = means(known[finer[-1]][..., None], factor // finer[-1])[..., 0]
            else:
                known[factor] = weighted(nearly_means(self.samples, factor), self.scan.weights)
        return known


def nearly_means(samples: Samples, factor: int) -> Image:
    """(height / factor, width / factor, channels) means over squares, by an even factor from means of four rounded to
    whole grey values, again and again: in a quarter of the time, and a grey value is no matter in a search."""
    while factor % 2 == 0:
        height, width, channels = samples.shape
        half = cv2.resize(samples, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        samples = half.astype(samples.dtype, copy=False).reshape(height // 2, width // 2, channels)
        factor //= 2
    return means(samples, factor)

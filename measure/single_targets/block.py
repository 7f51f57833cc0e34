"""A part of a scan that one thread looks at: its grey values at full resolution and reduced, with a margin about it."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.scans.radiometry import Samples
from measure.scans.scan import Scan, means, weighted

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Image = NDArray[np.float32]

Record = TypeVar("Record", bound="DataclassInstance")


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

    def holds(self, places: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which columns and rows, places (n, 2, count), of the scan are not beyond its edge and in the block."""
        first = np.maximum(self.place_px, 0)
        end = np.minimum(np.add(self.place_px, self.size_px), (self.scan.width_px, self.scan.height_px))
        return np.asarray((places >= first[:, None]) & (places < end[:, None]))

    def grey_at(self, corners: NDArray[np.intp], col: NDArray[np.intp], row: NDArray[np.intp]) -> Image:
        """(n, count) grey values at columns and rows (n, count) from places corners (n, 2) of the scan on; beyond the
        block any of its values."""
        width, height = self.size_px
        at = row * width + col
        at += (corners - self.place_px) @ np.array([[1], [width]])
        return weighted(self.samples.reshape(width * height, -1).take(at, axis=0, mode="clip"), self.scan.weights)

    def reductions(self, factors: Iterable[int]) -> dict[int, Image]:
        """Its grey values area-averaged by each factor, from the coarsest of the others that divides it; each
        halving of stored samples is right to half a grey value."""
        known: dict[int, Image] = {}
        for factor in sorted(factors):
            finer = [other for other in known if factor % other == 0]
            if finer:
                known[factor] = means(known[finer[-1]][..., None], factor // finer[-1])[..., 0]
            else:
                known[factor] = weighted(_nearly_means(self.samples, factor), self.scan.weights)
        return known


def _nearly_means(samples: Samples, factor: int) -> Samples | Image:
    """(height / factor, width / factor, channels) means over squares, by an even factor from means of four rounded to
    whole grey values, again and again: in a quarter of the time, and a grey value is no matter in a search."""
    while factor % 2 == 0:
        height, width, channels = samples.shape
        half = cv2.resize(samples, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        samples = half.astype(samples.dtype, copy=False).reshape(height // 2, width // 2, channels)
        factor //= 2
    return samples if factor == 1 else means(samples, factor)


def joined(first: Record, *others: Record) -> Record:
    """One record of what several of a kind hold."""
    names = [field.name for field in fields(first)]
    return type(first)(*(np.concatenate([getattr(record, name) for record in (first, *others)]) for name in names))

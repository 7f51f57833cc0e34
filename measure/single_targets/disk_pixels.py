"""The pixels of many disks as lists of one length, so that all disks are adjusted in one go, whatever their sizes."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from measure.single_targets.block import Block

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_TOGETHER_PIXELS = 1 << 16  # of all disks: with their derivatives they take some 10 MiB
_TOGETHER_CELLS = 1 << 18  # of the windows in which these lie
_LENGTHS_STEP = 2.0  # longest over shortest list among them


@dataclass(frozen=True, eq=False)
class DiskPixels:
    """Of n disks, each in every (n,) so many columns and rows, in windows of side x side of these that begin at columns
    and rows of the scan corners (n, 2): numbers (n, pixels) of the pixels by rows; used (n, pixels): those that only
    fill a list up are not, and have the number of the last pixel. The last column and row of a window are never used.
    """

    corners: Indices
    every: Indices
    side: int
    numbers: Indices
    used: Mask

    def part(self, chosen: Mask) -> "DiskPixels":
        of_disks = self.corners[chosen], self.every[chosen]
        return DiskPixels(*of_disks, self.side, self.numbers[chosen], self.used[chosen])

    @cached_property
    def places(self) -> tuple[Indices, Indices]:
        """Columns and rows (n, pixels) from the corners on."""
        row = self.numbers // self.side
        return (self.numbers - row * self.side) * self.every[:, None], row * self.every[:, None]

    def grey(self, block: Block) -> Image:
        """(n, pixels)"""
        return block.grey_at(self.corners, *self.places)

    def correlation(self, residuals: Image) -> Array:
        """(n,) of residuals (n, pixels) with those beside and below."""
        left = residuals * self.used
        cells = self.side**2
        at = self.numbers + cells * np.arange(len(left))[:, None]
        window = np.zeros(len(left) * cells, np.float32)
        window[at] = left
        beside = window.take(at + 1, mode="clip") + window.take(at + self.side, mode="clip")
        return np.asarray((left * beside).sum(axis=1) / np.maximum(2 * (left * left).sum(axis=1), 1e-6), float)


@dataclass(frozen=True, eq=False)
class Areas:
    """Of n disks: places (n, 2) of their middles in the scan; ellipses, by their half axes, axes (n, 2), the longer
    one last, and directions (n, 2, 2); every (n,) so many columns and rows are used."""

    places: Array
    axes: Array
    directions: Array
    every: Indices

    @classmethod
    def about(cls, places: Array, shapes: Array, margin_px: Array, every: Indices) -> "Areas":
        """Of ellipses of shapes (n, 2, 2) and the ground beside them, margin_px (n,) wide."""
        squares, directions = np.linalg.eigh(shapes @ shapes.swapaxes(1, 2))
        return cls(places, np.sqrt(np.maximum(squares, 0.0)) + margin_px[:, None], directions, every)

    def part(self, chosen: Indices) -> "Areas":
        return Areas(self.places[chosen], self.axes[chosen], self.directions[chosen], self.every[chosen])

    def alike(self) -> Iterator[Indices]:
        """Numbers of those that hold about as many pixels, and that are so few that these are not too many."""
        pixels = np.pi * self.axes.prod(axis=1) / self.every**2
        rest = np.argsort(-pixels, kind="stable")
        while len(rest):
            most = pixels[rest[0]]
            first = rest[: max(int(_TOGETHER_PIXELS / most), 1)]
            cells = np.arange(len(first)) * (2 * np.maximum.accumulate(self._half[first]) + 2) ** 2
            chosen = first[(cells < _TOGETHER_CELLS) & (pixels[first] * _LENGTHS_STEP >= most)]
            yield chosen
            rest = rest[len(chosen) :]

    @property
    def _half(self) -> Indices:
        """(n,) used columns on either side of the middle one."""
        return np.asarray(np.ceil((self.axes[:, 1] + 0.5) / self.every), np.intp)

    def pixels(self, block: Block) -> DiskPixels:
        """Those of them that are the scan's, and the block's."""
        half = int(self._half.max())
        corners = np.rint(self.places).astype(np.intp) - half * self.every[:, None]
        along = self.every[:, None] * np.arange(2 * half + 2)
        off = (along[:, None] - (self.places - corners)[..., None]).astype(np.float32)
        inside = block.holds(corners[..., None] + along[:, None])
        held = self._hold(off[:, 0, None], off[:, 1, :, None]) & (inside[:, 0, None] & inside[:, 1, :, None])
        held = held.reshape(len(held), -1)
        counts, cells = np.count_nonzero(held, axis=1), held.shape[1]
        used = np.arange(max(counts.max(), 1)) < counts[:, None]
        numbers = np.full(used.shape, cells - 1)
        numbers[used] = np.flatnonzero(held) - np.repeat(cells * np.arange(len(held)), counts)
        return DiskPixels(corners, self.every, along.shape[1], numbers, used)

    def _hold(self, col: Image, row: Image) -> Mask:
        """Which places, px from the middles, lie within the ellipses."""
        forms = (self.directions / self.axes[:, None] ** 2) @ self.directions.swapaxes(1, 2)
        by_col, by_both, by_row = (
            forms[:, i, j].astype(np.float32)[:, None, None] for i, j in ((0, 0), (0, 1), (1, 1))
        )
        return np.asarray((by_col * col + 2 * by_both * row) * col + by_row * row * row <= 1)

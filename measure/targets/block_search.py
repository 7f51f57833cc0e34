"""Detection in blocks: a scan in parts that one thread takes each, at full resolution and reduced, and the candidates
found there."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import product
from math import lcm
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.scans.metadata import Samples
from measure.scans.parallel import map_in_threads
from measure.scans.scan import Scan, means, weighted

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Image = NDArray[np.float32]

Record = TypeVar("Record", bound="DataclassInstance")
Array = NDArray[np.float64]

ROW_BYTES, BLOCK_BYTES = 1 << 14, 1 << 24  # of a block at most, but that strips are taken whole: a margin comes on top


@dataclass(frozen=True, eq=False)
class Block:
    """place_px: column and row of the scan of its first pixel; samples (height, width, channels), margin_px of them on
    every side being the neighbours', or repeating the scan's edge."""

    scan: Scan
    place_px: tuple[int, int]
    margin_px: int
    samples: Samples

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height, its margin included."""
        return self.samples.shape[1], self.samples.shape[0]

    def holds(self, places: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which columns and rows, places (n, 2, count), of the scan are not beyond its edge and in the block."""
        first = np.maximum(self.place_px, 0)
        end = np.minimum(np.add(self.place_px, self.size_px), (self.scan.width_px, self.scan.height_px))
        return np.asarray((places >= first[:, None]) & (places < end[:, None]))

    def grey_values(self, corners: NDArray[np.intp], col: NDArray[np.intp], row: NDArray[np.intp]) -> Image:
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


def concatenate(first: Record, *others: Record) -> Record:
    """One record of what several of a kind hold."""
    names = [field.name for field in fields(first)]
    return type(first)(*(np.concatenate([getattr(record, name) for record in (first, *others)]) for name in names))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A patch that may be a disk: center_px (2,), pixel_from_disk (2, 2), contrast_dn: positive where it is light."""

    center_px: Array
    pixel_from_disk: Array
    contrast_dn: float

    @property
    def radius_px(self) -> float:
        """Of the circle of the same area."""
        (a, b), (c, d) = self.pixel_from_disk.tolist()
        return math.sqrt(abs(a * d - b * c))


@dataclass(frozen=True, eq=False)
class Patches:
    """Of n candidates: centers (n, 2) px, shapes (n, 2, 2) as their pixel_from_disk, contrasts (n,)."""

    centers: Array
    shapes: Array
    contrasts: Array

    @classmethod
    def collect(cls, candidates: Sequence[Candidate]) -> "Patches":
        return cls(
            np.array([each.center_px for each in candidates]).reshape(-1, 2),
            np.array([each.pixel_from_disk for each in candidates]).reshape(-1, 2, 2),
            np.array([each.contrast_dn for each in candidates], float),
        )

    def candidates(self) -> list[Candidate]:
        return [*map(Candidate, self.centers, self.shapes, self.contrasts.tolist())]

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "Patches":
        return Patches(self.centers[chosen], self.shapes[chosen], self.contrasts[chosen])

    @property
    def radii(self) -> Array:
        """(n,) of the circles of the same area."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.shapes))))

    def strongest_first(self) -> "Patches":
        """The strongest first, whatever the order in which they were found."""
        return self.part(np.lexsort((*self.centers.T[::-1], -np.abs(self.contrasts))))


Confirmed = Callable[[Block, Patches], Patches]


@dataclass(frozen=True)
class Octave:
    """What is looked for in one reduction of the scan, by factor. margin: reduced px about a part that is looked at;
    widest_px: of the scan, that a part may be at most; find: the patches in a reduced picture, in its pixels, within
    its margin."""

    factor: int
    margin: int
    widest_px: int
    find: Callable[[Image], Patches]

    @property
    def margin_px(self) -> int:
        return self.margin * self.factor


def search_blocks(scan: Scan, octaves: Sequence[Octave], confirmed: Confirmed | None = None) -> list[Candidate]:
    """The patches of all octaves in pixels of the scan, the strongest first, none within another.

    confirmed: which of them are right, and where exactly, asked while the block about them is still decoded.
    """
    unit = lcm(*(octave.factor for octave in octaves))
    margin = _whole(max(octave.margin_px for octave in octaves), unit)
    width, height = _block_px(scan, unit, margin)

    rows, cols = height + 2 * margin, width + 2 * margin
    spare: list[Samples] = []  # new memory for every block would take longer than what is done in it

    def block_patches(corner: tuple[int, int]) -> Patches:
        row0, col0 = (place - margin for place in corner)
        memory = spare.pop() if spare else np.empty((rows, cols, scan.channels), scan.samples_dtype)
        block = Block(scan, (col0, row0), margin, scan.samples(col0, row0, cols, rows, memory))
        found = _separate(concatenate(Patches.collect(()), *_octave_patches(block, octaves)))
        found = confirmed(block, found) if confirmed else found
        spare.append(memory)
        return found

    corners = product(range(0, scan.height_px, height), range(0, scan.width_px, width))
    return _separate(concatenate(*map_in_threads(block_patches, corners))).candidates()


def _block_px(scan: Scan, unit: int, margin: int) -> tuple[int, int]:
    """Width and height of blocks, in whole units. What all threads have in work stays decoded, so that neighbours
    decode no more than their share; strips are taken whole."""
    tall, wide = scan.segment_px
    pixel = scan.channels * np.dtype(scan.samples_dtype).itemsize
    width = scan.width_px if wide >= scan.width_px else _even_part(scan.width_px, ROW_BYTES // pixel, unit)
    tallest = max(BLOCK_BYTES // (width * pixel), 1)
    if tall < scan.height_px:  # else all is decoded at once, and held
        kept = (scan.rows_kept * scan.width_px // width - tall) // max(cv2.getNumThreads(), 1) - 2 * margin
        tallest = min(max(kept, 2 * margin), tallest)
    return width, _even_part(scan.height_px, tallest, unit)


def _even_part(size: int, most: int, unit: int) -> int:
    """Of parts of one size, in whole units, that are hardly longer than most."""
    return _whole(-(-size // -(-size // most)), unit)


def _whole(size: int, unit: int) -> int:
    return -(-size // unit) * unit


def _octave_patches(block: Block, octaves: Sequence[Octave]) -> Iterator[Patches]:
    """Those that lie in the block, in pixels of the scan."""
    reductions = block.reductions({octave.factor for octave in octaves})
    width, height = (size - 2 * block.margin_px for size in block.size_px)
    for octave in octaves:
        factor, small = octave.factor, reductions[octave.factor]
        margin, spare = octave.margin, block.margin_px // factor - octave.margin
        rows = slice(spare, spare + height // factor + 2 * margin)
        part = _even_part(width, octave.widest_px, factor) // factor
        for col0 in range(0, width // factor, part):
            first, last = spare + col0, spare + min(col0 + part, width // factor) + 2 * margin
            place = np.array(block.place_px) + factor * np.array([first, spare]) + (factor - 1) / 2
            found = octave.find(small[rows, first:last])
            found = Patches(found.centers * factor + place, found.shapes * factor, found.contrasts)
            edge = np.array([block.scan.width_px, block.scan.height_px]) - 0.5
            yield found.part(np.all(found.centers < edge, axis=1))


def _separate(found: Patches) -> Patches:
    """The strongest of candidates that lie within one another, the strongest first."""
    found = found.strongest_first()
    kept: set[int] = set()
    for index, near in enumerate(cKDTree(found.centers).query_ball_point(found.centers, 0.7 * found.radii)):
        if kept.isdisjoint(near):
            kept.add(index)
    return found.part(np.array(sorted(kept), np.intp))

"""Detection in blocks: each thread searches one part of the scan, at full resolution and reduced."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from math import lcm
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.array_types import Array, Single
from measure.geometry import linear_scale, scan_px
from measure.matching.window import ClippedEnds, clipped_ends
from measure.scans.metadata import Samples
from measure.scans.parallel import map_in_threads
from measure.scans.scan import Scan, means, weighted

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


Record = TypeVar("Record", bound="DataclassInstance")

_WIDEST_PX = 1536  # width of a part that is searched with one level of texture and noise
ROW_BYTES, BLOCK_BYTES = 1 << 14, 1 << 24  # largest block, without its margin; strips are not divided


@dataclass(frozen=True, eq=False)
class ScanBlock:
    """Part of a scan. place_px: column and row of its first pixel; samples (height, width, channels), with a border of
    margin_px that belongs to the neighbours or repeats the scan's edge."""

    scan: Scan
    place_px: tuple[int, int]
    margin_px: int
    samples: Samples

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height, margin included."""
        return self.samples.shape[1], self.samples.shape[0]

    def holds(self, places: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Mask of the columns and rows, places (n, 2, count), that lie within the scan and the block."""
        first = np.maximum(self.place_px, 0)
        end = np.minimum(np.add(self.place_px, self.size_px), (self.scan.width_px, self.scan.height_px))
        return np.asarray((places >= first[:, None]) & (places < end[:, None]))

    def grey_values(self, corners: NDArray[np.intp], col: NDArray[np.intp], row: NDArray[np.intp]) -> Single:
        """(n, count) grey values at columns and rows (n, count) counted from corners (n, 2) in the scan; arbitrary ones
        outside the block."""
        pixels = self.samples.reshape(-1, self.samples.shape[2])
        at = self._index(corners, col, row)
        return weighted(pixels.take(at, axis=0, mode="clip"), self.scan.weights)

    def clipped_ends(self, corners: NDArray[np.intp], col: NDArray[np.intp], row: NDArray[np.intp]) -> ClippedEnds:
        """(n, count) ends of the scanner's range at which the grey values of these pixels are clipped."""
        return self._sides.take(self._index(corners, col, row), mode="clip")

    @cached_property
    def _sides(self) -> ClippedEnds:
        return clipped_ends(self.samples, self.scan.full_scale_dn)

    def _index(self, corners: NDArray[np.intp], col: NDArray[np.intp], row: NDArray[np.intp]) -> NDArray[np.intp]:
        width, _ = self.size_px
        return np.asarray(row * width + col + (corners - self.place_px) @ np.array([[1], [width]]))

    def reductions(self, factors: Iterable[int]) -> dict[int, Single]:
        """Area averages of the grey values by each factor, computed from the coarsest finer one that divides it.

        Stored samples are halved as long as the factor is even, each time with rounded grey values: a quarter of the
        time, and exact enough for a search.
        """
        known: dict[int, Single] = {}
        for factor in sorted(factors):
            finer = [other for other in known if factor % other == 0]
            if finer:
                known[factor] = means(known[finer[-1]][..., None], factor // finer[-1])[..., 0]
                continue
            samples, left = self.samples, factor
            while left % 2 == 0:
                height, width, channels = samples.shape
                half = cv2.resize(samples, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
                samples = half.astype(samples.dtype, copy=False).reshape(height // 2, width // 2, channels)
                left //= 2
            known[factor] = weighted(samples if left == 1 else means(samples, left), self.scan.weights)
        return known


def concatenate(first: Record, *others: Record) -> Record:
    """Concatenate all arrays of records of one class."""
    names = [field.name for field in fields(first)]
    return type(first)(*(np.concatenate([getattr(record, name) for record in (first, *others)]) for name in names))


@dataclass(frozen=True, eq=False)
class TargetCandidate:
    """Candidate for a target: center_px (2,), pixel_from_disk (2, 2), contrast_dn: positive if light."""

    center_px: Array
    pixel_from_disk: Array
    contrast_dn: float

    @property
    def radius_px(self) -> float:
        """Radius of the circle of equal area."""
        return linear_scale(self.pixel_from_disk)


@dataclass(frozen=True, eq=False)
class Patches:
    """Arrays of n candidates: centers (n, 2) px, shapes (n, 2, 2): pixel_from_disk, contrasts (n,)."""

    centers: Array
    shapes: Array
    contrasts: Array

    @classmethod
    def collect(cls, candidates: Sequence[TargetCandidate]) -> "Patches":
        return cls(
            np.array([each.center_px for each in candidates]).reshape(-1, 2),
            np.array([each.pixel_from_disk for each in candidates]).reshape(-1, 2, 2),
            np.array([each.contrast_dn for each in candidates], float),
        )

    def candidates(self) -> list[TargetCandidate]:
        return [*map(TargetCandidate, self.centers, self.shapes, self.contrasts.tolist())]

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "Patches":
        return Patches(self.centers[chosen], self.shapes[chosen], self.contrasts[chosen])

    @property
    def radii(self) -> Array:
        """(n,) radii of the circles of equal area."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.shapes))))

    def strongest_first(self) -> "Patches":
        """Sort by contrast, the strongest first; ties by position, so that the order is reproducible."""
        return self.part(np.lexsort((*self.centers.T[::-1], -np.abs(self.contrasts))))


@dataclass(frozen=True)
class Octave:
    """Search in the scan reduced by a factor. margin: border of a part, reduced px; find: returns the patches of a
    reduced image within its margin, in its pixels."""

    factor: int
    margin: int
    find: Callable[[Single], Patches]


def search_blocks(
    scan: Scan, octaves: Sequence[Octave], test_patches: Callable[[ScanBlock, Patches], Patches] | None = None
) -> list[TargetCandidate]:
    """Search all octaves of a scan in one pass over its blocks.

    Parameters
    ----------
    test_patches : tests and fits the patches of a block while it is still decoded; None: all pass.

    Returns
    -------
    Candidates in pixels of the scan, the strongest first, none within another.
    """
    unit = lcm(*(octave.factor for octave in octaves))
    margin = _round_up(max(octave.margin * octave.factor for octave in octaves), unit)
    width, height = _block_px(scan, unit, margin)
    rows, cols = height + 2 * margin, width + 2 * margin
    spare: list[Samples] = []  # reused: allocating memory for every block would take longer than the search

    def block_patches(corner: tuple[int, int]) -> Patches:
        row0, col0 = (place - margin for place in corner)
        memory = spare.pop() if spare else np.empty((rows, cols, scan.channels), scan.samples_dtype)
        block = ScanBlock(scan, (col0, row0), margin, scan.samples(col0, row0, cols, rows, memory))
        found = _drop_overlapping(concatenate(Patches.collect(()), *_octave_patches(block, octaves)))
        found = test_patches(block, found) if test_patches else found
        spare.append(memory)
        return found

    corners = product(range(0, scan.height_px, height), range(0, scan.width_px, width))
    return _drop_overlapping(concatenate(*map_in_threads(block_patches, corners))).candidates()


def _block_px(scan: Scan, unit: int, margin: int) -> tuple[int, int]:
    """Width and height of blocks, multiples of unit. Sized so that the segments under work by all threads stay in the
    cache and none is decoded twice; strips are not divided."""
    tall, wide = scan.segment_px
    pixel = scan.channels * np.dtype(scan.samples_dtype).itemsize
    width = scan.width_px if wide >= scan.width_px else _part_size(scan.width_px, ROW_BYTES // pixel, unit)
    tallest = max(BLOCK_BYTES // (width * pixel), 1)
    if tall < scan.height_px:  # otherwise the scan is one segment, decoded once
        kept = (scan.rows_kept * scan.width_px // width - tall) // max(cv2.getNumThreads(), 1) - 2 * margin
        tallest = min(max(kept, 2 * margin), tallest)
    return width, _part_size(scan.height_px, tallest, unit)


def _part_size(size: int, most: int, unit: int) -> int:
    """Size of equal parts, a multiple of unit, not much above most."""
    return _round_up(-(-size // -(-size // most)), unit)


def _round_up(size: int, unit: int) -> int:
    return -(-size // unit) * unit


def _octave_patches(block: ScanBlock, octaves: Sequence[Octave]) -> Iterator[Patches]:
    """Patches within the block, in pixels of the scan."""
    reductions = block.reductions({octave.factor for octave in octaves})
    width, height = (size - 2 * block.margin_px for size in block.size_px)
    for octave in octaves:
        factor, small = octave.factor, reductions[octave.factor]
        margin, spare = octave.margin, block.margin_px // factor - octave.margin
        rows = slice(spare, spare + height // factor + 2 * margin)
        part = _part_size(width, _WIDEST_PX, factor) // factor
        for col0 in range(0, width // factor, part):
            first, last = spare + col0, spare + min(col0 + part, width // factor) + 2 * margin
            found = octave.find(small[rows, first:last])
            centers = block.place_px + scan_px(np.add(found.centers, (first, spare)), factor)
            found = Patches(centers, found.shapes * factor, found.contrasts)
            edge = np.array([block.scan.width_px, block.scan.height_px]) - 0.5
            yield found.part(np.all(found.centers < edge, axis=1))


def _drop_overlapping(found: Patches) -> Patches:
    """Keep the strongest of overlapping candidates, the strongest first."""
    found = found.strongest_first()
    kept: set[int] = set()
    for index, near in enumerate(cKDTree(found.centers).query_ball_point(found.centers, 0.7 * found.radii)):
        if kept.isdisjoint(near):
            kept.add(index)
    return found.part(np.array(sorted(kept), np.intp))

"""Patches found in the whole frame in one pass over it, its blocks looked at side by side in several reductions."""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from math import lcm
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.scans.parallel import side_by_side
from measure.scans.radiometry import Samples
from measure.scans.scan import Scan
from measure.single_targets.block import Block, joined
from measure.single_targets.disk_patches import Candidate, Patches

Array = NDArray[np.float64]
Image = NDArray[np.float32]

ROW_BYTES, BLOCK_BYTES = 1 << 14, 1 << 24  # of a block at most, but that strips are taken whole: a margin comes on top

Confirmed = Callable[[Block, Patches], Patches]


class Octave(Protocol):
    """What is looked for in one reduction of the scan, by factor; margin_px: of the scan, a multiple of the factor,
    about a part that is looked at; widest_px: of the scan, that a part may be at most."""

    @property
    def factor(self) -> int: ...
    @property
    def margin_px(self) -> int: ...
    @property
    def widest_px(self) -> int: ...
    def patches(self, small: Image) -> Patches:
        """In a reduced picture, in its pixels, those within its margin."""


def search_blocks(scan: Scan, octaves: Sequence[Octave], confirmed: Confirmed | None = None) -> list[Candidate]:
    """The patches of all octaves in pixels of the scan, the strongest first, none within another.

    confirmed: which of them are right, and where exactly, asked while the block about them is still decoded.
    """
    unit = lcm(*(octave.factor for octave in octaves))
    margin = _whole(max(octave.margin_px for octave in octaves), unit)
    width, height = _block_px(scan, unit, margin)

    rows, cols = height + 2 * margin, width + 2 * margin
    spare: list[Samples] = []  # new memory for every block would take longer than what is done in it

    def in_block(corner: tuple[int, int]) -> Patches:
        row0, col0 = (place - margin for place in corner)
        memory = spare.pop() if spare else np.empty((rows, cols, scan.channels), scan.samples_dtype)
        block = Block(scan, col0, row0, margin, scan.samples(col0, row0, cols, rows, memory))
        found = _separate(joined(Patches.of(()), *_patches_in(block, octaves)))
        found = confirmed(block, found) if confirmed else found
        spare.append(memory)
        return found

    corners = product(range(0, scan.height_px, height), range(0, scan.width_px, width))
    return _separate(joined(*side_by_side(in_block, corners))).candidates()


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


def _patches_in(block: Block, octaves: Sequence[Octave]) -> Iterator[Patches]:
    """Those that lie in the block, in pixels of the scan."""
    reductions = block.reductions({octave.factor for octave in octaves})
    width, height = (size - 2 * block.margin_px for size in block.size_px)
    for octave in octaves:
        factor, small = octave.factor, reductions[octave.factor]
        margin, spare = octave.margin_px // factor, (block.margin_px - octave.margin_px) // factor
        rows = slice(spare, spare + height // factor + 2 * margin)
        part = _even_part(width, octave.widest_px, factor) // factor
        for col0 in range(0, width // factor, part):
            first, last = spare + col0, spare + min(col0 + part, width // factor) + 2 * margin
            place = np.array([block.col0, block.row0]) + factor * np.array([first, spare]) + (factor - 1) / 2
            found = octave.patches(small[rows, first:last])
            found = Patches(found.centers * factor + place, found.shapes * factor, found.contrasts)
            edge = np.array([block.scan.width_px, block.scan.height_px]) - 0.5
            yield found.part(np.all(found.centers < edge, axis=1))


def _separate(found: Patches) -> Patches:
    """The strongest of candidates that lie within one another, the strongest first."""
    found = found.by_strength()
    kept: set[int] = set()
    for index, near in enumerate(cKDTree(found.centers).query_ball_point(found.centers, 0.7 * found.radii)):
        if kept.isdisjoint(near):
            kept.add(index)
    return found.part(np.array(sorted(kept), np.intp))

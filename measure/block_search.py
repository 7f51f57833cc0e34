"""Patches found in the whole frame in one pass over it, its blocks looked at side by side in several reductions."""

from collections.abc import Callable, Sequence
from math import lcm
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.disk_patches import Candidate, strength
from measure.scan import SEGMENT_PX, Scan

Array = NDArray[np.float64]
Image = NDArray[np.float32]

BLOCK_PX = 1536

Confirmed = Callable[[list[Candidate]], list[Candidate]]


class Octave(Protocol):
    """What is looked for in one reduction of the scan, by factor; margin_px: of the scan, a multiple of the factor,
    about a part that is looked at."""

    @property
    def factor(self) -> int: ...
    @property
    def margin_px(self) -> int: ...
    def patches(self, small: Image) -> list[Candidate]:
        """In a reduced picture, in its pixels."""


def search_blocks(scan: Scan, octaves: Sequence[Octave], confirmed: Confirmed | None = None) -> list[Candidate]:
    """The patches of all octaves in pixels of the scan, the strongest first, none within another.

    confirmed: which of them are right, and where exactly, asked while the rows about them are still decoded.

    The scan is taken in bands of rows, no higher than what stays decoded: a band is decoded and reduced first, by all
    threads, then its blocks are looked at side by side.
    """
    unit = lcm(*(octave.factor for octave in octaves))
    reductions = reductions_of(scan, {octave.factor for octave in octaves})
    margin = max(octave.margin_px for octave in octaves)
    kept = min(factor * reduction.rows_kept for factor, reduction in reductions.items())
    # Of a very wide scan tiles are rather decoded again for what is to be confirmed than rows reduced again as margins.
    decoded = scan.rows_kept - SEGMENT_PX  # which a reduction may read beyond its rows
    most = min(kept, max(decoded, 6 * margin)) - 2 * margin
    width, height = (max(size // unit, 1) * unit for size in (BLOCK_PX, min(BLOCK_PX, most)))

    def in_block(block: tuple[Octave, int, int]) -> list[Candidate]:
        octave, col0, row0 = block
        factor, spare = octave.factor, octave.margin_px // octave.factor
        col, row, cols, rows = (size // factor for size in (col0, row0, width, height))
        small = reductions[factor].window(col - spare, row - spare, cols + 2 * spare, rows + 2 * spare)
        found = []
        for patch in octave.patches(small):
            own = (patch.center_px - spare + 0.5) * factor
            place = own + np.array([col0, row0])
            if np.all((own >= 0) & (own < (width, height)) & (place <= (scan.width_px, scan.height_px))):
                found.append(Candidate(place - 0.5, patch.pixel_from_disk * factor, patch.contrast_dn))
        return found

    found: list[Candidate] = []
    for row0 in range(0, scan.height_px, height):
        if height + 2 * margin <= decoded:
            scan.decode(row0 - margin, row0 + height + margin)
        for factor in sorted(reductions):
            reductions[factor].decode((row0 - margin) // factor, (row0 + height + margin) // factor)
        blocks = [(octave, col0, row0) for octave in octaves for col0 in range(0, scan.width_px, width)]
        in_band = separate([patch for own in scan.each(in_block, blocks) for patch in own])
        found += confirmed(in_band) if confirmed else in_band
    return separate(found)


def reductions_of(scan: Scan, factors: set[int]) -> dict[int, Scan]:
    """The scan reduced by each factor, from the coarsest of the others that it divides."""
    reductions = {1: scan}
    for factor in sorted(factors):
        finer = max(known for known in reductions if factor % known == 0)
        reductions[factor] = reductions[finer].reduction(factor // finer)
    return {factor: reductions[factor] for factor in factors}


def separate(found: list[Candidate]) -> list[Candidate]:
    """The strongest of candidates that lie within one another, the strongest first."""
    found = sorted(found, key=strength)
    centers = np.array([patch.center_px for patch in found]).reshape(-1, 2)
    radii = np.array([patch.radius_px for patch in found])
    kept = np.zeros(len(found), bool)
    for index, near in enumerate(cKDTree(centers).query_ball_point(centers, 0.7 * radii) if found else ()):
        kept[index] = not kept[near].any()
    return [patch for patch, is_kept in zip(found, kept, strict=True) if is_kept]

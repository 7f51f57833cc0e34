"""Patches found in the whole frame in one pass over its blocks, each read once and looked at in several reductions."""

from collections.abc import Sequence
from math import lcm
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.disk_patches import Candidate
from measure.scan import Scan

Array = NDArray[np.float64]
Image = NDArray[np.float32]

BLOCK_PX = 1536


class Octave(Protocol):
    """What is looked for in one reduction of the scan, by factor; margin_px: of the scan, a multiple of the factor,
    about a part that is looked at."""

    @property
    def factor(self) -> int: ...
    @property
    def margin_px(self) -> int: ...
    def patches(self, small: Image) -> list[Candidate]:
        """In a reduced picture, in its pixels."""


def search_blocks(scan: Scan, octaves: Sequence[Octave]) -> list[Candidate]:
    """The patches of all octaves in pixels of the scan, the strongest first, none within another.

    Blocks are taken row by row, as high as the rows of the file that stay decoded, and side by side.
    """
    unit = lcm(*(octave.factor for octave in octaves))
    margin = max(octave.margin_px for octave in octaves)
    rows = min(BLOCK_PX, scan.rows_kept - 2 * margin)
    width, height = (max(size // unit, 1) * unit for size in (BLOCK_PX, rows))

    def in_block(corner: tuple[int, int]) -> list[Candidate]:
        col0, row0 = corner
        fine = scan.window(col0 - margin, row0 - margin, width + 2 * margin, height + 2 * margin)
        found = []
        for patch in (patch for octave in octaves for patch in in_window(fine, margin, octave)):
            col, row = patch.center_px + 0.5
            in_scan = col + col0 <= scan.width_px and row + row0 <= scan.height_px
            if in_scan and 0 <= col < width and 0 <= row < height:
                found.append(Candidate(patch.center_px + corner, patch.pixel_from_disk, patch.contrast_dn))
        return found

    corners = [(col, row) for row in range(0, scan.height_px, height) for col in range(0, scan.width_px, width)]
    found = [patch for own in scan.each(in_block, corners) for patch in own]
    found.sort(key=lambda patch: (-abs(patch.contrast_dn), *patch.center_px))
    return separate(found)


def in_window(fine: Image, margin: int, octave: Octave) -> list[Candidate]:
    """An octave's patches in a block (rows, columns) with a margin about it, in pixels from the block's corner."""
    spare, factor = margin - octave.margin_px, octave.factor
    part = fine[spare : fine.shape[0] - spare, spare : fine.shape[1] - spare]
    size = (part.shape[1] // factor, part.shape[0] // factor)
    small = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.float32)
    origin = (factor - 1) / 2 - octave.margin_px
    return [
        Candidate(patch.center_px * factor + origin, patch.pixel_from_disk * factor, patch.contrast_dn)
        for patch in octave.patches(small)
    ]


def separate(found: list[Candidate]) -> list[Candidate]:
    """The strongest of candidates that lie within one another."""
    centers = np.array([patch.center_px for patch in found]).reshape(-1, 2)
    radii = np.array([patch.radius_px for patch in found])
    kept = np.zeros(len(found), bool)
    for index, near in enumerate(cKDTree(centers).query_ball_point(centers, 0.7 * radii) if found else ()):
        kept[index] = not kept[near].any()
    return [patch for patch, is_kept in zip(found, kept, strict=True) if is_kept]

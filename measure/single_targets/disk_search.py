"""Round targets found in the whole frame, in one pass over its blocks: patches that a disk explains, not yet fitted."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from measure.scans.scan import Scan
from measure.single_targets.block import Block
from measure.single_targets.block_search import search_blocks
from measure.single_targets.disk_batch import disks_among
from measure.single_targets.disk_patches import Candidate, DiskSearch, Patches, margin_px, patches

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_SCALE_STEP = 1.5  # from one radius to the next at most: between them a disk stands out by a tenth less
_SIZE_TOLERANCE = 1.4  # of what is found, to the sizes that are looked for
_WIDEST_PX = 12288  # of what is looked at in one piece
_SEARCH_RADIUS_PX = 2.0  # reduced so far that the smallest disk of an octave has at least this radius


def disk_candidates(scan: Scan, search: DiskSearch) -> list[Candidate]:
    """What a disk explains, to a tenth of a pixel or so, the strongest first, none within another."""
    smallest, largest = search.diameter_px[0] / _SIZE_TOLERANCE, search.diameter_px[1] * _SIZE_TOLERANCE

    def disks(block: Block, patches: Patches) -> Patches:
        found = disks_among(block, patches)
        return found.part(_are_between(smallest, largest, found))

    return search_blocks(scan, octaves_of(search, scan.full_scale_dn), disks)


def _are_between(smallest_px: float, largest_px: float, disks: Patches) -> NDArray[np.bool_]:
    """(n,) whether the diameters of ellipses can be those of disks seen obliquely."""
    longer, shorter = 2 * np.linalg.svd(disks.shapes, compute_uv=False).T
    return np.asarray((longer >= smallest_px) & (shorter <= largest_px))


@dataclass(frozen=True)
class DiskOctave:
    """A reduction of the scan and the radii, reduced px, that are looked for in it."""

    factor: int
    radii: list[float]
    search: DiskSearch
    full_scale_dn: float

    widest_px = _WIDEST_PX

    @property
    def margin_px(self) -> int:
        return margin_px(self.radii) * self.factor

    def patches(self, small: Image) -> Patches:
        return patches(small, self.radii, self.search, self.full_scale_dn, self.factor)


def octaves_of(search: DiskSearch, full_scale_dn: float) -> list[DiskOctave]:
    """Radii from the smallest to the largest, each in the reduction that leaves it a few pixels."""
    smallest, largest = search.diameter_px[0] / 2, search.diameter_px[1] / 2
    count = int(np.ceil(np.log(largest / smallest) / np.log(_SCALE_STEP))) + 1
    by_factor: dict[int, list[float]] = {}
    for radius in np.geomspace(smallest, largest, count).tolist():
        factor = max(1, int(2 ** np.floor(np.log2(max(radius / _SEARCH_RADIUS_PX, 1.0)))))
        by_factor.setdefault(factor, []).append(radius / factor)
    return [DiskOctave(factor, radii, search, full_scale_dn) for factor, radii in by_factor.items()]

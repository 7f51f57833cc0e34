"""Scans turned or scaled with nearest neighbours, told by the steps that this leaves.

Every pixel was copied from the nearest one of the source. Under a small turn rows jump sideways by one pixel at regular
distances, and columns in the other direction at the same distances. Under a small enlargement rows or columns stand
twice at regular distances. A mark between two steps was moved as a whole, by up to half a pixel along each axis, and
shows nothing of it.
"""

import numpy as np
from scipy.ndimage import median_filter

from measure.array_types import Array, Single
from measure.scans.scan import Scan

NEAREST_PX2 = np.eye(2) / 12  # covariance of a place: errors are uniform over a pixel
_WIDE_PX, _LONG_PX = 256, 4096  # largest strips of rows and columns through the centre that are looked at
_LEAST_DISTANCE_PX = 16  # between steps: several in a mark average out
_FEWEST_STEPS = 4
_MOSTLY = 0.75  # fraction of the distances between rows that are alike
_AROUND = 25  # rows whose median is what the picture's own slanted lines make
_MOST_SIGMAS = 6.0  # jumps are limited to as many: single ones may be anything
_OUTLYING, _MOST_OUTLYING = 3.0, 100  # standard deviations of rows whose distances are tried, and their largest number
_DISTANCES = 8  # that are tried, those between most of these rows
_SIGNIFICANT = 5.0  # standard deviations of a regular jump: film, compressed, sharpened or clipped, reaches 4.5


def is_nearest_neighbour(scan: Scan) -> bool:
    """Whether a scan was turned or enlarged with nearest neighbours."""
    sides = scan.width_px, scan.height_px
    wide, tall = (min(side, _LONG_PX) for side in sides)
    broad = min(wide, tall, _WIDE_PX)
    # From multiples of the width, those of tiles: a strip across two rows of them would decode both.
    left, top = ((side - broad) // 2 // broad * broad for side in sides)
    strips = [
        scan.window(left, (scan.height_px - tall) // 2, broad, tall),
        scan.window((scan.width_px - wide) // 2, top, wide, broad),
    ]
    rows, columns = strips[0], strips[1].T
    if min(len(rows), len(columns)) < _FEWEST_STEPS * _LEAST_DISTANCE_PX:
        return False
    return _jump_alike([_jumps(rows), -_jumps(columns)]) or _stand_twice(rows) or _stand_twice(columns)


def _stand_twice(rows: Single) -> bool:
    """Whether rows equal the one before at regular distances."""
    copies = np.flatnonzero((rows[1:] == rows[:-1]).all(axis=1))
    distances = np.diff(copies)[np.diff(copies) > 1]  # neighbours that are all alike are saturated
    usual = float(np.median(distances)) if len(distances) >= _FEWEST_STEPS else 0.0
    return usual >= _LEAST_DISTANCE_PX and bool(np.mean(np.abs(distances - usual) <= 1) > _MOSTLY)


def _jumps(rows: Single) -> Array:
    """(n - 1,) how much better each row continues the one before after a shift by a pixel one way than the other, in
    standard deviations."""
    ahead, behind = (np.abs(rows[1:, side] - rows[:-1, 1:-1]) for side in (slice(2, None), slice(-2)))
    better = (behind - ahead) / np.maximum(behind + ahead, np.finfo(np.float32).tiny)
    jumps = better.mean(axis=1, dtype=float)
    jumps -= median_filter(jumps, _AROUND)
    scaled = jumps / max(float(jumps.std()), np.finfo(float).tiny)
    return np.asarray(np.clip(scaled, -_MOST_SIGMAS, _MOST_SIGMAS))


def _jump_alike(jumps: list[Array]) -> bool:
    """Whether rows and columns jump alike at the same regular distances."""
    longest = min(map(len, jumps)) // _FEWEST_STEPS
    for sign in (1, -1):
        counts = np.sum([_distance_counts(sign * each, longest) for each in jumps], axis=0)
        pairs = counts[:-1] + counts[1:]  # rounded steps are one of two distances apart
        for least in np.argsort(-pairs)[:_DISTANCES].tolist():
            for distance in np.arange(least, least + 1, least / max(map(len, jumps))) if pairs[least] else ():
                if min(_regular_jump(sign * each, distance) for each in jumps) > _SIGNIFICANT:
                    return True
    return False


def _distance_counts(jumps: Array, longest: int) -> Array:
    """(longest + 2,) number of pairs of outlying rows by their distance."""
    rows = np.argsort(-jumps)[:_MOST_OUTLYING]
    rows = rows[jumps[rows] > _OUTLYING]
    distances = (rows - rows[:, None]).ravel()
    own = (distances >= _LEAST_DISTANCE_PX) & (distances <= longest)
    return np.bincount(distances[own], minlength=longest + 2).astype(float)


def _regular_jump(jumps: Array, distance: float) -> float:
    """Largest mean jump of rows at a distance from one another, in its standard deviations."""
    steps = int(len(jumps) / distance)
    firsts = np.floor(np.arange(steps) * distance).astype(int)
    return float(jumps[firsts[:, None] + np.arange(int(distance))].sum(axis=0).max() / np.sqrt(steps))

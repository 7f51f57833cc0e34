"""Scans altered as a whole before they came, told by what this leaves everywhere: nearest neighbours, and motion.

Turned or scaled with nearest neighbours, every pixel was copied from the nearest one of the source. Under a small turn
rows jump sideways by one pixel at regular distances, and columns in the other direction at the same distances. Under a
small enlargement rows or columns stand twice at regular distances. A mark between two steps was moved as a whole, by up
to half a pixel along each axis, and shows nothing of it.

Motion along a line multiplies the power spectrum of the scan by a squared sinc across that line. Its zeros tell it from
texture and lens, whose spectra are smooth. Where a line of a mark became a bar of even grey, its fit lies anywhere in
the bar.
"""

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import median_filter

from measure.array_types import Array, Single
from measure.flags import Cause, Code, Reason
from measure.scans.scan import Scan

_WIDE_PX, _LONG_PX = 256, 4096  # largest strips of rows and columns through the centre that are looked at
_LEAST_DISTANCE_PX = 16  # between steps: several in a mark average out
_FEWEST_STEPS = 4
_MOSTLY = 0.75  # fraction of the distances between rows that are alike
_AROUND = 25  # rows whose median is what the picture's own slanted lines make
_MOST_SIGMAS = 6.0  # jumps are limited to as many: single ones may be anything
_OUTLYING, _MOST_OUTLYING = 3.0, 100  # standard deviations of rows whose distances are tried, and their largest number
_DISTANCES = 8  # that are tried, those between most of these rows
_SIGNIFICANT = 5.0  # standard deviations of a regular jump: film, compressed, sharpened or clipped, reaches 4.5
_BLOCK_PX = 8  # of JPEG, whose grid rows and columns show as well
_FEW_BLOCKS = 5  # at fewer, thirds of blocks show, too
_TILE_PX, _FEWEST_TILES = 64, 8  # squares whose power spectra are taken, and how many of them tell motion
_MOST_TILES = 256  # more take time, and tell hardly more
_LEAST_DN = 0.5  # standard deviation of grey values in such a square
_ROUNDING_DN2 = 1 / 12  # variance of rounding, which fills the zeros of a spectrum
_SIGNAL_DN2 = 12 * _ROUNDING_DN2  # least power along or across the motion, to compare both
_LEAST_FREQUENCIES = 100
_LENGTHS_PX, _TURNS = np.arange(3.0, 9.5, 0.5), np.arange(12) * np.pi / 12  # motions that are tried
_MOVED = 0.42  # exponent with which motion stands in the spectrum, 1 for motion alone; film without motion: 0.37
_LIKE_MOTION = 0.65  # correlation with the spectrum of motion, without what is smooth in both; moire: 0.57
_ALONG = {0: "rows", 90: "columns"}


@dataclass(frozen=True, eq=False)
class Alteration:
    """Alteration of a whole scan.

    Attributes
    ----------
    reason : what it is, what it does to marks, and what to do.
    cause : of the part of each mark's covariance that stands for it.
    px2 : (2, 2) that part.
    """

    reason: Reason
    cause: Cause
    px2: Array


_NEAREST = Alteration(
    Reason(
        "The scan was turned or enlarged with nearest neighbours: each of its marks may lie half a pixel off. Measure "
        "the scan that it was made from, or turn that with interpolation.",
        Code.IMPRECISE,
    ),
    Cause.INTERPOLATION,
    np.eye(2) / 12,  # errors are uniform over a pixel
)


def find_alterations(scan: Scan) -> list[Alteration]:
    """Find what was done to a whole scan and makes the places of its marks uncertain."""
    strips = _strips(scan)
    if min(map(len, strips)) < _FEWEST_STEPS * _LEAST_DISTANCE_PX:
        return []
    if _is_nearest_neighbour(*strips):
        return [_NEAREST, *_motion(strips)]
    return _motion(strips)


def _strips(scan: Scan) -> tuple[Single, Single]:
    """Strips of the scan through its centre: rows, and columns transposed."""
    sides = scan.width_px, scan.height_px
    wide, tall = (min(side, _LONG_PX) for side in sides)
    broad = min(wide, tall, _WIDE_PX)
    # From multiples of the width, those of tiles: a strip across two rows of them would decode both.
    left, top = ((side - broad) // 2 // broad * broad for side in sides)
    columns = scan.window((scan.width_px - wide) // 2, top, wide, broad).T
    return scan.window(left, (scan.height_px - tall) // 2, broad, tall), columns


def _is_nearest_neighbour(rows: Single, columns: Single) -> bool:
    """Whether a scan was turned or enlarged with nearest neighbours, by strips of it."""
    jumps, alike = (_jumps(rows), -_jumps(columns)), [-_roughness(each) for each in (rows, columns)]
    if any(_are_regular([sign * each for each in jumps]) for sign in (1, -1)):
        return True
    # Rows that stand twice are still alike after compression.
    return any(map(_stand_twice, (rows, columns))) or _are_regular(alike, _FEW_BLOCKS * _BLOCK_PX, _BLOCK_PX)


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
    return _standardised(better.mean(axis=1, dtype=float))


def _roughness(rows: Single) -> Array:
    """(n - 1,) logarithm of the mean difference of each row to the one before, in standard deviations."""
    size = np.abs(np.diff(rows, axis=0)).mean(axis=1, dtype=float)
    return _standardised(np.log(np.maximum(size, 1e-3)))


def _standardised(rows: Array) -> Array:
    """(n,) values of rows less the median around, in limited standard deviations."""
    beyond = rows - median_filter(rows, _AROUND)
    scaled = beyond / max(float(beyond.std()), np.finfo(float).tiny)
    return np.asarray(np.clip(scaled, -_MOST_SIGMAS, _MOST_SIGMAS))


def _are_regular(jumps: list[Array], least_px: int = _LEAST_DISTANCE_PX, block_px: float = np.inf) -> bool:
    """Whether rows and columns jump alike at regular distances, from least_px on, other than whole blocks."""
    longest, most = min(map(len, jumps)) // _FEWEST_STEPS, max(map(len, jumps))
    counts = np.sum([_distance_counts(each, least_px, longest) for each in jumps], axis=0)
    pairs = counts[:-1] + counts[1:]  # rounded steps are one of two distances apart
    for least in np.argsort(-pairs)[:_DISTANCES].tolist():
        for distance in np.arange(least, least + 1, least / most) if pairs[least] else ():
            blocks = distance / block_px
            on_grid = blocks > 0 and abs(blocks - round(blocks)) < distance / most
            if not on_grid and min(_regular_jump(each, distance) for each in jumps) > _SIGNIFICANT:
                return True
    return False


def _distance_counts(jumps: Array, least: int, longest: int) -> Array:
    """(longest + 2,) number of pairs of outlying rows by their distance, from the least to the longest."""
    rows = np.argsort(-jumps)[:_MOST_OUTLYING]
    rows = rows[jumps[rows] > _OUTLYING]
    distances = (rows - rows[:, None]).ravel()
    own = (distances >= least) & (distances <= longest)
    return np.bincount(distances[own], minlength=longest + 2).astype(float)


def _regular_jump(jumps: Array, distance: float) -> float:
    """Largest mean jump of rows at a distance from one another, in its standard deviations."""
    steps = int(len(jumps) / distance)
    firsts = np.floor(np.arange(steps) * distance).astype(int)
    return float(jumps[firsts[:, None] + np.arange(int(distance))].sum(axis=0).max() / np.sqrt(steps))


def _motion(strips: tuple[Single, Single]) -> list[Alteration]:
    """Motion blur by the ratio of the power spectrum to itself a quarter turn on; empty without.

    The ratio is free of all that is alike in both directions: the lens, grain, compression. Its logarithm is a multiple
    of that of motion, plus smooth terms of second to sixth order.
    """
    power = _power_spectrum(strips[0], strips[1].T)
    if power is None:
        return []
    frequency = fft.fftfreq(_TILE_PX)
    across = power.T[:, -np.arange(_TILE_PX)]  # at (-v, u)
    col, row = np.meshgrid(frequency, frequency)
    signal, radius = np.maximum(power, across), np.hypot(col, row)
    plain = (np.minimum(np.abs(col), np.abs(row)) > 1.5 / _TILE_PX) & (row > 0)  # a spectrum is even
    used = plain & (radius > 4 / _TILE_PX) & (radius < 0.5) & (signal > _SIGNAL_DN2)
    if used.sum() < _LEAST_FREQUENCIES:
        return []
    u, v, floor = col[used], row[used], np.maximum(_ROUNDING_DN2 / signal[used], 0.003)
    squares, smooth = u**2 + v**2, np.stack([u**2 - v**2, u * v])
    smooth = np.concatenate([smooth, smooth * squares, smooth * squares**2])
    basis = np.linalg.qr(smooth.T)[0]
    length, turn = (each.reshape(-1, 1) for each in np.meshgrid(_LENGTHS_PX, _TURNS, indexing="ij"))
    sides = (u * np.cos(turn) + v * np.sin(turn), u * np.sin(turn) - v * np.cos(turn))
    moved, still = (np.log(np.sinc((length * side).astype(np.float32)) ** 2 + np.float32(floor)) for side in sides)
    ratio = np.log((power[used] + _ROUNDING_DN2 / 2) / (across[used] + _ROUNDING_DN2 / 2))
    templates, ratio = ((each - each @ basis @ basis.T) for each in (moved - still, ratio))
    size, likeness = np.linalg.norm(templates, axis=1), templates @ ratio
    best = int(np.argmax(likeness / size))
    exponent, correlation = likeness[best] / size[best] ** 2, likeness[best] / size[best] / np.linalg.norm(ratio)
    if exponent < _MOVED or correlation < _LIKE_MOTION:
        return []
    length_px, angle = float(length[best, 0]), float(turn[best, 0])
    degrees = round(np.degrees(angle))
    lines = _ALONG.get(degrees, f"lines that fall to the right by {degrees} degrees")
    reason = Reason(
        f"The scan is blurred by motion over about {length_px:g} px along {lines}: its marks may lie anywhere in the "
        "blur. Scan the film again, or measure the scan as it was before the blur.",
        Code.IMPRECISE,
    )
    along = np.array([np.cos(angle), np.sin(angle)])
    # The kernel's variance, less that of a pixel.
    return [Alteration(reason, Cause.MOTION, (length_px**2 - 1) / 12 * np.outer(along, along))]


def _power_spectrum(*strips: Single) -> Array | None:
    """(_TILE_PX, _TILE_PX) median power spectrum of the squares of strips; None of too few."""
    tiles = []
    for strip in strips:
        rows, cols = (size // _TILE_PX for size in strip.shape)
        whole = strip[: rows * _TILE_PX, : cols * _TILE_PX].reshape(rows, _TILE_PX, cols, _TILE_PX)
        tiles.append(whole.swapaxes(1, 2).reshape(-1, _TILE_PX, _TILE_PX))
    squares = np.concatenate(tiles)
    squares = squares - squares.mean(axis=(1, 2), keepdims=True)
    squares = squares[squares.std(axis=(1, 2)) > _LEAST_DN]
    if len(squares) < _FEWEST_TILES:
        return None
    window = np.hanning(_TILE_PX + 2)[1:-1].astype(np.float32)
    waves = fft.rfft2(squares[:: -(-len(squares) // _MOST_TILES)] * np.outer(window, window))
    half = np.median(waves.real**2 + waves.imag**2, axis=0) / np.log(2)  # of an exponential distribution
    opposite = half[-np.arange(_TILE_PX), 1:-1][:, ::-1]  # a spectrum is even
    power = np.hstack([half, opposite])
    return np.asarray(power / np.sum(np.outer(window, window) ** 2), float)

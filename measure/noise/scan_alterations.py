"""Alterations of a whole scan before it came, found by what they leave everywhere: nearest neighbours, interpolation,
screens of prints, and motion.

Turned or scaled with nearest neighbours, every pixel was copied from the nearest one of the source. Under a small turn
rows jump sideways by one pixel at regular distances, and columns in the other direction at the same distances. Under a
small enlargement rows or columns stand twice at regular distances. A mark between two steps was moved as a whole, by up
to half a pixel along each axis, and shows nothing of it.

Interpolation at a regular spacing smooths most where it falls between two pixels: rows and columns are rough at a
period that the scale gives (Gallagher, 2005, Detection of linear and cubic interpolation in JPEG compressed images).

The screen of a printed picture is a lattice of dots, which stands out in the power spectrum as single lines.

Motion along a line multiplies the power spectrum of the scan by a squared sinc across that line. Its zeros tell it from
texture and lens, whose spectra are smooth. Where a line of a mark became a bar of even grey, its fit lies anywhere in
the bar.
"""

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import maximum_filter1d, median_filter

from measure.array_types import Array, Mask, Single
from measure.flags import NO_REASON, Cause, Code, Reason
from measure.scans.scan import Scan

_WIDE_PX, _LONG_PX = 256, 4096  # largest strips of rows and columns through the centre that are looked at
_LEAST_DISTANCE_PX = 16  # between steps: several in a mark average out
_FEWEST_STEPS = 4
_MOSTLY = 0.75  # fraction of the distances between rows that are alike
_AROUND = 25  # rows whose median is what the picture's own slanted lines make
_CLOSELY_AROUND = 15  # the same for roughness, whose periods are shorter
_MOST_ROUGH = 3.0  # times the usual difference of rows: lines and edges of marks, which are regular, have more
_MOST_SIGMAS = 6.0  # jumps are limited to as many: single ones may be anything
_OUTLYING, _MOST_OUTLYING = 3.0, 100  # standard deviations of rows whose distances are tried, and their largest number
_DISTANCES = 8  # that are tried, those between most of these rows
_SIGNIFICANT = 5.0  # standard deviations of a regular jump: film, compressed, sharpened or clipped, reaches 4.5
_MEDIAN = 2.5  # the same of the median jump, which regular ones have at 3.9 and more; marks at regular places: 1.3
_BLOCK_PX = 8  # of JPEG, whose grid rows and columns show as well
_FEW_BLOCKS = 5  # at fewer, thirds of blocks show, too
_PERIODS, _ALL_NEAR = 16384, 7  # frequencies of the roughness that are sampled, and how many of them a line is wide
_LOWEST, _OFF_GRID = 0.05, 0.0022  # per pixel: least frequency of a line, and least distance from those of the grid
_LEAKS = 2.5  # over the number of rows: distance up to which a line leaks under the window
_STANDS_OUT = 120.0  # times the median power; film that is not interpolated reaches 80
_BEYOND_GRID = 10.0  # times the line of blocks that one of half their size has at least; of blocks: 2.6
_LINE, _LINE_AROUND = 4.0, 11  # logarithm of a line of a screen over the median around; other scans: 2.0
_COARSEST_SCREEN = 0.08  # per pixel: coarser ones are single dots to a mark
_TILE_PX, _FEWEST_TILES = 64, 8  # squares whose power spectra are taken, and how many of them tell motion
_MOST_TILES = 256  # more take time, and tell hardly more
_LEAST_DN = 0.5  # standard deviation of grey values in such a square
_ROUNDING_DN2 = 1 / 12  # variance of rounding, the least noise
_SIGNAL_DN2 = 12 * _ROUNDING_DN2  # least power along or across the motion, to compare both
_OF_NOISE = 0.01  # quantile of the power that is noise: less is chance, more has some of the picture
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
    pixels : number of pixels that are worth one: that part has the mark's own covariance as often, less once.
    doubt : why no mark is more than weak; empty if that part says it all.
    """

    reason: Reason
    cause: Cause
    px2: Array
    pixels: float = 1.0
    doubt: Reason = NO_REASON

    def covariance(self, own_px2: Array) -> Array:
        """(2, 2) part of a mark's covariance; own_px2: the rest of it."""
        return self.px2 + (self.pixels - 1) * own_px2


_NEAREST = Alteration(
    Reason(
        "The scan was turned or enlarged with nearest neighbours: each of its marks may lie half a pixel off. Measure "
        "the scan that it was made from, or turn that with interpolation.",
        Code.IMPRECISE,
    ),
    Cause.INTERPOLATION,
    np.eye(2) / 12,  # errors are uniform over a pixel
)
_INTERPOLATED = Alteration(
    Reason(
        "The scan was enlarged or reduced by interpolation: its pixels are not independent, and standard deviations "
        "are doubled. Measure the scan that it was made from.",
        Code.IMPRECISE,
    ),
    Cause.INTERPOLATION,
    np.zeros((2, 2)),
    pixels=4.0,  # enlarged to twice the size; which scale it is the period leaves open
    doubt=Reason("its scan was enlarged or reduced by interpolation", Code.IMPRECISE),
)
_SCREENED = Alteration(
    Reason(
        "A regular pattern lies over the whole scan, as the screen of a printed picture, and moves its marks: standard "
        "deviations are doubled. Measure a scan of the film.",
        Code.IMPRECISE,
    ),
    Cause.TEXTURE,
    np.zeros((2, 2)),
    pixels=4.0,  # errors of marks under screens of 4 to 11 px were twice their standard deviations
    doubt=Reason("a regular pattern lies over its scan, as the screen of a printed picture", Code.IMPRECISE),
)


def find_alterations(scan: Scan, weights: tuple[float, ...] | None = None) -> list[Alteration]:
    """Find what was done to a whole scan and makes the places of its marks uncertain.

    weights: of the channels; None: luminance. Channels that do not coincide are no motion.
    """
    strips = _strips(scan, weights)
    if min(map(len, strips)) < _FEWEST_STEPS * _LEAST_DISTANCE_PX:
        return []
    power = _power_spectrum(strips[0], strips[1].T)
    motion = [] if power is None else _motion(power)
    if power is not None and _is_screened(power):  # which makes rows periodic as well
        return [_SCREENED, *motion]
    if _is_nearest_neighbour(*strips):
        return [_NEAREST, *motion]
    return [*([_INTERPOLATED] if _is_interpolated(strips) else []), *motion]


def _strips(scan: Scan, weights: tuple[float, ...] | None) -> tuple[Single, Single]:
    """Strips of the scan through its centre: rows, and columns transposed."""
    sides = scan.width_px, scan.height_px
    wide, tall = (min(side, _LONG_PX) for side in sides)
    broad = min(wide, tall, _WIDE_PX)
    # From multiples of the width, those of tiles: a strip across two rows of them would decode both.
    left, top = ((side - broad) // 2 // broad * broad for side in sides)
    columns = scan.window((scan.width_px - wide) // 2, top, wide, broad, weights).T
    return scan.window(left, (scan.height_px - tall) // 2, broad, tall, weights), columns


def _is_nearest_neighbour(rows: Single, columns: Single) -> bool:
    """Whether a scan was turned or enlarged with nearest neighbours, by strips of it."""
    jumps, alike = (_jumps(rows), -_jumps(columns)), [-_roughness(each, 1) for each in (rows, columns)]
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
    both = behind + ahead
    behind -= ahead
    behind /= np.maximum(both, np.finfo(np.float32).tiny, out=both)
    return _standardised(behind @ np.full(behind.shape[1], 1.0 / behind.shape[1], dtype=np.float32))


def _roughness(rows: Single, order: int, around: int = _AROUND, most: float = np.inf) -> Array:
    """(n - order,) logarithm of the mean difference of an order between rows, in standard deviations; 0 where the
    difference is beyond so many times the usual one."""
    size = np.abs(np.diff(rows, order, axis=0)).mean(axis=1, dtype=float)
    return _standardised(np.log(np.maximum(size, 1e-3)), around, size > most * max(np.median(size), 1e-3))


def _standardised(rows: Array, around: int = _AROUND, left_out: Mask | bool = False) -> Array:
    """(n,) values of rows less the median around, in limited standard deviations; 0 for those left out."""
    beyond = np.where(left_out, 0.0, rows - median_filter(rows, around))
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
            if not on_grid and all(_jump_regularly(each, distance) for each in jumps):
                return True
    return False


def _distance_counts(jumps: Array, least: int, longest: int) -> Array:
    """(longest + 2,) number of pairs of outlying rows by their distance, from the least to the longest."""
    rows = np.argsort(-jumps)[:_MOST_OUTLYING]
    rows = rows[jumps[rows] > _OUTLYING]
    distances = (rows - rows[:, None]).ravel()
    own = (distances >= least) & (distances <= longest)
    return np.bincount(distances[own], minlength=longest + 2).astype(float)


def _jump_regularly(jumps: Array, distance: float) -> bool:
    """Whether rows at a distance from one another jump significantly on average, and most of them do: of the rows that
    cross marks at regular places a few jump far."""
    steps = int(len(jumps) / distance)
    firsts = np.floor(np.arange(steps) * distance).astype(int)
    own = jumps[firsts[:, None] + np.arange(int(distance))] * np.sqrt(steps)
    own = own[:, own.mean(axis=0).argmax()]
    return bool(own.mean() > _SIGNIFICANT and np.median(own) > _MEDIAN)


def _is_interpolated(strips: tuple[Single, Single]) -> bool:
    """Whether the roughness of rows and columns has a common period, other than those of a grid of blocks."""
    frequency = fft.rfftfreq(_PERIODS)
    lines = np.array([_lines(each) for each in strips])
    near = max(_OFF_GRID, _LEAKS / min(map(len, strips)))
    off_grid = np.abs(frequency * _BLOCK_PX - np.rint(frequency * _BLOCK_PX)) / _BLOCK_PX > near
    own = lines.min(axis=0)[off_grid & (frequency > _LOWEST)].max()
    # A grid of blocks has a line at its own frequency, too.
    eighth, fourth = lines[:, [_PERIODS // 8, _PERIODS // 4]].T
    return bool(own > _STANDS_OUT or (fourth > np.maximum(_STANDS_OUT, _BEYOND_GRID * eighth)).all())


def _lines(rows: Single) -> Array:
    """(frequencies,) power of the roughness of rows by its frequency, over the median."""
    roughness = _roughness(rows, 2, _CLOSELY_AROUND, _MOST_ROUGH)
    power = np.abs(fft.rfft(roughness * np.hanning(len(roughness) + 2)[1:-1], _PERIODS)) ** 2
    return np.asarray(maximum_filter1d(power, _ALL_NEAR) / max(float(np.median(power)), np.finfo(float).tiny))


def _is_screened(power: Array) -> bool:
    """Whether single lines stand out of a power spectrum."""
    logarithms = np.log(power + _ROUNDING_DN2)
    beyond = logarithms - median_filter(logarithms, _LINE_AROUND, mode="wrap")
    col, row = np.abs(np.meshgrid(*2 * [fft.fftfreq(_TILE_PX)]))
    lattice = (np.minimum(col, row) > 1.5 / _TILE_PX) & (np.hypot(col, row) > _COARSEST_SCREEN)  # no noise of rows
    return bool(beyond[lattice].max() > _LINE)


def _motion(power: Array) -> list[Alteration]:
    """Motion blur by the ratio of the power spectrum to itself a quarter turn on; empty without.

    The ratio is free of all that is alike in both directions: the lens, grain, compression. Its logarithm is a multiple
    of that of motion, plus smooth terms of second to sixth order.
    """
    frequency = fft.fftfreq(_TILE_PX)
    across = power.T[:, -np.arange(_TILE_PX)]  # at (-v, u)
    col, row = np.meshgrid(frequency, frequency)
    signal, radius = np.maximum(power, across), np.hypot(col, row)
    plain = (np.minimum(np.abs(col), np.abs(row)) > 1.5 / _TILE_PX) & (row > 0)  # a spectrum is even
    used = plain & (radius > 4 / _TILE_PX) & (radius < 0.5) & (signal > _SIGNAL_DN2)
    if used.sum() < _LEAST_FREQUENCIES:
        return []
    noise_dn2 = max(_ROUNDING_DN2, float(np.quantile(power[plain], _OF_NOISE)))  # which fills the zeros
    u, v, floor = col[used], row[used], np.maximum(noise_dn2 / signal[used], 0.003)
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

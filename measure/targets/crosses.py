"""Detection of crosses in a whole scan, in one pass over its blocks: connected thin structures that two bars through
their centre explain."""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.marks.shapes import Polarity
from measure.noise.robust_estimation import robust_scale
from measure.scans.scan import Scan
from measure.targets.block_search import Candidate, Octave, Patches, search_blocks
from measure.targets.disk_detection import DiskSearch

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SEARCHED_ARM_PX = 12.0  # half length of a cross in the reduced scan, provided that its lines stay...
_THINNEST_PX = 1.5  # ...this wide
_OCTAVE = 2.0  # longest over shortest half cross found in one reduction
_NOISE_SIGMAS = 5.0  # threshold above the noise of the top-hat image: one noise pixel in a million exceeds it
_STEPS_DEG = 5.0  # step of the bar directions that are tried
_LEAST_ANGLE_DEG = 35.0  # between the bars: a right angle in an oblique view
_BLURRED_PX = 0.75  # by which blur widens a bar on either side
_LEAST_FILLED, _LEAST_EXPLAINED = 0.85, 0.8  # fraction of the bars covered by the patch, and the reverse


@dataclass(frozen=True)
class CrossSearch:
    """Crosses to search for. half_px: shortest and longest half length, px of the scan; line: bar width in half
    lengths; polarity, least_contrast: as in `DiskSearch`."""

    half_px: tuple[float, float]
    line: float
    polarity: Polarity = "auto"
    least_contrast: float = 0.02

    def __post_init__(self) -> None:
        DiskSearch((2.0 * self.half_px[0], 2.0 * self.half_px[1]), self.polarity, self.least_contrast)
        if not 0.0 < self.line < 1.0:
            raise ValueError(f"line is {self.line} of half a cross; a share between 0 and 1 is right")


def cross_candidates(scan: Scan, search: CrossSearch) -> list[Candidate]:
    """Detect crosses in a whole scan, in one pass over its blocks.

    Returns
    -------
    Candidates, the strongest first; the columns of pixel_from_disk are a cross's half bars.
    """
    return search_blocks(scan, _octaves(search, scan.full_scale_dn))


def _octaves(search: CrossSearch, full_scale_dn: float) -> list[Octave]:
    """Octaves from the shortest half length to the longest, each reduced as far as the line width allows. Factors are
    powers of two, since a block is a whole number of pixels in every octave."""
    octaves = []
    shortest, longest = search.half_px
    upper = 0.0
    while upper < longest:
        upper = min(shortest * _OCTAVE, longest)
        finest = max(min(shortest / _SEARCHED_ARM_PX, search.line * shortest / _THINNEST_PX), 1.0)
        factor = int(2 ** np.floor(np.log2(finest)))
        half, margin = (shortest / factor, upper / factor), int(np.ceil(2.0 * upper / factor + 4))
        octaves.append(Octave(factor, margin, partial(_patches, half, margin, search, full_scale_dn)))
        shortest = upper
    return octaves


def _patches(
    half: tuple[float, float], margin: int, search: CrossSearch, full_scale_dn: float, small: Image
) -> Patches:
    """Crosses of these half lengths in a reduced image, within its margin."""
    wide = 2 * int(np.ceil(search.line * half[1]) + 1) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    crosses = []
    for sign, polarity, operation in ((1.0, "light", cv2.MORPH_TOPHAT), (-1.0, "dark", cv2.MORPH_BLACKHAT)):
        if search.polarity not in (polarity, "auto"):
            continue
        thin = np.asarray(cv2.morphologyEx(small, operation, kernel), np.float32)
        middle = float(np.median(thin[::3, ::3]))
        noise = robust_scale(thin[::3, ::3].astype(np.float64) - middle)
        level = max(0.5 * search.least_contrast * full_scale_dn, middle + _NOISE_SIGMAS * noise)
        crosses += _crosses(thin, level, half, search, sign)
    found = Patches.collect(crosses)
    last = np.array(small.shape[::-1]) - margin - 0.5
    return found.part(np.all((found.centers >= margin - 0.5) & (found.centers < last), axis=1))


def _crosses(thin: Image, level: float, half: tuple[float, float], search: CrossSearch, sign: float) -> list[Candidate]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats((thin > level).astype(np.uint8))
    found = []
    for label, (left, top, wide, tall, area) in enumerate(stats[1:], 1):
        if not (half[0] < max(wide, tall) < 2.6 * half[1] and area > 4.0 * half[0]):
            continue
        crop = slice(top, top + tall), slice(left, left + wide)
        patch = np.where(labels[crop] == label, thin[crop], 0.0)
        # Threshold at half height: at the detection level, blur and noise make a patch wider than the cross.
        patch = np.where(patch > 0.5 * np.quantile(patch[patch > 0.0], 0.8), patch, 0.0)
        cross = _fit_cross(patch, search.line)
        if cross is None:
            continue
        center, bars = cross
        length = np.hypot(*bars)
        if half[0] / 1.5 < length.max() < 1.5 * half[1]:
            contrast = sign * float(np.median(patch[patch > 0.0]))
            found.append(Candidate(center + np.array([left, top]), bars, contrast))
    return found


def _fit_cross(patch: NDArray[np.floating], line: float) -> tuple[Array, Array] | None:
    """Fit two bars to a patch (rows, columns) of grey values: centre (2,) and half bars (2, 2) as columns, or None."""
    rows, cols = np.nonzero(patch)
    if len(rows) < 12:
        return None
    weight = patch[rows, cols]
    place = np.stack([cols, rows], axis=1).astype(float)
    center = np.average(place, axis=0, weights=weight)
    off = place - center
    directions = np.deg2rad(np.arange(0.0, 180.0, _STEPS_DEG))
    units = np.stack([np.cos(directions), np.sin(directions)])
    across = off @ np.stack([-units[1], units[0]])
    reach = float(np.abs(off).max())
    on_bar = np.abs(across) <= line * reach / 2.0 + _BLURRED_PX
    first = int(np.argmax(on_bar.sum(axis=0)))
    apart = np.abs((np.arange(len(directions)) - first + len(directions) / 2) % len(directions) - len(directions) / 2)
    others = np.where(apart * _STEPS_DEG >= _LEAST_ANGLE_DEG, (on_bar & ~on_bar[:, [first]]).sum(axis=0), -1)
    second = int(np.argmax(others))
    explained = (on_bar[:, first] | on_bar[:, second]).mean()
    if explained < _LEAST_EXPLAINED or others[second] == 0:
        return None
    bars = np.stack([_bar(off[on_bar[:, k]], units[:, k]) for k in (first, second)], axis=1)
    filled = min(_filled(patch, center, bar) for bar in (*bars.T, *-bars.T))
    return (center, bars) if filled >= _LEAST_FILLED and abs(np.linalg.det(bars)) >= 1.0 else None


def _bar(off: Array, unit: Array) -> Array:
    """Half bar (2,): principal direction of its pixels, with the length of the shorter side."""
    values, vectors = np.linalg.eigh(off.T @ off)
    direction = vectors[:, int(np.argmax(values))]
    direction = direction * (np.sign(direction @ unit) or 1.0)
    along = off @ direction
    return np.asarray(direction * (min(along.max(), -along.min()) + 0.5))


def _filled(patch: NDArray[np.floating], center: Array, bar: Array) -> float:
    """Fraction of an arm that the patch covers."""
    places = np.round(center + np.linspace(0.0, 0.9, 12)[:, None] * bar).astype(int)
    places = np.clip(places, 0, np.array(patch.shape[::-1]) - 1)
    return float((patch[places[:, 1], places[:, 0]] > 0.0).mean())

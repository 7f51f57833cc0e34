"""Detection of disks and crosses in a whole scan, in one pass over its blocks.

Disks are blobs by the Laplacian at several scales, whose outlines at half height are ellipses, tested by a batch fit. A
disk is convex: each ray from its centre crosses the outline once. The outlines of many patches are therefore traced
together, to a fraction of a pixel, and each is compared with the ellipse that has the same moments. Crosses are
connected thin structures that two bars through their centre explain.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial, reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Mask, Single
from measure.marks.shapes import Polarity
from measure.noise.robust_estimation import robust_scale
from measure.scans.scan import Scan
from measure.targets.block_search import Octave, Patches, ScanBlock, TargetCandidate, concatenate, search_blocks
from measure.targets.disks import LEAST_SNR, fit_disks

Sampler = Callable[[NDArray[np.intp], Array], Single]

_RAYS, _FEW_RAYS = 32, (8, 16)  # of an outline, and of the quick tests before it: the first rejects half of the blobs
REACH = 3.0  # radii of a blob within which its patch must end
_CORE, _AROUND = 0.5, (1.5, 2.5)  # radii of a blob: its height is taken within the first, background between the others
_GROUND_SHARE = 1 / 3  # of the rays must reach the background: other objects may be near
_LEAST_HEIGHT = 0.5  # in contrasts of the blob
_CHUNK = 1 << 18  # samples taken at a time: a few MiB
# Maximum of the scale-normalised Laplacian of a disk of contrast 1, at sigma = r / sqrt(2).
_PEAK_OF_DISK = 2 / math.e
_RESPONSE_SIGMAS = 5.0  # above the background texture at that scale
_TEXTURE_PX = 1024  # side, px of the scan: a smaller one may be full of disks, which must not count as texture or noise
_EVERY = 8  # sampling step for the texture and noise estimates
_WORST_MISFIT = 0.075  # rms distance of an outline from its ellipse, in radii, without noise
_NOISE_SIGMAS = 1.5  # factor on the expected misfit from noise, an rms over many rays
_EDGE_PX = 2.5  # height over steepest slope of an edge with a blur of one pixel
_LEAST_FLAT = 0.05  # shorter over longer half axis, squared
_SCALE_STEP = 1.5  # ratio of consecutive radii: between them the response falls by a tenth
_SIZE_TOLERANCE = 1.4  # factor on the stated sizes
_SEARCH_RADIUS_PX = 2.0  # smallest radius of an octave after reduction
_SEARCHED_ARM_PX = 12.0  # half length of a cross in the reduced scan, provided that its lines stay...
_THINNEST_PX = 1.5  # ...this wide
_OCTAVE = 2.0  # longest over shortest half cross found in one reduction
_TOP_HAT_SIGMAS = 5.0  # threshold above the noise of the top-hat image: one noise pixel in a million exceeds it
_STEPS_DEG = 5.0  # step of the bar directions that are tried
_LEAST_ANGLE_DEG = 35.0  # between the bars: a right angle in an oblique view
_BLURRED_PX = 0.75  # by which blur widens a bar on either side
_LEAST_FILLED, _LEAST_EXPLAINED = 0.85, 0.8  # fraction of the bars covered by the patch, and the reverse


@dataclass(frozen=True, eq=False)
class Blobs:
    """Local maxima of the Laplacian. places (n, 2): whole columns and rows; radius (n,) px and contrast (n,) of a disk
    with the same response."""

    places: NDArray[np.intp]
    radius: Array
    contrast: Array

    def part(self, chosen: Mask | slice | NDArray[np.intp]) -> "Blobs":
        return Blobs(self.places[chosen], self.radius[chosen], self.contrast[chosen])


@dataclass(frozen=True, eq=False)
class Outlines:
    """Outlines of n patches. centers (n, 2); moments (n, 2, 2): central second moments of the area, px²; misfit (n,):
    rms distance of the outline from the ellipse of these moments, in radii; height (n,) above the background."""

    centers: Array
    moments: Array
    misfit: Array
    height: Array

    def part(self, chosen: Mask) -> "Outlines":
        return Outlines(self.centers[chosen], self.moments[chosen], self.misfit[chosen], self.height[chosen])

    @property
    def radius(self) -> Array:
        """(n,) of the circle of equal area."""
        return np.asarray(2.0 * np.maximum(np.linalg.det(self.moments), 0.0) ** 0.25)


def blob_outlines(image: Single, blobs: Blobs) -> Outlines:
    """Outlines of the light blobs that end on every ray; most structures of a landscape go on along some ray."""
    near, between = partial(_nearest_values, image), partial(_interpolated_values, image)
    found = []
    for radius in np.unique(blobs.radius).tolist():
        alike = blobs.part(blobs.radius == radius)
        for rays in _FEW_RAYS:
            ends = [_Profiles(near, some, radius, rays, 1.0).ends for some in _chunks(alike, rays * REACH * radius)]
            alike = alike.part(np.concatenate([np.zeros(0, bool), *ends]))
        for some in _chunks(alike, _RAYS * REACH * radius / 0.5):
            profiles = _Profiles(between, some, radius, _RAYS, 0.5)
            found.append(_outlines(some.places[profiles.ends], profiles))
    return concatenate(Outlines(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0)), *found)


def _chunks(blobs: Blobs, samples: float) -> Iterator[Blobs]:
    """Split blobs into parts of limited size. samples: number that each blob takes."""
    count = max(int(_CHUNK / samples), 1)
    return (blobs.part(slice(first, first + count)) for first in range(0, len(blobs.radius), count))


class _Profiles:
    """Grey values (steps, rays, n) along rays from blobs of one radius. ends (n,): whether every ray falls below half
    the height of its blob."""

    def __init__(self, sampled: Sampler, blobs: Blobs, radius: float, rays: int, step_px: float) -> None:
        self.step_px = step_px
        along = step_px * np.arange(int(np.ceil(REACH * radius / step_px)) + 1)
        angle = 2 * np.pi * np.arange(rays) / rays
        self.directions = np.stack([np.cos(angle), np.sin(angle)])
        self.values = sampled(blobs.places, along[:, None] * self.directions[:, None])
        core, around = (along <= _CORE * radius), (along >= _AROUND[0] * radius) & (along <= _AROUND[1] * radius)
        top, outer = self.values[core].mean(axis=(0, 1)), self.values[around].mean(axis=0)
        ground = np.partition(outer, int(_GROUND_SHARE * rays), axis=0)[int(_GROUND_SHARE * rays)]
        self.height = top - ground
        self.level = (top + ground) / 2
        is_below = (self.values[1:].min(axis=0) < self.level).all(axis=0)
        self.ends = (self.values[0, 0] >= self.level) & is_below & (self.height >= _LEAST_HEIGHT * blobs.contrast)


def _nearest_values(image: Single, places: NDArray[np.intp], offsets: Array) -> Single:
    """(steps, rays, n) nearest pixel values at offsets (2, steps, rays) from places (n, 2)."""
    col, row = np.rint(offsets).astype(np.intp)
    width = image.shape[1]
    at = (col + width * row)[..., None] + places @ (1, width)
    return np.asarray(image.ravel().take(at), np.float32)


def _interpolated_values(image: Single, places: NDArray[np.intp], offsets: Array) -> Single:
    """(steps, rays, n) interpolated grey values at offsets (2, steps, rays) from places (n, 2)."""
    at, off = places.T.astype(np.float32), offsets.reshape(2, -1, 1).astype(np.float32)
    values = cv2.remap(image, at[0] + off[0], at[1] + off[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(*offsets.shape[1:], len(places))


def _outlines(places: NDArray[np.intp], profiles: _Profiles) -> Outlines:
    """Outlines of the patches that end: moments of the polygons through the places where the rays fall below half the
    height, by Green's theorem."""
    values, level = profiles.values[..., profiles.ends], profiles.level[profiles.ends]
    last = (values < level).argmax(axis=0)[None] - 1
    inner, outer = (np.take_along_axis(values, step, axis=0)[0] for step in (last, last + 1))
    share = (inner - level) / np.maximum(inner - outer, np.float32(1e-9))
    radii = np.asarray(profiles.step_px * (last[0] + np.clip(share, 0.0, 1.0)), np.float32)
    x, y = profiles.directions[..., None].astype(np.float32) * radii
    x1, y1 = (np.roll(each, -1, axis=0) for each in (x, y))
    twice = x * y1 - x1 * y
    area = twice.sum(axis=0) / 2
    col, row = ((twice * (a + b)).sum(axis=0) / (6 * area) for a, b in ((x, x1), (y, y1)))
    xx, yy = ((twice * (a * a + a * b + b * b)).sum(axis=0) / (12 * area) for a, b in ((x, x1), (y, y1)))
    xy = (twice * (2 * (x * y + x1 * y1) + x * y1 + x1 * y)).sum(axis=0) / (24 * area)
    xx, xy, yy = xx - col * col, xy - col * row, yy - row * row
    x, y = x - col, y - row
    squares = (yy * x * x - 2 * xy * x * y + xx * y * y) / (4 * (xx * yy - xy * xy))
    misfit = np.sqrt(np.mean((np.sqrt(np.maximum(squares, 0.0)) - 1) ** 2, axis=0))
    center, moments = np.stack([col, row], axis=1), np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    height = profiles.height[profiles.ends]
    return Outlines(places + center.astype(float), moments.astype(float), misfit.astype(float), height.astype(float))


@dataclass(frozen=True)
class DiskSearch:
    """Disks to search for.

    diameter_px: smallest and largest, px of the scan; polarity: lighter or darker than the background; least_contrast:
    as a fraction of the full scale.
    """

    diameter_px: tuple[float, float]
    polarity: Polarity = "auto"
    least_contrast: float = 0.02

    def __post_init__(self) -> None:
        smallest, largest = self.diameter_px
        if not 2.0 <= smallest <= largest:
            raise ValueError(f"diameter_px is {self.diameter_px}; 2 or more, the smallest first, is right")
        if self.polarity not in ("light", "dark", "auto"):
            raise ValueError(f"polarity is {self.polarity!r}; light, dark or auto is right")
        if not 0 < self.least_contrast < 1:
            raise ValueError(f"least_contrast is {self.least_contrast}; a share between 0 and 1 is right")


def _margin(radii: list[float]) -> int:
    """Width of the border that the outlines at a part's edge need, px."""
    return int(np.ceil(REACH * radii[-1])) + 3


def _patches(radii: list[float], search: DiskSearch, full_scale_dn: float, factor: int, small: Single) -> Patches:
    """Elliptical patches in a reduced image, within its margin."""
    small = np.ascontiguousarray(small)
    is_textured = small.size * factor**2 >= _TEXTURE_PX**2
    noise = _white_noise(small) if is_textured else 0.0
    found = [Patches.collect(())]
    for sign, own in _blobs(small, radii, search, full_scale_dn, is_textured):
        outlines = blob_outlines(small if sign > 0 else -small, own)
        # Ellipses within the noise of their outlines. The least SNR refers to single pixels of the scan; means over
        # factor² pixels raise it by the factor.
        share = np.minimum(noise / np.maximum(outlines.height, 1e-9), 1 / (LEAST_SNR * factor))
        worst = np.hypot(_WORST_MISFIT, _NOISE_SIGMAS * _EDGE_PX * share / outlines.radius)
        ellipses = outlines.part(outlines.misfit < worst)
        axes, directions = np.linalg.eigh(ellipses.moments)
        shapes = directions * (2 * np.sqrt(np.maximum(axes, 0.0)))[:, None]
        is_wide = axes[:, 0] >= _LEAST_FLAT * axes[:, 1]
        found.append(Patches(ellipses.centers, shapes, sign * ellipses.height).part(is_wide))
    return concatenate(*found)


def _blobs(
    small: Single, radii: list[float], search: DiskSearch, full_scale_dn: float, is_textured: bool
) -> Iterator[tuple[int, Blobs]]:
    """Yield -1 with the dark blobs and 1 with the light ones, within the image's margin. is_textured: whether a blob
    must exceed the background's texture."""
    contrasts, levels = list[Single](), list[float]()
    smooth, blurred = small, 0.0
    for radius in radii:
        sigma = radius / np.sqrt(2)
        further = np.sqrt(sigma**2 - blurred**2)
        smooth = np.asarray(cv2.GaussianBlur(smooth, 2 * (2 * int(3 * further + 0.5) + 1,), further), np.float32)
        blurred = sigma
        contrast = cv2.Laplacian(smooth, cv2.CV_32F, ksize=1, scale=-(sigma**2) / _PEAK_OF_DISK)
        contrasts.append(np.asarray(contrast, np.float32))
        texture = robust_scale(contrasts[-1][::_EVERY, ::_EVERY].astype(float)) if is_textured else 0.0
        levels.append(max(_RESPONSE_SIGMAS * texture, search.least_contrast * full_scale_dn))
    neighbourhood = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, 2 * (2 * max(int(radii[0]), 1) + 1,))
    margin = _margin(radii)
    for sign, polarity in ((-1, "dark"), (1, "light")):  # the light ones last: they overwrite the contrasts
        if search.polarity in (polarity, "auto"):
            standing = [
                cv2.threshold(contrast if sign > 0 else -contrast, level, 0.0, cv2.THRESH_TOZERO)[1]
                for contrast, level in zip(contrasts, levels, strict=True)
            ]
            strongest = reduce(np.maximum, standing)
            peaks = (strongest > 0) & (strongest >= cv2.dilate(strongest, neighbourhood))
            rows, cols = margin + np.array(np.nonzero(peaks[margin:-margin, margin:-margin]))
            by_radius = np.stack([contrast[rows, cols] for contrast in standing])
            radius, contrast = np.array(radii)[by_radius.argmax(axis=0)], by_radius.max(axis=0).astype(float)
            yield sign, Blobs(np.stack([cols, rows], axis=1), radius, contrast)


def _white_noise(small: Single) -> float:
    """Standard deviation of an image's white noise, from samples of its second differences (Immerkaer, 1996, Fast noise
    variance estimation)."""
    above, row, below = (small[first : len(small) - 2 + first : _EVERY] for first in range(3))
    rows = above - 2 * row + below
    left, column, right = (rows[:, first : rows.shape[1] - 2 + first : _EVERY] for first in range(3))
    return robust_scale(np.asarray((left - 2 * column + right) / 6, float))


def disk_candidates(scan: Scan, search: DiskSearch) -> list[TargetCandidate]:
    """Detect disks in a whole scan, in one pass over its blocks.

    Returns
    -------
    Candidates to a tenth of a pixel or so, the strongest first, none within another.
    """
    smallest, largest = search.diameter_px[0] / 2, search.diameter_px[1] / 2
    count = int(np.ceil(np.log(largest / smallest) / np.log(_SCALE_STEP))) + 1
    by_factor: dict[int, list[float]] = {}  # radii, each reduced to a few pixels
    for radius in np.geomspace(smallest, largest, count).tolist():
        factor = max(1, int(2 ** np.floor(np.log2(max(radius / _SEARCH_RADIUS_PX, 1.0)))))
        by_factor.setdefault(factor, []).append(radius / factor)
    octaves = [
        Octave(factor, _margin(radii), partial(_patches, radii, search, scan.full_scale_dn, factor))
        for factor, radii in by_factor.items()
    ]

    def disks(block: ScanBlock, patches: Patches) -> Patches:
        """Fitted disks whose axes agree with the stated diameters in an oblique view."""
        found = fit_disks(block, patches)
        longer, shorter = 2 * np.linalg.svd(found.shapes, compute_uv=False).T
        is_right = longer >= search.diameter_px[0] / _SIZE_TOLERANCE
        return found.part(is_right & (shorter <= search.diameter_px[1] * _SIZE_TOLERANCE))

    return search_blocks(scan, octaves, disks)


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


def cross_candidates(scan: Scan, search: CrossSearch) -> list[TargetCandidate]:
    """Detect crosses in a whole scan, in one pass over its blocks.

    Returns
    -------
    Candidates, the strongest first; the columns of pixel_from_disk are a cross's half bars.
    """
    octaves = []
    shortest, longest = search.half_px
    upper = 0.0
    while upper < longest:
        upper = min(shortest * _OCTAVE, longest)
        # Reduced as far as the line width allows, and by a power of two: a block is a whole number of pixels in every
        # octave.
        finest = max(min(shortest / _SEARCHED_ARM_PX, search.line * shortest / _THINNEST_PX), 1.0)
        factor = int(2 ** np.floor(np.log2(finest)))
        half, margin = (shortest / factor, upper / factor), int(np.ceil(2.0 * upper / factor + 4))
        octaves.append(Octave(factor, margin, partial(_cross_patches, half, margin, search, scan.full_scale_dn)))
        shortest = upper
    return search_blocks(scan, octaves)


def _cross_patches(
    half: tuple[float, float], margin: int, search: CrossSearch, full_scale_dn: float, small: Single
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
        level = max(0.5 * search.least_contrast * full_scale_dn, middle + _TOP_HAT_SIGMAS * noise)
        crosses += _crosses(thin, level, half, search, sign)
    found = Patches.collect(crosses)
    last = np.array(small.shape[::-1]) - margin - 0.5
    return found.part(np.all((found.centers >= margin - 0.5) & (found.centers < last), axis=1))


def _crosses(
    thin: Single, level: float, half: tuple[float, float], search: CrossSearch, sign: float
) -> list[TargetCandidate]:
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
            found.append(TargetCandidate(center + np.array([left, top]), bars, contrast))
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
    arms = np.stack([*bars.T, *-bars.T])
    places = np.round(center + np.linspace(0.0, 0.9, 12)[:, None, None] * arms).astype(int)
    places = np.clip(places, 0, np.array(patch.shape[::-1]) - 1)
    filled = (patch[places[..., 1], places[..., 0]] > 0.0).mean(axis=0).min()
    return (center, bars) if filled >= _LEAST_FILLED and abs(np.linalg.det(bars)) >= 1.0 else None


def _bar(off: Array, unit: Array) -> Array:
    """Half bar (2,): principal direction of its pixels, with the length of the shorter side."""
    values, vectors = np.linalg.eigh(off.T @ off)
    direction = vectors[:, int(np.argmax(values))]
    direction = direction * (np.sign(direction @ unit) or 1.0)
    along = off @ direction
    return np.asarray(direction * (min(along.max(), -along.min()) + 0.5))

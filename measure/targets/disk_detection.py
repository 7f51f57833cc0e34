"""Disks detected in a whole scan: blobs by their Laplacian at several scales, their outlines at half height, then
fitted in batches.

A disk's picture is seen whole from its middle: each ray leaves it once. So the outlines of many patches are found at
once, to a fraction of a pixel, and the ellipse with the moments of each is compared with it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial, reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.marks.shapes import Polarity
from measure.noise.robust_estimation import robust_scales
from measure.scans.scan import Scan
from measure.targets.block_search import Block, Candidate, Octave, Patches, concatenate, search_blocks
from measure.targets.disk_fit_batch import disks_among

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Sampled = Callable[[NDArray[np.intp], Array], Image]

_RAYS, _FEW_RAYS = 32, (8, 16)  # of an outline, and of the looks before: half of the blobs do not outlast the first
REACH = 3.0  # radii of a blob: where its patch must have ended
_CORE, _AROUND = 0.5, (1.5, 2.5)  # radii of a blob: within, that it is as high as; between, that there is ground
_GROUND_SHARE = 1 / 3  # of the rays, that are lower there: other things may stand about
_LEAST_HEIGHT = 0.5  # of the blob's contrast
_CHUNK = 1 << 18  # samples taken at a time: they take a few MiB
# Of the scale-normalised Laplacian of a disk, in units of its contrast, at sigma = r / sqrt(2).
_PEAK_OF_DISK = 2 / math.e
_RESPONSE_SIGMAS = 5.0  # above the picture's own texture at that scale
_TEXTURE_PX = 1024  # side, px of the scan: a smaller picture may be full of disks, which are no texture or noise
_CELL_PX = 1536  # of the scan, side of what has one texture and one noise, about
_EVERY = 8  # column and row are enough to tell these
_WORST_MISFIT = 0.075  # rms distance of an outline from its ellipse, in radii, beside what noise makes of it
_NOISE_SIGMAS = 1.5  # by which that may exceed its expectation: it is that of many rays
_EDGE_PX = 2.5  # of an edge with a blur of a pixel: its whole height over its steepest slope
LEAST_SNR = 4.0  # of a disk that is measured
_LEAST_FLAT = 0.05  # the shorter half axis over the longer, squared
_SCALE_STEP = 1.5  # from one radius to the next at most: between them a disk stands out by a tenth less
_SIZE_TOLERANCE = 1.4  # of what is found, to the sizes that are looked for
_WIDEST_PX = 12288  # of what is looked at in one piece
_SEARCH_RADIUS_PX = 2.0  # reduced so far that the smallest disk of an octave has at least this radius


@dataclass(frozen=True, eq=False)
class Blobs:
    """What stands out: places (n, 2) in whole columns and rows, radius (n,) px and contrast (n,) of a disk that would
    stand out as much."""

    places: NDArray[np.intp]
    radius: Array
    contrast: Array

    def part(self, chosen: Mask | slice | NDArray[np.intp]) -> "Blobs":
        return Blobs(self.places[chosen], self.radius[chosen], self.contrast[chosen])


@dataclass(frozen=True, eq=False)
class Outlines:
    """Of n patches: centers (n, 2), moments (n, 2, 2) of their area about them, px²; misfit (n,): rms distance of the
    outline from the ellipse of these moments, in its radii; height (n,) above the ground."""

    centers: Array
    moments: Array
    misfit: Array
    height: Array

    def part(self, chosen: Mask) -> "Outlines":
        return Outlines(self.centers[chosen], self.moments[chosen], self.misfit[chosen], self.height[chosen])

    @property
    def radius(self) -> Array:
        """(n,) of the circle of the same area."""
        return np.asarray(2.0 * np.maximum(np.linalg.det(self.moments), 0.0) ** 0.25)


_NONE = Outlines(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0))


def blob_outlines(image: Image, blobs: Blobs) -> Outlines:
    """Of those blobs, light ones, that end on every ray; most of what stands out of a landscape runs on along some."""
    near, between = partial(_nearest, image), partial(_interpolated, image)
    found = []
    for radius in np.unique(blobs.radius).tolist():
        alike = blobs.part(blobs.radius == radius)
        for rays in _FEW_RAYS:
            ends = [_Profiles(near, some, radius, rays, 1.0).ends for some in _chunks(alike, rays * REACH * radius)]
            alike = alike.part(np.concatenate([np.zeros(0, bool), *ends]))
        for some in _chunks(alike, _RAYS * REACH * radius / 0.5):
            profiles = _Profiles(between, some, radius, _RAYS, 0.5)
            found.append(_outlines(some.places[profiles.ends], profiles))
    return concatenate(_NONE, *found)


def _chunks(blobs: Blobs, samples: float) -> Iterator[Blobs]:
    """Blobs of which each takes so many samples."""
    count = max(int(_CHUNK / samples), 1)
    return (blobs.part(slice(first, first + count)) for first in range(0, len(blobs.radius), count))


class _Profiles:
    """Grey values (steps, rays, n) along rays from blobs of one radius, at steps of so many px; ends (n,): whether all
    fall below half of the blob's height."""

    def __init__(self, sampled: Sampled, blobs: Blobs, radius: float, rays: int, step_px: float) -> None:
        self.step_px = step_px
        along = step_px * np.arange(int(np.ceil(REACH * radius / step_px)) + 1)
        angle = 2 * np.pi * np.arange(rays) / rays
        self.directions = np.stack([np.cos(angle), np.sin(angle)])
        self.values = sampled(blobs.places, along[:, None] * self.directions[:, None])
        core, around = (along <= _CORE * radius), (along >= _AROUND[0] * radius) & (along <= _AROUND[1] * radius)
        top, outer = self.values[core].mean(axis=(0, 1)), self.values[around].mean(axis=0)
        self.ground = np.partition(outer, int(_GROUND_SHARE * rays), axis=0)[int(_GROUND_SHARE * rays)]
        self.height = top - self.ground
        self.level = (top + self.ground) / 2
        is_below = (self.values[1:].min(axis=0) < self.level).all(axis=0)
        self.ends = (self.values[0, 0] >= self.level) & is_below & (self.height >= _LEAST_HEIGHT * blobs.contrast)

    def radii(self) -> Image:
        """(rays, those that end) px to where the rays fall below half of the height."""
        values, level = self.values[..., self.ends], self.level[self.ends]
        last = (values < level).argmax(axis=0)[None] - 1
        inner, outer = np.take_along_axis(values, last, axis=0)[0], np.take_along_axis(values, last + 1, axis=0)[0]
        share = (inner - level) / np.maximum(inner - outer, np.float32(1e-9))
        return np.asarray(self.step_px * (last[0] + np.clip(share, 0.0, 1.0)), np.float32)


def _nearest(image: Image, places: NDArray[np.intp], offsets: Array) -> Image:
    """(steps, rays, n) pixels nearest to offsets (2, steps, rays) from places (n, 2), within the image."""
    col, row = np.rint(offsets).astype(np.intp)
    width = image.shape[1]
    at = (col + width * row)[..., None] + places @ (1, width)
    return np.asarray(image.ravel().take(at), np.float32)


def _interpolated(image: Image, places: NDArray[np.intp], offsets: Array) -> Image:
    """(steps, rays, n) grey values at offsets (2, steps, rays) from places (n, 2)."""
    at, off = places.T.astype(np.float32), offsets.reshape(2, -1, 1).astype(np.float32)
    values = cv2.remap(image, at[0] + off[0], at[1] + off[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(*offsets.shape[1:], len(places))


def _outlines(places: NDArray[np.intp], profiles: _Profiles) -> Outlines:
    """Of the patches that end: the moments of the polygons that the rays' ends make, by Green's theorem."""
    x, y = profiles.directions[..., None].astype(np.float32) * profiles.radii()
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
    """What is looked for.

    diameter_px: smallest and largest, px of the scan; polarity: whether disks are lighter or darker than what surrounds
    them; least_contrast: as a share of the full scale.
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
    """How far beyond a part of the picture its patches are looked at."""
    return int(np.ceil(REACH * radii[-1])) + 3


def _patches(radii: list[float], search: DiskSearch, full_scale_dn: float, factor: int, small: Image) -> Patches:
    """Patches of a disk's shape in a picture reduced by a factor that lie within its margin."""
    small, scan_px2 = np.ascontiguousarray(small), small.size * factor**2
    cells = Cells.divide(small.shape[1], round(scan_px2 / _CELL_PX**2))
    is_textured = scan_px2 >= _TEXTURE_PX**2
    noise = cells.scales(_fine_structure(small)) if is_textured else np.zeros(len(cells.ends))
    found = []
    for sign, own in _blobs(small, radii, search, full_scale_dn, cells, is_textured):
        outlines = blob_outlines(small if sign > 0 else -small, own)
        found.append(_round_ones(outlines, noise[cells.index(outlines.centers[:, 0])], factor, sign))
    return concatenate(Patches.collect(()), *found)


@dataclass(frozen=True, eq=False)
class Cells:
    """Parts of a picture of about one width, which have a noise and a texture of their own; ends (n,): the columns
    where they end."""

    ends: NDArray[np.intp]

    @classmethod
    def divide(cls, width: int, count: int) -> "Cells":
        """Some count of them, as far as they hold samples."""
        count = max(min(count, width // (2 * _EVERY)), 1)
        return cls(np.linspace(0, width, count + 1).astype(np.intp)[1:])

    def scales(self, samples: Image) -> Array:
        """(n,) robust standard deviations of the samples (rows, columns) in each cell, spread over all of them."""
        count, rows = len(self.ends), len(samples)
        wide = samples.shape[1] // count
        own = samples[:, : count * wide].reshape(rows, count, wide).swapaxes(0, 1)
        return robust_scales(own.reshape(count, -1))

    def index(self, columns: Array) -> NDArray[np.intp]:
        """The cells in which columns lie."""
        return np.searchsorted(self.ends[:-1], columns, side="right")

    def cut(self, picture: Image, levels: Array) -> Image:
        """The picture, which from now on is 0 where it is not above its cell's level."""
        for first, last, level in zip((0, *self.ends), self.ends, levels.tolist(), strict=False):
            cv2.threshold(picture[:, first:last], level, 0.0, cv2.THRESH_TOZERO, picture[:, first:last])
        return picture


def _blobs(
    small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float, cells: Cells, is_textured: bool
) -> Iterator[tuple[int, Blobs]]:
    """1 with the light ones and -1 with the dark ones, within the picture's margin. is_textured: whether they have to
    stand out of their cells' texture."""
    contrasts: list[Image] = []
    levels: list[Array] = []
    smooth, blurred = small, 0.0
    for radius in radii:
        sigma = radius / np.sqrt(2)
        further = np.sqrt(sigma**2 - blurred**2)
        smooth = np.asarray(cv2.GaussianBlur(smooth, 2 * (2 * int(3 * further + 0.5) + 1,), further), np.float32)
        blurred = sigma
        contrast = cv2.Laplacian(smooth, cv2.CV_32F, ksize=1, scale=-(sigma**2) / _PEAK_OF_DISK)
        contrasts.append(np.asarray(contrast, np.float32))
        textures = cells.scales(contrasts[-1][::_EVERY, ::_EVERY]) if is_textured else np.zeros(len(cells.ends))
        levels.append(np.maximum(_RESPONSE_SIGMAS * textures, search.least_contrast * full_scale_dn))
    neighbourhood = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, 2 * (2 * max(int(radii[0]), 1) + 1,))
    margin = _margin(radii)
    for sign, polarity in ((-1, "dark"), (1, "light")):  # which may use the contrasts up
        if search.polarity in (polarity, "auto"):
            standing = [
                cells.cut(contrast if sign > 0 else -contrast, level)
                for contrast, level in zip(contrasts, levels, strict=True)
            ]
            strongest = reduce(np.maximum, standing)
            peaks = (strongest > 0) & (strongest >= cv2.dilate(strongest, neighbourhood))
            rows, cols = margin + np.array(np.nonzero(peaks[margin:-margin, margin:-margin]))
            by_radius = np.stack([contrast[rows, cols] for contrast in standing])
            radius, contrast = np.array(radii)[by_radius.argmax(axis=0)], by_radius.max(axis=0).astype(float)
            yield sign, Blobs(np.stack([cols, rows], axis=1), radius, contrast)


def _fine_structure(small: Image) -> Image:
    """Samples of what is no smooth picture, with the noise's standard deviation (Immerkaer, 1996, Fast noise variance
    estimation)."""
    above, row, below = (small[first : len(small) - 2 + first : _EVERY] for first in range(3))
    rows = above - 2 * row + below
    left, column, right = (rows[:, first : rows.shape[1] - 2 + first : _EVERY] for first in range(3))
    return np.asarray((left - 2 * column + right) / 6)


def _round_ones(found: Outlines, noise: Array, factor: int, sign: int) -> Patches:
    """Those that are ellipses but for noise (n,), light ones if the sign is 1, dark ones if it is -1.

    A disk that stands out of the noise of the scan's own pixels stands out of their means so much the more.
    """
    share = np.minimum(noise / np.maximum(found.height, 1e-9), 1 / (LEAST_SNR * factor))
    kept = found.part(found.misfit < np.hypot(_WORST_MISFIT, _NOISE_SIGMAS * _EDGE_PX * share / found.radius))
    axes, directions = np.linalg.eigh(kept.moments)
    shapes = directions * (2 * np.sqrt(np.maximum(axes, 0.0)))[:, None]
    is_wide = axes[:, 0] >= _LEAST_FLAT * axes[:, 1]
    return Patches(kept.centers, shapes, sign * kept.height).part(is_wide)


def disk_candidates(scan: Scan, search: DiskSearch) -> list[Candidate]:
    """Detect disks in a whole scan, in one pass over its blocks.

    Returns
    -------
    Candidates to a tenth of a pixel or so, the strongest first, none within another.
    """
    smallest, largest = search.diameter_px[0] / _SIZE_TOLERANCE, search.diameter_px[1] * _SIZE_TOLERANCE

    def disks(block: Block, patches: Patches) -> Patches:
        """Those whose diameters can be those of disks seen obliquely."""
        found = disks_among(block, patches)
        longer, shorter = 2 * np.linalg.svd(found.shapes, compute_uv=False).T
        return found.part((longer >= smallest) & (shorter <= largest))

    return search_blocks(scan, disk_octaves(search, scan.full_scale_dn), disks)


def disk_octaves(search: DiskSearch, full_scale_dn: float) -> list[Octave]:
    """Radii from the smallest to the largest, each in the reduction that leaves it a few pixels."""
    smallest, largest = search.diameter_px[0] / 2, search.diameter_px[1] / 2
    count = int(np.ceil(np.log(largest / smallest) / np.log(_SCALE_STEP))) + 1
    by_factor: dict[int, list[float]] = {}
    for radius in np.geomspace(smallest, largest, count).tolist():
        factor = max(1, int(2 ** np.floor(np.log2(max(radius / _SEARCH_RADIUS_PX, 1.0)))))
        by_factor.setdefault(factor, []).append(radius / factor)
    return [
        Octave(factor, _margin(radii), _WIDEST_PX, partial(_patches, radii, search, full_scale_dn, factor))
        for factor, radii in by_factor.items()
    ]

"""Patches of a disk's shape in a picture: blobs by their Laplacian at several scales, then by the outline at half of
their height."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.noise.robust_estimation import robust_scales
from measure.single_targets.block import joined
from measure.single_targets.disk_outlines import REACH, Blobs, Outlines, outlines_about

Array = NDArray[np.float64]
Image = NDArray[np.float32]

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


@dataclass(frozen=True)
class DiskSearch:
    """What is looked for.

    diameter_px: smallest and largest, px of the scan; polarity: whether disks are lighter or darker than what surrounds
    them; least_contrast: as a share of the full scale.
    """

    diameter_px: tuple[float, float]
    polarity: Literal["light", "dark", "auto"] = "auto"
    least_contrast: float = 0.02

    def __post_init__(self) -> None:
        smallest, largest = self.diameter_px
        if not 2.0 <= smallest <= largest:
            raise ValueError(f"diameter_px is {self.diameter_px}; 2 or more, the smallest first, is right")
        if self.polarity not in ("light", "dark", "auto"):
            raise ValueError(f"polarity is {self.polarity!r}; light, dark or auto is right")
        if not 0 < self.least_contrast < 1:
            raise ValueError(f"least_contrast is {self.least_contrast}; a share between 0 and 1 is right")


@dataclass(frozen=True, eq=False)
class Candidate:
    """A patch that may be a disk: center_px (2,), pixel_from_disk (2, 2), contrast_dn: positive where it is light."""

    center_px: Array
    pixel_from_disk: Array
    contrast_dn: float

    @property
    def radius_px(self) -> float:
        """Of the circle of the same area."""
        (a, b), (c, d) = self.pixel_from_disk.tolist()
        return math.sqrt(abs(a * d - b * c))


@dataclass(frozen=True, eq=False)
class Patches:
    """Of n candidates: centers (n, 2) px, shapes (n, 2, 2) as their pixel_from_disk, contrasts (n,)."""

    centers: Array
    shapes: Array
    contrasts: Array

    @classmethod
    def of(cls, candidates: Sequence[Candidate]) -> "Patches":
        return cls(
            np.array([each.center_px for each in candidates]).reshape(-1, 2),
            np.array([each.pixel_from_disk for each in candidates]).reshape(-1, 2, 2),
            np.array([each.contrast_dn for each in candidates], float),
        )

    def candidates(self) -> list[Candidate]:
        return [*map(Candidate, self.centers, self.shapes, self.contrasts.tolist())]

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> "Patches":
        return Patches(self.centers[chosen], self.shapes[chosen], self.contrasts[chosen])

    @property
    def radii(self) -> Array:
        """(n,) of the circles of the same area."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.shapes))))

    def by_strength(self) -> "Patches":
        """The strongest first, whatever the order in which they were found."""
        return self.part(np.lexsort((*self.centers.T[::-1], -np.abs(self.contrasts))))


def margin_px(radii: list[float]) -> int:
    """How far beyond a part of the picture its patches are looked at."""
    return int(np.ceil(REACH * radii[-1])) + 3


def patches(small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float, factor: int) -> Patches:
    """Patches of a disk's shape in a picture reduced by a factor that lie within its margin."""
    small, scan_px2 = np.ascontiguousarray(small), small.size * factor**2
    cells = Cells.of(small.shape[1], round(scan_px2 / _CELL_PX**2))
    is_textured = scan_px2 >= _TEXTURE_PX**2
    noise = cells.scales(_fine_structure(small)) if is_textured else np.zeros(len(cells.ends))
    found = []
    for sign, own in _blobs(small, radii, search, full_scale_dn, cells, is_textured):
        outlines = outlines_about(small if sign > 0 else -small, own)
        found.append(_round_ones(outlines, noise[cells.at(outlines.centers[:, 0])], factor, sign))
    return joined(Patches.of(()), *found)


@dataclass(frozen=True, eq=False)
class Cells:
    """Parts of a picture of about one width, which have a noise and a texture of their own; ends (n,): the columns
    where they end."""

    ends: NDArray[np.intp]

    @classmethod
    def of(cls, width: int, count: int) -> "Cells":
        """Some count of them, as far as they hold samples."""
        count = max(min(count, width // (2 * _EVERY)), 1)
        return cls(np.linspace(0, width, count + 1).astype(np.intp)[1:])

    def scales(self, samples: Image) -> Array:
        """(n,) robust standard deviations of the samples (rows, columns) in each cell, spread over all of them."""
        count, rows = len(self.ends), len(samples)
        wide = samples.shape[1] // count
        own = samples[:, : count * wide].reshape(rows, count, wide).swapaxes(0, 1)
        return robust_scales(own.reshape(count, -1))

    def at(self, columns: Array) -> NDArray[np.intp]:
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
    margin, width = margin_px(radii), small.shape[1] - 2 * margin_px(radii)
    for sign, polarity in ((-1, "dark"), (1, "light")):  # which may use the contrasts up
        if search.polarity in (polarity, "auto"):
            standing = [
                cells.cut(contrast if sign > 0 else -contrast, level)
                for contrast, level in zip(contrasts, levels, strict=True)
            ]
            strongest = reduce(np.maximum, standing)
            peaks = (strongest > 0) & (strongest >= cv2.dilate(strongest, neighbourhood))
            rows, cols = (
                place + margin for place in divmod(np.flatnonzero(peaks[margin:-margin, margin:-margin]), width)
            )
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

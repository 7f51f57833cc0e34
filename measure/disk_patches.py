"""Patches of a disk's shape in a picture: blobs by their Laplacian at several scales, then by the outline at half of
their height."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from math import sqrt
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.disk_outlines import Blobs, Outlines, outlines_about
from measure.noise import robust_scale

Array = NDArray[np.float64]
Image = NDArray[np.float32]

PEAK_OF_DISK = 2 / np.e  # of the scale-normalised Laplacian of a disk, in units of its contrast, at sigma = r / sqrt(2)
RESPONSE_SIGMAS = 5.0  # above the picture's own texture at that scale...
TEXTURE_PX = 1024  # ...where it is so large, px of the scan along a side: a smaller one may be full of disks
WORST_MISFIT = 0.075  # rms distance of an outline from its ellipse, in radii, beside what noise makes of it
NOISE_SIGMAS = 1.5  # by which that may exceed its expectation: it is that of many rays
EDGE_PX = 2.5  # of an edge with a blur of a pixel: its whole height over its steepest slope
LEAST_SNR = 4.0  # of a disk that is measured
LEAST_FLAT = 0.05  # the shorter half axis over the longer, squared


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
        return sqrt(abs(a * d - b * c))


def strength(patch: Candidate) -> tuple[float, ...]:
    """Sorts the strongest first, whatever the order in which they were found."""
    return -abs(patch.contrast_dn), *patch.center_px.tolist()


def margin_px(radii: list[float]) -> int:
    """How far beyond a part of the picture its patches may be looked at."""
    return int(np.ceil(4 * radii[-1])) + 3


def patches(small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float, factor: int) -> list[Candidate]:
    """Patches of a disk's shape in a picture reduced by a factor, without its margin; some may be there twice."""
    noise = fine_noise(small)
    return [
        Candidate(center, shape, sign * height)
        for sign, own in blobs(small, radii, search, full_scale_dn, small.size * factor**2 >= TEXTURE_PX**2)
        for center, shape, height in round_ones(outlines_about(small if sign > 0 else -small, own), noise, factor)
    ]


def blobs(
    small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float, is_textured: bool
) -> Iterator[tuple[int, Blobs]]:
    """1 with the light ones and -1 with the dark ones, none so near to the border that its outline could be cut.
    is_textured: whether they have to stand out of the picture's own texture."""
    contrasts, levels = [], []
    for radius in radii:
        sigma = radius / np.sqrt(2)
        smooth = cv2.GaussianBlur(small, 2 * (2 * int(3 * sigma + 0.5) + 1,), sigma)
        contrasts.append(cv2.Laplacian(smooth, cv2.CV_32F, ksize=1, scale=-(sigma**2) / PEAK_OF_DISK))
        texture = robust_scale(contrasts[-1][::8, ::8].astype(np.float64)) if is_textured else 0.0
        levels.append(max(RESPONSE_SIGMAS * texture, search.least_contrast * full_scale_dn))
    neighbourhood = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, 2 * (2 * max(int(radii[0]), 1) + 1,))
    border = int(np.ceil(3 * radii[-1])) + 2
    for sign, polarity in ((1, "light"), (-1, "dark")):
        if search.polarity in (polarity, "auto"):
            standing = [
                cv2.threshold(contrast if sign > 0 else -contrast, level, 0, cv2.THRESH_TOZERO)[1]
                for contrast, level in zip(contrasts, levels, strict=True)
            ]
            strongest = reduce(cv2.max, standing)
            peaks = (strongest > 0) & (strongest >= cv2.dilate(strongest, neighbourhood))
            rows, cols = (place + border for place in np.nonzero(peaks[border:-border, border:-border]))
            by_radius = np.stack([contrast[rows, cols] for contrast in standing])
            radius, contrast = np.array(radii)[by_radius.argmax(axis=0)], by_radius.max(axis=0).astype(float)
            yield sign, Blobs(np.stack([cols, rows], axis=1), radius, contrast)


def fine_noise(small: Image) -> float:
    """The standard deviation of what is no smooth picture (Immerkaer, 1996, Fast noise variance estimation)."""
    kernel = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], np.float32) / 6
    return robust_scale(np.asarray(cv2.filter2D(small, cv2.CV_32F, kernel)[1:-1:8, 1:-1:8], np.float64))


def round_ones(found: Outlines, noise: float, factor: int) -> Iterator[tuple[Array, Array, float]]:
    """Centre (2,), shape (2, 2) and height of those that are ellipses but for noise.

    A disk that stands out of the noise of the scan's own pixels stands out of their means so much the more.
    """
    share = np.minimum(noise / np.maximum(found.height, 1e-9), 1 / (LEAST_SNR * factor))
    kept = found.part(found.misfit < np.hypot(WORST_MISFIT, NOISE_SIGMAS * EDGE_PX * share / found.radius))
    axes, directions = np.linalg.eigh(kept.moments)
    for index in np.flatnonzero(axes[:, 0] >= LEAST_FLAT * axes[:, 1]):
        yield kept.centers[index], directions[index] * (2 * np.sqrt(axes[index])), float(kept.height[index])

"""Patches of a disk's shape in a picture: blobs by their Laplacian at several scales, then by the outline at half of
their height."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.noise import robust_scale

Array = NDArray[np.float64]
Image = NDArray[np.float32]

PEAK_OF_DISK = 2 / np.e  # of the scale-normalised Laplacian of a disk, in units of its contrast, at sigma = r / sqrt(2)
RESPONSE_SIGMAS = 5.0  # above the picture's own texture at that scale
ROUNDEST, LEAST_ROUND = 1.12, 0.85  # area of a patch over that of the ellipse of its moments
LEAST_FLAT = 0.05  # the shorter half axis over the longer, squared
RAYS = 32  # from a blob outwards: on each a patch must end


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
        return float(np.sqrt(abs(np.linalg.det(self.pixel_from_disk))))


@dataclass(frozen=True)
class Blob:
    """Where the scale-normalised Laplacian is extreme in place and radius; contrast: positive where it is light."""

    col: int
    row: int
    radius: float
    contrast: float

    @property
    def half(self) -> int:
        """Of the crop that shows the blob and its ground."""
        return int(np.ceil(3.0 * self.radius)) + 2


@dataclass(frozen=True)
class Standing:
    """A blob with the heights of its middle and of the ground about it, the sign such that the blob is the higher."""

    blob: Blob
    top: float
    ground: float


def margin_px(radii: list[float]) -> int:
    """How far beyond a part of the picture its patches may be looked at."""
    return int(np.ceil(4 * radii[-1])) + 3


def patches(small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float) -> list[Candidate]:
    """Patches of a disk's shape in a reduced picture, without its margin."""
    found, covered = [], np.zeros(small.shape, bool)
    for standing in enclosed(small, blobs(small, radii, search, full_scale_dn)):
        row, col, near = standing.blob.row, standing.blob.col, max(int(standing.blob.radius // 2), 1)
        if not covered[row, col]:
            patch = patch_about(small, standing)
            if patch is not None:
                found.append(patch)
                covered[max(row - near, 0) : row + near + 1, max(col - near, 0) : col + near + 1] = True
    return found


def blobs(small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float) -> list[Blob]:
    """The strongest first; none so near to the border that its crop would be cut."""
    strongest, best_radius = np.zeros_like(small), np.zeros_like(small)
    least = search.least_contrast * full_scale_dn
    for radius in radii:
        sigma = radius / np.sqrt(2)
        laplacian = cv2.Laplacian(cv2.GaussianBlur(small, (0, 0), sigma), cv2.CV_32F, ksize=1)
        contrast = np.asarray(laplacian * np.float32(-(sigma**2) / PEAK_OF_DISK), np.float32)
        texture = robust_scale(contrast[::3, ::3].astype(np.float64))
        stronger = (np.abs(contrast) > np.abs(strongest)) & (np.abs(contrast) > RESPONSE_SIGMAS * texture)
        strongest = np.where(stronger, contrast, strongest)
        best_radius = np.where(stronger, np.float32(radius), best_radius)
    neighbourhood = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, 2 * (2 * max(int(0.5 * radii[0]), 1) + 1,))
    found = []
    for sign, polarity in ((1, "light"), (-1, "dark")):
        if search.polarity in (polarity, "auto"):
            signed = sign * strongest
            around = cv2.blur(small, 2 * (2 * int(2 * radii[-1]) + 1,))
            peak = (
                (signed >= cv2.dilate(signed, neighbourhood))
                & (signed > least)
                & (sign * (small - around) > 0.3 * signed)
            )
            border = int(np.ceil(3 * radii[-1])) + 2
            places = np.argwhere(peak[border:-border, border:-border]) + border
            found += [
                Blob(int(col), int(row), float(best_radius[row, col]), float(strongest[row, col]))
                for row, col in places
            ]
    return sorted(found, key=lambda blob: -abs(blob.contrast))


def enclosed(small: Image, found: list[Blob]) -> list[Standing]:
    """Those of the blobs, in their order, whose patch may end before the crop does: edges and ridges, most of what
    stands out of a landscape, run on along one of the rays."""
    kept: dict[int, Standing] = {}
    for radius in {blob.radius for blob in found}:
        own = [index for index, blob in enumerate(found) if blob.radius == radius]
        top, ground, ends = _on_rays(small, [found[index] for index in own])
        for place in np.flatnonzero(ends):
            kept[own[place]] = Standing(found[own[place]], float(top[place]), float(ground[place]))
    return [kept[index] for index in sorted(kept)]


def _on_rays(small: Image, alike: list[Blob]) -> tuple[Image, Image, NDArray[np.bool_]]:
    """(n,) heights of blobs of one radius, of the ground about them, the sign such that the blob is higher, and whether
    they stand out and end on all rays; in steps of one pixel a ray cannot leave its patch unnoticed."""
    half, inner = alike[0].half, int(alike[0].radius // 3)
    rows, cols = (np.array([getattr(blob, name) for blob in alike]) - half for name in ("row", "col"))
    contrast = np.array([blob.contrast for blob in alike], np.float32)
    side = 2 * half + 1
    crops = np.lib.stride_tricks.sliding_window_view(small, (side, side))[rows, cols]
    signed = crops * np.sign(contrast)[:, None, None]
    middle = slice(half - inner, half + inner + 1)
    top = signed[:, middle, middle].mean(axis=(1, 2))
    flat = signed.reshape(len(alike), -1)
    ground = np.partition(flat, flat.shape[1] // 3, axis=1)[:, flat.shape[1] // 3]
    angle = 2 * np.pi * np.arange(RAYS) / RAYS
    step = np.stack([np.cos(angle), np.sin(angle)]) / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    col, row = half + np.rint(step[:, :, None] * np.arange(half + 1)).astype(int)
    above = signed[:, row, col] > ((top + ground) / 2)[:, None, None]
    stands_out = top - ground >= 0.5 * np.abs(contrast)
    return top, ground, np.asarray(stands_out & above[:, 0, 0] & ~above.all(axis=2).any(axis=1))


def patch_about(small: Image, standing: Standing) -> Candidate | None:
    """The patch about a blob that stands out by half of its height, if it has the shape of an ellipse."""
    blob, level = standing.blob, (standing.top + standing.ground) / 2
    half, sign = blob.half, np.sign(blob.contrast)
    row0, col0 = blob.row - half, blob.col - half
    crop = small[row0 : row0 + 2 * half + 1, col0 : col0 + 2 * half + 1]
    _, labels, stats, _ = cv2.connectedComponentsWithStats((crop * sign > level).view(np.uint8))
    label = labels[half, half]
    left, upper, wide, tall, area = stats[label]
    touches = left == 0 or upper == 0 or left + wide == crop.shape[1] or upper + tall == crop.shape[0]
    if label == 0 or touches or area < 5:
        return None
    patch = (labels[upper : upper + tall, left : left + wide] == label).view(np.uint8)
    return ellipse_of(patch, np.array([col0 + left, row0 + upper]), (standing.top - standing.ground) * sign)


def ellipse_of(patch: NDArray[np.uint8], origin: Array, contrast: float) -> Candidate | None:
    """The ellipse with the moments of a patch, 1 among 0, if the patch fills it as an ellipse does."""
    sums = cv2.moments(patch, binaryImage=True)
    area = sums["m00"]
    moments = np.array([[sums["mu20"], sums["mu11"]], [sums["mu11"], sums["mu02"]]]) / area + np.eye(2) / 12
    fill = area / (4 * np.pi * np.sqrt(moments[0, 0] * moments[1, 1] - moments[0, 1] ** 2))
    if not LEAST_ROUND < fill < ROUNDEST:
        return None
    axes, directions = np.linalg.eigh(moments)
    if axes[0] < LEAST_FLAT * axes[1]:
        return None
    center = origin + np.array([sums["m10"], sums["m01"]]) / area
    return Candidate(center, directions * (2 * np.sqrt(axes)), contrast)

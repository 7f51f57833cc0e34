"""Round targets found in the whole frame, in one pass over its blocks: blobs by their Laplacian at several scales, then
by the shape of the patch that stands out, then by least-squares matching."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from measure.disks import FittedDisk, fit_disk
from measure.noise import robust_scale
from measure.scan import Scan

Array = NDArray[np.float64]
Image = NDArray[np.float32]

BLOCK_PX = 1536  # of the full picture
SCALE_STEP = 1.35  # from one radius to the next
SEARCH_RADIUS_PX = 3.0  # reduced so far that the smallest disk of an octave has about this radius
PEAK_OF_DISK = 2 / np.e  # of the scale-normalised Laplacian of a disk, in units of its contrast, at sigma = r / sqrt(2)
RESPONSE_SIGMAS = 5.0  # above the picture's own texture at that scale
ROUNDEST, LEAST_ROUND = 1.12, 0.85  # area of a patch over that of the ellipse of its moments


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


def find_disks(scan: Scan, search: DiskSearch) -> tuple[FittedDisk, ...]:
    """All disks of the frame that the fit does not refuse, from top to bottom."""
    fitted = [fit_disk(scan, patch.center_px, patch.pixel_from_disk) for patch in disk_candidates(scan, search)]
    kept = [disk for disk in fitted if not disk.reason and disk.half_axes_px[0] < search.diameter_px[1]]
    return tuple(sorted(without_doubles(kept), key=lambda disk: (disk.center_px[1], disk.center_px[0])))


def without_doubles(disks: list[FittedDisk]) -> list[FittedDisk]:
    """Of disks found twice, one."""
    kept: list[FittedDisk] = []
    for disk in disks:
        reach = disk.half_axes_px[1]
        if all(np.hypot(*(disk.center_px - other.center_px)) > reach for other in kept):
            kept.append(disk)
    return kept


def disk_candidates(scan: Scan, search: DiskSearch) -> list[Candidate]:
    """Patches of a disk's shape, the strongest first, none within another."""
    found: list[Candidate] = []
    for factor, radii in octaves(search.diameter_px):
        margin = int(np.ceil(4 * radii[-1])) * factor
        for col0, row0 in blocks(scan, factor):
            size = block_px(factor) + 2 * margin
            window = scan.window(col0 - margin, row0 - margin, size, size)
            small = np.asarray(
                cv2.resize(window, (size // factor, size // factor), interpolation=cv2.INTER_AREA), np.float32
            )
            origin = np.array([col0 - margin, row0 - margin]) + (factor - 1) / 2
            for patch in patches(small, radii, search, scan.full_scale_dn):
                center = patch.center_px * factor + origin
                if is_own(center, col0, row0, size - 2 * margin, scan):
                    found.append(Candidate(center, patch.pixel_from_disk * factor, patch.contrast_dn))
    found.sort(key=lambda patch: (-abs(patch.contrast_dn), *patch.center_px))
    return separate(found)


def octaves(diameter_px: tuple[float, float]) -> Iterator[tuple[int, list[float]]]:
    """Reduction factors and the radii (reduced px) to search at each."""
    radius, largest = diameter_px[0] / 2, diameter_px[1] / 2
    steps = [radius]
    while steps[-1] < largest:
        steps.append(steps[-1] * SCALE_STEP)
    by_factor: dict[int, list[float]] = {}
    for step in steps:
        factor = max(1, int(2 ** np.floor(np.log2(max(step / SEARCH_RADIUS_PX, 1.0)))))
        by_factor.setdefault(factor, []).append(step / factor)
    yield from by_factor.items()


def block_px(factor: int) -> int:
    """The side of a block: a whole number of reduced pixels."""
    return (BLOCK_PX // factor) * factor


def blocks(scan: Scan, factor: int) -> Iterator[tuple[int, int]]:
    """Upper left corners of the blocks."""
    step = block_px(factor)
    for row0 in range(0, scan.height_px, step):
        for col0 in range(0, scan.width_px, step):
            yield col0, row0


def is_own(center: Array, col0: int, row0: int, size: int, scan: Scan) -> bool:
    """Whether a centre lies in the block itself, not in its margin, and in the scan."""
    col, row = center + 0.5
    in_block = col0 <= col < col0 + size and row0 <= row < row0 + size
    return bool(in_block and col <= scan.width_px and row <= scan.height_px)


def patches(small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float) -> list[Candidate]:
    """Patches of a disk's shape in a reduced picture."""
    found, covered = [], np.zeros(small.shape, bool)
    for col, row, radius, contrast in blobs(small, radii, search, full_scale_dn):
        if not covered[row, col]:
            patch = patch_about(small, col, row, radius, contrast)
            if patch is not None:
                found.append(patch)
                near = max(int(radius // 2), 1)
                covered[max(row - near, 0) : row + near + 1, max(col - near, 0) : col + near + 1] = True
    return found


def blobs(
    small: Image, radii: list[float], search: DiskSearch, full_scale_dn: float
) -> list[tuple[int, int, float, float]]:
    """Column, row, radius and contrast (positive: light) where the scale-normalised Laplacian is extreme in place and
    radius, the strongest first."""
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
            places = np.argwhere(peak)
            found += [
                (int(col), int(row), float(best_radius[row, col]), float(strongest[row, col])) for row, col in places
            ]
    return sorted(found, key=lambda blob: -abs(blob[3]))


def patch_about(small: Image, col: int, row: int, radius: float, contrast: float) -> Candidate | None:
    """The patch about a blob that stands out by half of its contrast, if it has the shape of an ellipse."""
    half = int(np.ceil(3.0 * radius)) + 2
    row0, col0 = max(row - half, 0), max(col - half, 0)
    crop = small[row0 : row + half + 1, col0 : col + half + 1]
    signed = crop if contrast > 0 else -crop
    inner = int(radius // 3)
    core = signed[
        max(row - row0 - inner, 0) : row - row0 + inner + 1, max(col - col0 - inner, 0) : col - col0 + inner + 1
    ]
    top, ground = float(core.mean()), float(np.partition(signed, signed.size // 3, axis=None)[signed.size // 3])
    if top - ground < 0.5 * abs(contrast):
        return None
    _, labels, stats, _ = cv2.connectedComponentsWithStats((signed > (top + ground) / 2).astype(np.uint8))
    label = labels[row - row0, col - col0]
    left, upper, wide, tall, area = stats[label]
    if (
        label == 0
        or left == 0
        or upper == 0
        or left + wide == crop.shape[1]
        or upper + tall == crop.shape[0]
        or area < 5
    ):
        return None
    return ellipse_of(labels == label, np.array([col0, row0]), (top - ground) * np.sign(contrast))


def ellipse_of(patch: NDArray[np.bool_], origin: Array, contrast: float) -> Candidate | None:
    """The ellipse with the patch's moments, if the patch fills it as an ellipse does."""
    rows, cols = np.nonzero(patch)
    places = np.stack([cols, rows]).astype(float)
    moments = np.cov(places, bias=True) + np.eye(2) / 12
    axes, directions = np.linalg.eigh(moments)
    if axes[0] < 0.05 * axes[1]:
        return None
    half_axes = 2 * np.sqrt(axes)
    fill = len(rows) / (np.pi * half_axes[0] * half_axes[1])
    if not LEAST_ROUND < fill < ROUNDEST:
        return None
    return Candidate(places.mean(axis=1) + origin, directions * half_axes, contrast)


def separate(found: list[Candidate]) -> list[Candidate]:
    """The strongest of candidates that lie within one another."""
    centers = np.array([patch.center_px for patch in found]).reshape(-1, 2)
    radii = np.array([patch.radius_px for patch in found])
    kept = np.zeros(len(found), bool)
    for index, near in enumerate(cKDTree(centers).query_ball_point(centers, 0.7 * radii) if found else ()):
        kept[index] = not kept[near].any()
    return [patch for patch, is_kept in zip(found, kept, strict=True) if is_kept]

"""Scans for tie points: detection of SIFT features and matching between two scans."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.array_types import Array, Indices, Mask
from measure.errors import MeasurementError
from measure.flags import Code, Reason
from measure.geometry import linear_scale, scan_px
from measure.scans.opening import open_scan
from measure.scans.parallel import map_or_replace
from measure.scans.scan import Scan
from measure.tie_points.multi_image import RADIUS_PX, SPARE_PX, Piece

_LONGEST_PX = 3000  # longer side of the reduced scan
_TILE_PX, _OVERLAP_PX = 1024, 96  # SIFT needs some 130 bytes per pixel: one tile at a time
_CONTRAST = 0.02  # half of OpenCV's default: fields and water have weak texture
_RATIO = 0.8  # ratio test of Lowe: rejects nine false matches in ten, and one right match in twenty
_CELLS = 12  # per side, over which the kept features are spread
_SURPLUS = 3  # detected features per wanted one: some are unusable, and the strongest are clustered
_STRETCH = (0.5, 99.5)  # percentiles of the grey values that are mapped to black and white


@dataclass(frozen=True, eq=False)
class TieFrame:
    """A scan for tie points.

    Attributes
    ----------
    image, scan : name and file.
    pixel_from_camera : (2, 3) from camera coordinates (x', y', 1), mm, to column and row.
    frame_mm : width and height of the exposed frame about the origin; None if the whole scan is exposed.
    taken_px : (n, 3) column, row and radius of marks, which are excluded.
    max_pixels : limit for the scan, if the user states one.
    part_of : name of the exposed frame if this scan is one part of it.
    """

    image: str
    scan: Path
    pixel_from_camera: Array
    frame_mm: tuple[float, float] | None
    taken_px: Array
    max_pixels: int | None = None
    part_of: str = ""

    @property
    def frame(self) -> str:
        """Name of the exposed frame."""
        return self.part_of or self.image

    def open(self) -> Scan:
        """Open the scan; raises MeasurementError where it cannot be read."""
        return open_scan(self.scan, self.max_pixels)

    @property
    def px_per_mm(self) -> float:
        return linear_scale(self.pixel_from_camera)

    @property
    def mirrored(self) -> bool:
        """Whether the scan is mirrored. Rows count downward and y' upward: an ordinary scan has a negative
        determinant."""
        return bool(np.linalg.det(self.pixel_from_camera[:, :2]) > 0.0)

    def camera_px(self, places_px: Array) -> Array:
        """(n, 2) camera coordinates of places, in pixels."""
        linear, shift = self.pixel_from_camera[:, :2], self.pixel_from_camera[:, 2]
        return np.asarray((places_px - shift) @ np.linalg.inv(linear).T * self.px_per_mm)

    def usable(self, places_px: Array, size_px: tuple[int, int], radius_px: int = RADIUS_PX) -> Mask:
        """Mask of the places whose whole patch lies within the exposed frame and clear of marks."""
        rim = radius_px + SPARE_PX
        inside = np.all((places_px >= rim) & (places_px <= np.array(size_px) - 1 - rim), axis=1)
        if self.frame_mm is not None:
            half = np.array(self.frame_mm) / 2 * self.px_per_mm - rim
            inside &= np.all(np.abs(self.camera_px(places_px)) <= half, axis=1)
        if len(self.taken_px) and len(places_px):
            for col, row, radius in self.taken_px:
                inside &= np.hypot(*(places_px - (col, row)).T) > radius + radius_px
        return np.asarray(inside)


@dataclass(frozen=True, eq=False)
class Features:
    """SIFT features of a scan. places_px (n, 2): column and row; descriptors (n, 128); strengths (n,): contrast;
    textures (n,): smaller eigenvalue of the gradient matrix over a patch; size_px: width and height of the scan;
    reduction: factor by which it was reduced."""

    places_px: Array
    descriptors: NDArray[np.float32]
    strengths: Array
    textures: Array
    size_px: tuple[int, int] = (0, 0)
    reduction: int = 1

    def part(self, rows: Indices) -> "Features":
        arrays = ("places_px", "descriptors", "strengths", "textures")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})


def find_all_features(
    frames: Sequence[TieFrame], count: int, are_alike: bool, what_fails: str, workers: Executor | None
) -> Iterator[Features | Reason]:
    """Detect at most count features in every scan.

    are_alike: the scans show one film, so that none is mirrored against another; what_fails: start of the reason that
    an unreadable scan gets.
    """
    find = partial(_features, count, are_alike, what_fails)
    return map_or_replace(workers, find, frames, lambda _, why: unreachable(what_fails, why))


def unreachable(what_fails: str, why: str) -> Reason:
    """Reason of a scan that cannot be read."""
    return Reason(f"{what_fails}: {why}", Code.UNREACHABLE)


def _features(count: int, are_alike: bool, what_fails: str, frame: TieFrame) -> Features | Reason:
    """Features spread evenly over the scan, the strongest of each cell first."""
    try:
        with frame.open() as scan:
            size_px = scan.width_px, scan.height_px
            factor = -(-max(size_px) // _LONGEST_PX)
            grey = scan.reduced(factor)
    except MeasurementError as error:
        return unreachable(what_fails, str(error))
    # In the mirror image of a mirrored scan: SIFT descriptors are invariant to rotation, not to reflection.
    mirrored = frame.mirrored and not are_alike
    black, white = np.percentile(grey[::4, ::4], _STRETCH)
    picture = np.clip((grey - black) * (255.0 / max(white - black, 1e-9)), 0.0, 255.0).astype(np.uint8)
    if mirrored:
        picture = np.ascontiguousarray(picture[:, ::-1])
    found = _detect_in_tiles(picture, _SURPLUS * count, 2 * (RADIUS_PX // factor) + 1)
    places = found.places_px
    if mirrored:
        places = np.array([picture.shape[1] - 1, 0]) + places * np.array([-1, 1])
    found = replace(found, places_px=scan_px(places, factor), size_px=size_px, reduction=factor)
    found = found.part(np.flatnonzero(frame.usable(found.places_px, size_px)))
    cell = np.floor(found.places_px / size_px * _CELLS).astype(np.intp) @ np.array([1, _CELLS])
    return found.part(interleave_groups(cell, found.strengths)[:count])


def read_pieces(frame: TieFrame, patches: Sequence[tuple[Array, int]]) -> list[Piece]:
    """Read the windows of patches, given as map (2, 3) and radius, from top to bottom of a scan. Raises
    MeasurementError where it cannot be read."""
    pieces: dict[int, Piece] = {}
    with frame.open() as scan:
        for k, (matrix, radius_px) in sorted(enumerate(patches), key=lambda patch: float(patch[1][0][1, 2])):
            half = int(np.ceil(radius_px * np.linalg.norm(matrix[:, :2], 2))) + SPARE_PX
            col0, row0 = (int(value) - half for value in np.round(matrix[:, 2]))
            pieces[k] = Piece(scan.window(col0, row0, 2 * half + 1, 2 * half + 1), (col0, row0), matrix)
    return [pieces[k] for k in range(len(patches))]


def shared_features(pair: tuple[Features, Features]) -> Indices:
    """(n, 2) indices of mutual nearest neighbours that pass the ratio test."""
    first, second = pair
    if min(len(first.places_px), len(second.places_px)) < 2:
        return np.zeros((0, 2), np.intp)
    there, back = _nearest_features(first, second), _nearest_features(second, first)
    mutual = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(there))))
    return np.column_stack([mutual, there[mutual]])


def _nearest_features(first: Features, second: Features) -> Indices:
    """Nearest feature of the second scan for each of the first; -1 where the ratio test fails."""
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    return np.array(
        [best.trainIdx if best.distance < _RATIO * other.distance else -1 for best, other in pairs], np.intp
    )


def _detect_in_tiles(picture: NDArray[np.uint8], count: int, patch_px: int) -> Features:
    """Detect about `count` features tile by tile; features at one place with two directions count once.

    Texture is the smaller eigenvalue of the gradient matrix over a patch (Förstner and Gülch 1987).
    """
    tiles = [(np.empty((0, 2)), np.empty((0, 128), np.float32), np.empty(0), np.empty(0))]
    for row0, col0 in product(*(range(0, side, _TILE_PX) for side in picture.shape)):
        corner = np.array([col0, row0])
        first, last = np.maximum(corner - _OVERLAP_PX, 0), corner + _TILE_PX + _OVERLAP_PX
        tile = picture[first[1] : last[1], first[0] : last[0]]
        sift = cv2.SIFT.create(int(np.ceil(count * tile.size / picture.size)), contrastThreshold=_CONTRAST)
        points, described = sift.detectAndCompute(tile, None)
        if not points:
            continue
        found = np.array([point.pt for point in points]) + first
        once = np.zeros(len(found), bool)
        once[np.unique(np.round(found, 2), axis=0, return_index=True)[1]] = True
        within = found - corner + 0.5
        own = once & np.all((within >= 0) & (within < _TILE_PX), axis=1)
        col, row = np.round(found[own] - first).astype(np.intp).T
        textures = cv2.cornerMinEigenVal(tile, patch_px)[row, col].astype(np.float64)
        strengths = np.array([point.response for point in points])[own]
        tiles.append((found[own], np.asarray(described, np.float32)[own], strengths, textures))
    places, descriptors, strengths, textures = (np.concatenate(parts) for parts in zip(*tiles, strict=True))
    return Features(places, descriptors, strengths, textures)


def interleave_groups(group: Indices, strengths: Array) -> Indices:
    """Order that takes the strongest of every group first, then the second of every group, and so on."""
    order = np.lexsort((-strengths, group))
    _, starts = np.unique(group[order], return_index=True)
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.asarray(order[np.lexsort((-strengths[order], rank))], np.intp)

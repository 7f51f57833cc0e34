"""Scans in which tie points are sought, their natural features (SIFT), and which of them two scans share."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.flags import Code, Reason
from measure.geometry import linear_scale
from measure.scans.opening import open_scan
from measure.scans.parallel import map_or_replace
from measure.scans.scan import Scan
from measure.tie_points.multi_image import RADIUS_PX, SPARE_PX, Piece

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

_LONGEST_PX = 3000  # side of the reduced scan in which features are sought
_TILE_PX, _OVERLAP_PX = 1024, 96  # SIFT takes some 130 bytes a pixel: a tile at a time
_CONTRAST = 0.02  # half of OpenCV's default: fields and water have weak texture
_RATIO = 0.8  # Lowe's: nine false matches in ten have a second neighbour nearer than that, one right in twenty
_CELLS = 12  # a side, over which the features kept are spread
_SURPLUS = 3  # so many times the features wanted are found: some are not usable, and the strongest lie together
_STRETCH = (0.5, 99.5)  # percentiles of the grey values that become black and white


@dataclass(frozen=True, eq=False)
class TieFrame:
    """A scan in which natural points are sought.

    pixel_from_camera: (2, 3), camera mm (x', y', 1) to column and row. frame_mm: width and height of the exposed frame
    about the camera frame's origin, None where the whole scan is one. taken_px (n, 3): column, row and radius of the
    marks in it, which are no natural points. max_pixels: of the scan, if the user says it. part_of: the name of the
    exposed frame where that was scanned in parts, of which this is one.
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
        """The name of the exposed frame."""
        return self.part_of or self.image

    def open(self) -> Scan:
        """The scan. Raises MeasurementError where it cannot be read."""
        return open_scan(self.scan, self.max_pixels)

    @property
    def px_per_mm(self) -> float:
        return linear_scale(self.pixel_from_camera)

    @property
    def mirrored(self) -> bool:
        """Rows count downwards, y' upwards: a scan that is not mirrored changes the sense of rotation."""
        return bool(np.linalg.det(self.pixel_from_camera[:, :2]) > 0.0)

    def camera_px(self, places_px: Array) -> Array:
        """(n, 2) places in the camera frame, in units of a pixel."""
        linear, shift = self.pixel_from_camera[:, :2], self.pixel_from_camera[:, 2]
        return np.asarray((places_px - shift) @ np.linalg.inv(linear).T * self.px_per_mm)

    def usable(self, places_px: Array, size_px: tuple[int, int], radius_px: int = RADIUS_PX) -> Mask:
        """Where a whole patch lies in the exposed frame and beside the marks."""
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
    """places_px (n, 2): column and row in the scan; descriptors (n, 128); strengths (n,): SIFT's contrast.
    textures (n,): how well the picture about them fixes a place, in any unit. size_px: width and height of the scan;
    reduction: by which it was reduced before they were sought."""

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
    """The features of every scan, so many at most; or why it has none, after the words for what fails so. are_alike:
    whether the scans show one film, so that none is mirrored against another."""
    find = partial(_features_or_reason, count, are_alike, what_fails)
    return map_or_replace(workers, find, frames, lambda _, why: unreachable(what_fails, why))


def unreachable(what_fails: str, why: str) -> Reason:
    """Of a scan that cannot be read."""
    return Reason(f"{what_fails}: {why}", Code.UNREACHABLE)


def _features_or_reason(count: int, are_alike: bool, what_fails: str, frame: TieFrame) -> Features | Reason:
    try:
        return _features(frame, count, frame.mirrored and not are_alike)
    except MeasurementError as error:
        return unreachable(what_fails, str(error))


def _features(frame: TieFrame, count: int, mirrored: bool) -> Features:
    """Features evenly over the scan, the strongest first in every part of it. mirrored: whether it is to be seen as in
    a mirror; a turn needs no word, for descriptors turn with the picture."""
    with frame.open() as scan:
        size_px = scan.width_px, scan.height_px
        factor = -(-max(size_px) // _LONGEST_PX)
        grey = scan.reduced(factor)
    black, white = np.percentile(grey[::4, ::4], _STRETCH)
    picture = np.clip((grey - black) * (255.0 / max(white - black, 1e-9)), 0.0, 255.0).astype(np.uint8)
    if mirrored:
        picture = np.ascontiguousarray(picture[:, ::-1])
    found = _tiled(picture, _SURPLUS * count, 2 * (RADIUS_PX // factor) + 1)
    places = found.places_px
    if mirrored:
        places = np.array([picture.shape[1] - 1, 0]) + places * np.array([-1, 1])
    found = replace(found, places_px=places * factor + (factor - 1) / 2, size_px=size_px, reduction=factor)
    found = found.part(np.flatnonzero(frame.usable(found.places_px, size_px)))
    cell = np.floor(found.places_px / size_px * _CELLS).astype(np.intp) @ np.array([1, _CELLS])
    return found.part(interleave_groups(cell, found.strengths)[:count])


def read_pieces(frame: TieFrame, patches: Sequence[tuple[Array, int]]) -> list[Piece]:
    """The pictures about places in one scan, by their maps (2, 3) from the patch and its radius, read from the top.
    Raises MeasurementError where the scan cannot be read."""
    pieces: dict[int, Piece] = {}
    with frame.open() as scan:
        for k, (matrix, radius_px) in sorted(enumerate(patches), key=lambda patch: float(patch[1][0][1, 2])):
            half = int(np.ceil(radius_px * np.linalg.norm(matrix[:, :2], 2))) + SPARE_PX
            col0, row0 = (int(value) - half for value in np.round(matrix[:, 2]))
            pieces[k] = Piece(scan.window(col0, row0, 2 * half + 1, 2 * half + 1), (col0, row0), matrix)
    return [pieces[k] for k in range(len(patches))]


def shared_features(first: Features, second: Features) -> Indices:
    """(n, 2) indices of features that are each other's nearest by far."""
    if min(len(first.places_px), len(second.places_px)) < 2:
        return np.zeros((0, 2), np.intp)
    there, back = _nearest(first, second), _nearest(second, first)
    mutual = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(there))))
    return np.column_stack([mutual, there[mutual]])


def _nearest(first: Features, second: Features) -> Indices:
    """For each feature the nearest of the second scan, -1 where another is nearly as near."""
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    return np.array(
        [best.trainIdx if best.distance < _RATIO * other.distance else -1 for best, other in pairs], np.intp
    )


def _tiled(picture: NDArray[np.uint8], count: int, patch_px: int) -> Features:
    """About `count` features of a picture, found tile by tile, the strongest of each; one where there are two
    directions at a place.

    Texture is what the matching of a patch has to go by: the lesser eigenvalue of the grey values' gradients over it
    (Förstner and Gülch 1987).
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
    """The order that takes the strongest of every group, then the second of every group, and so on."""
    order = np.lexsort((-strengths, group))
    _, starts = np.unique(group[order], return_index=True)
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.asarray(order[np.lexsort((-strengths[order], rank))], np.intp)

"""Scans in which tie points are sought, their natural features (SIFT), and which of them two scans share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.geometry import linear_scale
from measure.scans.opening import open_scan
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

    def chosen(self, rows: Indices) -> "Features":
        return replace(
            self,
            places_px=self.places_px[rows],
            descriptors=self.descriptors[rows],
            strengths=self.strengths[rows],
            textures=self.textures[rows],
        )


def find_features(scan: Scan, usable: Callable[[Array], Mask], mirrored: bool, count: int) -> Features:
    """At most `count` features, evenly over the scan, the strongest first in every part of it.

    usable: which places (n, 2) in px may hold one. mirrored: whether the scan shows the field as a mirror does; a turn
    needs no word, for descriptors turn with the picture.
    """
    size_px = scan.width_px, scan.height_px
    factor = -(-max(size_px) // _LONGEST_PX)
    picture = _eight_bit(scan.reduced(factor))
    if mirrored:
        picture = np.ascontiguousarray(picture[:, ::-1])
    found = _tiled(picture, _SURPLUS * count, 2 * (RADIUS_PX // factor) + 1)
    places = found.places_px
    if mirrored:
        places = np.array([picture.shape[1] - 1, 0]) + places * np.array([-1, 1])
    found = replace(found, places_px=places * factor + (factor - 1) / 2, size_px=size_px, reduction=factor)
    found = found.chosen(np.flatnonzero(usable(found.places_px)))
    return found.chosen(_spread(found, np.array(size_px), count))


def find_frame_features(frame: TieFrame, mirrored: bool, count: int) -> Features:
    """As `find_features` gives them. Raises MeasurementError where the scan cannot be read."""
    with frame.open() as scan:
        size_px = scan.width_px, scan.height_px
        return find_features(scan, lambda places: frame.usable(places, size_px), mirrored, count)


def read_pieces(frame: TieFrame, patches: Sequence[tuple[Array, int]]) -> list[Piece]:
    """The pictures about places in one scan, by their maps (2, 3) from the patch and its radius, read from the top.
    Raises MeasurementError where the scan cannot be read."""
    pieces: dict[int, Piece] = {}
    with frame.open() as scan:
        for k in sorted(range(len(patches)), key=lambda k: float(patches[k][0][1, 2])):
            matrix, radius_px = patches[k]
            half = int(np.ceil(radius_px * np.linalg.norm(matrix[:, :2], 2))) + SPARE_PX
            col0, row0 = (int(value) - half for value in np.round(matrix[:, 2]))
            pieces[k] = Piece(scan.window(col0, row0, 2 * half + 1, 2 * half + 1), (col0, row0), matrix)
    return [pieces[k] for k in range(len(patches))]


def shared_features(first: Features, second: Features) -> Indices:
    """(n, 2) indices of features that are each other's nearest by far."""
    if min(len(first.places_px), len(second.places_px)) < 2:
        return np.zeros((0, 2), np.intp)
    there = _nearest(first, second)
    back = _nearest(second, first)
    pairs = [(i, j) for i, j in enumerate(there) if j >= 0 and back[j] == i]
    return np.array(pairs, np.intp).reshape(-1, 2)


def _eight_bit(grey: NDArray[np.float32]) -> NDArray[np.uint8]:
    black, white = np.percentile(grey[::4, ::4], _STRETCH)
    return np.asarray(np.clip((grey - black) * (255.0 / max(white - black, 1e-9)), 0.0, 255.0), np.uint8)


def _tiled(picture: NDArray[np.uint8], count: int, patch_px: int) -> Features:
    """About `count` features of a picture, found tile by tile, the strongest of each.

    Texture is what the matching of a patch has to go by: the lesser eigenvalue of the grey values' gradients over it
    (Förstner and Gülch 1987).
    """
    places: list[Array] = [np.empty((0, 2))]
    descriptors, strengths, textures = [np.empty((0, 128), np.float32)], [np.empty(0)], [np.empty(0)]
    height, width = picture.shape
    for row0 in range(0, height, _TILE_PX):
        for col0 in range(0, width, _TILE_PX):
            top, left = max(row0 - _OVERLAP_PX, 0), max(col0 - _OVERLAP_PX, 0)
            tile = picture[top : row0 + _TILE_PX + _OVERLAP_PX, left : col0 + _TILE_PX + _OVERLAP_PX]
            share = int(np.ceil(count * tile.size / picture.size))
            points, described = cv2.SIFT.create(nfeatures=share, contrastThreshold=_CONTRAST).detectAndCompute(
                tile, None
            )
            if not points:
                continue
            found = np.array([point.pt for point in points]) + np.array([left, top])
            own = np.all(
                (found >= (col0 - 0.5, row0 - 0.5)) & (found < (col0 + _TILE_PX - 0.5, row0 + _TILE_PX - 0.5)), 1
            )
            own &= _first_of_place(found)
            places.append(found[own])
            descriptors.append(np.asarray(described, np.float32)[own])
            strengths.append(np.array([point.response for point in points])[own])
            col, row = np.round(found[own] - (left, top)).astype(np.intp).T
            textures.append(cv2.cornerMinEigenVal(tile, patch_px)[row, col].astype(np.float64))
    return Features(
        np.concatenate(places), np.concatenate(descriptors), np.concatenate(strengths), np.concatenate(textures)
    )


def _first_of_place(places: Array) -> Mask:
    """A feature with two directions is found twice; one of them is enough."""
    first = np.zeros(len(places), dtype=bool)
    first[np.unique(np.round(places, 2), axis=0, return_index=True)[1]] = True
    return first


def _spread(features: Features, size_px: Array, count: int) -> Indices:
    """Indices of the strongest features of every cell in turn, until there are enough."""
    cell = np.floor(features.places_px / size_px * _CELLS).astype(np.intp) @ np.array([1, _CELLS])
    return interleave_groups(cell, features.strengths)[:count]


def interleave_groups(group: Indices, strengths: Array) -> Indices:
    """The order that takes the strongest of every group, then the second of every group, and so on."""
    order = np.lexsort((-strengths, group))
    _, starts = np.unique(group[order], return_index=True)
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return np.asarray(order[np.lexsort((-strengths[order], rank))], np.intp)


def _nearest(first: Features, second: Features) -> list[int]:
    """For each feature the nearest of the second scan, -1 where another is nearly as near."""
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    pairs = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    return [best.trainIdx if best.distance < _RATIO * other.distance else -1 for best, other in pairs]

"""COLMAP's tracks as tie marks of the scans, and its poses in the frame of the control."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from adjust.problem.network import ObjectPoint
from measure.status import Status
from pipeline.blocks.mapping import Mapped
from pipeline.blocks.pictures import BlockPicture, BlockScan
from pipeline.errors import InputError
from pipeline.exchange.pinhole import Y_DOWN_Z_FORWARD
from pipeline.results.comparator_file import ComparatorPoint, comparator_from_pixel

Array = NDArray[np.float64]

CELLS = 8  # a side of an image: ties are spread over these
A_CELL = 3  # ties that are taken of one, the longest tracks first
FEWEST_CONTROL = 3
_MAD = 1.4826  # of a normal distribution's standard deviation in median absolute deviations
_CONSISTENT = 3.0  # standard deviations of a reprojection error that a track may have


def tie_marks(mapped: Mapped, pictures: Sequence[BlockPicture]) -> tuple[ComparatorPoint, ...]:
    """The tracks that are taken, back in the scans that they were seen in, with one standard deviation for all."""
    by_image = {picture.image: picture for picture in pictures}
    sigma_px = feature_sigma_px(mapped)
    marks = []
    for number in chosen_tracks(mapped, by_image, sigma_px):
        for image, col, row in mapped.tracks[number]:
            picture = by_image[image]
            seen = picture.scan_place(picture.lattice.camera_mm(np.array([col, row])))
            if seen is None:
                continue
            scan, place_px = seen
            place = comparator_from_pixel(place_px, scan.chain.pitch_um)
            sigma = np.full(2, sigma_px * picture.lattice.pitch_mm)
            marks.append(ComparatorPoint(scan.image, f"tie-{number}", "tie", place, sigma, 0.0, Status.MEASURED, ""))
    return tuple(marks)


def feature_sigma_px(mapped: Mapped) -> float:
    """The standard deviation of a feature's coordinate, from the reprojection errors of tracks that are seen thrice or
    more: of 2 n coordinates three degrees of freedom went into the point.

    COLMAP's error is the mean length of a point's residuals, whose square is pi / 4 of the mean square of the lengths
    of normally distributed ones. Of many points the median counts, and the median of chi-square over its degrees of
    freedom f is about (1 - 2 / (9 f))^3 (Wilson and Hilferty 1931).
    """
    squares = []
    for number, track in mapped.tracks.items():
        if len(track) >= 3:
            free = 2 * len(track) - 3
            of_lengths = mapped.errors_px[number] ** 2 * 4.0 / np.pi
            squares.append(of_lengths / 2.0 * 2 * len(track) / free / (1.0 - 2.0 / (9.0 * free)) ** 3)
    if not squares:
        raise InputError("COLMAP found no point in three frames: a block needs more overlap.")
    return float(np.sqrt(np.median(squares)))


def chosen_tracks(mapped: Mapped, pictures: Mapping[str, BlockPicture], sigma_px: float) -> list[int]:
    """Of every part of every image the longest tracks, as far as they agree with themselves."""
    usable = [
        number
        for number, track in mapped.tracks.items()
        if len({image for image, _, _ in track}) == len(track) and mapped.errors_px[number] < _CONSISTENT * sigma_px
    ]
    usable.sort(key=lambda number: (-len(mapped.tracks[number]), mapped.errors_px[number]))
    taken: dict[tuple[str, int, int], int] = defaultdict(int)
    chosen = []
    for number in usable:
        cells = [_cell(pictures[image], col, row) for image, col, row in mapped.tracks[number]]
        if any(taken[cell] < A_CELL for cell in cells):
            chosen.append(number)
            for cell in cells:
                taken[cell] += 1
    return sorted(chosen)


def _cell(picture: BlockPicture, col: float, row: float) -> tuple[str, int, int]:
    lattice = picture.lattice
    return picture.image, int(CELLS * col / lattice.width_px), int(CELLS * row / lattice.height_px)


def oriented_by_control(
    mapped: Mapped,
    pictures: Sequence[BlockPicture],
    marks: Sequence[ComparatorPoint],
    points: Mapping[str, ObjectPoint],
    camera_rays: Mapping[str, Array],
) -> dict[str, tuple[Array, Array]]:
    """By image: rotation (3, 3) to axes x right, y up, looking along -z, and station (3,), in the frame of the control.

    camera_rays: by image the principal distance and point (3,) by which COLMAP saw it, mm. Raises InputError where
    fewer than three control points are seen by two oriented images each.
    """
    seen: dict[str, dict[str, Array]] = defaultdict(dict)
    scans = {scan.image: (picture.image, scan) for picture in pictures for scan in picture.scans}
    for mark in marks:
        if mark.kind == "target" and mark.status.is_observation and mark.point in points and mark.image in scans:
            frame, scan = scans[mark.image]
            if frame in mapped.poses:
                seen[mark.point].setdefault(frame, _camera_mm(mark, scan))
    theirs, ours = [], []
    for point, places in sorted(seen.items()):
        given = points[point]
        if len(places) < 2 or given.X is None or given.Y is None or given.Z is None:
            continue
        theirs.append(_intersection(mapped, places, camera_rays))
        ours.append([given.X.value, given.Y.value, given.Z.value])
    if len(ours) < FEWEST_CONTROL:
        raise InputError(
            f"{len(ours)} points with coordinates are marked in two of the frames that COLMAP oriented; "
            f"{FEWEST_CONTROL} are needed to place the block. Mark more control points, as targets in comparator.csv."
        )
    scale, turn, shift = similarity(np.array(theirs), np.array(ours))
    placed = {}
    for image, (rotation, translation) in mapped.poses.items():
        station = shift + scale * turn @ (-rotation.T @ translation)
        placed[image] = (np.asarray(Y_DOWN_Z_FORWARD @ rotation @ turn.T), np.asarray(station))
    return placed


def _camera_mm(mark: ComparatorPoint, scan: BlockScan) -> Array:
    """Where a mark (2,) is in the camera's frame."""
    assert mark.xy_mm is not None
    straight = scan.chain.bend.apply(scan.chain.bend_parameters, mark.xy_mm[None])
    return np.asarray(scan.chain.film.camera_from_comparator(straight)[0])


def _intersection(mapped: Mapped, places: Mapping[str, Array], camera_rays: Mapping[str, Array]) -> Array:
    """The point (3,) nearest to the rays of its places in the camera, by image, in COLMAP's coordinates."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for image, place in places.items():
        c, x0, y0 = camera_rays[image]
        rotation, translation = mapped.poses[image]
        ray = rotation.T @ np.array([(place[0] - x0) / c, -(place[1] - y0) / c, 1.0])
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ (-rotation.T @ translation)
    return np.asarray(np.linalg.solve(normal, right))


def similarity(start: Array, end: Array) -> tuple[float, Array, Array]:
    """Scale, rotation (3, 3) and shift (3,) from points (n, 3) to points (n, 3), by least squares.

    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 13 (1991).
    """
    a, b = start - start.mean(axis=0), end - end.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    turn = u @ np.diag(signs) @ vt
    scale = float((d * signs).sum() / (a**2).sum())
    return scale, turn, end.mean(axis=0) - scale * turn @ start.mean(axis=0)

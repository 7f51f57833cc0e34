"""Convert COLMAP's tracks to tie marks in the scans, and its poses to the control system."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from adjust.problem.network import ObjectPoint
from measure.flags import Status
from pipeline.blocks.mapping import Mapped, Sight
from pipeline.blocks.pictures import BlockPicture, BlockScan
from pipeline.errors import InputError
from pipeline.exchange.pinhole import Y_DOWN_Z_FORWARD
from pipeline.results.comparator_file import ComparatorPoint, comparator_from_pixel
from pipeline.types import Array

CELLS = 8  # per side of an image, over which ties are spread
A_CELL = 3  # ties taken per cell, the longest tracks first
FEWEST_CONTROL = 3
_CONSISTENT = 3.0  # largest rms reprojection error of a track, in standard deviations
_FEWEST_SIGHTS = 3
_ROUNDS = 5


@dataclass(frozen=True)
class FeaturePrecision:
    """Precision of a feature's coordinate: variance grain² + (share · size)², since larger features are less
    precise."""

    grain_px: float
    share: float

    def sigma_px(self, size_px: float) -> float:
        return float(np.hypot(self.grain_px, self.share * size_px))

    @property
    def variances_px2(self) -> Array:
        return np.array([self.grain_px**2, self.share**2])


def tie_marks(mapped: Mapped, pictures: Sequence[BlockPicture]) -> tuple[ComparatorPoint, ...]:
    """Tie marks of the selected tracks in the scans, with standard deviations estimated by feature size."""
    by_image = {picture.image: picture for picture in pictures}
    precision = feature_precision(mapped)
    marks = []
    for number in chosen_tracks(mapped, by_image, precision):
        for sight in mapped.tracks[number]:
            picture = by_image[sight.image]
            shown = picture.scan_place(picture.lattice.camera_from_pixel(np.array([sight.col, sight.row])))
            if shown is None:
                continue
            scan, place_px = shown
            place = comparator_from_pixel(place_px, scan.chain.pitch_um)
            sigma = np.full(2, precision.sigma_px(sight.size_px) * picture.lattice.pitch_mm)
            marks.append(ComparatorPoint(scan.image, f"tie-{number}", "tie", place, sigma, 0.0, Status.MEASURED, ""))
    return tuple(marks)


def feature_precision(mapped: Mapped) -> FeaturePrecision:
    """Estimate the precision of features from the reprojection errors of tracks with three or more observations.

    Of the 2n coordinates of a track, three degrees of freedom determine the point. The initial value is the median of
    all squares (that of chi-square with two degrees of freedom is 2 ln 2). Then the squares of consistent tracks are
    fitted, each weighted by its expectation. Raises InputError where no track has three observations.
    """
    tracks = [track for track in mapped.tracks.values() if len(track) >= _FEWEST_SIGHTS]
    if not tracks:
        raise InputError("COLMAP found no point in three frames: a block needs more overlap.")
    squares = np.concatenate([_squares_px2(track) for track in tracks])
    design = np.concatenate([_design(track) for track in tracks])
    ends = np.cumsum([len(track) for track in tracks])
    precision = FeaturePrecision(float(np.sqrt(np.median(squares / design[:, 0]) / np.log(2.0))), 0.0)
    for _ in range(_ROUNDS):
        expected = design @ precision.variances_px2
        agree = [part.mean() < _CONSISTENT**2 for part in np.split(squares / expected, ends[:-1])]
        used = np.repeat(agree, np.diff(ends, prepend=0))
        weight = 1.0 / expected[used]
        grain2, share2 = nnls(weight[:, None] * design[used], weight * squares[used])[0]
        precision = FeaturePrecision(float(np.sqrt(grain2)), float(np.sqrt(share2)))
    return precision


def _squares_px2(track: Sequence[Sight]) -> Array:
    """(n,) mean squared reprojection error of a coordinate, px²."""
    return np.array([sight.off_px**2 / 2.0 for sight in track])


def _design(track: Sequence[Sight]) -> Array:
    """(n, 2) design matrix: coefficients of grain² and share² in the expectation of these squares.

    With the redundancy f of a coordinate, the variance of a residual is f² times the observation's own plus f (1 - f)
    times the mean of all, as for a projection in a random direction: the actual one depends on the geometry.
    """
    free = (2 * len(track) - 3) / (2 * len(track))
    squares = np.array([sight.size_px**2 for sight in track])
    return np.stack([np.full(len(track), free), free * (free * squares + (1.0 - free) * squares.mean())], axis=1)


def chosen_tracks(mapped: Mapped, pictures: Mapping[str, BlockPicture], precision: FeaturePrecision) -> list[int]:
    """Select consistent tracks for each cell of each image: the longest ones, among these the most precise."""
    usable = [
        number
        for number, track in mapped.tracks.items()
        if len({sight.image for sight in track}) == len(track)
        and (_squares_px2(track) / (_design(track) @ precision.variances_px2)).mean() < _CONSISTENT**2
    ]
    usable.sort(key=lambda number: (-len(mapped.tracks[number]), max(s.size_px for s in mapped.tracks[number])))
    taken: dict[tuple[str, int, int], int] = defaultdict(int)
    chosen = []
    for number in usable:
        cells = [_cell(pictures[sight.image], sight.col, sight.row) for sight in mapped.tracks[number]]
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
    """Transform COLMAP's poses into the control system.

    Parameters
    ----------
    marks, points : marks in the scans, and the object points.
    camera_rays : by image, the principal distance and point (3,) that COLMAP used, mm.

    Returns
    -------
    By image, rotation (3, 3) to axes x right, y up, looking along -z, and projection centre (3,).

    Raises
    ------
    InputError
        Fewer than three control points are observed in two oriented images each.
    """
    places: dict[str, dict[str, Array]] = defaultdict(dict)
    scans = {scan.image: (picture.image, scan) for picture in pictures for scan in picture.scans}
    for mark in marks:
        if mark.kind == "target" and mark.status.is_observation and mark.point in points and mark.image in scans:
            frame, scan = scans[mark.image]
            if frame in mapped.poses:
                places[mark.point].setdefault(frame, _camera_mm(mark, scan))
    theirs, ours = [], []
    for point, own in sorted(places.items()):
        given = points[point]
        if len(own) < 2 or given.X is None or given.Y is None or given.Z is None:
            continue
        theirs.append(_intersection(mapped, own, camera_rays))
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
    """(2,) place of a mark in the camera frame, mm."""
    assert mark.xy_mm is not None
    straight = scan.chain.bend.apply(scan.chain.bend_parameters, mark.xy_mm[None])
    return np.asarray(scan.chain.film.camera_from_comparator(straight)[0])


def _intersection(mapped: Mapped, places: Mapping[str, Array], camera_rays: Mapping[str, Array]) -> Array:
    """Intersect the rays of a point observed in several images: the nearest point (3,), in COLMAP's coordinates."""
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
    """Scale, rotation (3, 3) and shift (3,) of the least-squares similarity between points (n, 3).

    Source: S. Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 13
    (1991).
    """
    a, b = start - start.mean(axis=0), end - end.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    turn = u @ np.diag(signs) @ vt
    scale = float((d * signs).sum() / (a**2).sum())
    return scale, turn, end.mean(axis=0) - scale * turn @ start.mean(axis=0)

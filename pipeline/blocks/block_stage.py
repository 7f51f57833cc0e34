"""`reseau block`: orient and calibrate a block from a folder of overlapping frames without known orientation.

Scans are resampled into the fiducial system of their camera. COLMAP extracts and matches features and estimates poses
with the given camera. Its poses serve as initial values, its tracks as observations in the scans. One adjustment
combines them with film deformations, fiducials, lens and control."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from adjust.functional_model.rotation import angles_from_rotation
from adjust.initial_values.model_formation import absolute_orientation
from adjust.initial_values.pose import intersect
from adjust.problem.network import Exterior, ObjectPoint
from measure.flags import Status
from pipeline.blocks.mapping import (
    BlockPicture,
    Mapped,
    Sight,
    given_interior,
    mapped,
    quiet_colmap,
    write_pictures,
)
from pipeline.errors import InputError
from pipeline.exchange.pinhole import Y_DOWN_Z_FORWARD
from pipeline.files.object_files import ELEMENTS, GivenImages
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.resampling.resample_stage import FAST, resample, resample_tasks
from pipeline.results.comparator_file import (
    ComparatorPoint,
    comparator_from_pixel,
    pixel_from_comparator,
    read_comparator,
    read_pitches,
    write_comparator,
)
from pipeline.text.csv_table import csv_line
from pipeline.text.files import write_atomically
from pipeline.text.wording import counted
from pipeline.types import Array

CELLS = 8  # per side of an image, over which ties are spread
A_CELL = 3  # ties taken per cell, the longest tracks first
FEWEST_CONTROL = 3
_CONSISTENT = 3.0  # largest rms reprojection error of a track, in standard deviations
_FEWEST_SIGHTS = 3
_ROUNDS = 5
MOST_PX = 3000  # pixels along the longer side of a frame, unless the user gives a pitch


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
    given = {id: np.array([prior.value for prior in (p.X, p.Y, p.Z) if prior is not None]) for id, p in points.items()}
    rays: dict[str, dict[str, tuple[Array, Array]]] = defaultdict(dict)
    scans = {scan.image: (picture.image, scan) for picture in pictures for scan in picture.scans}
    for mark in marks:
        if mark.kind == "target" and mark.status.is_observation and mark.image in scans:
            frame, scan = scans[mark.image]
            if frame in mapped.poses and len(given.get(mark.point, ())) == 3:
                assert mark.xy_mm is not None
                pixel = pixel_from_comparator(mark.xy_mm[None], scan.chain.pitch_um)
                (x, y), (c, x0, y0) = scan.chain.frame_from_scan(pixel)[0][0], camera_rays[frame]
                rotation, translation = mapped.poses[frame]
                ray = -rotation.T @ translation, rotation.T @ np.array([(x - x0) / c, (y0 - y) / c, 1.0])
                rays[mark.point].setdefault(frame, ray)
    control = sorted(point for point, own in rays.items() if len(own) > 1)
    if len(control) < FEWEST_CONTROL:
        raise InputError(
            f"{len(control)} points with coordinates are marked in two of the frames that COLMAP oriented; "
            f"{FEWEST_CONTROL} are needed to place the block. Mark more control points, as targets in comparator.csv."
        )
    numbered = [(number, *ray) for number, point in enumerate(control) for ray in rays[point].values()]
    numbers, centers, directions = (np.array(each) for each in zip(*numbered, strict=True))
    theirs, _ = intersect(centers, directions, numbers, np.full((len(control), 3), np.nan))
    ours = np.array([given[point] for point in control])
    stations = {image: -rotation.T @ translation for image, (rotation, translation) in mapped.poses.items()}
    found = np.isfinite(theirs).all(axis=1)
    block = absolute_orientation(theirs[found], ours[found], np.array(list(stations.values())))
    if block is None:
        raise InputError(
            "The control points that COLMAP's frames show do not determine how the block lies. Mark others."
        )
    return {
        image: (np.asarray(Y_DOWN_Z_FORWARD @ rotation @ block.rotation.T), block.apply(stations[image]))
        for image, (rotation, _) in mapped.poses.items()
    }


def run_block(
    project: Project, folder: Path, pitch_um: float | None, reporter: Reporter
) -> tuple[Project, tuple[str, ...], list[str]]:
    """Orient a block by COLMAP; its adjustment is then run as for any project.

    Returns the project with the block's own comparator.csv, images.csv and output; the images that COLMAP did not
    orient; and lines about the block for the user. pitch_um: of the resampled frames; None: chosen. Raises InputError
    where COLMAP is not installed, fiducials are not measured, COLMAP orients nothing, or control is missing.
    """
    quiet_colmap()  # fails before the resampling, which takes far longer
    if not project.comparator.exists():
        raise InputError(f"{project.comparator}: there is no such file. Run `reseau measure` first: films come by it.")
    marks = read_comparator(project.comparator, project.list_pitch_um)
    pitch_um = pitch_um or coarse_pitch_um(project)
    seconds = dict[str, float]()
    with _step(seconds, "resampling"):
        frames = folder / "frames"
        results = resample(project, frames, pitch_um, False, True, reporter)
        made = {result.image for result in results if not result.problem}
        tasks = [task for task in resample_tasks(project, frames, pitch_um, False, FAST)[0] if task.image in made]
    if len(tasks) < 2:
        problems = " ".join(f"{result.image}: {result.problem}." for result in results if result.problem)
        raise InputError(f"a block needs two frames, and {len(tasks)} could be resampled. {problems}")
    cameras = {camera.name: camera for camera in project.cameras.values()}
    with _step(seconds, "pictures"):
        pictures = write_pictures(tasks, cameras, folder)
    with _step(seconds, "features, matches and mapping"):
        found = mapped(pictures, cameras, folder)
    with _step(seconds, "tracks and poses back"):
        ties = tie_marks(found, pictures)
        interior = {picture.image: given_interior(cameras[picture.camera]) for picture in pictures}
        poses = oriented_by_control(found, pictures, marks, project.object_points, interior)
        own = written_block(project, folder, (*marks, *ties), poses)
    left_out = tuple(sorted({project.image_frame(mark.image) for mark in marks} - set(poses)))
    lines = [
        f"COLMAP oriented {counted(len(found.poses), 'image')}; {counted(len(ties), 'tie mark')} of "
        f"{counted(len({tie.point for tie in ties}), 'point')} are observations now.",
        *([f"not oriented: {', '.join(left_out)}"] if left_out else []),
        *(f"{step}: {duration:.0f} s" for step, duration in seconds.items()),
    ]
    return own, left_out, lines


def coarse_pitch_um(project: Project) -> float | None:
    """Pixel pitch that reduces the frames to MOST_PX, so that feature extraction takes minutes; None where the scans
    are already that coarse."""
    pitches = read_pitches(project.comparator)
    sides = [max(camera.frame_mm) for camera in project.cameras.values() if camera.frame_mm is not None]
    enough = 1000.0 * max(sides, default=0.0) / MOST_PX
    finest = min((min(pitch) for pitch in pitches.values()), default=0.0)
    return enough if enough > finest else None


def written_block(
    project: Project,
    folder: Path,
    marks: Sequence[ComparatorPoint],
    poses: dict[str, tuple[Array, Array]],
) -> Project:
    """Write comparator.csv and images.csv of a block, and return the project that uses them."""
    pitches, given = read_pitches(project.comparator), project.given_images or GivenImages({}, {})
    frames = {mark.image: project.image_frame(mark.image) for mark in marks}
    kept = [mark for mark in marks if mark.kind != "target" or frames[mark.image] in poses]
    write_comparator(folder / "comparator.csv", kept, pitches)
    exterior: dict[str, Exterior | None] = {}
    lines = [
        "# orientations by COLMAP, as approximations",
        ",".join(("image", *ELEMENTS, "camera", "scanner", "part_of")),
    ]
    for image, frame in sorted(frames.items()):
        if frame not in poses and not given.part_of.get(image):
            continue
        elements = [""] * len(ELEMENTS)
        if frame in poses:
            rotation, station = poses[frame]
            values = np.concatenate([station, angles_from_rotation(rotation)])
            exterior[image] = Exterior(values)
            elements = [repr(float(value)) for value in [*values[:3], *np.degrees(values[3:])]]
        columns = (given.camera, given.scanner, given.part_of)
        lines.append(csv_line([image, *elements, *(column.get(image, "") for column in columns)]))
    write_atomically(folder / "images.csv", "\n".join(lines) + "\n")
    return replace(
        project,
        scans={},
        comparator=folder / "comparator.csv",
        output=folder / "out",
        given_images=replace(given, exterior=exterior),
        images_path=folder / "images.csv",
    )


@contextmanager
def _step(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the duration of the block, s."""
    start = time.monotonic()
    yield
    seconds[name] = time.monotonic() - start

"""`reseau block`: orient and calibrate a block from a folder of overlapping frames without known orientation.

Scans are resampled into the fiducial system of their camera, on one pixel grid per camera, with masks of what is fixed
to the camera. COLMAP extracts and matches features and estimates poses with the given camera. Its poses serve as
initial values, its tracks as observations in the scans. One adjustment combines them with film deformations, fiducials,
lens and control.
"""

import json
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.optimize import nnls

from adjust.functional_model.rotation import angles_from_rotation, angles_near
from adjust.initial_values.model_formation import absolute_orientation
from adjust.initial_values.pose import intersect
from adjust.problem.network import Exterior, ObjectPoint
from measure.flags import Status
from measure.scans.opening import open_scan
from pipeline.errors import InputError
from pipeline.exchange.incoming import Y_DOWN_Z_FORWARD
from pipeline.exchange.pinhole import COLMAP, import_pycolmap
from pipeline.files.camera_file import CameraFile
from pipeline.files.object_files import ELEMENTS, SIGMAS, GivenImages
from pipeline.files.project_file import Project
from pipeline.resampling.canvas import Canvas, FrameChain
from pipeline.resampling.resample_stage import FAST, ResampleTask, read_description, resample, resample_tasks
from pipeline.results.comparator_file import (
    ComparatorPoint,
    comparator_from_pixel,
    pixel_from_comparator,
    read_comparator,
    read_pitches,
    write_comparator,
)
from pipeline.terminal import Reporter
from pipeline.text.csv_table import csv_line
from pipeline.text.files import file_word, path_below, write_atomically
from pipeline.text.wording import counted, listed_by_reason
from pipeline.types import Array, Mask

Picture = NDArray[np.uint8]

_BORDER = 0.02  # fraction of the frame's side: vignetting, edge of the frame
_MARK = 0.03  # masked around fiducials, which would match themselves in every frame; fraction of the frame's side
_DARKEST, _LIGHTEST = 0.5, 99.5  # percentiles that are mapped to black and white
FEATURES = 2000  # per image; a block needs hundreds of them in common
SEED = 0  # of the mapper's random choices, so that a block is the same in every run
_EXHAUSTIVE = 60  # images up to which every pair is matched
_NEIGHBOURS = 12  # neighbours in the sequence with which an image is matched in larger blocks
CELLS = 8  # per side of an image, over which ties are spread
A_CELL = 3  # ties taken per cell, the longest tracks first
FEWEST_CONTROL = 3
_CONSISTENT = 3.0  # largest rms reprojection error of a track, in standard deviations
_FEWEST_SIGHTS = 3
_ROUNDS = 5
_HEAD = "# orientations by COLMAP, as approximations"  # of images.csv
_FOLDERS = ("pictures", "masks", "sparse")
MOST_PX = 3000  # pixels along the longer side of a frame, unless the user gives a pitch


@dataclass(frozen=True)
class BlockScan:
    """Scan of a frame: name of its image, transformation from the frame, and size."""

    image: str
    chain: FrameChain
    width_px: int
    height_px: int


@dataclass(frozen=True)
class BlockPicture:
    """Image of one frame.

    Attributes
    ----------
    name : file, in its camera's folder.
    lattice : pixel grid of its camera's images.
    scans : scan of the frame, or several of its parts.
    """

    image: str
    camera: str
    name: str
    lattice: Canvas
    scans: tuple[BlockScan, ...]

    def scan_place(self, camera_mm: Array) -> tuple[BlockScan, Array] | None:
        """Scan in which a place (2,) of the camera frame is farthest from the edges, and its pixel (2,); None where no
        transformation succeeds."""

        def depth_px(place: tuple[BlockScan, Array]) -> float:
            """Distance from the nearest edge of the scan; negative outside."""
            scan, (col, row) = place
            return float(min(col + 0.5, scan.width_px - 0.5 - col, row + 0.5, scan.height_px - 0.5 - row))

        candidates = [(scan, scan.chain.scan_from_frame(camera_mm[None])) for scan in self.scans]
        return max(((scan, pixels[0]) for scan, (pixels, found) in candidates if found[0]), key=depth_px, default=None)


@dataclass(frozen=True)
class TrackObservation:
    """Observation of a track in an image.

    Attributes
    ----------
    col, row : of the feature; (0, 0) is the centre of the first pixel.
    size_px : size of the feature: standard deviation of the Gaussian that detected it.
    off_px : length of the reprojection error.
    """

    image: str
    col: float
    row: float
    size_px: float
    off_px: float


@dataclass(frozen=True)
class Reconstruction:
    """Result of COLMAP, in a coordinate system of its own.

    poses: by image, rotation (3, 3) and translation (3,) to axes x right, y down, z forward; tracks: by point, its
    observations.
    """

    poses: dict[str, tuple[Array, Array]]
    tracks: dict[int, list[TrackObservation]]


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


def tie_marks(block: Reconstruction, pictures: Sequence[BlockPicture]) -> tuple[ComparatorPoint, ...]:
    """Tie marks of the selected tracks in the scans, with standard deviations estimated by feature size."""
    by_image = {picture.image: picture for picture in pictures}
    precision = feature_precision(block)
    marks = []
    for number in choose_tracks(block, by_image, precision):
        for sight in block.tracks[number]:
            picture = by_image[sight.image]
            shown = picture.scan_place(picture.lattice.camera_from_pixel(np.array([sight.col, sight.row])))
            if shown is None:
                continue
            scan, place_px = shown
            place = comparator_from_pixel(place_px, scan.chain.pitch_um)
            sigma = np.full(2, precision.sigma_px(sight.size_px) * picture.lattice.pitch_mm)
            marks.append(ComparatorPoint(scan.image, f"tie-{number}", "tie", place, sigma, 0.0, Status.MEASURED, ""))
    return tuple(marks)


def feature_precision(block: Reconstruction) -> FeaturePrecision:
    """Estimate the precision of features from the reprojection errors of tracks with three or more observations.

    Of the 2n coordinates of a track, three degrees of freedom determine the point. The initial value is the median of
    all squares (that of chi-square with two degrees of freedom is 2 ln 2). Then the squares of consistent tracks are
    fitted, each weighted by its expectation. Raises InputError where no track has three observations.
    """
    tracks = [track for track in block.tracks.values() if len(track) >= _FEWEST_SIGHTS]
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


def _squares_px2(track: Sequence[TrackObservation]) -> Array:
    """(n,) mean squared reprojection error of a coordinate, px²."""
    return np.array([sight.off_px**2 / 2.0 for sight in track])


def _design(track: Sequence[TrackObservation]) -> Array:
    """(n, 2) design matrix: coefficients of grain² and share² in the expectation of these squares.

    With the redundancy f of a coordinate, the variance of a residual is f² times the observation's own plus f (1 - f)
    times the mean of all, as for a projection in a random direction: the actual one depends on the geometry.
    """
    free = (2 * len(track) - 3) / (2 * len(track))
    squares = np.array([sight.size_px**2 for sight in track])
    return np.stack([np.full(len(track), free), free * (free * squares + (1.0 - free) * squares.mean())], axis=1)


def choose_tracks(
    block: Reconstruction, pictures: Mapping[str, BlockPicture], precision: FeaturePrecision
) -> list[int]:
    """Select consistent tracks for each cell of each image: the longest ones, among these the most precise; of those
    that share a place, one."""
    usable = [
        number
        for number, track in block.tracks.items()
        if len({sight.image for sight in track}) == len(track)
        and (_squares_px2(track) / (_design(track) @ precision.variances_px2)).mean() < _CONSISTENT**2
    ]
    usable.sort(key=lambda number: (-len(block.tracks[number]), max(s.size_px for s in block.tracks[number])))
    taken: dict[tuple[str, int, int], int] = defaultdict(int)
    places = set[tuple[str, float, float]]()  # a feature with two directions is two features at one place
    chosen = []
    for number in usable:
        own = {(sight.image, sight.col, sight.row) for sight in block.tracks[number]}
        cells = []
        for sight in block.tracks[number]:
            picture = pictures[sight.image]
            column = int(CELLS * sight.col / picture.lattice.width_px)
            cells.append((picture.image, column, int(CELLS * sight.row / picture.lattice.height_px)))
        if places.isdisjoint(own) and any(taken[cell] < A_CELL for cell in cells):
            chosen.append(number)
            places |= own
            for cell in cells:
                taken[cell] += 1
    return sorted(chosen)


def orient_by_control(
    block: Reconstruction,
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
            if frame in block.poses and len(given.get(mark.point, ())) == 3:
                assert mark.xy_mm is not None
                pixel = pixel_from_comparator(mark.xy_mm[None], scan.chain.pitch_um)
                (x, y), (c, x0, y0) = scan.chain.frame_from_scan(pixel)[0][0], camera_rays[frame]
                rotation, translation = block.poses[frame]
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
    stations = {image: -rotation.T @ translation for image, (rotation, translation) in block.poses.items()}
    found = np.isfinite(theirs).all(axis=1)
    similarity = absolute_orientation(theirs[found], ours[found], np.array(list(stations.values())))
    if similarity is None:
        raise InputError(
            "The control points that COLMAP's frames show do not determine how the block lies. "
            "Mark control points that are not on one line, in two frames or more."
        )
    return {
        image: (np.asarray(Y_DOWN_Z_FORWARD @ rotation @ similarity.rotation.T), similarity.apply(stations[image]))
        for image, (rotation, _) in block.poses.items()
    }


def run_block(
    project: Project, folder: Path, pitch_um: float | None, reporter: Reporter
) -> tuple[Project, tuple[str, ...], list[str]]:
    """Orient a block by COLMAP; its adjustment is then run as for any project.

    Returns the project with the block's own comparator.csv, images.csv and output; the images not resampled, or
    not oriented by COLMAP; and lines about the block for the user. pitch_um: of the resampled frames; None: chosen.
    Raises InputError where COLMAP is not installed, fiducials are not measured, COLMAP orients nothing, or control is
    missing.
    """
    quiet_colmap()  # fails before the resampling, which takes far longer
    if not project.comparator.exists():
        raise InputError(
            f"{project.comparator}: there is no such file. Run `reseau measure` first: it gives the film "
            "transformations."
        )
    check_folder(project, folder)
    marks = read_comparator(project.comparator, project.list_pitch_um)
    pitch_um = pitch_um or coarse_pitch_um(project)
    seconds = dict[str, float]()
    with _step(seconds, "resampling"):
        frames = folder / "frames"
        results = resample(project, frames, pitch_um, False, True, reporter)
        failed = {result.image: result.problem for result in results if result.problem}
        made = {result.image for result in results} - failed.keys()
        tasks = [task for task in resample_tasks(project, frames, pitch_um, False, FAST)[0] if task.image in made]
    if len(tasks) < 2:
        problems = " ".join(f"{image}: {problem}." for image, problem in failed.items())
        raise InputError(f"a block needs two frames, and {len(tasks)} could be resampled. {problems}")
    cameras = {camera.name: camera for camera in project.cameras.values()}
    with _step(seconds, "pictures"):
        pictures = write_pictures(tasks, cameras, folder)
    with _step(seconds, "features, matches and mapping"):
        found = run_colmap(pictures, cameras, folder)
    with _step(seconds, "tracks and exterior orientations"):
        ties = tie_marks(found, pictures)
        interior = {picture.image: given_interior(cameras[picture.camera]) for picture in pictures}
        poses = orient_by_control(found, pictures, marks, project.object_points, interior)
        own = write_block(project, folder, (*marks, *ties), poses)
    exterior = own.given_images.exterior if own.given_images else {}
    oriented = {project.image_frame(image) for image, each in exterior.items() if each is not None}
    observed = {project.image_frame(image) for image, each in exterior.items() if _observed_elements(each).any()}
    left_out = tuple(sorted({project.image_frame(mark.image) for mark in marks} - oriented))
    lines = [
        f"COLMAP oriented {counted(len(found.poses), 'image')}; {counted(len(ties), 'tie mark')} of "
        f"{counted(len({tie.point for tie in ties}), 'point')} are observations now.",
        *([f"not resampled: {listed_by_reason(failed)}"] if failed else []),
        *([f"not oriented: {', '.join(left_out)}"] if left_out else []),
        *([f"{counted(len(observed), 'orientation')} of images.csv observed, and adjusted so"] if observed else []),
        *(f"{step}: {duration:.0f} s" for step, duration in seconds.items()),
    ]
    return own, tuple(sorted({*left_out, *failed})), lines


def check_folder(project: Project, folder: Path) -> None:
    """Raise InputError where a file would be replaced that was not written by `reseau block`, or is the project's."""
    own = {path.resolve() for path in (project.comparator, project.images_path) if path is not None}
    comparator, images, frames = (folder / name for name in ("comparator.csv", "images.csv", "frames"))
    is_block = images.is_file() and images.read_bytes().startswith(_HEAD.encode())
    is_begun = is_block or any(read_description(path) for path in frames.rglob("*.tif"))
    others = [path for path in (comparator, images) if path.exists() and (not is_block or path.resolve() in own)]
    if not is_begun:
        others += [
            path for path in (*(folder / name for name in _FOLDERS), *folder.glob("colmap.db*")) if path.exists()
        ]
    if others:
        raise InputError(
            f"{others[0]}: would be replaced, and was not written by `reseau block`, or is the project's. Name another "
            "folder."
        )


def coarse_pitch_um(project: Project) -> float | None:
    """Pixel pitch that reduces the frames to MOST_PX, so that feature extraction takes minutes; None where the scans
    are already that coarse."""
    pitches = read_pitches(project.comparator)
    sides = [max(camera.frame_mm) for camera in project.cameras.values() if camera.frame_mm is not None]
    enough = 1000.0 * max(sides, default=0.0) / MOST_PX
    finest = min((min(pitch) for pitch in pitches.values()), default=0.0)
    return enough if enough > finest else None


def write_block(
    project: Project, folder: Path, marks: Sequence[ComparatorPoint], poses: dict[str, tuple[Array, Array]]
) -> Project:
    """Write comparator.csv and images.csv of a block, and return the project that uses them."""
    pitches, given = read_pitches(project.comparator), project.given_images or GivenImages({}, {})
    frames = {mark.image: project.image_frame(mark.image) for mark in marks}
    observed = {
        frames[image]: each
        for image, each in given.exterior.items()
        if image in frames and _observed_elements(each).any()
    }
    oriented = poses.keys() | {frame for frame, each in observed.items() if _observed_elements(each).all()}
    kept = [mark for mark in marks if mark.kind != "target" or frames[mark.image] in oriented]
    write_comparator(folder / "comparator.csv", kept, pitches)
    exterior: dict[str, Exterior | None] = {}
    lines = [
        f"{_HEAD}; elements with standard deviations as they were observed",
        ",".join(("image", *ELEMENTS, *SIGMAS, "camera", "scanner", "part_of")),
    ]
    for image, frame in sorted(frames.items()):
        if frame not in oriented and not given.part_of.get(image):
            continue
        elements = [""] * len(ELEMENTS + SIGMAS)
        if frame in oriented:
            exterior[image] = each = _exterior(poses.get(frame), observed.get(frame))
            to_file = np.array([1.0, 1.0, 1.0, *np.degrees(np.ones(3))])
            numbers = [*(each.values * to_file).tolist(), *(each.sigmas * to_file).tolist()]
            elements = ["" if np.isinf(number) else repr(number) for number in numbers]
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


def _observed_elements(exterior: Exterior | None) -> Mask:
    """(6,) mask of the elements with standard deviations."""
    return np.isfinite(exterior.sigmas) if exterior else np.zeros(len(ELEMENTS), bool)


def _exterior(pose: tuple[Array, Array] | None, given: Exterior | None) -> Exterior:
    """Exterior orientation of a frame: observed elements as given, the others by COLMAP's pose."""
    if pose is None or given is None:
        if given is not None:
            return given
        assert pose is not None
        return Exterior(np.concatenate([pose[1], angles_from_rotation(pose[0])]))
    rotation, station = pose
    angles = angles_near(rotation, given.values[3:])
    values = np.concatenate([station, angles])
    return replace(given, values=np.where(_observed_elements(given), given.values, values))


@contextmanager
def _step(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the duration of the block, s."""
    start = time.monotonic()
    yield
    seconds[name] = time.monotonic() - start


def camera_lattice(camera: CameraFile, pitch_mm: float) -> Canvas:
    """Pixel grid of the exposed frame, at integer multiples of the pitch. Raises InputError where the frame's size is
    unknown."""
    if camera.frame_mm is None or not camera.fiducials:
        raise InputError(
            f"{camera.path}: frame_mm and fiducials are needed to make pictures of one lattice. Give them."
        )
    columns, rows = (int(np.floor(side / 2.0 / pitch_mm)) for side in camera.frame_mm)
    return Canvas(-columns * pitch_mm, rows * pitch_mm, pitch_mm, 2 * columns + 1, 2 * rows + 1)


def write_pictures(
    tasks: Sequence[ResampleTask], cameras: Mapping[str, CameraFile], folder: Path
) -> tuple[BlockPicture, ...]:
    """Write frames as 8-bit images below folder/pictures, and their masks below folder/masks."""
    made, images = [], dict[str, str]()
    for task in tasks:
        camera = cameras[task.camera]
        lattice = camera_lattice(camera, task.pitch_mm)
        picture, mask = _frame_on_lattice(task.target, lattice)
        mask = mask & _usable(camera, lattice)
        name = f"{file_word(task.camera)}/{task.image.replace('/', '_')}.png"
        if images.setdefault(name, task.image) != task.image:
            raise InputError(f"{images[name]!r} and {task.image!r} would share the picture {name}. Rename one scan.")
        for kind, content in (("pictures", _eight_bits(picture, mask)), ("masks", mask.astype(np.uint8) * 255)):
            path = path_below(folder / kind, name, "" if kind == "pictures" else ".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(path), content):
                raise InputError(f"{path}: cannot be written. Make room there, or set another output folder.")
        scans = []
        for each in task.scans:
            with open_scan(each.scan, task.max_pixels) as scan:
                scans.append(BlockScan(each.image, each.chain, scan.width_px, scan.height_px))
        made.append(BlockPicture(task.image, task.camera, name, lattice, tuple(scans)))
    return tuple(made)


def _frame_on_lattice(path: Path, lattice: Canvas) -> tuple[Array, Mask]:
    """Grey values of a resampled frame on the grid, and the mask of valid pixels."""
    with tifffile.TiffFile(path) as file:
        description = json.loads(file.pages.first.description)
        pixels, inside = file.pages[0].asarray(), file.pages[1].asarray().astype(bool)
    grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels.astype(np.float64)
    col = round((lattice.x_mm - description["x_mm"]) / lattice.pitch_mm)
    row = round((description["y_mm"] - lattice.y_mm) / lattice.pitch_mm)
    shape = (lattice.height_px, lattice.width_px)
    picture, mask = np.zeros(shape), np.zeros(shape, bool)
    rows = slice(max(row, 0), min(row + lattice.height_px, grey.shape[0]))
    cols = slice(max(col, 0), min(col + lattice.width_px, grey.shape[1]))
    there = (slice(rows.start - row, rows.stop - row), slice(cols.start - col, cols.stop - col))
    picture[there], mask[there] = grey[rows, cols], inside[rows, cols]
    return picture, mask


def _usable(camera: CameraFile, lattice: Canvas) -> Mask:
    """Mask of the frame without its border and the fiducials."""
    assert camera.frame_mm is not None
    x = lattice.x_mm + lattice.pitch_mm * np.arange(lattice.width_px)
    y = lattice.y_mm - lattice.pitch_mm * np.arange(lattice.height_px)
    width, height = camera.frame_mm
    inside = (np.abs(x) < (0.5 - _BORDER) * width)[None, :] & (np.abs(y) < (0.5 - _BORDER) * height)[:, None]
    reach = _MARK * max(camera.frame_mm)
    for mark in camera.fiducials:
        left, up = mark.xy_mm
        inside &= ~((np.abs(x - left) < reach)[None, :] & (np.abs(y - up) < reach)[:, None])
    return np.asarray(inside)


def _eight_bits(picture: Array, mask: Mask) -> Picture:
    if not mask.any():
        return np.zeros(picture.shape, np.uint8)
    dark, light = np.percentile(picture[mask], (_DARKEST, _LIGHTEST))
    scaled = (picture - dark) * (255.0 / max(light - dark, 1e-9))
    return np.asarray(np.clip(np.rint(scaled), 0, 255).astype(np.uint8))


def run_colmap(pictures: Sequence[BlockPicture], cameras: dict[str, CameraFile], folder: Path) -> Reconstruction:
    """Run COLMAP with fixed cameras and return the largest part of the block that it orients. Raises InputError where
    it orients nothing."""
    pycolmap = quiet_colmap()
    database = folder / "colmap.db"
    for left in folder.glob("colmap.db*"):
        left.unlink()
    for camera in dict.fromkeys(picture.camera for picture in pictures):
        own = [picture for picture in pictures if picture.camera == camera]
        _extract(pycolmap, database, folder, own, cameras[camera])
    if len(pictures) <= _EXHAUSTIVE:
        pycolmap.match_exhaustive(str(database), device=pycolmap.Device.cpu)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = _NEIGHBOURS
        pycolmap.match_sequential(str(database), pairing_options=pairing, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    options.min_model_size = 3
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_principal_point = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    sparse = folder / "sparse"
    sparse.mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(str(database), str(folder / "pictures"), str(sparse), options)
    if not models:
        raise InputError(
            "COLMAP orients no two of these frames. Give frames that overlap by half or more, or orientations in "
            "images.csv and `reseau run`."
        )
    model = max(models.values(), key=lambda model: model.num_reg_images())
    return read_model(model, pycolmap.Database.open(str(database)), pictures)


def quiet_colmap() -> Any:
    """pycolmap, without its log: what fails raises."""
    pycolmap = import_pycolmap("reseau block")
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    return pycolmap


def read_model(model: Any, database: Any, pictures: Sequence[BlockPicture]) -> Reconstruction:
    """Content of a reconstruction, by the names of the images here; feature sizes are read from its database."""
    names = {picture.name: picture.image for picture in pictures}
    images = {number: model.images[number] for number in model.reg_image_ids()}
    poses = {}
    for image in images.values():
        pose = image.cam_from_world()
        poses[names[image.name]] = (np.array(pose.rotation.matrix()), np.array(pose.translation))
    keypoints = {number: np.array(database.read_keypoints(number)) for number in images}
    shapes = {number: each[:, 2:6].reshape(-1, 2, 2) for number, each in keypoints.items()}  # behind x and y
    sizes_px = {number: np.sqrt(np.abs(np.linalg.det(each))) for number, each in shapes.items()}
    tracks = {}
    for number, point in model.points3D.items():
        sights = []
        for element in point.track.elements:
            image, row = images[element.image_id], element.point2D_idx
            place_px = image.points2D[row].xy
            off_px = float(np.linalg.norm(place_px - image.project_point(point.xyz)))
            place = place_px - COLMAP.first_pixel_px
            size_px = float(sizes_px[element.image_id][row])
            sights.append(TrackObservation(names[image.name], float(place[0]), float(place[1]), size_px, off_px))
        tracks[int(number)] = sights
    return Reconstruction(poses, tracks)


def _extract(pycolmap: Any, database: Path, folder: Path, pictures: Sequence[BlockPicture], camera: CameraFile) -> None:
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = (
        "OPENCV",
        ",".join(map(repr, camera_params(camera, pictures[0].lattice))),
    )
    reader.mask_path = str(folder / "masks")
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = FEATURES
    extraction.sift.first_octave = 0  # scans are blurred: doubling the image takes four times as long and adds nothing
    pycolmap.extract_features(
        str(database),
        str(folder / "pictures"),
        [picture.name for picture in pictures],
        pycolmap.CameraMode.SINGLE,
        reader,
        extraction,
        pycolmap.Device.cpu,
    )


def camera_params(camera: CameraFile, lattice: Canvas) -> list[float]:
    """fx, fy, cx, cy, k1, k2, p1, p2 of COLMAP's OPENCV model: given principal distance and point, no distortion."""
    interior = given_interior(camera)
    focal = float(interior[0]) / lattice.pitch_mm
    center = lattice.pixel_from_camera(interior[1:]) + COLMAP.first_pixel_px
    return [focal, focal, *center.tolist(), 0.0, 0.0, 0.0, 0.0]


def given_interior(camera: CameraFile) -> Array:
    """c, x0', y0' (3,), mm. Raises InputError where the camera file does not give c."""
    if camera.principal_distance_mm is None:
        raise InputError(f"{camera.path}: principal_distance_mm is missing: COLMAP needs about the right one. Give it.")
    return np.array([camera.principal_distance_mm, *(camera.principal_point_mm or (0.0, 0.0))])

"""Images for COLMAP, resampled frames on one pixel grid per camera with masks of what is fixed to the camera; features,
matches and incremental mapping of a block's images, with the given cameras."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from measure.scans.opening import open_scan
from pipeline.errors import InputError
from pipeline.exchange.pinhole_formats import COLMAP, import_pycolmap
from pipeline.files.camera_file import CameraFile
from pipeline.resampling.canvas import Canvas, FrameChain
from pipeline.resampling.resample_stage import ResampleTask
from pipeline.text.files import file_word, path_below
from pipeline.types import Array, Mask

Picture = NDArray[np.uint8]

_BORDER = 0.02  # fraction of the frame's side: vignetting, edge of the frame
_MARK = 0.03  # masked around fiducials, which would match themselves in every frame; fraction of the frame's side
_DARKEST, _LIGHTEST = 0.5, 99.5  # percentiles that are mapped to black and white
FEATURES = 2000  # per image; a block needs hundreds of them in common
SEED = 0  # of the mapper's random choices, so that a block is the same in every run
_EXHAUSTIVE = 60  # images up to which every pair is matched
_NEIGHBOURS = 12  # neighbours in the sequence with which an image is matched in larger blocks


@dataclass(frozen=True)
class BlockScan:
    """Scan of a frame: name of its image, transformation from the frame, and size."""

    image: str
    chain: FrameChain
    width_px: int
    height_px: int

    def depths_px(self, pixels: Array) -> Array:
        """(n,) distances of pixels (n, 2) from the nearest edge of the scan, px; negative outside."""
        col, row = pixels.T
        edges = [col + 0.5, self.width_px - 0.5 - col, row + 0.5, self.height_px - 0.5 - row]
        return np.asarray(np.min(edges, axis=0))


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
        candidates = [(scan, scan.chain.scan_from_frame(camera_mm[None])) for scan in self.scans]
        places = [(scan, pixels[0]) for scan, (pixels, found) in candidates if found[0]]
        return max(places, key=lambda place: place[0].depths_px(place[1][None])[0], default=None)


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
    made = []
    for task in tasks:
        camera = cameras[task.camera]
        lattice = camera_lattice(camera, task.pitch_mm)
        picture, mask = _cut(task.target, lattice)
        mask = mask & _usable(camera, lattice)
        name = f"{file_word(task.camera)}/{task.image.replace('/', '_')}.png"
        for kind, content in (("pictures", _eight_bits(picture, mask)), ("masks", mask.astype(np.uint8) * 255)):
            path = path_below(folder / kind, name, "" if kind == "pictures" else ".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(path), content):
                raise InputError(f"{path}: cannot be written. Make room there, or set another output folder.")
        made.append(BlockPicture(task.image, task.camera, name, lattice, _scans(task)))
    return tuple(made)


def _scans(task: ResampleTask) -> tuple[BlockScan, ...]:
    scans = []
    for each in task.scans:
        with open_scan(each.scan, task.max_pixels) as scan:
            scans.append(BlockScan(each.image, each.chain, scan.width_px, scan.height_px))
    return tuple(scans)


def _cut(path: Path, lattice: Canvas) -> tuple[Array, Mask]:
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


@dataclass(frozen=True)
class Sight:
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
class Mapped:
    """Result of COLMAP, in a coordinate system of its own.

    poses: by image, rotation (3, 3) and translation (3,) to axes x right, y down, z forward; tracks: by point, its
    observations.
    """

    poses: dict[str, tuple[Array, Array]]
    tracks: dict[int, list[Sight]]


def mapped(pictures: Sequence[BlockPicture], cameras: dict[str, CameraFile], folder: Path) -> Mapped:
    """Run COLMAP and return the largest part of the block that it orients. Raises InputError where it orients
    nothing."""
    pycolmap = quiet_colmap()
    database = folder / "colmap.db"
    for left in folder.glob("colmap.db*"):
        left.unlink()
    for camera in dict.fromkeys(picture.camera for picture in pictures):
        own = [picture for picture in pictures if picture.camera == camera]
        _extract(pycolmap, database, folder, own, cameras[camera])
    _match(pycolmap, database, len(pictures))
    return _run_mapping(pictures, folder)


def quiet_colmap() -> Any:
    """pycolmap, with only errors logged."""
    pycolmap = import_pycolmap("reseau block")
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    return pycolmap


def _run_mapping(pictures: Sequence[BlockPicture], folder: Path) -> Mapped:
    """Estimate poses and points from the matches in the database, with fixed cameras."""
    pycolmap = quiet_colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = SEED
    options.min_model_size = 3
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_principal_point = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    sparse = folder / "sparse"
    sparse.mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(str(folder / "colmap.db"), str(folder / "pictures"), str(sparse), options)
    if not models:
        raise InputError("COLMAP orients no two of these frames: they may not overlap, or show too little in common.")
    model = max(models.values(), key=lambda model: model.num_reg_images())
    return read_model(model, pycolmap.Database.open(str(folder / "colmap.db")), pictures)


def read_model(model: Any, database: Any, pictures: Sequence[BlockPicture]) -> Mapped:
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
            sights.append(Sight(names[image.name], float(place[0]), float(place[1]), size_px, off_px))
        tracks[int(number)] = sights
    return Mapped(poses, tracks)


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


def _match(pycolmap: Any, database: Path, images: int) -> None:
    device = pycolmap.Device.cpu
    if images <= _EXHAUSTIVE:
        pycolmap.match_exhaustive(str(database), device=device)
        return
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap = _NEIGHBOURS
    pycolmap.match_sequential(str(database), pairing_options=pairing, device=device)

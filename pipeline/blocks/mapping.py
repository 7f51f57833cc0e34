"""Interface to COLMAP: features, matches and incremental mapping of a block's images, with the given cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.blocks.pictures import BlockPicture
from pipeline.errors import InputError
from pipeline.exchange.colmap_format import CONVENTION, import_pycolmap
from pipeline.files.camera_file import CameraFile
from pipeline.resampling.canvas import Canvas
from pipeline.types import Array

FEATURES = 2000  # per image; a block needs hundreds of them in common
SEED = 0
_EXHAUSTIVE = 60  # images up to which every pair is matched
_NEIGHBOURS = 12  # neighbours in the sequence with which an image is matched in larger blocks


@dataclass(frozen=True)
class Sight:
    """Observation of a track in an image.

    Attributes
    ----------
    image : name of the image.
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

    Attributes
    ----------
    poses : by image, rotation (3, 3) and translation (3,) to axes x right, y down, z forward.
    tracks : by point, its observations.
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
            place = place_px - CONVENTION.first_pixel_px
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
    center = lattice.pixel_from_camera(interior[1:]) + CONVENTION.first_pixel_px
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

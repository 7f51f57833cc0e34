"""OpenCV's YAML: camera matrix, distortion and orientation of every resampled frame."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.exchange.block import Block
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.incoming import ForeignPose, ImportOptions, Incoming, foreign_pose, opencv_camera
from pipeline.exchange.pinhole import BROWN, PRISMS, PinholeFrame, pinhole_frames, pinholes_written
from pipeline.files.camera_file import CameraFile
from pipeline.files.opencv_file import FISHEYE, read_pixel_camera
from pipeline.opencv_check.opencv_calibration import NAMES
from pipeline.text.files import image_name

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; camera = R X + t",
    "OpenCV, calib3d: projectPoints, and undistort, whose maps count from the first pixel's centre",
)


def write(block: Block, options: ExportOptions) -> Written:
    """Write NAME.yml for each image, for cv2.FileStorage."""
    frames, left_out = pinhole_frames(block, options, (BROWN, PRISMS, NAMES[4:]), "opencv")
    files = {f"{frame.frame.image}.yml": _yaml(frame, block.lens_reach.get(frame.frame.camera)) for frame in frames}
    return pinholes_written(files, frames, left_out, lost="the marks")


def _yaml(frame: PinholeFrame, lens_reach: str | None) -> str:
    """YAML text of one image. lens_reach: comment on the radius up to which the lens is known."""
    fx, fy, cx, cy = frame.interior_px(CONVENTION)
    distortion = frame.lens.named(NAMES[4:])
    used = np.flatnonzero(distortion)
    count = next(size for size in (5, 8, 12, 14) if size > (used.max() if used.size else 0))
    storage = cv2.FileStorage("", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    storage.write("image", frame.picture)
    storage.write("camera", frame.frame.camera)
    storage.write("image_width", frame.canvas.width_px)
    storage.write("image_height", frame.canvas.height_px)
    storage.write("camera_matrix", np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))
    if lens_reach:
        storage.writeComment(lens_reach)
    if frame.lens.fisheye:
        storage.write("distortion_model", FISHEYE)
        storage.write("distortion_coefficients", np.array([frame.lens.fisheye]))
    else:
        storage.write("distortion_coefficients", distortion[:count].reshape(1, -1))
    storage.write("R", frame.rotation)
    storage.write("t", frame.translation.reshape(3, 1))
    return str(storage.releaseAndGetString())


def read(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Read files of cv2.FileStorage: matrix, distortion and size as camera files; R and t, if given, as
    orientations."""
    found = [_camera_and_pose(path, options) for path in paths]
    poses = tuple(pose for _, pose in found if pose is not None)
    return Incoming(cameras=tuple(camera for camera, _ in found), poses=poses)


def _camera_and_pose(path: Path, options: ImportOptions) -> tuple[CameraFile, ForeignPose | None]:
    found, storage = read_pixel_camera(path)
    name = storage.getNode("camera").string() or path.stem
    picture = image_name(storage.getNode("image").string() or path.stem)
    camera = opencv_camera(
        path, name, found.interior_px, found.distortion, found.size_px, options, CONVENTION, found.family
    )
    turn, shift = storage.getNode("R").mat(), storage.getNode("t").mat()
    if turn is None or shift is None:
        return camera, None
    return camera, foreign_pose(picture, np.array(turn, dtype=float), np.ravel(shift).astype(float))

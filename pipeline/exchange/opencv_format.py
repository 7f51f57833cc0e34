"""OpenCV's YAML: camera matrix, distortion and pose of every image, of its resampled frame."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from adjust.functional_model.families import parameter_names
from pipeline.errors import InputError
from pipeline.exchange.block import Block
from pipeline.exchange.fitted_lens import BROWN, PRISMS
from pipeline.exchange.formats import Convention, ExportOptions, Written
from pipeline.exchange.incoming import ForeignPose, ImportOptions, Incoming, foreign_pose, opencv_camera
from pipeline.exchange.pinhole import PinholeFrame, pinhole_frames, pinholes_written
from pipeline.files.camera_file import CameraFile
from pipeline.opencv_check.opencv_model import NAMES
from pipeline.text.names import image_name
from pipeline.text.text_file import read_bytes

CONVENTION = Convention(
    (0.0, 0.0),
    "column right, row down; camera x right, y down, z forward; camera = R X + t",
    "OpenCV, calib3d: projectPoints, and undistort, whose maps count from the first pixel's centre",
)
MOST_MB = 4
FISHEYE = "fisheye"  # of cv2.fisheye, as ROS and others call the key and the model ("equidistant" too)
_MATRIX = ("camera_matrix", "K", "Camera_Matrix", "cameraMatrix", "M1")
_LENS = ("distortion_coefficients", "D", "Distortion_Coefficients", "distCoeffs", "D1")
_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")


def write(block: Block, options: ExportOptions) -> Written:
    """NAME.yml an image, for cv2.FileStorage."""
    frames, left_out = pinhole_frames(block, options, (BROWN, PRISMS, NAMES[4:]), "opencv")
    files = {f"{frame.frame.image}.yml": _yaml(frame, block.lens_reach.get(frame.frame.camera)) for frame in frames}
    return pinholes_written(files, frames, left_out, lost="the marks")


def _yaml(frame: PinholeFrame, lens_reach: str | None) -> str:
    """lens_reach: a comment on how far out the lens is known."""
    fx, fy, cx, cy = frame.interior_px(CONVENTION)
    used = np.flatnonzero(frame.lens.values[4:])
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
        storage.write("distortion_coefficients", frame.lens.values[4 : 4 + count].reshape(1, -1))
    storage.write("R", frame.rotation)
    storage.write("t", frame.translation.reshape(3, 1))
    return str(storage.releaseAndGetString())


def read(paths: Sequence[Path], options: ImportOptions) -> Incoming:
    """Files of cv2.FileStorage: matrix, distortion and size as camera files; R and t, where there are, as poses."""
    found = [_read(path, options) for path in paths]
    poses = tuple(pose for _, pose in found if pose is not None)
    return Incoming(cameras=tuple(camera for camera, _ in found), poses=poses)


def _read(path: Path, options: ImportOptions) -> tuple[CameraFile, ForeignPose | None]:
    try:
        return _camera_and_pose(path, options)
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{path}: there is no such file.") from None
    except (UnicodeDecodeError, cv2.error, SystemError):
        raise InputError(
            f"{path}: is no YAML, XML or JSON file of OpenCV (cv2.FileStorage) with a camera in it. Name one."
        ) from None


def _camera_and_pose(path: Path, options: ImportOptions) -> tuple[CameraFile, ForeignPose | None]:
    text = read_bytes(path, MOST_MB).decode("utf-8")
    storage: Any = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)

    def first(names: Sequence[str]) -> Any:
        nodes = (storage.getNode(name) for name in names)
        return next((node for node in nodes if not node.empty()), None)

    matrix, lens, size = (first(names) for names in (_MATRIX, _LENS, _WIDTH))
    if matrix is None or matrix.mat() is None or matrix.mat().shape != (3, 3):
        raise InputError(f"{path}: has no 3 x 3 matrix {_MATRIX[0]} (or {', '.join(_MATRIX[1:])}).")
    k = np.array(matrix.mat(), dtype=float)
    values = np.zeros(0) if lens is None else np.ravel(lens.mat()).astype(float)
    if values.size > len(NAMES[4:]) or not (np.isfinite(values).all() and np.isfinite(k).all() and k[0, 0] > 0.0):
        raise InputError(f"{path}: the camera matrix and up to {len(NAMES[4:])} distortion values are to be finite.")
    height = first(_HEIGHT)
    pixels = (k[0, 0], k[1, 1], k[0, 2], k[1, 2])
    extent = (size.real(), height.real()) if size is not None and height is not None else None
    name = storage.getNode("camera").string() or path.stem
    picture = image_name(storage.getNode("image").string() or path.stem)
    is_fisheye = storage.getNode("distortion_model").string() in (FISHEYE, "equidistant")
    names = parameter_names("opencv_fisheye")[:4] if is_fisheye else NAMES[4:]
    if is_fisheye and values.size > len(names):
        raise InputError(f"{path}: a fisheye has {len(names)} distortion values, not {values.size}.")
    given = dict(zip(names, values.tolist(), strict=False)) | {"b2": k[0, 1] / k[1, 1]}
    family = "opencv_fisheye" if is_fisheye else "opencv"
    camera = opencv_camera(path, name, pixels, given, extent, options, CONVENTION, family)
    turn, shift = storage.getNode("R").mat(), storage.getNode("t").mat()
    if turn is None or shift is None:
        return camera, None
    return camera, foreign_pose(picture, np.array(turn, dtype=float), np.ravel(shift).astype(float))

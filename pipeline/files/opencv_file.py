"""Read a camera from a file of cv2.FileStorage: camera matrix, distortion and image size, in pixels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from adjust.functional_model.families import parameter_names
from pipeline.errors import InputError
from pipeline.text.text_file import read_bytes
from pipeline.types import Array

FISHEYE = "fisheye"  # model of cv2.fisheye, also called "equidistant", and the key that ROS and others use
COVARIANCE = "intrinsics_covariance"  # key in camera.yaml: covariance of fx, fy, cx, cy and the distortion coefficients
MOST_MB = 4
_MATRIX = ("camera_matrix", "K", "Camera_Matrix", "cameraMatrix", "M1")
_LENS = ("distortion_coefficients", "D", "Distortion_Coefficients", "distCoeffs", "D1")
_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")


@dataclass(frozen=True, eq=False)
class PixelCamera:
    """Camera in pixels.

    Attributes
    ----------
    interior_px : fx, fy, cx, cy.
    family : distortion model.
    distortion : values by parameter, as many as the file has, and b2 (skew) from the camera matrix.
    size_px : width and height of the images; None if unknown.
    covariance : of fx, fy, cx, cy and the first distortion coefficients; None if the file has none.
    """

    interior_px: tuple[float, float, float, float]
    family: str
    distortion: Mapping[str, float]
    size_px: tuple[float, float] | None
    covariance: Array | None


def read_pixel_camera(path: Path) -> tuple[PixelCamera, Any]:
    """Read the camera of a YAML, XML or JSON file; also return the file's storage, for its other content. Raises
    InputError."""
    try:
        text = read_bytes(path, MOST_MB).decode("utf-8")
        storage: Any = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        return _pixel_camera(path, storage), storage
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{path}: there is no such file.") from None
    except (UnicodeDecodeError, cv2.error, SystemError):
        raise InputError(
            f"{path}: is no YAML, XML or JSON file of OpenCV (cv2.FileStorage) with a camera in it. Name one."
        ) from None


def _pixel_camera(path: Path, storage: Any) -> PixelCamera:
    def first(names: Sequence[str]) -> Any:
        nodes = (storage.getNode(name) for name in names)
        return next((node for node in nodes if not node.empty()), None)

    matrix, lens, size, height = (first(names) for names in (_MATRIX, _LENS, _WIDTH, _HEIGHT))
    if matrix is None or matrix.mat() is None or matrix.mat().shape != (3, 3):
        raise InputError(f"{path}: has no 3 x 3 matrix {_MATRIX[0]} (or {', '.join(_MATRIX[1:])}).")
    k = np.array(matrix.mat(), dtype=float)
    values = np.zeros(0) if lens is None else np.ravel(lens.mat()).astype(float)
    is_fisheye = storage.getNode("distortion_model").string() in (FISHEYE, "equidistant")
    family = "opencv_fisheye" if is_fisheye else "opencv"
    names = parameter_names(family)[:-2]  # b1 and b2 are part of the matrix
    if values.size > len(names) or not (np.isfinite([*values, *k.ravel()]).all() and k[0, 0] > 0.0):
        raise InputError(f"{path}: the camera matrix and up to {len(names)} distortion values are to be finite.")
    covariance, count = storage.getNode(COVARIANCE), 4 + values.size
    known = None if covariance.empty() else np.array(covariance.mat(), dtype=float)
    if known is not None and (known.shape != (count, count) or not np.allclose(known, known.T, atol=0.0)):
        raise InputError(f"{path}: {COVARIANCE} is to be {count} x {count} and symmetric: see `reseau calibrate`.")
    return PixelCamera(
        (k[0, 0], k[1, 1], k[0, 2], k[1, 2]),
        family,
        dict(zip(names, values.tolist(), strict=False)) | {"b2": k[0, 1] / k[1, 1]},
        None if size is None or height is None else (size.real(), height.real()),
        known,
    )

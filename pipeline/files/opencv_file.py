"""Cameras in files of cv2.FileStorage, in pixels; among them the lens of the camera that photographed the film."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from adjust.functional_model.families import parameter_names
from adjust.functional_model.lens import Distortion, Lens
from measure.scans.scan import Scan
from pipeline.errors import InputError
from pipeline.results.comparator_file import comparator_from_pixel, pixel_from_comparator
from pipeline.results.image_unit import pixel_intrinsics
from pipeline.text.files import read_bytes
from pipeline.types import Array

FISHEYE_MODEL = "fisheye"  # model of cv2.fisheye, also called "equidistant", and the key that ROS and others use
COVARIANCE = "intrinsics_covariance"  # key in camera.yaml: covariance of fx, fy, cx, cy and the distortion coefficients
MOST_MB = 4
_FISHEYES = (FISHEYE_MODEL, "equidistant", "kannala_brandt")  # values of distortion_model
_OPENCV = ("plumb_bob", "rational_polynomial", "radtan", "brown_conrady", "pinhole", "opencv", "")
_MATRIX = ("camera_matrix", "K", "Camera_Matrix", "cameraMatrix", "M1")
_LENS = ("distortion_coefficients", "D", "Distortion_Coefficients", "distCoeffs", "D1")
_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")
_COUNTS = {"opencv": (0, 4, 5, 8, 12, 14), "opencv_fisheye": (0, 4)}  # of coefficients that OpenCV takes
_MOST_PX = 1e6  # along a picture's side; a word reads as 1e308


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
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file.") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder. Name the camera's file in it.") from None
    except (UnicodeDecodeError, cv2.error, SystemError):
        raise InputError(
            f"{path}: is no YAML, XML or JSON file of OpenCV (cv2.FileStorage) with a camera in it. Name one."
        ) from None


def yaml_text(values: Iterable[tuple[str, Any]]) -> str:
    """YAML text of cv2.FileStorage; an empty name marks a comment."""
    storage = cv2.FileStorage("", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML)
    for name, value in values:
        if name:
            storage.write(name, value)
        else:
            storage.writeComment(value)
    return str(storage.releaseAndGetString())


def read_matrix(path: Path, node: Any) -> Array:
    """Matrix of a node, with its type or, as ROS writes it, without. Raises InputError where it is none."""
    with suppress(cv2.error, SystemError):
        content = node.mat()
        return np.zeros(0) if content is None else np.atleast_1d(np.array(content, dtype=float))
    with suppress(cv2.error, ValueError, OverflowError):
        data, shape = node.getNode("data"), [int(node.getNode(side).real()) for side in ("rows", "cols")]
        values = [data.at(i) for i in range(data.size())]
        if all(value.isReal() or value.isInt() for value in values):
            return np.reshape([value.real() for value in values], shape)
    raise InputError(f"{path}: {node.name()} is no matrix (!!opencv-matrix). Write it as cv2.FileStorage does.")


def _pixel_camera(path: Path, storage: Any) -> PixelCamera:
    def first(names: Sequence[str]) -> Any:
        nodes = (storage.getNode(name) for name in names)
        return next((node for node in nodes if not node.empty()), None)

    matrix, lens, size, height = (first(names) for names in (_MATRIX, _LENS, _WIDTH, _HEIGHT))
    k = np.zeros(0) if matrix is None else read_matrix(path, matrix)
    if k.shape != (3, 3):
        raise InputError(f"{path}: has no 3 x 3 matrix {_MATRIX[0]} (or {', '.join(_MATRIX[1:])}).")
    if not storage.getNode("M2").empty():
        raise InputError(
            f"{path}: holds two cameras (M1 and M2 of a stereo pair). Save each in a file of its own, with the keys "
            f"{_MATRIX[0]} and {_LENS[0]}."
        )
    if k[1, 0] or not np.array_equal(k[2], (0.0, 0.0, 1.0)):
        raise InputError(
            f"{path}: {matrix.name()} is to be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], in px. MATLAB's is transposed."
        )
    values = np.zeros(0) if lens is None else np.ravel(read_matrix(path, lens))
    model = storage.getNode("distortion_model").string()
    is_fisheye = model in _FISHEYES or storage.getNode("fisheye_model").real() > 0.0  # flag of OpenCV's own program
    if not storage.getNode("xi").empty() or not (is_fisheye or model in _OPENCV):
        raise InputError(
            f"{path}: its distortion model, {model or 'omnidirectional (xi)'}, is none of OpenCV's two that are read "
            f"({_OPENCV[0]} and {_FISHEYES[0]}). Calibrate again with one of them."
        )
    family = "opencv_fisheye" if is_fisheye else "opencv"
    names = parameter_names(family)[:-2]  # b1 and b2 are part of the matrix
    if not (np.isfinite([*values, *k.ravel()]).all() and min(k[0, 0], k[1, 1]) > 0.0):
        raise InputError(f"{path}: camera matrix and distortion are to be finite, and its fx and fy positive.")
    if values.size not in _COUNTS[family]:
        counts = ", ".join(map(str, _COUNTS[family][1:]))
        raise InputError(
            f"{path}: {values.size} distortion coefficients; OpenCV has {counts}, in the order "
            f"{', '.join(names[:5])}. Append zeros."
        )
    size_px = None if size is None or height is None else (size.real(), height.real())
    if size_px is not None and not all(0.0 < side <= _MOST_PX for side in size_px):
        raise InputError(f"{path}: {_WIDTH[0]} and {_HEIGHT[0]} are to be the picture's sides in px.")
    covariance, count = storage.getNode(COVARIANCE), 4 + values.size
    known = None if covariance.empty() else read_matrix(path, covariance)
    if known is not None and (known.shape != (count, count) or not np.allclose(known, known.T, atol=0.0)):
        raise InputError(f"{path}: {COVARIANCE} is to be {count} x {count} and symmetric: see `reseau calibrate`.")
    return PixelCamera(
        (k[0, 0], k[1, 1], k[0, 2], k[1, 2]),
        family,
        dict(zip(names, values.tolist(), strict=False)) | {"b2": k[0, 1] / k[1, 1]},
        size_px,
        known,
    )


@dataclass(frozen=True, eq=False)
class CalibratedLens:
    """Lens in comparator coordinates of the scans that its camera took.

    Attributes
    ----------
    lens : interior orientation, mm at the scans' pitch, with its covariance if the calibration gives one.
    pitch_um : pixel pitch across and down.
    size_px : width and height of its images.
    """

    lens: Lens
    pitch_um: tuple[float, float]
    size_px: tuple[int, int]

    @property
    def is_covariance_known(self) -> bool:
        return self.lens.covariance.size > 0

    def ideal_px(self, scan_px: Array) -> Array:
        """Distortion-free pixel coordinates of scan pixels (..., 2); unchanged outside the lens's field of view."""
        scan_mm = comparator_from_pixel(np.reshape(scan_px, (-1, 2)), self.pitch_um)
        ideal_mm, found = self.lens.ideal_from_observed(scan_mm)
        return self._px(np.where(found[:, None], ideal_mm, scan_mm), np.shape(scan_px))

    def scan_px(self, ideal_px: Array) -> Array:
        """Inverse of `ideal_px`: scan pixels of distortion-free pixels (..., 2)."""
        ideal_mm = comparator_from_pixel(np.reshape(ideal_px, (-1, 2)), self.pitch_um)
        scan_mm, found = self.lens.camera_from_ray((ideal_mm - self.lens.interior[1:]) / self.lens.interior[0])
        return self._px(np.where(found[:, None], scan_mm, ideal_mm), np.shape(ideal_px))

    def covariance_px2(self, scan_px: Array) -> Array:
        """(2n, 2n) joint covariance of the ideal pixels of scan pixels (n, 2), propagated from the lens's covariance,
        px²; 0 where the calibration gives none."""
        if not self.is_covariance_known:
            return np.zeros((scan_px.size, scan_px.size))
        scan_mm = comparator_from_pixel(scan_px, self.pitch_um)
        c, point = self.lens.interior[0], self.lens.interior[1:]
        ray = (self.lens.ideal_from_observed(scan_mm)[0] - point) / c
        at = self.lens.equations(scan_mm, ray)
        by_lens = c * np.linalg.solve(-at.ray_jacobian, at.quantity_jacobian)
        by_lens[:, :, 0] += ray
        by_lens[:, :, 1:3] += np.eye(2)
        by_lens = (by_lens * np.array([1000.0, -1000.0])[:, None] / np.array(self.pitch_um)[:, None]).reshape(
            scan_px.size, -1
        )
        return np.asarray(by_lens @ self.lens.covariance @ by_lens.T)

    def crop(self, col: int, row: int) -> "CalibratedLens":
        """Lens for a part of the scan whose first pixel is (col, row)."""
        interior = self.lens.interior.copy()
        interior[1:] -= comparator_from_pixel(np.array([col, row], float), self.pitch_um)
        return replace(self, lens=replace(self.lens, interior=interior))

    def misfit(self, scan: Scan) -> str:
        """Message where a scan's size differs from that of the lens's images; else ""."""
        size = scan.width_px, scan.height_px
        if size == self.size_px:
            return ""
        width, height = self.size_px
        turned = " Rotate it back to the sensor's orientation." if size == (height, width) else ""
        return (
            f"{scan.path}: has {size[0]} x {size[1]} px, and the lens under [scanner] was calibrated for {width} x "
            f"{height} px: the principal point in this image is unknown.{turned or ' Give the image uncropped.'}"
        )

    def _px(self, mm: Array, shape: tuple[int, ...]) -> Array:
        return pixel_from_comparator(mm, self.pitch_um).reshape(shape)


def read_lens(path: Path, pitch_um: float) -> CalibratedLens:
    """Read the lens of camera.yaml, as `reseau calibrate` or OpenCV writes it, for scans of a pixel pitch. Raises
    InputError."""
    camera, _ = read_pixel_camera(path)
    if camera.size_px is None:
        raise InputError(f"{path}: does not say the picture's size. Give image_width and image_height in px.")
    (fx, fy, cx, cy), pitch_mm = camera.interior_px, pitch_um / 1000.0
    given = {"b1": fx / fy - 1.0, **camera.distortion}
    interior = np.array([fy, cx, -cy]) * pitch_mm
    parameters = np.array([given.get(name, 0.0) for name in parameter_names(camera.family)])
    covariance = np.empty((0, 0))
    if camera.covariance is not None:
        known = Lens(Distortion(camera.family), interior, parameters)
        _, by_mm = pixel_intrinsics(dict(zip(known.quantities, known.values.tolist(), strict=True)), pitch_mm)
        by_px = np.linalg.inv(by_mm)[:, : len(camera.covariance)]
        covariance = by_px @ camera.covariance @ by_px.T
    lens = Lens(Distortion(camera.family), interior, parameters, covariance)
    width, height = (round(side) for side in camera.size_px)
    return CalibratedLens(lens, (pitch_um, pitch_um), (width, height))

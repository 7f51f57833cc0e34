"""cv2.calibrateCameraExtended on observations in the camera frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.scans.parallel import one_opencv_thread
from pipeline.opencv_check.opencv_model import NAMES, Y_UP, Freedom, camera_matrix

Array = NDArray[np.float64]

PICTURE_PX = 4000.0  # the frame's longer side, in the pixels in which OpenCV is given the observations
CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-15)
FLAT = 1e-3  # OpenCV takes a field for a plane where its smallest extent is below this part of the middle one (squared)
FEWEST_FLAT, FEWEST_DEEP = 4, 6  # points from which OpenCV begins an image
RADIAL_FLAGS = {
    "k1": cv2.CALIB_FIX_K1,
    "k2": cv2.CALIB_FIX_K2,
    "k3": cv2.CALIB_FIX_K3,
    "k4": cv2.CALIB_FIX_K4,
    "k5": cv2.CALIB_FIX_K5,
    "k6": cv2.CALIB_FIX_K6,
}


@dataclass(frozen=True)
class ImagePoints:
    """One image for OpenCV: object points (n, 3) and where they were observed in the camera frame (n, 2), mm, y up."""

    image: str
    xyz: Array
    xy_mm: Array


@dataclass(frozen=True)
class OpenCvCalibration:
    """Parameters (18,) and standard deviations (18,) in the order of `opencv_model.NAMES`; rms a point in um.

    rounding_um: rms of what the rounding to single precision, which OpenCV demands, changes an image coordinate by.
    """

    parameters: Array
    sigmas: Array
    rms_um: float
    rounding_um: float


def can_begin(xyz: Array) -> bool:
    """Whether OpenCV finds a start of its own for an image of these points (n, 3)."""
    if len(xyz) < FEWEST_FLAT:
        return False
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extents[1] < 1e-5 * extents[0]:
        return False
    return bool(len(xyz) >= FEWEST_DEEP or (extents[2] / extents[1]) ** 2 < FLAT)


def calibrate(images: Sequence[ImagePoints], freedom: Freedom, start: Array) -> OpenCvCalibration:
    """OpenCV's least squares from `start` (18,); what `freedom` does not name is held at its start.

    Its points are single precision: object points are taken about their mean, and the frame about its middle.
    Raises cv2.error where OpenCV refuses.
    """
    observed = np.concatenate([image.xy_mm for image in images])
    corners = np.array([np.minimum(observed.min(axis=0), start[2:4]), np.maximum(observed.max(axis=0), start[2:4])])
    pixel_mm = float((corners[1] - corners[0]).max()) / (PICTURE_PX - 1)
    offset = np.array([corners[0, 0], -corners[1, 1]]) / pixel_mm - 0.5  # of the top left corner, y down
    middle = np.concatenate([image.xyz for image in images]).mean(axis=0)

    exact = [image.xy_mm * Y_UP / pixel_mm - offset for image in images]
    pixels = [each.astype(np.float32) for each in exact]
    objects = [(image.xyz - middle).astype(np.float32) for image in images]
    matrix = camera_matrix(start) / pixel_mm
    matrix[2, 2] = 1.0
    matrix[:2, 2] -= offset
    size = tuple(int(extent) + 2 for extent in np.ceil((corners[1] - corners[0]) / pixel_mm))
    tilted = "tau_x" in freedom.names or bool(start[-2:].any())
    lens = start[4:] if tilted else start[4:-2]
    with one_opencv_thread():  # several add up the images in the order in which they end, which differs by the run
        rms_px, adjusted_matrix, distortion, _, _, sigmas, _, _ = cv2.calibrateCameraExtended(
            objects, pixels, (size[0], size[1]), matrix, lens.copy(), flags=_flags(freedom, tilted), criteria=CRITERIA
        )
    rounding_px = np.concatenate([a - b for a, b in zip(exact, pixels, strict=True)])
    return OpenCvCalibration(
        parameters=_parameters(np.asarray(adjusted_matrix, dtype=np.float64), np.ravel(distortion), offset, pixel_mm),
        sigmas=_sigmas(np.ravel(sigmas), freedom, start, pixel_mm),
        rms_um=1e3 * pixel_mm * float(rms_px),
        rounding_um=1e3 * pixel_mm * float(np.sqrt((rounding_px**2).mean())),
    )


def _flags(freedom: Freedom, tilted: bool) -> int:
    free = set(freedom.names)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL
    flags |= cv2.CALIB_TILTED_MODEL if tilted else 0
    flags |= 0 if "tau_x" in free else cv2.CALIB_FIX_TAUX_TAUY
    flags |= 0 if "fx" in free else cv2.CALIB_FIX_FOCAL_LENGTH
    flags |= 0 if {"fx", "fy"} <= free else cv2.CALIB_FIX_ASPECT_RATIO
    flags |= 0 if "cx" in free else cv2.CALIB_FIX_PRINCIPAL_POINT
    flags |= 0 if "p1" in free else cv2.CALIB_FIX_TANGENT_DIST
    flags |= 0 if "s1" in free else cv2.CALIB_FIX_S1_S2_S3_S4
    for name, flag in RADIAL_FLAGS.items():
        flags |= 0 if name in free else flag
    return flags


def _parameters(matrix: Array, distortion: Array, offset: Array, pixel_mm: float) -> Array:
    principal_point = (matrix[:2, 2] + offset) * pixel_mm * Y_UP
    lens = np.zeros(len(NAMES) - 4)
    lens[: len(distortion)] = distortion[: len(lens)]  # without a tilt OpenCV gives none
    return np.concatenate([np.diag(matrix)[:2] * pixel_mm, principal_point, lens])


def _sigmas(sigmas: Array, freedom: Freedom, start: Array, pixel_mm: float) -> Array:
    """In OpenCV's order, which is that of NAMES; with the ratio kept it gives the focal length's at fy alone."""
    found = sigmas[: len(NAMES)] * np.where(np.arange(len(NAMES)) < 4, pixel_mm, 1.0)
    if "fy" not in freedom.names:
        found[0] = found[1] * start[0] / start[1]
    return found

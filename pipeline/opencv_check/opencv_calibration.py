"""Calibration of observations in the camera frame by cv2.calibrateCamera and cv2.fisheye.calibrate.

Parameters are OpenCV's in the unit of the camera frame: fx, fy, cx, cy in mm, where cx and cy are the principal point
x0', y0' (y up); k1 to s4 and the fisheye's alpha without unit; the sensor's tilt tau_x, tau_y in rad.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from adjust.functional_model import opencv_family
from adjust.functional_model.lens import Distortion, Lens, Prior
from measure.scans.parallel import one_opencv_thread
from pipeline.types import Array

INTERIOR = ("fx", "fy", "cx", "cy")
NAMES = (*INTERIOR, *opencv_family.OPENCV_NAMES[:-2])  # without b1 and b2, which fx and fy hold
OPENCV_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")  # numerator and denominator
FISHEYE = "opencv_fisheye"  # name of this model's family in the adjustment
FISHEYE_NAMES = (*INTERIOR, *opencv_family.FISHEYE_NAMES[:-2], "alpha")
Y_UP = np.array([1.0, -1.0])

PICTURE_PX = 4000.0  # px, longer side of the frame in the observations for OpenCV
OBJECT_EXTENT = 100.0  # rms distance of object points from their centroid: with smaller numbers OpenCV loses digits
CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-15)
FLAT = 1e-3  # squared ratio of the smallest to the middle extent, below which OpenCV treats a field as a plane
FEWEST_FLAT, FEWEST_DEEP = 4, 6  # points that OpenCV needs for the initial orientation of an image
FIXED = {  # flags that hold parameters; those of a group are held together
    "fx": cv2.CALIB_FIX_FOCAL_LENGTH,
    "cx": cv2.CALIB_FIX_PRINCIPAL_POINT,
    "k1": cv2.CALIB_FIX_K1,
    "k2": cv2.CALIB_FIX_K2,
    "k3": cv2.CALIB_FIX_K3,
    "k4": cv2.CALIB_FIX_K4,
    "k5": cv2.CALIB_FIX_K5,
    "k6": cv2.CALIB_FIX_K6,
    "p1": cv2.CALIB_FIX_TANGENT_DIST,
    "s1": cv2.CALIB_FIX_S1_S2_S3_S4,
    "tau_x": cv2.CALIB_FIX_TAUX_TAUY,
    "alpha": cv2.CALIB_FIX_SKEW,
}


@dataclass(frozen=True)
class Freedom:
    """Parameters of a model that are estimated. "fx" without "fy": one focal length, the ratio fx/fy is held."""

    names: tuple[str, ...]

    @property
    def held_interior(self) -> tuple[str, ...]:
        """Those of c, x0 and y0 that are held."""
        return tuple(own for own, name in (("c", "fx"), ("x0", "cx"), ("y0", "cy")) if name not in self.names)

    def fixed_flags(self, names: Sequence[str]) -> int:
        """OpenCV's flags for an initial camera matrix of which parameters of the model are held."""
        held = (flag for name, flag in FIXED.items() if name in names and name not in self.names)
        return cv2.CALIB_USE_INTRINSIC_GUESS | sum(held)

    @property
    def distortion(self) -> tuple[str, ...]:
        """Estimated distortion parameters, by the names of the adjustment's family."""
        affinity = [own for own, name in (("b1", "fy"), ("b2", "alpha")) if name in self.names]
        return (*(name for name in self.names if name not in (*INTERIOR, "alpha")), *affinity)


def model_names(family: str) -> tuple[str, ...]:
    """Parameters of OpenCV's model for a distortion family."""
    return FISHEYE_NAMES if family == FISHEYE else NAMES


def fixed_distortion(values: Mapping[str, float]) -> Distortion:
    """Distortion in OpenCV's model with all parameters held."""
    return Distortion("opencv", {name: Prior(value, 0.0) for name, value in values.items()})


def opencv_values(lens: Lens) -> tuple[Array, Array]:
    """OpenCV's parameters (n,) of a lens in the family of its model, and their derivatives (n, 3 + k) with respect to
    c, x0', y0' and the family's parameters."""
    (c, x0, y0), (*others, b1, b2) = lens.interior, lens.parameters
    values = [c * (1.0 + b1), c, x0, y0, *others]
    by_lens = np.zeros((len(values) + 1, 3 + len(lens.parameters)))
    by_lens[0, [0, -2]], by_lens[1, 0] = (1.0 + b1, c), 1.0
    by_lens[2 : len(values), 1:-2] = np.eye(len(values) - 2)
    by_lens[-1, -2:] = -b2 / (1.0 + b1) ** 2, 1.0 / (1.0 + b1)
    if lens.distortion.family == FISHEYE:
        return np.array([*values, b2 / (1.0 + b1)]), by_lens
    return np.array(values), by_lens[:-1]


class NoRedundancyError(Exception):
    """Observations that are no more than the parameters, so that nothing tells their standard deviations."""


@dataclass(frozen=True)
class OpenCVPoints:
    """One image for OpenCV: object points (n, 3) and their observations in the camera frame (n, 2), mm, y up."""

    image: str
    xyz: Array
    xy_mm: Array


@dataclass(frozen=True)
class OpenCvCalibration:
    """OpenCV's solution.

    Attributes
    ----------
    parameters : (n,) in the order of `model_names`.
    sigmas : (n,) standard deviations.
    rms_um : per point.
    rounding_um : rms change of an image coordinate by the rounding to single precision, which OpenCV requires.
    """

    parameters: Array
    sigmas: Array
    rms_um: float
    rounding_um: float


def can_begin(xyz: Array) -> bool:
    """Whether OpenCV can compute initial values for an image of these points (n, 3)."""
    if len(xyz) < FEWEST_FLAT:
        return False
    extents = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if extents[1] < 1e-5 * extents[0]:
        return False
    return bool(len(xyz) >= FEWEST_DEEP or (extents[2] / extents[1]) ** 2 < FLAT)


def calibrate(images: Sequence[OpenCVPoints], freedom: Freedom, start: Array) -> OpenCvCalibration:
    """OpenCV's least squares with initial values `start` (18,); parameters that are not in `freedom` are held.

    OpenCV's points are single precision. Object points are therefore reduced to their centroid and scaled to a common
    extent, and image points are reduced to the frame. Raises cv2.error where OpenCV fails, NoRedundancyError.
    """
    pixels = _Pixels.from_images(images, start)
    rounded = [each.astype(np.float32) for each in pixels.places]
    objects = [each.astype(np.float32) for each in pixels.objects]
    tilted = "tau_x" in freedom.names or bool(start[-2:].any())
    lens = start[4:] if tilted else start[4:-2]
    flags = freedom.fixed_flags(NAMES) | cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL
    flags |= cv2.CALIB_TILTED_MODEL if tilted else 0
    flags |= 0 if {"fx", "fy"} <= set(freedom.names) else cv2.CALIB_FIX_ASPECT_RATIO
    with one_opencv_thread():  # several threads sum the images in the order they finish, which is not reproducible
        rms_px, ended, distortion, rotations, shifts = cv2.calibrateCamera(
            objects,
            rounded,
            pixels.size,
            pixels.matrix(start),
            lens.copy(),
            flags=flags,
            criteria=CRITERIA,
        )
    matrix, values = np.asarray(ended, dtype=np.float64), np.zeros(len(NAMES) - 4)
    values[: np.size(distortion)] = np.ravel(distortion)[: len(values)]  # OpenCV returns no tilt if it is not estimated
    derivatives = [
        np.asarray(cv2.projectPoints(xyz, turn, shift, matrix, values)[1], np.float64)
        for xyz, turn, shift in zip(pixels.objects, rotations, shifts, strict=True)
    ]
    if "fy" not in freedom.names:  # which goes with fx
        for each in derivatives:
            each[:, 6] += each[:, 7] * start[1] / start[0]
    own = [NAMES.index(name) for name in freedom.names]
    rounding_px = np.concatenate([a - b for a, b in zip(pixels.places, rounded, strict=True)])
    return OpenCvCalibration(
        parameters=np.concatenate([pixels.interior_mm(matrix), values]),
        sigmas=parameter_sigmas([(each[:, :6], each[:, 6:]) for each in derivatives], own, float(rms_px), pixels.mm),
        rms_um=1e3 * pixels.mm * float(rms_px),
        rounding_um=1e3 * pixels.mm * float(np.sqrt((rounding_px**2).mean())),
    )


def calibrate_fisheye(images: Sequence[OpenCVPoints], freedom: Freedom, start: Array) -> OpenCvCalibration:
    """OpenCV's least squares of a fisheye with initial values `start` (9,); parameters that are not in `freedom` are
    held.

    OpenCV uses double precision; the accuracy of its solution is limited by a gradient that is not exactly 0. Raises
    cv2.error where OpenCV fails, NoRedundancyError.
    """
    pixels = _Pixels.from_images(images, start)
    begun = pixels.matrix(start)
    begun[0, 1] = start[-1] * begun[0, 0]
    with one_opencv_thread():
        rms_px, ended, distortion, rotations, shifts = cv2.fisheye.calibrate(
            [each[None] for each in pixels.objects],
            [each[None] for each in pixels.places],
            pixels.size,
            begun,
            start[4:-1].copy(),
            flags=freedom.fixed_flags(FISHEYE_NAMES) | cv2.CALIB_RECOMPUTE_EXTRINSIC,
            criteria=CRITERIA,
        )
    matrix = np.asarray(ended, dtype=np.float64)
    alpha = float(matrix[0, 1] / matrix[0, 0])
    derivatives = [
        np.asarray(cv2.fisheye.projectPoints(xyz[None], turn, shift, matrix, distortion, alpha=alpha)[1], np.float64)
        for xyz, turn, shift in zip(pixels.objects, rotations, shifts, strict=True)
    ]
    own = [FISHEYE_NAMES.index(name) for name in freedom.names]
    by_pose_camera = [(each[:, 8:14], each[:, [*range(8), 14]]) for each in derivatives]
    return OpenCvCalibration(
        parameters=np.concatenate([pixels.interior_mm(matrix), np.ravel(distortion), [alpha]]),
        sigmas=parameter_sigmas(by_pose_camera, own, float(rms_px), pixels.mm),
        rms_um=1e3 * pixels.mm * float(rms_px),
        rounding_um=1e3 * pixels.mm * PICTURE_PX * float(np.finfo(np.float64).eps),
    )


def parameter_sigmas(
    by_pose_camera: Sequence[tuple[Array, Array]], own: Sequence[int], rms_px: float, pixel_mm: float
) -> Array:
    """Standard deviations (m,) of a camera's parameters from OpenCV's derivatives at its solution.

    OpenCV returns none of a fisheye. Its others come from normal equations, in which it drops directions that hardly
    change the residuals, such as c of a board that is never tilted.

    by_pose_camera: by image, derivatives (2 n, 6) by the exterior orientation and (2 n, m) by the camera's parameters;
    own: those that are estimated. Raises NoRedundancyError.
    """
    observations = sum(len(by_pose) for by_pose, _ in by_pose_camera)
    redundancy = observations - 6 * len(by_pose_camera) - len(own)
    if redundancy < 1:
        raise NoRedundancyError(f"{observations} coordinates leave no redundancy for standard deviations")
    reduced = []
    for by_pose, by_camera in by_pose_camera:
        pose = np.linalg.qr(by_pose)[0]
        reduced.append(by_camera[:, own] - pose @ (pose.T @ by_camera[:, own]))
    stacked = np.concatenate(reduced)
    scales = np.linalg.norm(stacked, axis=0)
    root = np.linalg.inv(np.linalg.qr(stacked / scales, mode="r"))
    share = observations / redundancy / 2.0
    sigmas = np.zeros(by_pose_camera[0][1].shape[1])
    sigmas[own] = rms_px * np.sqrt(share) * np.linalg.norm(root, axis=1) / scales
    sigmas[:4] *= pixel_mm
    return sigmas


@dataclass(frozen=True)
class _Pixels:
    """Observations for OpenCV.

    Attributes
    ----------
    objects : object points, reduced to their centroid and scaled to OBJECT_EXTENT.
    places : (n, 2) image points in px, y down.
    mm : size of a pixel.
    offset : (2,) of the top left corner, px.
    size : of the frame, px.
    """

    objects: list[Array]
    places: list[Array]
    mm: float
    offset: Array
    size: tuple[int, int]

    @classmethod
    def from_images(cls, images: Sequence[OpenCVPoints], start: Array) -> "_Pixels":
        observed = np.concatenate([image.xy_mm for image in images])
        corners = np.array([np.minimum(observed.min(axis=0), start[2:4]), np.maximum(observed.max(axis=0), start[2:4])])
        mm = float((corners[1] - corners[0]).max()) / (PICTURE_PX - 1)
        offset = np.array([corners[0, 0], -corners[1, 1]]) / mm - 0.5
        middle = np.concatenate([image.xyz for image in images]).mean(axis=0)
        width, height = (int(extent) + 2 for extent in np.ceil((corners[1] - corners[0]) / mm))
        xyz = np.concatenate([image.xyz for image in images]) - middle
        unit = float(np.sqrt((xyz**2).sum(axis=1).mean())) / OBJECT_EXTENT
        objects = [(image.xyz - middle) / unit for image in images]
        return cls(objects, [image.xy_mm * Y_UP / mm - offset for image in images], mm, offset, (width, height))

    def matrix(self, values: Array) -> Array:
        """OpenCV's camera matrix (3, 3) in px."""
        fx, fy, cx, cy = values[:4]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, -cy], [0.0, 0.0, 1.0]]) / self.mm
        matrix[2, 2] = 1.0
        matrix[:2, 2] -= self.offset
        return matrix

    def interior_mm(self, matrix: Array) -> Array:
        """fx, fy, cx, cy (4,), y up, from a camera matrix in px."""
        return np.concatenate([np.diag(matrix)[:2], (matrix[:2, 2] + self.offset) * Y_UP]) * self.mm

"""Corners of a board found by OpenCV's functions, and its calibration of them beside the measured ones."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from measure.boards.markers import charuco_board
from measure.boards.specs import ArucoSpec, BoardSpec, CharucoSpec, ChessboardSpec, CircleGridSpec, aruco_dictionary
from measure.errors import MeasurementError
from measure.scans.scan import Scan
from pipeline.adjusting.picture_turn import turned_back
from pipeline.opencv_check.opencv_calibration import (
    NoRedundancyError,
    OpenCvCalibration,
    OpenCVPoints,
    can_begin,
)
from pipeline.results import stage_files
from pipeline.results.comparator_file import comparator_from_pixel
from pipeline.types import Array

Bytes = NDArray[np.uint8]
Calibrate = Callable[[Sequence[OpenCVPoints]], OpenCvCalibration]

HALF_WINDOW_PX = 11  # of cornerSubPix, as in OpenCV's calibration sample
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 0.0001)  # of the same sample
FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK | cv2.CALIB_CB_NORMALIZE_IMAGE  # of the same sample
NEAREST = 0.4  # of the distance to the next point: largest distance between corresponding points
FEWEST_PICTURES = 3  # with points of both, for a calibration of each


@dataclass(frozen=True)
class BoardPictures:
    """Images of a board.

    Attributes
    ----------
    open_scan : opens an image by its name; raises MeasurementError or KeyError where its scan is not available.
    pitch_um : pixel pitch across and down, by image.
    turned : (counter-clockwise turn in degrees, size of the sensor), by image, for images that were turned.
    """

    board: BoardSpec
    open_scan: Callable[[str], Scan]
    pitch_um: Mapping[str, tuple[float, float]]
    turned: Mapping[str, tuple[int, tuple[float, float]]] = field(default_factory=dict)

    def points_mm(self, image: str) -> Array:
        """(n, 2) points that OpenCV finds, in the frame of the sensor, mm; empty where the scan is not available."""
        try:
            with self.open_scan(image) as scan:
                grey = scan.window(0, 0, scan.width_px, scan.height_px) * (255.0 / scan.full_scale_dn)
                pitch_um = self.pitch_um[image]
        except (MeasurementError, KeyError):
            return np.zeros((0, 2))
        picture = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        points_mm = comparator_from_pixel(find_points(picture, self.board), pitch_um)
        return turned_back(points_mm, *self.turned[image]) if image in self.turned else points_mm


def detector_name(board: BoardSpec) -> str:
    """OpenCV's functions that detect such a board; empty where there is no customary one."""
    match board:
        case ChessboardSpec():
            return f"findChessboardCorners and cornerSubPix, half a window of {HALF_WINDOW_PX} px"
        case CircleGridSpec(asymmetric=False):
            return "findCirclesGrid"
        case CharucoSpec():
            return "CharucoDetector"
        case ArucoSpec():
            return "ArucoDetector"
        case _:
            return ""


def find_points(picture: Bytes, board: BoardSpec) -> Array:
    """(n, 2) column and row of a board's points, by OpenCV's functions with their customary settings."""
    found: object = True
    points = None
    match board:
        case ChessboardSpec():
            found, points = cv2.findChessboardCorners(picture, (board.columns, board.rows), flags=FLAGS)
            if found:
                points = cv2.cornerSubPix(picture, points, (HALF_WINDOW_PX,) * 2, (-1, -1), CRITERIA)
        case CircleGridSpec(asymmetric=False):
            found, points = cv2.findCirclesGrid(picture, (board.columns, board.rows), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        case CharucoSpec():
            points = cv2.aruco.CharucoDetector(charuco_board(board)).detectBoard(picture)[0]
        case ArucoSpec():
            parameters = cv2.aruco.DetectorParameters()
            parameters.markerBorderBits = board.border_modules
            markers = cv2.aruco.ArucoDetector(aruco_dictionary(board.dictionary), parameters).detectMarkers(picture)[0]
            points = np.concatenate(markers) if len(markers) else None
    return np.asarray(points, dtype=float).reshape(-1, 2) if found and points is not None else np.zeros((0, 2))


def compare_corners(
    images: Sequence[OpenCVPoints], pictures: BoardPictures, calibrate: Calibrate
) -> stage_files.CornersCheck | None:
    """Calibrate the measured points and OpenCV's own points with OpenCV, using the points that both have.

    Returns None where too few images are available, or OpenCV finds the board in too few of them.
    """
    both = []
    for image in images:
        own_mm = pictures.points_mm(image.image)
        if len(own_mm) == 0 or len(image.xyz) < 2:
            continue
        # OpenCV's points take the names of the nearest measured ones.
        apart_mm = np.asarray(KDTree(image.xy_mm).query(image.xy_mm, k=2)[0])[:, 1]
        distance_mm, nearest = (np.asarray(each) for each in KDTree(own_mm).query(image.xy_mm))
        rows = np.flatnonzero(distance_mm < NEAREST * apart_mm)
        xyz, xy_mm = image.xyz[rows], image.xy_mm[rows]
        if can_begin(xyz):
            both.append((OpenCVPoints(image.image, xyz, xy_mm), OpenCVPoints(image.image, xyz, own_mm[nearest[rows]])))
    if len(both) < FEWEST_PICTURES:
        return None
    found = {image.image for image, _ in both}
    try:
        measured, own = (calibrate(each) for each in zip(*both, strict=True))
    except (cv2.error, NoRedundancyError):
        return None
    pitch_mm = np.array(pictures.pitch_um[both[0][0].image]) / 1000.0
    return stage_files.CornersCheck(
        detector_name(pictures.board),
        len(both),
        sum(len(image.xyz) for image, _ in both),
        tuple(image.image for image in images if image.image not in found),
        _pixel_calibration(measured, pitch_mm),
        _pixel_calibration(own, pitch_mm),
    )


def _pixel_calibration(calibration: OpenCvCalibration, pitch_mm: Array) -> stage_files.PixelCalibration:
    fx, fy, cx, cy = (calibration.parameters[:4] / np.tile(pitch_mm, 2) * (1.0, 1.0, 1.0, -1.0)).tolist()
    return stage_files.PixelCalibration(fx, fy, cx, cy, calibration.rms_um / 1000.0 / float(np.sqrt(pitch_mm.prod())))

"""Real pictures of boards: points found by this program and by OpenCV's detectors, and how far they lie apart.

`check` is OpenCV's function as `reseau check` calls it: half a window of 11 px for corners, the grid finder for dots.
`window 5` is the same with half a window of 5 px, `sector` is findChessboardCornersSB. rms and largest distance of the
points that both have, and OpenCV's calibration (k1, k2, p1, p2) of either's: rms of a point's residual vector, px.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from benchmarks.drawn_boards import found_by_opencv
from benchmarks.halves import BOUGUET
from benchmarks.harness import DATA
from measure.boards.measure import measure_board, one_definition
from measure.boards.specs import BoardSpec, ChessboardSpec, CircleGridSpec
from measure.scans.opening import open_scan
from pipeline.opencv_check.check import CRITERIA, FLAGS, NEAREST

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
SONY = "circles/boofcv/Sony_DSC-HX5V"
HEXAGONAL = CircleGridSpec(24, 28, 0.6 * np.sqrt(3), 1.0, asymmetric=True, row_spacing_mm=0.6)
SETS: dict[str, tuple[str, BoardSpec]] = {
    "OpenCV left": ("chessboards/opencv/left[01]*.jpg", ChessboardSpec(9, 6, 25.0)),
    "OpenCV right": ("chessboards/opencv/right[01]*.jpg", ChessboardSpec(9, 6, 25.0)),
    "Bouguet": (BOUGUET, ChessboardSpec(13, 12, 30.0)),
    "BoofCV chessboard": (f"{SONY}_Chess/frame*.jpg", ChessboardSpec(6, 4, 30.0)),
    "BoofCV circle grid": (f"{SONY}_CircleRegular/image*.jpg", CircleGridSpec(8, 10, 25.0, 15.0)),
    "BoofCV hexagonal grid": (f"{SONY}_CircleHexagonal/image*.jpg", HEXAGONAL),
}
COLUMNS = {"set": "s", "pictures": "d", "points": "d", "here": "d", "detector": "s", "opencv": "d", "rms_px": ".3f"}
COLUMNS |= {"largest_px": ".2f", "common": "d", "here_calibrated_px": ".3f", "opencv_calibrated_px": ".3f"}


def cells() -> Iterator[dict[str, Any]]:
    for name, (_, spec) in SETS.items():
        for detector in ("check", "window 5", "sector") if isinstance(spec, ChessboardSpec) else ("check",):
            yield {"set": name, "detector": detector}


def case(set: str, detector: str) -> dict[str, Any]:
    """Compare the points of one set with those of one of OpenCV's detectors."""
    spec = SETS[set][1]
    points = spec.object_points()
    objects, own, other, found = [], [], [], 0
    for grey, places in _measured(set):
        detected = _detected(grey, spec, detector)
        found += len(detected)
        if len(detected) == 0 or len(places) < 4:
            continue
        at = np.array(list(places.values()))
        apart = np.asarray(KDTree(at).query(at, k=2)[0])[:, 1]
        distance, nearest = (np.asarray(each) for each in KDTree(detected).query(at))
        common = distance < NEAREST * apart
        objects.append(np.array([points[name] for name in places], np.float32)[common])
        own.append(at[common])
        other.append(detected[nearest[common]])
    row = {
        "pictures": len(_measured(set)),
        "points": len(points) * len(_measured(set)),
        "here": sum(len(places) for _, places in _measured(set)),
        "opencv": found,
    }
    if not own:
        return row
    far = np.hypot(*(np.concatenate(own) - np.concatenate(other)).T)
    size_px = _measured(set)[0][0].shape[::-1]
    return row | {
        "rms_px": float(np.sqrt((far**2).mean())),
        "largest_px": float(far.max()),
        "common": len(far),
        "here_calibrated_px": _calibrated_px(objects, own, size_px),
        "opencv_calibrated_px": _calibrated_px(objects, other, size_px),
    }


@cache
def _measured(set: str) -> list[tuple[Bytes, dict[str, Array]]]:
    """Grey values and places of the points measured, of each picture."""
    pattern, spec = SETS[set]
    greys, marks = [], []
    for path in sorted(DATA.glob(pattern)):
        with open_scan(path) as scan:
            marks.append(measure_board(scan, spec).marks)
            grey = scan.window(0, 0, scan.width_px, scan.height_px) * (255.0 / scan.full_scale_dn)
        greys.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    if isinstance(spec, ChessboardSpec):
        marks = list(one_definition(marks))
    places = [
        {each.point: np.asarray(each.center_px) for each in picture if each.status.is_observation} for picture in marks
    ]
    return list(zip(greys, places, strict=True))


def _detected(grey: Bytes, spec: BoardSpec, detector: str) -> Array:
    """(n, 2) points found by OpenCV."""
    if detector == "check" or not isinstance(spec, ChessboardSpec):
        return found_by_opencv(grey, spec)
    size = spec.columns, spec.rows
    if detector == "sector":
        found, corners = cv2.findChessboardCornersSB(grey, size)
    else:
        found, corners = cv2.findChessboardCorners(grey, size, flags=FLAGS)
        corners = cv2.cornerSubPix(grey, corners, (5, 5), (-1, -1), CRITERIA) if found else corners
    return np.asarray(corners, float).reshape(-1, 2) if found else np.zeros((0, 2))


def _calibrated_px(objects: list[Any], places: list[Array], size_px: tuple[int, ...]) -> float:
    images = [each.astype(np.float32) for each in places]
    return float(cv2.calibrateCamera(objects, images, size_px, None, None, flags=cv2.CALIB_FIX_K3)[0])

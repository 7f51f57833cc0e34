"""The pictures of the marks, cut from their scans as the report asks for them."""

from collections.abc import Collection
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.results import MarkMeasurement
from measure.scans.addresses import scan_path
from measure.scans.scan import Scan, open_scan
from pipeline.report.data import Thumbnail
from pipeline.results.measured_scan import MeasuredScan

_FIDUCIAL_PX, _TARGET_PX = 81, 41  # the least width of a window
_SHOWN_PX = 96  # a larger window is reduced to about this many pixels
_REACH_SIZES = 2.0  # a window's width in the mark's own


class Thumbnails:
    """Windows about marks, by image, point and kind; one scan is open at a time, none behind the `with` block."""

    def __init__(self, scans: Collection[MeasuredScan], max_pixels: int | None = None) -> None:
        self._max_pixels = max_pixels
        self._scans = {scan.frame.image: scan for scan in scans}
        self._marks = {
            (s.frame.image, mark.point, mark.kind == "fiducial"): mark for s in scans for mark in s.frame.marks
        }
        self._open: tuple[Path, Scan] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._open is not None:
            self._open[1].close()

    def of(self, image: str, point: str, kind: str) -> Thumbnail | None:
        """The picture of a mark; None where it has no place, or its scan cannot be read any more."""
        mark = self._marks.get((image, point, kind == "fiducial"))
        if mark is None or mark.center_px is None:
            return None
        try:
            return _cut(self._scan(scan_path(self._scans[image].scan)), mark.center_px, _half_px(mark))
        except MeasurementError:
            return None

    def _scan(self, path: Path) -> Scan:
        if self._open is None or self._open[0] != path:
            if self._open is not None:
                self._open[1].close()
            self._open = (path, open_scan(path, self._max_pixels))
        return self._open[1]


def _half_px(mark: MarkMeasurement) -> int:
    """Half the width of the window about a mark."""
    least = _FIDUCIAL_PX if mark.kind == "fiducial" else _TARGET_PX
    return max(least // 2, int(np.ceil(_REACH_SIZES * mark.quality.get("size_px", 0.0) / 2.0)))


def _cut(scan: Scan, center_px: NDArray[np.float64], half: int) -> Thumbnail | None:
    col0, row0 = (round(float(value)) - half for value in center_px)
    width = 2 * half + 1
    if col0 >= scan.width_px or row0 >= scan.height_px or col0 + width <= 0 or row0 + width <= 0:
        return None
    window = scan.window(col0, row0, width, width)
    step = max(1, width // _SHOWN_PX)
    size = width // step
    pixels = cv2.resize(window[: size * step, : size * step], (size, size), interpolation=cv2.INTER_AREA)
    middle = (step - 1) / 2.0
    return Thumbnail(np.asarray(pixels), (col0 + middle, row0 + middle), float(step))

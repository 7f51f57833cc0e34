"""Thumbnails of a scan, cut while it is decoded for measurement: a window around each mark, and the whole scan."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.results import MarkMeasurement
from measure.scans.scan import Scan
from pipeline.results.measured_record import MeasuredScan
from pipeline.types import Array

_FIDUCIAL_PX, _TARGET_PX = 81, 41  # px, smallest width of a window
_SHOWN_PX = 96  # px, larger windows are reduced to about this width
_REACH_SIZES = 2.0  # width of a window in widths of the mark
_WHOLE_PX = 480  # px, largest side of the thumbnail of the whole scan
WHOLE: tuple[str, str] = ("", "frame")  # point and kind of the thumbnail of the whole scan
_CLIPPED = 0.1  # per cent of the pixels clipped at each end of the grey values
_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 75]


def stretch(grey: NDArray[np.generic]) -> Array:
    """Stretch grey values to 0 to 255 between their extreme percentiles."""
    low, high = np.percentile(values := grey.astype(np.float64), [_CLIPPED, 100.0 - _CLIPPED])
    return np.asarray(np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0) * 255.0)


@dataclass(frozen=True)
class Thumbnail:
    """Window of a scan around a mark.

    pixels: (rows, columns) grey values on any scale; origin_px: column and row in the scan of the centre of its
    top-left pixel; step_px: scan pixels per thumbnail pixel, above 1 if reduced.
    """

    pixels: NDArray[np.generic]
    origin_px: tuple[float, float]
    step_px: float = 1.0

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2 or 0 in self.pixels.shape:
            raise ValueError(f"a thumbnail has rows and columns of grey values, not the shape {self.pixels.shape}")
        if not self.step_px > 0.0:
            raise ValueError(f"step_px must be positive, not {self.step_px}")

    def row(self, point: str, kind: str) -> "ThumbnailRow":
        """Stored form: a JPEG in 8 bits, with stretched grey values. point, kind: of the mark."""
        jpeg = cv2.imencode(".jpg", np.rint(stretch(self.pixels)).astype(np.uint8), _QUALITY)[1]
        return point, kind, *self.origin_px, self.step_px, bytes(jpeg)

    @classmethod
    def from_row(cls, row: "ThumbnailRow") -> "Thumbnail":
        """Inverse of `row`."""
        _, _, col_px, row_px, step_px, jpeg = row
        pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        return cls(np.asarray(pixels), (col_px, row_px), step_px)


ThumbnailRow = tuple[str, str, float, float, float, bytes]  # point, kind, column and row of the origin, step, JPEG


def thumbnail_rows(scan: Scan, measured: MeasuredScan) -> list[ThumbnailRow]:
    """Thumbnails of the marks of an open scan, and of the whole scan if a reduced image was decoded."""
    marks = measured.frame.marks
    rows = [thumbnail.row(mark.point, mark.kind) for mark in marks if (thumbnail := cut(scan, mark))]
    if scan.last_reduction is not None:
        factor, grey = scan.last_reduction  # each pixel of `grey` covers `factor` pixels a side
        step = max(1, -(-max(grey.shape) // _WHOLE_PX))
        size = grey.shape[1] // step, grey.shape[0] // step
        pixels = cv2.resize(grey[: size[1] * step, : size[0] * step], size, interpolation=cv2.INTER_AREA)
        whole = Thumbnail(np.asarray(pixels), ((factor * step - 1) / 2.0,) * 2, float(factor * step))
        rows.insert(0, whole.row(*WHOLE))
    return rows


def cut(scan: Scan, mark: MarkMeasurement) -> Thumbnail | None:
    """Cut the window around a mark; None if it has no position within the scan. Raises MeasurementError as the scan
    does."""
    if mark.center_px is None:
        return None
    least = _FIDUCIAL_PX if mark.kind == "fiducial" else _TARGET_PX
    half = max(least // 2, int(np.ceil(_REACH_SIZES * mark.quality.get("size_px", 0.0) / 2.0)))
    col0, row0 = (round(float(value)) - half for value in mark.center_px)
    width = 2 * half + 1
    if col0 >= scan.width_px or row0 >= scan.height_px or col0 + width <= 0 or row0 + width <= 0:
        return None
    window = scan.window(col0, row0, width, width)
    step = max(1, width // _SHOWN_PX)
    size = width // step
    pixels = cv2.resize(window[: size * step, : size * step], (size, size), interpolation=cv2.INTER_AREA)
    middle = (step - 1) / 2.0
    return Thumbnail(np.asarray(pixels), (col0 + middle, row0 + middle), float(step))

"""Images of scans for the page: windows at full resolution, residual images of fits, reduced whole frames."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from measure.errors import MeasurementError
from measure.marks.rendering import picture
from measure.marks.shapes import Mark
from measure.scans.opening import open_scan
from measure.scans.scan import Scan
from pipeline.results.thumbnail import stretch
from pipeline.types import Array

Result = TypeVar("Result")

_OPEN = 4  # scans kept open
_WINDOW_PX = 480  # px, larger windows are reduced to about this width
_FRAME_PX = 1400  # px, longer side of a whole scan
_POSE_PX = 180
_NOTHING = 128  # grey value outside the scan
_ROUNDS, _OUTLYING = 6, 5.0  # iterations of the robust fit; outlier limit in median residuals, 3.5 standard deviations
_DRAWN_BGR, _COVERED = (61, 163, 22), 0.55  # colour and opacity of a drawing over the scan


class Pictures:
    """Windows of scans as PNG. Thread-safe; the scans used last are kept open."""

    def __init__(self, max_pixels: int | None = None) -> None:
        self._max_pixels = max_pixels
        self._open: OrderedDict[str, Scan] = OrderedDict()
        self._reading = threading.Lock()

    def close(self) -> None:
        with self._reading:
            while self._open:
                self._open.popitem()[1].close()

    def size(self, scan: str) -> tuple[tuple[int, int], tuple[float, float] | None]:
        """Width and height, px, and the pixel pitch from the file, µm, None if unknown."""
        return self.compute(scan, lambda file: ((file.width_px, file.height_px), file.pitch_um))

    def compute(self, scan: str, work: Callable[[Scan], Result]) -> Result:
        """Run a function on an open scan."""
        with self._reading:
            return work(self._scan(scan))

    def window(self, scan: str, col0: int, row0: int, size: int) -> bytes:
        """Square window; a large one is reduced. Raises MeasurementError if the file cannot be read."""
        return self._png(lambda: _window(self._scan(scan), col0, row0, size))

    def residual(self, scan: str, mark: Mark, pixel_from_mark: Array, blur_px: float, half: int) -> bytes:
        """Residual image around a mark, after subtraction of the fitted mark and a linear background."""
        return self._png(lambda: _residual(self._scan(scan), mark, pixel_from_mark, blur_px, half))

    def drawing(self, mark: Mark, pixel_from_mark: Array, blur_px: float, half: int) -> bytes:
        """Mark as rendered for the fit, transparent outside, in the window of `residual`."""
        return self._png(lambda: _drawing(mark, pixel_from_mark, blur_px, half))

    def frame(self, scan: str) -> bytes:
        """Whole scan, reduced."""
        return self._png(lambda: to_8_bits(self._reduced(scan, _FRAME_PX)))

    def upright(self, scan: str, pose: str) -> bytes:
        """Whole scan rotated and mirrored back from a scan orientation (pose): upright if that pose is right."""
        return self._png(lambda: upright(to_8_bits(self._reduced(scan, _POSE_PX)), pose))

    def _reduced(self, name: str, side_px: int) -> Array:
        scan = self._scan(name)
        factor = max(1, -(-max(scan.width_px, scan.height_px) // _FRAME_PX))  # kept by the scan, for both sizes
        grey = np.asarray(scan.reduced(factor), dtype=np.float64)
        smaller = min(side_px / max(grey.shape), 1.0)
        return np.asarray(cv2.resize(grey, None, fx=smaller, fy=smaller, interpolation=cv2.INTER_AREA))

    def _png(self, make: Callable[[], NDArray[np.uint8]]) -> bytes:
        with self._reading:
            _, data = cv2.imencode(".png", make(), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return data.tobytes()

    def _scan(self, name: str) -> Scan:
        """Open a scan, or get it from the cache. The caller holds `_reading`."""
        if name not in self._open:
            self._open[name] = open_scan(name, self._max_pixels)
            while len(self._open) > _OPEN:
                self._open.popitem(last=False)[1].close()
        self._open.move_to_end(name)
        return self._open[name]


def to_8_bits(grey: Array) -> NDArray[np.uint8]:
    """Stretch grey values to 8 bits between their extreme percentiles."""
    return np.asarray(np.rint(stretch(grey)), dtype=np.uint8)


def upright(grey: NDArray[np.uint8], pose: str) -> NDArray[np.uint8]:
    """Rotate and mirror back a scan in that orientation (pose)."""
    turned = np.rot90(grey, -int(pose.removesuffix("m")) // 90)
    return np.ascontiguousarray(turned[:, ::-1] if pose.endswith("m") else turned)


def _window(scan: Scan, col0: int, row0: int, size: int) -> NDArray[np.uint8]:
    if col0 >= scan.width_px or row0 >= scan.height_px or col0 + size <= 0 or row0 + size <= 0:
        raise MeasurementError("the window is outside of the scan")
    step = max(1, size // _WINDOW_PX)
    if step == 1:
        shown = to_8_bits(np.asarray(scan.window(col0, row0, size, size), dtype=np.float64))
        shown[~scan.inside(col0, row0, size, size)] = _NOTHING
        return shown
    # Means over squares of step x step pixels, read within the scan, one row of means at a time.
    side = size // step
    shown = np.full((side, side), _NOTHING, np.uint8)
    extents = (col0, scan.width_px), (row0, scan.height_px)
    cols, rows = (_overlapping_pixels(*extent, side, step) for extent in extents)
    if cols and rows:
        starts = ((col0 + step * cols.start, row0 + step * row) for row in rows)
        bands = (scan.window(*start, len(cols) * step, step).reshape(step, len(cols), step) for start in starts)
        means = [np.asarray(band.mean(axis=(0, 2), dtype=np.float64)) for band in bands]
        shown[rows.start : rows.stop, cols.start : cols.stop] = to_8_bits(np.stack(means))
    return shown


def _overlapping_pixels(start_px: int, extent_px: int, side: int, step: int) -> range:
    """Indices of the reduced pixels of a row or column that overlap the scan."""
    return range(max(0, -start_px // step), min(side, -((start_px - extent_px) // step)))


def window_start(pixel_from_mark: Array, half: int) -> tuple[int, int]:
    """First column and row of the window around a mark, 2 half + 1 pixels wide."""
    col, row = np.rint(pixel_from_mark[:, 2]).astype(int).tolist()
    return col - half, row - half


def _model(mark: Mark, pixel_from_mark: Array, blur_px: float, half: int) -> Array:
    """Rendered image of the mark in the window around it."""
    local = np.column_stack([pixel_from_mark[:, :2], pixel_from_mark[:, 2] - window_start(pixel_from_mark, half)])
    return picture(mark, local, 2 * half + 1, 2 * half + 1, blur_px)


def _drawing(mark: Mark, pixel_from_mark: Array, blur_px: float, half: int) -> NDArray[np.uint8]:
    """(rows, columns, 4) blue, green, red and opacity."""
    shown = np.empty((2 * half + 1, 2 * half + 1, 4), np.uint8)
    shown[..., :3] = _DRAWN_BGR
    shown[..., 3] = np.rint(_COVERED * 255 * np.clip(_model(mark, pixel_from_mark, blur_px, half), 0.0, 1.0))
    return shown


def _residual(scan: Scan, mark: Mark, pixel_from_mark: Array, blur_px: float, half: int) -> NDArray[np.uint8]:
    model = _model(mark, pixel_from_mark, blur_px, half)
    width = len(model)
    grey = np.asarray(scan.window(*window_start(pixel_from_mark, half), width, width), dtype=np.float64)
    rows, cols = np.mgrid[-1 : 1 : width * 1j, -1 : 1 : width * 1j]
    design = np.stack([model, np.ones_like(model), rows, cols], axis=-1).reshape(-1, 4)
    left, is_fitted = grey.ravel(), np.ones(grey.size, dtype=bool)
    for _ in range(_ROUNDS):  # robust, so that damage stays visible and does not bias the fit
        values, *_ = np.linalg.lstsq(design[is_fitted], grey.ravel()[is_fitted], rcond=None)
        left = grey.ravel() - design @ values
        is_fitted = np.abs(left) <= _OUTLYING * np.median(np.abs(left))
    shown = left.reshape(grey.shape)
    reach = max(np.percentile(np.abs(shown), 99.5), 1e-12)
    return np.asarray(np.rint(np.clip(shown / reach, -1.0, 1.0) * 127.0 + 128.0), dtype=np.uint8)

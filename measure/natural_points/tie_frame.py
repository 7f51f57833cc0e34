"""A scan in which natural points are sought: where its exposed frame and its marks lie."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from measure.natural_points.multi_image import RADIUS_PX, SPARE_PX
from measure.scans.scan import Scan, open_scan

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class TieFrame:
    """A scan in which natural points are sought.

    pixel_from_camera: (2, 3), camera mm (x', y', 1) to column and row. frame_mm: width and height of the exposed frame
    about the camera frame's origin, None where the whole scan is one. taken_px (n, 3): column, row and radius of the
    marks in it, which are no natural points. max_pixels: of the scan, if the user says it. part_of: the name of the
    exposed frame where that was scanned in parts, of which this is one.
    """

    image: str
    scan: Path
    pixel_from_camera: Array
    frame_mm: tuple[float, float] | None
    taken_px: Array
    max_pixels: int | None = None
    part_of: str = ""

    @property
    def frame(self) -> str:
        """The name of the exposed frame."""
        return self.part_of or self.image

    def open(self) -> Scan:
        """The scan. Raises MeasurementError where it cannot be read."""
        return open_scan(self.scan, self.max_pixels)

    @property
    def px_per_mm(self) -> float:
        return float(np.sqrt(abs(np.linalg.det(self.pixel_from_camera[:, :2]))))

    @property
    def mirrored(self) -> bool:
        """Rows count downwards, y' upwards: a scan that is not mirrored changes the sense of rotation."""
        return bool(np.linalg.det(self.pixel_from_camera[:, :2]) > 0.0)

    def camera_px(self, places_px: Array) -> Array:
        """(n, 2) places in the camera frame, in units of a pixel."""
        linear, shift = self.pixel_from_camera[:, :2], self.pixel_from_camera[:, 2]
        return np.asarray((places_px - shift) @ np.linalg.inv(linear).T * self.px_per_mm)

    def usable(self, places_px: Array, size_px: tuple[int, int], radius_px: int = RADIUS_PX) -> Mask:
        """Where a whole patch lies in the exposed frame and beside the marks."""
        rim = radius_px + SPARE_PX
        inside = np.all((places_px >= rim) & (places_px <= np.array(size_px) - 1 - rim), axis=1)
        if self.frame_mm is not None:
            half = np.array(self.frame_mm) / 2 * self.px_per_mm - rim
            inside &= np.all(np.abs(self.camera_px(places_px)) <= half, axis=1)
        if len(self.taken_px) and len(places_px):
            for col, row, radius in self.taken_px:
                inside &= np.hypot(*(places_px - (col, row)).T) > radius + radius_px
        return np.asarray(inside)

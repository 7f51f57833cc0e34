"""Paints: areas in pixels with one tone each, laid on a scan one after another."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetic_images.areas import Area, Cover, bounds
from synthetic_images.film import FrameGeometry
from synthetic_images.optics import blurred_coverage, reach_px
from synthetic_images.scene import ChipMark

Array = NDArray[np.float64]
Window = tuple[slice, slice]

CHIP_FOLD = 4


@dataclass(frozen=True, eq=False)
class AreaPaint:
    """Union of areas in (column, row). inside_frame: imaged by the lens, hence limited to the exposed frame."""

    areas: tuple[Area, ...]
    tone: float
    inside_frame: bool = False

    def rows(self, row0: int, height: int, width_px: int, blur_px: float) -> tuple[Window, Cover] | None:
        """Window within rows row0 to row0 + height that is touched, and its coverage; None if none is."""
        col0, top, width, tall = self._bounds
        reach = reach_px(blur_px)
        left, right = max(col0 - reach, 0), min(col0 + width + reach, width_px)
        upper, lower = max(top - reach, row0), min(top + tall + reach, row0 + height)
        if left >= right or upper >= lower:
            return None
        window = (slice(upper - row0, lower - row0), slice(left, right))
        return window, blurred_coverage(self.areas, left, upper, right - left, lower - upper, blur_px)

    @cached_property
    def _bounds(self) -> tuple[int, int, int, int]:
        return bounds(self.areas)


@dataclass(frozen=True, eq=False)
class ChipPaint:
    """Mark from an image: its coverage; col0, row0: position of its first pixel."""

    cover: Cover
    col0: int
    row0: int
    tone: float
    inside_frame: bool = False

    def rows(self, row0: int, height: int, width_px: int, _: float) -> tuple[Window, Cover] | None:
        """As `AreaPaint.rows`, without further blur: the image of the mark is blurred already."""
        tall, width = self.cover.shape
        left, right = max(self.col0, 0), min(self.col0 + width, width_px)
        upper, lower = max(self.row0, row0), min(self.row0 + tall, row0 + height)
        if left >= right or upper >= lower:
            return None
        window = (slice(upper - row0, lower - row0), slice(left, right))
        inner = (slice(upper - self.row0, lower - self.row0), slice(left - self.col0, right - self.col0))
        return window, self.cover[inner]


Paint = AreaPaint | ChipPaint


def chip_paint(chip: ChipMark, xy_mm: Array, geometry: FrameGeometry, tone: float) -> ChipPaint:
    """Resample the image of a mark at its place: 4 x 4 samples per pixel through the local affine mapping, bilinear."""
    rows, columns = chip.image.shape
    mm = chip.pitch_um / 1000
    angle = np.deg2rad(chip.turn_deg)
    c, s = np.cos(angle), np.sin(angle)
    camera_from_chip = np.array([[c, -s], [s, c]]) @ np.diag([mm, -mm])
    ends = np.vstack([xy_mm, xy_mm + camera_from_chip.T])
    origin, right, down = geometry.pixel_from_camera(ends)
    pixel_from_chip = np.stack([right - origin, down - origin], axis=1)
    corners = np.array([[0, 0], [columns - 1, 0], [0, rows - 1], [columns - 1, rows - 1]]) - chip.origin_px
    outline = corners @ pixel_from_chip.T + origin
    low = np.floor(outline.min(axis=0)).astype(int)
    width, height = np.ceil(outline.max(axis=0)).astype(int) - low + 1
    chip_from_pixel = np.linalg.inv(pixel_from_chip)
    # The centre of fine pixel k of fold f is at (k + 0.5) / f - 0.5 px.
    start = chip_from_pixel @ (low + 0.5 / CHIP_FOLD - 0.5 - origin) + chip.origin_px
    chip_from_fine = np.column_stack([chip_from_pixel / CHIP_FOLD, start])
    fine = cv2.warpAffine(
        chip.image.astype(np.float32),
        chip_from_fine,
        (int(width) * CHIP_FOLD, int(height) * CHIP_FOLD),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    cover = fine.reshape(height, CHIP_FOLD, width, CHIP_FOLD).mean(axis=(1, 3))
    return ChipPaint(np.asarray(cover, np.float32), int(low[0]), int(low[1]), tone)

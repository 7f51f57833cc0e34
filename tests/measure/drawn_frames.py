"""Whole frames for the tests, drawn by brute force: marks on a textured, exposed frame, and what is right of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from brute_marks import Array, brute_picture, written_scan
from scipy.ndimage import gaussian_filter

from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import Disk, FiducialLayout, LayoutMark, Mark, MarkShape, Part, ring_cross
from measure.results import FrameMeasurement

PITCH_UM, PX_PER_MM = 50.0, 20.0
FRAME_PX = 400
CORNERS = ((7.0, -7.0), (-7.0, -7.0), (-7.0, 7.0), (7.0, 7.0))
RING_CROSS = ring_cross(0.5, 0.1, 0.8, 0.1)
NOISE_DN = 200.0


def layout_of(
    marks: Sequence[MarkShape],
    places: Sequence[tuple[float, float]] = CORNERS,
    frame_mm: tuple[float, float] = (17.0, 17.0),
) -> FiducialLayout:
    """Marks 1, 2, ... given to a hundredth of a millimetre."""
    given = [
        LayoutMark(str(number), place, (0.01, 0.01), mark)
        for number, (mark, place) in enumerate(zip(marks, places, strict=True), 1)
    ]
    return FiducialLayout(tuple(given), frame_mm)


def numbered(count: int) -> MarkShape:
    """A ring-cross with so many identification dots to its right and above it."""
    dots: tuple[Part, ...] = tuple(Disk((1.0, 0.3 * k - 0.3), 0.08) for k in range(count))
    return MarkShape((*RING_CROSS, *dots))


NUMBERED = layout_of([numbered(count) for count in range(4)])
ALIKE = layout_of([MarkShape(RING_CROSS)] * 4)


def pixel_from_camera(pose: str, turn_rad: float = 0.008, center: tuple[float, float] = (202.3, 197.6)) -> Array:
    """By the definition of a pose: mirror x', then turn counter-clockwise, then look at it with rows downwards."""
    angle = np.deg2rad(float(pose.rstrip("m"))) + turn_rad
    c, s = np.cos(angle), np.sin(angle)
    right, up = np.array([c, -s]), np.array([s, c])
    if pose.endswith("m"):
        right, up = right * (-1, 1), up * (-1, 1)
    return np.column_stack([PX_PER_MM * np.stack([right, -up]), center])


def frame_picture(layout: FiducialLayout, matrix: Array, seed: int = 1, size: int = FRAME_PX) -> Array:
    """A textured, exposed frame with light marks on its dark corners."""
    rng = np.random.default_rng(seed)
    grey = 8000 + 2500 * gaussian_filter(rng.normal(0, 1, (size, size)), 2.0) / 0.14
    for mark in layout.marks:
        col, row = np.rint(matrix @ (*mark.xy_mm, 1.0)).astype(int)
        top, left, bottom, right = (int(np.clip(v, 0, size)) for v in (row - 40, col - 40, row + 41, col + 41))
        grey[top:bottom, left:right] = 3000
        paint(grey, mark.mark, mark.xy_mm, matrix, 9000.0)
    return np.asarray(grey + rng.normal(0, NOISE_DN, grey.shape))


def paint(
    grey: Array,
    mark: Mark,
    xy_mm: tuple[float, float],
    matrix: Array,
    contrast: float,
    half: int = 30,
    blur_px: float = 0.8,
) -> None:
    """Add a mark to a picture in which a place (mm) lies by matrix (2, 3), within so many pixels about it."""
    assert isinstance(mark, MarkShape)
    center = matrix @ (*xy_mm, 1.0)
    col0, row0 = np.rint(center).astype(int) - half
    place, size = np.column_stack([matrix[:, :2], center - (col0, row0)]), 2 * half + 1
    shown = brute_picture(mark, place, size, size, blur_px)
    rows, cols = np.mgrid[row0 : row0 + size, col0 : col0 + size]
    inside = (rows >= 0) & (cols >= 0) & (rows < grey.shape[0]) & (cols < grey.shape[1])
    grey[rows[inside], cols[inside]] += contrast * shown[inside]


def measured(
    grey: Array, layout: FiducialLayout, folder: Path, options: FiducialOptions | None = None, pitch: bool = True
) -> FrameMeasurement:
    with written_scan(grey, folder) as scan:
        result = measure_fiducials(scan, layout, (PITCH_UM, PITCH_UM) if pitch else None, options)
    assert [mark.point for mark in result.marks] == [mark.id for mark in layout.marks]
    return result


def assert_right(result: FrameMeasurement, layout: FiducialLayout, matrix: Array) -> None:
    """All marks measured, with the right names, within their standard deviations."""
    for mark, given in zip(result.marks, layout.marks, strict=True):
        assert mark.status is Status.MEASURED, mark.reason
        assert mark.center_px is not None
        assert mark.covariance_px2 is not None
        error = mark.center_px - matrix @ (*given.xy_mm, 1.0)
        assert error @ np.linalg.solve(mark.covariance_px2, error) < 20

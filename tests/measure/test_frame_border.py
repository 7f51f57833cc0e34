"""Wings that grow out of the frame's border and merge into it, and notches cut into it, drawn by half planes."""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from drawn import Array, drawn, scan_of, transformed
from drawn_frames import layout_of, pixel_from_camera
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Status
from measure.marks.shapes import (
    FiducialLayout,
    MarkShape,
    Point,
    Polygon,
    known_outline_mm,
    limit_to_frame,
    turned_part,
)

HALF_MM, WEDGE_MM, SIDES = 8.0, 7.0, ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
PIXEL_FROM_CAMERA = pixel_from_camera("90", turn_rad=0.03)
ONE_IN_8000 = 18.0  # of chi-square, two coordinates
WEDGE = ((0.0, 0.0), (1.6, 0.7), (1.6, -0.7))
WEDGE_TO_EDGE = ((0.0, 0.0), (1.0, 0.4375), (1.0, -0.4375))
WEDGE_AND_BORDER = ((0.0, 0.0), (1.0, 0.4375), (1.0, 2.5), (2.5, 2.5), (2.5, -2.5), (1.0, -2.5), (1.0, -0.4375))
NOTCH = ((-0.3, 0.5), (0.8, 0.5), (0.8, -0.5), (-0.3, -0.5))


class Measured(NamedTuple):
    """A mark's error, the standard deviation claimed of a coordinate, and the squared error in such ones."""

    off_px: float
    sigma_px: float
    chi2: float


def layout(vertices: tuple[Point, ...], at_mm: float) -> FiducialLayout:
    """One to each side, drawn as on the right."""
    turns = [float(np.degrees(np.arctan2(up, right))) for right, up in SIDES]
    marks = [MarkShape((turned_part(Polygon(vertices), turn),)) for turn in turns]
    places = [(at_mm * x, at_mm * y) for x, y in SIDES]
    return layout_of(marks, places, (2 * HALF_MM, 2 * HALF_MM))


@cache
def scanned(at_mm: float, is_notch: bool, blur_px: float = 0.9, landscape: float = 0.0) -> Array:
    """A light frame with a wedge of its dark border, or a notch in it, on each side. landscape: by what share of itself
    its light varies, over some 6 px."""
    generator = np.random.default_rng(3)
    light = light_profile(at_mm, is_notch, blur_px)
    noise = generator.normal(0, 400, light.shape)
    terrain = gaussian_filter(generator.normal(0, 1, light.shape), 6)
    return np.asarray(3000 + 20000 * light * (1 + landscape * terrain / terrain.std()) + noise)


@cache
def light_profile(at_mm: float, is_notch: bool, blur_px: float) -> Array:
    camera_from_pixel = np.linalg.inv(PIXEL_FROM_CAMERA[:, :2])

    def exposed(col: Array, row: Array) -> Array:
        x, y = transformed(camera_from_pixel, col - PIXEL_FROM_CAMERA[0, 2], row - PIXEL_FROM_CAMERA[1, 2])
        frame = np.maximum(np.abs(x), np.abs(y)) < HALF_MM
        for right, up in SIDES:
            out, along = x * right + y * up - at_mm, np.abs(y * right - x * up)
            if is_notch:
                frame |= (out > -0.3) & (out < 0.8) & (along < 0.5)
            else:
                frame &= ~((out > 0) & (along < out * 0.7 / 1.6))
        return np.asarray(frame)

    return drawn(exposed, 400, 400, blur_px, fineness=4)


def measure_picture(camera: FiducialLayout, picture: Array) -> list[Measured]:
    """What is measured of the marks in it, none of them damaged or in doubt."""
    result = measure_fiducials(scan_of(picture), camera, (50.0, 50.0), FiducialOptions(pose="90"))
    found = []
    for mark, given in zip(result.marks, camera.marks, strict=True):
        assert mark.status is Status.MEASURED, mark.reason
        assert mark.center_px is not None
        assert mark.covariance_px2 is not None
        off = mark.center_px - PIXEL_FROM_CAMERA @ (*given.xy_mm, 1.0)
        chi2 = float(off @ np.linalg.solve(mark.covariance_px2, off))
        found.append(Measured(float(np.hypot(*off)), float(np.sqrt(np.trace(mark.covariance_px2) / 2)), chi2))
    return found


@parametrize_with_studies(
    ("vertices", "at_mm", "is_notch"),
    [
        (WEDGE, WEDGE_MM, False),
        (WEDGE_AND_BORDER, WEDGE_MM, False),
        (WEDGE_TO_EDGE, WEDGE_MM, False),
        (NOTCH, HALF_MM, True),
    ],
    quick=(1, 2),
    ids=["beyond", "with its border", "to the edge", "notch"],
)
def test_marks_at_the_border_are_measured_as_if_it_were_not_there(
    vertices: tuple[Point, ...], at_mm: float, is_notch: bool
) -> None:
    for mark in measure_picture(layout(vertices, at_mm), scanned(at_mm, is_notch)):
        assert mark.off_px < 0.1
        assert mark.chi2 < ONE_IN_8000


@pytest.mark.study
def test_the_border_of_a_soft_scan_reaches_farther_into_the_frame() -> None:
    for mark in measure_picture(layout(WEDGE_TO_EDGE, WEDGE_MM), scanned(WEDGE_MM, False, blur_px=1.8)):
        assert mark.off_px < 0.2
        assert mark.chi2 < ONE_IN_8000


@pytest.mark.study
def test_a_notch_claims_no_more_than_the_landscape_in_it_allows() -> None:
    camera = layout(NOTCH, HALF_MM)
    even, uneven = (measure_picture(camera, scanned(HALF_MM, True, 2.0, landscape)) for landscape in (0.0, 0.05))
    assert max(mark.off_px for mark in uneven) > 3 * max(mark.sigma_px for mark in even)
    for mark in (*even, *uneven):
        assert mark.chi2 < ONE_IN_8000


def test_what_is_known_of_a_drawing_ends_at_the_frame() -> None:
    (wedge, *_), (notch, *_) = (
        limit_to_frame(layout(WEDGE, WEDGE_MM)).marks,
        limit_to_frame(layout(NOTCH, HALF_MM)).marks,
    )
    inner = layout(((0.0, 0.0), (0.8, 0.3), (0.8, -0.3)), WEDGE_MM)
    assert isinstance(wedge.mark, MarkShape)
    assert isinstance(notch.mark, MarkShape)
    assert known_outline_mm(wedge.mark)[:, 0].max() == pytest.approx(0.9)
    assert known_outline_mm(notch.mark)[:, 0].min() == pytest.approx(0.1)
    assert limit_to_frame(inner) == inner

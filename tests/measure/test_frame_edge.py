"""Corners, wings and notches of the exposed frame, and crossings of lines that run on: drawn pixel by pixel."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from drawn import Array, center, chi_square, draw, lay_out, make_scan, pixel_from_camera, transformed
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr
from studies import parametrize_with_studies

from measure import FiducialOptions, MarkFit, Status, measure_fiducials
from measure.marks.shapes import (
    Bar,
    Disk,
    FiducialLayout,
    LayoutMark,
    MarkShape,
    Point,
    Polygon,
    frame_corner,
    limit_to_crossings,
    limit_to_frame,
    turned_part,
)
from measure.matching.frame_edge import fit_frame_corner
from measure.tone.curve import LINEAR, Tone, power

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
    return lay_out(marks, places, (2 * HALF_MM, 2 * HALF_MM))


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

    return draw(exposed, 400, 400, blur_px, fineness=4)


def measure_picture(camera: FiducialLayout, picture: Array) -> list[Measured]:
    """What is measured of the marks in it, none of them damaged or in doubt."""
    result = measure_fiducials(make_scan(picture), camera, (50.0, 50.0), FiducialOptions(pose="90"))
    found = []
    for mark, given in zip(result.marks, camera.marks, strict=True):
        assert mark.status is Status.MEASURED, mark.reason
        true_px = PIXEL_FROM_CAMERA @ (*given.xy_mm, 1.0)
        assert mark.covariance_px2 is not None
        sigma_px = float(np.sqrt(np.trace(mark.covariance_px2) / 2))
        found.append(Measured(float(np.hypot(*(center(mark) - true_px))), sigma_px, chi_square(mark, true_px)))
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
    assert wedge.mark.known_outline_mm[:, 0].max() == pytest.approx(0.9)
    assert notch.mark.known_outline_mm[:, 0].min() == pytest.approx(0.1)
    assert limit_to_frame(inner) == inner


PX_PER_MM, SIZE, FINE = 20.0, 520, 4
FRAME_CORNER_HALF_MM = 10.0
CORNERS = {"1": (10.0, -10.0), "2": (-10.0, -10.0), "3": (-10.0, 10.0), "4": (10.0, 10.0)}
TURN, CENTER = 0.007, (262.3, 257.6)
MATRIX = np.column_stack(
    [PX_PER_MM * np.array([[np.cos(TURN), -np.sin(TURN)], [-np.sin(TURN), -np.cos(TURN)]]), CENTER]
)


def picture(seed: int, radius_mm: float = 0.0, neighbour: bool = False, negative: bool = False) -> Array:
    """A landscape in the frame, whose corners may be rounded, on a dark border with a white stamp across one edge."""
    rng = np.random.default_rng(seed)

    def exposed(x: Array, y: Array) -> NDArray[np.bool_]:
        beyond_x, beyond_y = np.abs(x) - FRAME_CORNER_HALF_MM + radius_mm, np.abs(y) - FRAME_CORNER_HALF_MM + radius_mm
        outside = np.hypot(np.maximum(beyond_x, 0.0), np.maximum(beyond_y, 0.0)) - radius_mm
        return np.asarray(np.where(radius_mm > 0, outside, np.maximum(beyond_x, beyond_y)) < 0.0)

    def inside(col: Array, row: Array) -> Array:
        x, y = transformed(np.linalg.inv(MATRIX[:, :2]), col - CENTER[0], row - CENTER[1])
        return np.asarray(
            exposed(x, y) | exposed(x - 2 * FRAME_CORNER_HALF_MM - 1.2, y) if neighbour else exposed(x, y)
        )

    share = draw(inside, SIZE, SIZE, 0.0, FINE)
    land = 15000 + 3000 * gaussian_filter(rng.normal(0, 1, (SIZE, SIZE)), 3.0) / 0.09
    grey = 2000 + share * (np.clip(land, 6000, None) - 2000)
    grey = gaussian_filter(grey, 0.8)
    grey[40:75, 140:180] = 40000  # a stamp over the upper edge
    grey += rng.normal(0, 250, grey.shape)
    return np.asarray(60000 - grey if negative else grey)


def layout_frame_corner(radius_mm: float = 0.0) -> FiducialLayout:
    marks = [LayoutMark(id, xy, (0.02, 0.02), frame_corner(xy, 5.0, radius_mm)) for id, xy in CORNERS.items()]
    return FiducialLayout(tuple(marks), (2 * FRAME_CORNER_HALF_MM, 2 * FRAME_CORNER_HALF_MM))


@parametrize_with_studies(
    ("radius_mm", "neighbour", "negative"), [(0.0, False, True), (1.0, False, False), (0.0, True, False)]
)
def test_corners_of_the_frame_are_where_its_edges_meet(radius_mm: float, neighbour: bool, negative: bool) -> None:
    grey = picture(1, radius_mm, neighbour, negative)
    scan = make_scan(grey)
    frame = measure_fiducials(scan, layout_frame_corner(radius_mm), (50.0, 50.0), FiducialOptions(pose="0"))
    scores = []
    for mark in frame.marks:
        true = MATRIX @ (*CORNERS[mark.point], 1.0)
        assert mark.status in (Status.MEASURED, Status.WEAK), mark.reason
        assert np.hypot(*(center(mark) - true)) < 0.6
        scores.append(chi_square(mark, true) / 2)
    assert np.sqrt(np.mean(scores)) < 2.0


def test_no_corner_is_visible_in_a_landscape() -> None:
    land = 15000 + 3000 * gaussian_filter(np.random.default_rng(3).normal(0, 1, (400, 400)), 3.0) / 0.09
    start = np.column_stack([MATRIX[:, :2], (200.0, 200.0)])
    scan = make_scan(np.asarray(land))
    corner = frame_corner((-10.0, 10.0), 5.0)
    fit = fit_frame_corner(scan, corner, start, 10.0, 1)
    assert not fit.converged
    assert "edge of the frame" in fit.reason


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_a_corner_moves_with_the_tone_curve_as_its_edges_say(gamma: float) -> None:
    corner = frame_corner((-10.0, 10.0), 5.0)
    start = np.column_stack([MATRIX[:, :2], MATRIX @ (-10.0, 10.0, 1.0)])
    scan = make_scan(65535 * (picture(4) / 65535) ** (1 / gamma))
    tone = Tone(power(gamma), covariance=np.eye(5))

    def fit_mark(tone: Tone) -> MarkFit:
        fit = fit_frame_corner(scan.replace_tone(tone), corner, start, 6.0, 1)
        assert fit.converged
        return fit

    estimate = fit_mark(tone).tone
    assert estimate is not None
    for k in range(2):
        more, less = (fit_mark(tone.replace_departures(way * 0.1 * np.eye(5)[k])).center_px for way in (1, -1))
        np.testing.assert_allclose((more - less) / 0.2, estimate.on_place[:, k], atol=0.1)
    assert np.hypot(*estimate.on_place[:, 0]) > 0.15
    assert estimate.information.sum_of_squares < 25  # of 5 figures, by the true curve
    assert fit_mark(Tone(power(gamma))).tone is None


LINES_PX_PER_MM, LINE_MM, SIZE_PX, BLUR_PX = 20.0, 0.2, 640, 0.9
STEPS_MM = np.arange(-2, 3) * 5.0
MIDDLE_PX, LINES_TURN = np.array([322.3, 317.8]), np.deg2rad(0.4)
BRIGHT = {"0-0": (0.05, -0.1), "3-1": (-0.1, 0.05)}  # stars on crossings, mm beside them


def line_layout(arm_mm: float = 2.5) -> FiducialLayout:
    cross = MarkShape(
        (Bar((-arm_mm, 0.0), (arm_mm, 0.0), LINE_MM), Bar((0.0, -arm_mm), (0.0, arm_mm), LINE_MM)), "dark"
    )
    marks = (LayoutMark(name, xy, (0.002, 0.002), cross) for name, xy in places_mm().items())
    return FiducialLayout(tuple(marks), (30.0, 30.0))


def places_mm() -> dict[str, tuple[float, float]]:
    return {f"{i}-{j}": (float(x), float(y)) for i, x in enumerate(STEPS_MM) for j, y in enumerate(STEPS_MM)}


def to_px(xy_mm: Array) -> Array:
    c, s = np.cos(LINES_TURN), np.sin(LINES_TURN)
    return np.asarray(xy_mm @ np.array([[c, s], [-s, c]]) * (LINES_PX_PER_MM, -LINES_PX_PER_MM) + MIDDLE_PX)


def plate() -> Array:
    """Grey values of a negative."""
    rng, (rows, cols) = np.random.default_rng(5), np.mgrid[:SIZE_PX, :SIZE_PX]
    right, up = (cols - MIDDLE_PX[0]) / LINES_PX_PER_MM, (MIDDLE_PX[1] - rows) / LINES_PX_PER_MM
    x, y = np.cos(LINES_TURN) * right + np.sin(LINES_TURN) * up, np.cos(LINES_TURN) * up - np.sin(LINES_TURN) * right
    covered, blur_mm = np.zeros(rows.shape), BLUR_PX / LINES_PX_PER_MM
    for across, along in ((x, y), (y, x)):
        for step in STEPS_MM:
            line = ndtr((LINE_MM / 2 - across + step) / blur_mm) - ndtr((-LINE_MM / 2 - across + step) / blur_mm)
            covered = np.maximum(covered, line * ndtr((11.5 - np.abs(along)) / blur_mm))
    stars = [(place, 1.0, 0.1) for place in rng.uniform(-14, 14, (120, 2))]
    stars += [(np.add(places_mm()[name], off), 20.0, 0.3) for name, off in BRIGHT.items()]
    density = sum(h * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 2 / sigma**2) for at, h, sigma in stars)
    ground = 45000.0 - 9000.0 * covered
    return np.asarray(ground - (ground - 6000.0) * (1 - np.exp(-density)) + rng.normal(0, 300, rows.shape))


def test_crossings_are_measured_with_claims_that_hold_and_those_under_stars_are_not() -> None:
    scan = make_scan(plate()).replace_tone(LINEAR)
    frame = measure_fiducials(scan, line_layout(), (1000 / LINES_PX_PER_MM,) * 2, FiducialOptions("0"))
    good = [mark for mark in frame.marks if mark.status is Status.MEASURED]
    assert len(good) >= 20
    assert not {mark.point for mark in good} & {*BRIGHT}
    places = np.array([mark.center_px for mark in good], dtype=float)
    errors = places - to_px(np.array([places_mm()[mark.point] for mark in good]))
    sigmas = np.sqrt([np.diag(mark.covariance.px2) for mark in good if mark.covariance is not None])
    assert np.abs(errors).max() < 0.05
    assert 0.7 < np.sqrt((errors**2).mean() / (sigmas**2).mean()) < 1.3


def test_lines_that_run_on_are_known_about_their_crossings_only() -> None:
    (limited, *_) = limit_to_crossings(line_layout()).marks
    assert isinstance(limited.mark, MarkShape)
    assert limited.mark.known_mm == ((-1.0, -1.0), (1.0, 1.0))
    assert np.abs(limited.mark.known_outline_mm).max() <= 1.0
    assert limit_to_crossings(line_layout(2.0)) == line_layout(2.0)  # crosses with gaps between them
    dots = replace(
        line_layout(), marks=tuple(replace(m, mark=MarkShape((Disk((0.0, 0.0), 2.4),))) for m in line_layout().marks)
    )
    assert limit_to_crossings(dots) == dots

"""Corners, wings and notches of the exposed frame, and crossings of lines that run on: drawn pixel by pixel."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from drawn import center, chi_square, draw, lay_out, make_scan, pixel_from_camera, transformed, whitened
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr
from scipy.stats import multivariate_normal
from studies import parametrize_with_studies

from measure import FiducialOptions, MarkFit, ScanWindow, Status, measure_fiducials
from measure.array_types import Single
from measure.boards.corner_fit import Corner, CornerStart, Surface, crossing, fit_corners, quarter
from measure.marks import shapes
from measure.matching.frame_edge import fit_frame_corner
from measure.scans.jpeg import quantisation_step_dn
from measure.tone.curve import LINEAR, Tone, power

Array = NDArray[np.float64]

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


def layout(vertices: tuple[shapes.Point, ...], at_mm: float) -> shapes.FiducialLayout:
    """One to each side, drawn as on the right."""
    turns = [float(np.degrees(np.arctan2(up, right))) for right, up in SIDES]
    marks = [shapes.MarkShape((shapes.rotate_part(shapes.Polygon(vertices), turn),)) for turn in turns]
    places = [(at_mm * x, at_mm * y) for x, y in SIDES]
    return lay_out(marks, places, (2 * HALF_MM, 2 * HALF_MM))


@cache
def scanned(at_mm: float, is_notch: bool) -> Array:
    """A light frame with a wedge of its dark border, or a notch in it, on each side."""
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

    light = draw(exposed, 400, 400, 0.9, fineness=4)
    return np.asarray(3000 + 20000 * light + np.random.default_rng(3).normal(0, 400, light.shape))


def measure_picture(camera: shapes.FiducialLayout, picture: Array) -> list[Measured]:
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
    quick=(2, 3),
    ids=["beyond", "with its border", "to the edge", "notch"],
)
def test_border_marks_are_measured_as_elsewhere(
    vertices: tuple[shapes.Point, ...], at_mm: float, is_notch: bool
) -> None:
    for mark in measure_picture(layout(vertices, at_mm), scanned(at_mm, is_notch)):
        assert mark.off_px < 0.1
        assert mark.chi2 < ONE_IN_8000


def test_what_is_known_of_a_drawing_ends_at_the_frame() -> None:
    (wedge, *_), (notch, *_) = (
        shapes.limit_to_frame(layout(WEDGE, WEDGE_MM)).marks,
        shapes.limit_to_frame(layout(NOTCH, HALF_MM)).marks,
    )
    inner = layout(((0.0, 0.0), (0.8, 0.3), (0.8, -0.3)), WEDGE_MM)
    assert isinstance(wedge.mark, shapes.MarkShape)
    assert isinstance(notch.mark, shapes.MarkShape)
    assert wedge.mark.known_outline_mm[:, 0].max() == pytest.approx(0.9)
    assert notch.mark.known_outline_mm[:, 0].min() == pytest.approx(0.1)
    assert shapes.limit_to_frame(inner) == inner


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


def layout_frame_corner(radius_mm: float = 0.0) -> shapes.FiducialLayout:
    marks = [
        shapes.LayoutMark(id, xy, (0.02, 0.02), shapes.frame_corner(xy, 5.0, radius_mm)) for id, xy in CORNERS.items()
    ]
    return shapes.FiducialLayout(tuple(marks), (2 * FRAME_CORNER_HALF_MM, 2 * FRAME_CORNER_HALF_MM))


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
    corner = shapes.frame_corner((-10.0, 10.0), 5.0)
    fit = fit_frame_corner(scan, corner, start, 10.0, 1)
    assert not fit.converged
    assert "edge of the frame" in fit.reason


@parametrize_with_studies("gamma", [1.0, 2.2], quick=(1,))
def test_a_corner_moves_with_the_tone_curve_as_its_edges_say(gamma: float) -> None:
    corner = shapes.frame_corner((-10.0, 10.0), 5.0)
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
        more, less = (fit_mark(replace(tone, mean=way * 0.1 * np.eye(5)[k])).center_px for way in (1, -1))
        np.testing.assert_allclose((more - less) / 0.2, estimate.on_place[:, k], atol=0.1)
    assert np.hypot(*estimate.on_place[:, 0]) > 0.15
    assert estimate.information.sum_of_squares < 25  # of 5 figures, by the true curve
    assert fit_mark(Tone(power(gamma))).tone is None


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("border_dn", [10000.0, 0.0])
def test_a_corners_contrast_in_the_file_does_not_depend_on_the_tone_curve(gamma: float, border_dn: float) -> None:
    """A step of 14 of 255 grey values beside black is 1/600 of the light of white, at a power of 2.2."""
    step_dn = 27000.0 if border_dn else 14 * 257.0
    rows, cols = np.mgrid[:SIZE, :SIZE]
    sharp = np.where((cols > CENTER[0]) & (rows > CENTER[1]), border_dn + step_dn, border_dn)
    stored = gaussian_filter(sharp, 1.0) + np.random.default_rng(2).normal(0.0, 60.0, sharp.shape)
    start = np.column_stack([PX_PER_MM * np.diag([1.0, -1.0]), CENTER])
    scan = make_scan(np.clip(stored, 0.0, None)).replace_tone(Tone(power(gamma)))
    fit = fit_frame_corner(scan, shapes.frame_corner((-10.0, 10.0), 5.0), start, 6.0, 1)
    assert fit.converged
    assert fit.stored_contrast_dn == pytest.approx(step_dn, rel=0.04)
    light = 65535 * np.diff((np.array([border_dn, border_dn + step_dn]) / 65535) ** gamma)
    assert fit.contrast_dn == pytest.approx(light[0], rel=0.04)


LINES_PX_PER_MM, LINE_MM, SIZE_PX, BLUR_PX = 20.0, 0.2, 640, 0.9
STEPS_MM = np.arange(-2, 3) * 5.0
MIDDLE_PX, LINES_TURN = np.array([322.3, 317.8]), np.deg2rad(0.4)
BRIGHT = {"0-0": (0.05, -0.1), "3-1": (-0.1, 0.05)}  # stars on crossings, mm beside them


def line_layout(arm_mm: float = 2.5) -> shapes.FiducialLayout:
    cross = shapes.MarkShape(
        (shapes.Bar((-arm_mm, 0), (arm_mm, 0), LINE_MM), shapes.Bar((0, -arm_mm), (0, arm_mm), LINE_MM)), "dark"
    )
    marks = (shapes.LayoutMark(name, xy, (0.002, 0.002), cross) for name, xy in places_mm().items())
    return shapes.FiducialLayout(tuple(marks), (30.0, 30.0))


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
    density, edge = np.zeros(rows.shape), np.arange(SIZE_PX)
    for at, height, sigma in stars:
        col, row = (np.exp(-0.5 * ((edge - px) / LINES_PX_PER_MM / sigma) ** 2) for px in to_px(np.array(at)))
        density += height * np.outer(row, col)
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
    (limited, *_) = shapes.limit_to_crossings(line_layout()).marks
    assert isinstance(limited.mark, shapes.MarkShape)
    assert limited.mark.known_mm == ((-1.0, -1.0), (1.0, 1.0))
    assert np.abs(limited.mark.known_outline_mm).max() <= 1.0
    assert shapes.limit_to_crossings(line_layout(2.0)) == line_layout(2.0)  # crosses with gaps between them
    dots = replace(
        line_layout(),
        marks=tuple(replace(m, mark=shapes.MarkShape((shapes.Disk((0.0, 0.0), 2.4),))) for m in line_layout().marks),
    )
    assert shapes.limit_to_crossings(dots) == dots


CORNER_SIZE, NOISE, CORNER_CONTRAST = 25, 4.0, 100.0


@pytest.mark.parametrize("correlation", [-0.7, 0.0, 0.4])
@pytest.mark.parametrize("surface", [crossing, quarter])
def test_the_closed_form_and_its_derivatives(correlation: float, surface: Surface) -> None:
    rng = np.random.default_rng(1)
    u, v = rng.normal(0, 2, (2, 6))
    both = [multivariate_normal([0, 0], [[1, correlation], [correlation, 1]]).cdf(place) for place in np.c_[u, v]]
    truth = 4 * np.array(both) - 2 * ndtr(u) - 2 * ndtr(v) + 1 if surface is crossing else 2 * np.array(both) - 1
    value, *slopes = surface(*singles(u, v, correlation))
    np.testing.assert_allclose(value[0], truth, atol=2e-6)
    e = 0.02
    steps = ((e, 0, 0), (0, e, 0), (0, 0, e))
    for slope, (du, dv, dc) in zip(slopes, steps, strict=True):
        ahead, behind = (surface(*singles(u + s * du, v + s * dv, correlation + s * dc))[0] for s in (1, -1))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * e), atol=5e-4)


def singles(u: Array, v: Array, correlation: float) -> tuple[Single, Single, Single]:
    """Of one corner, in single precision."""
    return u[None].astype(np.float32), v[None].astype(np.float32), np.array([[correlation]], np.float32)


def board_steps(rng: np.random.Generator) -> Array:
    """Sides of a square seen at an angle."""
    first = rng.uniform(0, np.pi)
    second = first + np.pi / 2 + rng.uniform(-0.4, 0.4)
    return np.array([[np.cos(first), np.cos(second)], [np.sin(first), np.sin(second)]]) * (16.0, 14.0)


def square_picture(center: Array, steps: Array, blur_px: float, alone: bool) -> Array:
    """Squares about a corner, light between the steps; alone: that one square only."""
    inverse = np.linalg.inv(steps)

    def light(col: Array, row: Array) -> Array:
        s, t = transformed(inverse, col - center[0], row - center[1])
        return np.asarray((s > 0) & (t > 0) if alone else (np.floor(s) + np.floor(t)) % 2 == 0)

    return 50 + CORNER_CONTRAST * draw(light, CORNER_SIZE, CORNER_SIZE, blur_px)


def fit_mark(window: Array, start: Array, steps: Array, alone: bool, quantisation_step_dn: float = 0.0) -> Corner:
    outside = 4  # pixels that are none of the picture
    grey, valid = np.pad(window, outside), np.pad(np.ones(window.shape, bool), outside)

    def read(col: int, row: int, side: int) -> ScanWindow:
        part = slice(row + outside, row + outside + side), slice(col + outside, col + outside + side)
        return ScanWindow(grey[part], (col, row), valid[part])

    starts = [CornerStart(start, steps, np.array([6.0, 6.0]), np.zeros(2))]
    return fit_corners(read, starts, quarter if alone else crossing, quantisation_step_dn, (0, 0))[0]


@parametrize_with_studies(("blur_px", "alone"), [(0.5, False), (0.9, False), (1.5, False), (0.8, True)], quick=(1,))
def test_errors_are_as_large_as_their_sigmas_say(blur_px: float, alone: bool) -> None:
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(8):
        center, steps = CORNER_SIZE // 2 + rng.uniform(-0.5, 0.5, 2), board_steps(rng)
        clean = square_picture(center, steps, blur_px, alone)
        for _ in range(6):
            noisy = clean + rng.normal(0, NOISE, clean.shape)
            corner = fit_mark(noisy, center + rng.normal(0, 0.3, 2), steps, alone)
            assert not corner.reason
            errors.append(whitened(corner.center_px - center, corner.covariance.px2))
            assert corner.noise_dn == pytest.approx(NOISE, rel=0.35)
    assert 0.83 < np.sqrt(np.mean(np.square(errors))) < 1.17  # 96 numbers: 7.2 % standard deviation
    assert np.abs(np.mean(errors, axis=0)).max() < 0.4  # 2.8 standard deviations


@pytest.mark.parametrize(("quality", "alone"), [(5, False), (20, True)])
def test_what_jpeg_does_to_edges_is_in_the_standard_deviations(quality: int, alone: bool) -> None:
    """Residuals alone make them 2.5 and 2.3 times too small."""
    rng, errors = np.random.default_rng(5), []
    for _ in range(20):
        center, steps = CORNER_SIZE // 2 + rng.uniform(-4, 4, 2), board_steps(rng)
        clean = square_picture(center, steps, 0.8, alone)
        noisy = np.rint(clean + rng.normal(0, 1.0, clean.shape)).astype(np.uint8)
        stored = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        grey = np.asarray(cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE), float)
        corner = fit_mark(grey, center, steps, alone, quantisation_step_dn(stored.tobytes()))
        if not corner.reason:
            errors.append(whitened(corner.center_px - center, corner.covariance.px2))
    assert len(errors) >= 18
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.25  # 40 numbers: 11 % standard deviation


def test_a_corner_of_a_part_is_known_as_well_as_in_the_whole_picture() -> None:
    """JPEG's blocks begin where they do in the whole one."""
    rng, center = np.random.default_rng(6), np.array([12.3, 12.8])
    grey = square_picture(center, np.diag([16.0, 14.0]), 0.8, False) + rng.normal(0, 1.0, (CORNER_SIZE, CORNER_SIZE))
    starts = [CornerStart(center, np.diag([16.0, 14.0]), np.array([6.0, 6.0]), np.zeros(2))]

    def covariance(first: int, first_block_px: tuple[int, int]) -> Array:
        def read(col: int, row: int, side: int) -> ScanWindow:
            part = slice(first + row, first + row + side), slice(first + col, first + col + side)
            return ScanWindow(grey[part], (col, row))

        own = [replace(start, center_px=start.center_px - first) for start in starts]
        return fit_corners(read, own, crossing, 40.0, first_block_px)[0].covariance.px2

    np.testing.assert_allclose(covariance(3, (5, 5)), covariance(0, (0, 0)), rtol=1e-4)
    assert not np.allclose(covariance(3, (0, 0)), covariance(0, (0, 0)), rtol=0.02)


@pytest.mark.parametrize("blur_px", [0.5, 1.5])
def test_the_junction_lies_where_the_squares_meet(blur_px: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(8):
        center, steps = CORNER_SIZE // 2 + rng.uniform(-0.5, 0.5, 2), board_steps(rng)
        corner = fit_mark(square_picture(center, steps, blur_px, False), center, steps, False)
        assert corner.junction_px is not None
        assert np.abs(corner.junction_px - center).max() < 0.03


def test_trap_pixel_locking() -> None:
    """Without noise the error stays below 0.004 px wherever the corner lies in its pixel: no grid of any kind."""
    rng = np.random.default_rng(3)
    steps = board_steps(rng)
    for phase in np.linspace(-0.5, 0.5, 9):
        center = CORNER_SIZE // 2 + np.array([phase, -phase / 2])
        corner = fit_mark(square_picture(center, steps, 0.7, False), center + 0.2, steps, False)
        assert np.abs(corner.center_px - center).max() < 0.004


def test_a_stain_is_left_out() -> None:
    rng = np.random.default_rng(5)
    center, steps = np.array([12.1, 11.8]), np.diag([14.0, 14.0])
    window = square_picture(center, steps, 0.8, False) + rng.normal(0, 1.0, (CORNER_SIZE, CORNER_SIZE))
    window[7:9, 14:17] = 255
    corner = fit_mark(window, center, steps, False)
    assert not corner.reason
    assert 0.02 < corner.damaged_fraction < 0.1
    assert np.abs(corner.center_px - center).max() < 0.03


def test_where_no_corner_is_the_reason_is_stated() -> None:
    rng = np.random.default_rng(6)
    start, steps = np.array([12.0, 12.0]), np.diag([14.0, 14.0])
    assert fit_mark(rng.normal(100, 4, (CORNER_SIZE, CORNER_SIZE)), start, steps, False).reason
    assert fit_mark(np.full((CORNER_SIZE, CORNER_SIZE), 7.0), start, steps, False).reason

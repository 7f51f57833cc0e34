"""Scans turned and scaled with nearest neighbours, by copying pixels of textures, enlarged, of prints, and blurred by
motion: found, and nothing else is."""

from functools import lru_cache

import cv2
import numpy as np
import pytest
from drawn import (
    ALIKE,
    PITCH_UM,
    Array,
    brute_picture,
    center,
    frame_picture,
    make_scan,
    measure_grey,
    pixel_from_camera,
)
from scipy.ndimage import convolve, gaussian_filter

from measure import Code, MarkShape, Status, measure_fiducials, ring_cross
from measure.flags import Cause
from measure.noise.scan_alterations import find_alterations

SIDE = 700


@lru_cache
def film() -> Array:
    """(700, 700) grain over a landscape, with a frame's edges and a band of one grey value."""
    random = np.random.default_rng(5)
    grain = gaussian_filter(random.normal(size=(SIDE, SIDE)), 0.8) * 20
    picture = 128 + grain + 400 * gaussian_filter(random.normal(size=(SIDE, SIDE)), 9)
    picture[:, 200:204] -= 60
    picture[:60] = 255
    return np.asarray(np.clip(picture, 0, 255))


def nearest(picture: Array, turn_deg: float, scale: tuple[float, float] = (1.0, 1.0)) -> Array:
    """The picture turned about its first pixel and scaled in columns and rows, each pixel copied."""
    turn = np.radians(turn_deg)
    side = len(picture)
    col, row = np.meshgrid(*(np.arange(side) / each for each in scale))
    cols, rows = np.cos(turn) * col - np.sin(turn) * row, np.sin(turn) * col + np.cos(turn) * row
    own = (np.clip(np.rint(each).astype(int), 0, side - 1) for each in (rows, cols))
    return np.asarray(picture[tuple(own)])


def moved(picture: Array, length_px: int, slope: tuple[int, int]) -> Array:
    """The picture's mean over as many pixels along a slope in columns and rows, each of -1 to 1."""
    reach = length_px // 2
    kernel = np.zeros((length_px, length_px))
    for step in range(-reach, reach + 1):
        kernel[reach + step * slope[1], reach + step * slope[0]] = 1 / length_px
    return np.asarray(convolve(picture, kernel, mode="nearest"))


def causes(picture: Array) -> list[Cause]:
    """Causes of what is found to be done to the whole picture."""
    return [each.cause for each in find_alterations(make_scan(picture, 255))]


def jpeg(picture: Array, quality: int) -> Array:
    stored = cv2.imencode(".jpg", picture.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE), float)


@pytest.mark.parametrize(
    ("turn_deg", "scale"), [(0.5, (1.0, 1.0)), (-1.2, (1.0, 1.0)), (0.0, (1.01, 1.01)), (0.0, (1.0, 1.012))]
)
def test_nearest_neighbours_are_found(turn_deg: float, scale: tuple[float, float]) -> None:
    assert causes(nearest(film(), turn_deg, scale)) == [Cause.INTERPOLATION]


def test_nearest_neighbours_are_found_under_compression() -> None:
    assert causes(jpeg(nearest(film(), 0.0, (1.012, 1.012)), 90)) == [Cause.INTERPOLATION]


@pytest.mark.parametrize("kind", [cv2.INTER_LINEAR, cv2.INTER_CUBIC])
@pytest.mark.parametrize("scale", [1.2, 4 / 3, 1.5])
def test_enlarged_scans_are_found(scale: float, kind: int) -> None:
    enlarged = cv2.resize(film(), None, fx=scale, fy=scale, interpolation=kind)
    (found,) = find_alterations(make_scan(np.rint(enlarged), 255))
    assert (found.cause, found.pixels) == (Cause.INTERPOLATION, 4.0)


def print_screen(light: Array, period_px: float) -> Array:
    """Soft dots of a screen at 45 degrees, the larger the more light (0 to 1) there is, as grey values."""
    col, row = np.meshgrid(*map(np.arange, light.shape[::-1]))
    waves = [np.cos(2 * np.pi * (col + sign * row) / period_px) for sign in (1, -1)]
    return np.asarray(255 / (1 + np.exp(-12 * (light - 0.5 - 0.25 * (waves[0] + waves[1])))))


@pytest.mark.parametrize("period_px", [4.0, 6.0, 7.5, 8.0])
def test_screens_of_prints_are_found(period_px: float) -> None:
    (found,) = find_alterations(make_scan(gaussian_filter(print_screen(film() / 255, period_px), 0.8), 255))
    assert "screen" in found.reason
    assert (found.cause, found.pixels) == (Cause.TEXTURE, 4.0)


def test_marks_of_a_print_are_weak_and_lie_within_what_its_dots_make_uncertain() -> None:
    matrix = pixel_from_camera("0")
    picture = print_screen(frame_picture(ALIKE, matrix) / 16000 + 0.15, 6.0)
    result = measure_grey(np.rint(100 * gaussian_filter(picture, 0.8)), ALIKE)
    assert [Code.IMPRECISE in problem.codes for problem in result.problems] == [True]
    for mark, given in zip(result.marks, ALIKE.marks, strict=True):
        assert mark.status is Status.WEAK
        assert mark.covariance is not None
        off = center(mark) - matrix @ (*given.xy_mm, 1.0)
        assert off @ np.linalg.solve(mark.covariance.px2, off) < 9


@pytest.mark.parametrize(
    ("length_px", "slope", "named"),
    [(3, (1, 0), "3 px along rows"), (5, (0, 1), "5 px along columns"), (5, (1, -1), "to the right by 135 degrees")],
)
def test_motion_is_found(length_px: int, slope: tuple[int, int], named: str) -> None:
    (found,) = find_alterations(make_scan(np.rint(moved(film(), length_px, slope)), 255))
    along = np.array(slope)
    assert found.cause is Cause.MOTION
    assert named in found.reason
    assert found.px2 == pytest.approx(((length_px**2) - 1 / (along @ along)) / 12 * np.outer(along, along), rel=0.05)


def test_nothing_else_is_taken_for_an_altered_scan() -> None:
    picture = film()
    turned = cv2.getRotationMatrix2D((SIDE / 2, SIDE / 2), 0.5, 1.01)
    interpolated = cv2.warpAffine(picture, turned, (SIDE, SIDE), flags=cv2.INTER_LINEAR)
    halved = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    saturated = np.clip(3 * picture - 400, 0, 255)
    posterised = 36 * np.rint(picture / 36)
    resampled = [np.asarray(each, float) for each in (interpolated, halved)]
    for each in (picture, *resampled, saturated, posterised, jpeg(picture, 10), np.zeros((SIDE, SIDE))):
        assert not causes(each)


@pytest.mark.parametrize("quality", [90, 94])
def test_the_blocks_of_a_small_compressed_scan_are_no_enlargement(quality: int) -> None:
    """Of 460 rows the line of the blocks reaches far beside its frequency."""
    grain = gaussian_filter(np.random.default_rng(quality).normal(size=(460, 460)), 0.7)
    assert not causes(jpeg(100 + 2 * grain / grain.std(), quality))


def test_the_lines_of_a_reseau_are_no_enlargement() -> None:
    """A réseau's lines make every sixty-second row rough, and those of its harmonics."""
    side, step_px = 2000, 62.5
    across = np.abs((np.arange(side) + 20.3) % step_px - step_px / 2)
    lines = np.clip(2.0 - across, 0.0, 1.0)
    picture = 180.0 - 36.0 * np.maximum.outer(lines, lines)
    assert not causes(picture + np.random.default_rng(8).normal(0.0, 1.5, picture.shape))


def test_large_marks_at_regular_places_are_no_enlargement() -> None:
    """Between their lines a few rows of even noise are more alike than those around, at the same distances in both."""
    apart, half = 250, 133
    place = np.array([[1.0, 0.0, half + 0.3], [0.0, -1.0, half + 0.3]])
    mark = brute_picture(MarkShape(ring_cross(50.0, 6.25, 65.0, 6.25, angle_deg=45.0)), place, 267, 267, 1.0)
    picture = 80.0 + np.random.default_rng(1).normal(0.0, 0.6, (825, 825))
    for row in range(3):
        for col in range(3):
            if (row, col) != (1, 1):
                picture[29 + apart * row :, 29 + apart * col :][:267, :267] += 60.0 * mark
    assert find_alterations(make_scan(256 * picture)) == []


def test_marks_of_a_scan_turned_with_nearest_neighbours_may_be_half_a_pixel_off() -> None:
    matrix, turn = pixel_from_camera("0"), np.radians(1.0)
    result = measure_grey(nearest(frame_picture(ALIKE, matrix), 1.0), ALIKE)
    back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    assert [Code.IMPRECISE in problem.codes for problem in result.problems] == [True]
    for mark, given in zip(result.marks, ALIKE.marks, strict=True):
        assert mark.status is Status.WEAK
        assert mark.covariance is not None
        assert mark.covariance.sigmas_px[Cause.INTERPOLATION] == pytest.approx(12**-0.5)
        assert np.abs(center(mark) - back @ matrix @ (*given.xy_mm, 1.0)).max() < 0.6


def test_marks_of_a_scan_blurred_by_motion_may_lie_anywhere_in_the_blur() -> None:
    matrix, random = pixel_from_camera("0"), np.random.default_rng(6)
    picture = frame_picture(ALIKE, matrix)
    picture = moved(picture + random.normal(0.0, 8.0, picture.shape), 5, (1, 0))
    result = measure_grey(np.rint(picture), ALIKE)
    assert [Code.IMPRECISE in problem.codes for problem in result.problems] == [True]
    for mark, given in zip(result.marks, ALIKE.marks, strict=True):
        assert mark.status is Status.WEAK
        assert mark.covariance is not None
        assert mark.covariance.parts[Cause.MOTION] == pytest.approx(np.diag([2.0, 0.0]), rel=0.1, abs=1e-9)
        assert np.abs(center(mark) - matrix @ (*given.xy_mm, 1.0)).max() < 1.0


def test_standard_deviations_of_an_enlarged_scan_are_doubled_and_its_marks_weak() -> None:
    matrix, random = pixel_from_camera("0"), np.random.default_rng(7)
    picture = frame_picture(ALIKE, matrix)
    enlarged = cv2.resize(picture + random.normal(0.0, 3.0, picture.shape), None, fx=1.1, fy=1.1)
    result = measure_fiducials(make_scan(np.rint(enlarged)), ALIKE, (PITCH_UM / 1.1, PITCH_UM / 1.1))
    assert [Code.IMPRECISE in problem.codes for problem in result.problems] == [True]
    for mark in result.marks:
        assert mark.status is Status.WEAK
        assert "interpolation" in mark.reason
        assert mark.covariance is not None
        assert mark.covariance.parts[Cause.INTERPOLATION] == pytest.approx(0.75 * mark.covariance.px2)

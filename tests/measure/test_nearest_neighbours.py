"""Scans turned and scaled with nearest neighbours, by copying pixels of textures: found, and nothing else is."""

from functools import lru_cache

import cv2
import numpy as np
import pytest
from drawn import ALIKE, Array, center, frame_picture, make_scan, measure_grey, pixel_from_camera
from scipy.ndimage import gaussian_filter

from measure import Code, Status
from measure.flags import Cause
from measure.noise.resampling import is_nearest_neighbour

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


def jpeg(picture: Array, quality: int) -> Array:
    stored = cv2.imencode(".jpg", picture.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE), float)


@pytest.mark.parametrize(
    ("turn_deg", "scale"), [(0.5, (1.0, 1.0)), (-1.2, (1.0, 1.0)), (0.0, (1.01, 1.01)), (0.0, (1.0, 1.012))]
)
def test_nearest_neighbours_are_found(turn_deg: float, scale: tuple[float, float]) -> None:
    assert is_nearest_neighbour(make_scan(nearest(film(), turn_deg, scale), 255))


def test_nothing_else_is_taken_for_nearest_neighbours() -> None:
    picture = film()
    turned = cv2.getRotationMatrix2D((SIDE / 2, SIDE / 2), 0.5, 1.01)
    interpolated = cv2.warpAffine(picture, turned, (SIDE, SIDE), flags=cv2.INTER_LINEAR)
    enlarged = cv2.resize(picture, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC)
    saturated = np.clip(3 * picture - 400, 0, 255)
    posterised = 36 * np.rint(picture / 36)
    resampled = [np.asarray(each, float) for each in (interpolated, enlarged)]
    for each in (picture, *resampled, saturated, posterised, jpeg(picture, 10), np.zeros((SIDE, SIDE))):
        assert not is_nearest_neighbour(make_scan(each, 255))


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

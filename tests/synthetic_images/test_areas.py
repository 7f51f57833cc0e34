"""Area coverage against closed forms and against brute force."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from synthetic_images.areas import bar, bounds, centroid, coverage, disk, polygon, stroke
from synthetic_images.optics import blurred_coverage

Array = NDArray[np.float64]

WINDOW = (-3, 5, 24, 20)  # col0, row0, width, height


def moments(cover: NDArray[np.float32], col0: int, row0: int) -> tuple[float, Array]:
    weights = cover.astype(np.float64)
    rows, columns = np.indices(cover.shape)
    total = weights.sum()
    return total, np.array([(weights * columns).sum() / total + col0, (weights * rows).sum() / total + row0])


@pytest.mark.parametrize("seed", range(2))
def test_a_disk_keeps_its_centre_and_its_area(seed: int) -> None:
    generator = np.random.default_rng(seed)
    center, radius = generator.uniform((5, 12), (12, 18)), generator.uniform(1.0, 6.0)
    cover = blurred_coverage((disk((center[0], center[1]), radius),), -13, -5, 44, 40, 0.8)
    total, middle = moments(cover, -13, -5)
    assert np.abs(middle - center).max() < 1e-3
    assert total == pytest.approx(np.pi * radius**2, rel=2e-4)


def test_optics_blur_before_pixels_average() -> None:
    """A disk of 2 px under a Gaussian of 0.6 px, against the blurred disk integrated over every pixel by quadrature."""
    x = (np.arange(-400, 400) + 0.5) / 40
    sharp = (np.hypot(x[None, :] - 0.23, x[:, None] + 0.41) < 2.0).astype(float)
    expected = gaussian_filter(sharp, 0.6 * 40).reshape(20, 40, 20, 40).mean(axis=(1, 3))
    # The window's pixel (0, 0) is centred at -9.5 of the fine grid's axes.
    view = blurred_coverage((disk((9.5 + 0.23, 9.5 - 0.41), 2.0),), 0, 0, 20, 20, 0.6)
    assert np.abs(view - expected).max() < 2e-3


@pytest.mark.parametrize("blur_px", [0.0, 0.9])
def test_blocks_leave_no_seams(blur_px: float) -> None:
    """A great disk, block by block, against the same in one piece."""
    area = disk((101.3, 97.8), 80.4)
    view = blurred_coverage((area,), 3, 2, 150, 170, blur_px)
    reach = 6
    fine = coverage((area,), 3 - reach, 2 - reach, 150 + 2 * reach, 170 + 2 * reach, 4).astype(np.float64)
    smooth = gaussian_filter(fine, 4 * blur_px, truncate=6.0) if blur_px else fine
    whole = smooth.reshape(170 + 2 * reach, 4, 150 + 2 * reach, 4).mean(axis=(1, 3))
    assert np.abs(view - whole[reach:-reach, reach:-reach]).max() < 2e-5


def test_a_slanted_polygon_agrees_with_counting_points() -> None:
    vertices = np.array([[0.3, 7.2], [14.8, 8.1], [16.2, 21.4], [9.1, 12.6], [2.2, 22.9]])
    cover = coverage((polygon(tuple((x, y) for x, y in vertices)),), *WINDOW)
    assert np.abs(cover - counted(vertices, 64)).max() < 0.01
    assert float(cover.sum()) == pytest.approx(shoelace(vertices), abs=1e-4)


def counted(vertices: Array, fold: int) -> Array:
    """Coverage by even-odd counting of fold x fold points in every pixel."""
    col0, row0, width, height = WINDOW
    x = (np.arange(width * fold) + 0.5) / fold - 0.5 + col0
    y = (np.arange(height * fold) + 0.5) / fold - 0.5 + row0
    inside = np.zeros((len(y), len(x)), bool)
    for (x1, y1), (x2, y2) in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        spans = (y1 > y) != (y2 > y)
        crossing = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
        inside ^= spans[:, None] & (x[None, :] < crossing[:, None])
    return np.asarray(inside.reshape(height, fold, width, fold).mean(axis=(1, 3)))


def shoelace(vertices: Array) -> float:
    x, y = vertices.T
    return abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())) / 2


def test_parts_that_overlap_count_once() -> None:
    across, along = bar((2.0, 14.5), (15.0, 14.5), 1.5), bar((8.25, 8.0), (8.25, 21.0), 1.5)
    cover = coverage((across, along), *WINDOW)
    assert cover.max() <= 1.0
    assert float(cover.sum()) == pytest.approx(2 * 13.0 * 1.5 - 1.5**2, abs=0.02)


def test_bounds_hold_every_pixel_that_is_touched() -> None:
    area = disk((7.6, 14.2), 3.3)
    col0, row0, width, height = bounds((area,))
    total, _ = moments(coverage((area,), col0, row0, width, height), col0, row0)
    assert total == pytest.approx(np.pi * 3.3**2, rel=2e-4)
    wide, _ = moments(coverage((area,), col0 - 5, row0 - 5, width + 10, height + 10), 0, 0)
    assert total == pytest.approx(wide, abs=1e-5)


def test_centroid_far_from_the_origin() -> None:
    square = np.array([[20000.0, 11000.0], [20003.0, 11000.0], [20003.0, 11001.0], [20000.0, 11001.0]])
    assert np.abs(centroid((square,)) - (20001.5, 11000.5)).max() < 1e-9


def test_a_stroke_has_the_width_and_length_of_its_path() -> None:
    path = np.stack([np.linspace(0.0, 14.0, 30), np.full(30, 14.0)], axis=1)
    total, middle = moments(coverage((stroke(path, 1.2),), *WINDOW), *WINDOW[:2])
    assert total == pytest.approx(14.0 * 1.2, abs=1e-3)
    assert np.abs(middle - (7.0, 14.0)).max() < 1e-5

"""What a mark's place is worth where its picture is not quite the one that it is fitted with."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from true_marks import KIND, Kind, some_mark, whitened_rms

from measure.flags import Cause
from measure.marks.shapes import Bar, MarkShape, MarkTemplate, cross, polygon
from measure.matching.covariance import LinearFit
from measure.matching.match import MatchOptions, match
from measure.matching.window import ScanWindow
from measure.noise.noise_model import NoiseModel, combined, correlated, products, weighted

CROSS = MarkShape(cross(1.5, 0.15))
FOLD, SPARE_PX = 4, 6
SHIFTS = ((2, 0), (0, 2), (1, 1), (3, 2), (2, 3))


def coarse(fine: NDArray[np.float64], col: int, row: int) -> NDArray[np.float64]:
    """Means over squares of its pixels, the first of which begins at a column and a row."""
    rows = len(fine) // FOLD - 1
    part = fine[row : row + rows * FOLD, col : col + rows * FOLD]
    return np.asarray(part.reshape(rows, FOLD, rows, FOLD).mean(axis=(1, 3)))


@pytest.mark.parametrize("is_grain", [False, True])
def test_noise_alone_hardly_is_hardly_taken_for_it(is_grain: bool) -> None:
    """Of a line's place under noise that is alike everywhere, white or grain of 1.5 px."""
    rng, shares = np.random.default_rng(2), []
    cols = np.mgrid[0:40, 0:40][1] - 19.5
    lags = np.arange(-8, 9)
    grain = np.exp(-(lags[:, None] ** 2 + lags**2) / (4 * 1.5**2)) + 0.1 * np.outer(lags == 0, lags == 0)
    noise = NoiseModel(1.1, grain, 0.9, is_grain=True) if is_grain else NoiseModel(1.0, np.ones((1, 1)), 0.0)
    line = -np.gradient(np.exp(-(cols**2) / 2), axis=1)
    design, used = np.stack([line, line.T, np.ones_like(line)]), np.ones(line.shape, dtype=bool)
    weights = weighted(design, used, noise, 0.0)[0] if is_grain else design
    by_grey = combined(np.asarray(np.linalg.inv(products(weights, design)), np.float64), weights)
    for _ in range(30):
        white = rng.standard_normal(line.shape)
        left = correlated(white[None], noise, 0.5)[0] if is_grain else white
        fit = LinearFit(left, used, design, by_grey, noise, np.ones_like(line))
        by_noise = fit.covariance(by_grey[:2])
        shares.append(np.trace(fit.unlike_drawing_px2(by_noise)) / np.trace(by_noise))
    assert np.mean(shares) < 0.1


def test_ragged_lines_are_known_as_badly_as_they_are() -> None:
    """Each pixel's length of them lies elsewhere by 0.08 px, one standard deviation. The ground is clear, and would let
    a cross be known three times as well as it is."""
    rng, errors, known, by_noise = np.random.default_rng(4), [], [], []
    for _ in range(8):
        mark = some_mark(Kind("ragged", MarkShape((*ragged(0, rng), *ragged(1, rng)))), 1.0, rng)
        grey = 1000 * mark.picture + rng.normal(0, 10, (mark.size, mark.size))
        fit = match(ScanWindow(grey), CROSS, mark.place, MatchOptions())
        errors.append(fit.center_px - mark.place[:, 2])
        known.append(fit.covariance_px2)
        by_noise.append(fit.place_covariance.parts[Cause.NOISE])
    assert whitened_rms(errors, by_noise) > 2.3
    assert whitened_rms(errors, known) < 1.7


def test_a_mark_in_a_textured_border_is_known_as_badly_as_it_is() -> None:
    """Its blotches are cut out as damage, and bend its edges all the same; outside of it there is hardly any noise."""
    rng, errors, known, without = np.random.default_rng(6), [], [], []
    block = MarkShape(polygon(((0.0, 0.0), (1.2, 1.2), (3.0, 1.2), (3.0, -1.2), (1.2, -1.2))))
    for _ in range(8):
        mark = some_mark(Kind("block", block), 0.8, rng)
        texture = gaussian_filter(rng.normal(size=(mark.size, mark.size)), 2.0)
        light = 1.0 - mark.picture * (1.0 + 0.1 * texture / texture.std())
        fit = match(ScanWindow(20000 * light + rng.normal(0, 300, light.shape)), block, mark.place, MatchOptions())
        errors.append(fit.center_px - mark.place[:, 2])
        known.append(fit.covariance_px2)
        without.append(fit.covariance_px2 - fit.place_covariance.parts[Cause.TEXTURE])
    assert whitened_rms(errors, without) > 2.0
    assert 0.6 < whitened_rms(errors, known) < 1.3


def test_what_damage_leaves_beside_itself_is_a_cause_of_a_marks_covariance() -> None:
    """A region of 4 x 4 px on a line, of which the pixels about it may have any amount up to what is cut out."""
    line = -np.gradient(np.exp(-((np.mgrid[0:40, 0:40][1] - 19.5) ** 2) / 2), axis=1)
    design, used = np.stack([line, line.T, np.ones_like(line)]), np.ones(line.shape, dtype=bool)
    damaged = np.zeros_like(used)
    damaged[10:14, 20:24] = True
    by_grey = combined(np.asarray(np.linalg.inv(products(design, design)), np.float64), design)
    noise = NoiseModel(4.0, np.full((1, 1), 4.0), 0.0)
    fit = LinearFit(np.where(damaged, 1000.0, 0.0), used & ~damaged, design, by_grey, noise, np.ones_like(line))
    beside = gaussian_filter(damaged * 3.2 * 2.0, 1.0, mode="constant")
    moved = (by_grey[:2] * beside * fit.used).sum(axis=(1, 2))
    np.testing.assert_allclose(fit.damage_px2(damaged), np.outer(moved, moved) / 3, rtol=1e-6)
    assert not fit.damage_px2(np.zeros_like(used)).any()


def ragged(axis: int, rng: np.random.Generator) -> list[Bar]:
    """The pieces of a line of 3 mm along an axis."""
    ends, off_mm = np.linspace(-1.5, 1.5, 31).tolist(), rng.normal(0, 0.008, 30).tolist()

    def place(along: float, off: float) -> tuple[float, float]:
        return (off, along) if axis else (along, off)

    pieces = zip(ends[:-1], ends[1:], off_mm, strict=True)
    return [Bar(place(begin, off), place(end, off), 0.15) for begin, end, off in pieces]


def test_a_chip_sampled_too_coarsely_is_found_in_pictures_shifted_by_known_parts_of_a_pixel() -> None:
    rng, errors, sigmas = np.random.default_rng(1), [], []
    for name in ("wedge", "wing", "notch"):  # their edges lie on one side: what these do does not cancel
        fine = some_mark(KIND[name], 0.8, rng, 200, 32.0).picture
        chip = coarse(fine, 0, 0)[SPARE_PX:-SPARE_PX, SPARE_PX:-SPARE_PX]
        middle = (np.array(chip.shape) - 1) / 2
        template = MarkTemplate(chip, 1000.0, (float(middle[0]), float(middle[1])))
        for shift in SHIFTS:
            true = middle + SPARE_PX - np.array(shift) / FOLD
            start = np.column_stack([np.diag([1.0, -1.0]), np.rint(true)])
            fit = match(
                ScanWindow(100 * coarse(fine, *shift)), template, start, MatchOptions("shift", estimate_blur=False)
            )
            assert fit.converged
            errors.append(fit.center_px - true)
            sigmas.append(np.sqrt(np.diag(fit.covariance_px2)))
    assert np.abs(errors).max() < 0.005  # 1.6 px, with a standard deviation of 0.004, where edges are taken for damage
    assert np.sqrt(np.mean(np.square(np.divide(errors, sigmas)))) < 1.2

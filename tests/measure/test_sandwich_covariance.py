"""What a chip is worth that was sampled as coarsely as the pictures it is compared with."""

import numpy as np
import pytest
from numpy.typing import NDArray
from true_marks import KIND, some_mark

from measure.fitting.linear_fit import sandwich_covariance
from measure.fitting.matching import MatchOptions, match
from measure.fitting.scan_window import ScanWindow
from measure.marks.shapes import MarkTemplate

FOLD, SPARE_PX = 4, 6
SHIFTS = ((2, 0), (0, 2), (1, 1), (3, 2), (2, 3))


def coarse(fine: NDArray[np.float64], col: int, row: int) -> NDArray[np.float64]:
    """Means over squares of its pixels, the first of which begins at a column and a row."""
    rows = len(fine) // FOLD - 1
    part = fine[row : row + rows * FOLD, col : col + rows * FOLD]
    return np.asarray(part.reshape(rows, FOLD, rows, FOLD).mean(axis=(1, 3)))


def test_where_residuals_are_alike_everywhere_it_is_the_ordinary_covariance() -> None:
    """Of a slope and an offset under white noise: neither larger nor smaller."""
    rng, sigma, ratios = np.random.default_rng(2), 3.0, []
    rows, cols = np.mgrid[0:24, 0:24] - 11.5
    design = np.stack([np.ones_like(cols), cols / 8.0, np.sin(rows)])
    inverse = np.linalg.inv(np.einsum("ihw,jhw->ij", design, design))
    for _ in range(60):
        claimed = sandwich_covariance(inverse, design, rng.normal(0, sigma, cols.shape), np.ones(cols.shape, bool))
        ratios.append(np.diag(claimed) / (sigma**2 * np.diag(inverse)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)


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

"""Marks in 8 bit with less noise than a grey value's step."""

import numpy as np
import pytest
from drawn import scan_of
from true_marks import KIND, some_mark, whitened_rms

from measure.matching.rounding import likely_sigma, rounding_step, unrounded, unrounded_variance
from measure.targets.disks import fit_disk


def test_disks_on_an_even_ground_are_measured_by_the_intervals_that_grey_values_stand_for() -> None:
    rng = np.random.default_rng(3)
    errors, covariances = [], []
    for _ in range(20):
        mark = some_mark(KIND["ellipse"], 1.0, rng)
        ground = 60 + rng.uniform(-0.5, 0.5) + 1.5 * rng.uniform() * np.arange(mark.size) / mark.size
        disk = fit_disk(scan_of(ground + 120 * mark.picture, 255), mark.place[:, 2] + 0.3, mark.place[:, :2])
        errors.append(disk.center_px - mark.place[:, 2])
        covariances.append(disk.covariance_px2)
    assert np.sqrt(np.mean(np.square(errors))) < 0.0019  # rounding taken as noise: 0.0023
    assert 0.7 < whitened_rms(errors, covariances) < 1.3


@pytest.mark.parametrize("sigma", [0.14, 0.2])
def test_residuals_vary_as_noise_and_rounding_make_them(sigma: float) -> None:
    rng = np.random.default_rng(4)
    light, model = rng.normal(0.0, sigma, 20000), rng.uniform(0, 1, 20000)
    residuals = np.rint(model + light) - model
    assert likely_sigma(residuals) == sigma
    np.testing.assert_allclose(np.mean(unrounded(residuals, sigma) ** 2), unrounded_variance(sigma), rtol=0.03)


def test_the_step_is_that_of_all_grey_values() -> None:
    assert rounding_step(np.array([60.0, 61, 64, 60])) == 1.0
    assert rounding_step(np.array([514.0, 257, 1028])) == 257.0
    assert rounding_step(np.array([0.3, 1.0, 1.1, 1.5])) == 0.0
    assert rounding_step(np.full(4, 60.0)) == 0.0

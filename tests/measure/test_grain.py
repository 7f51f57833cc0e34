"""The grain behind the residuals of a small fit, against noise of known grain."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from measure.noise.grain import grain_model
from measure.noise.noise import noise_model


@pytest.mark.parametrize("grain_px", [0.6, 0.8, 1.1])
def test_variance_and_power_of_grain_are_found_behind_a_fit_that_took_most_of_it(grain_px: float) -> None:
    rng = np.random.default_rng(1)
    size = 19
    y, x = np.mgrid[:size, :size] - 9.0
    used = np.hypot(x, y) < 8.0
    edge = np.exp(-((np.hypot(x, y) - 5.0) ** 2))
    shapes = [np.ones_like(x), x, y, x * x + y * y, edge, edge * x, edge * y, edge * x * y, edge * (x * x - y * y)]
    design = np.stack(shapes) * used
    directions, _ = np.linalg.qr(design[:, used].T)
    reach = np.arange(-9, 10)
    correlation = np.exp(-(reach[:, None] ** 2 + reach[None, :] ** 2) / (4.0 * grain_px**2))
    white = 0.4
    models, naive = [], []
    for _ in range(60):
        grain = gaussian_filter(rng.standard_normal((60, 60)), grain_px)[20 : 20 + size, 20 : 20 + size]
        noise = grain * 2.0 * grain_px * np.sqrt(np.pi) + white * rng.standard_normal((size, size))
        residuals = np.zeros((size, size))
        residuals[used] = noise[used] - directions @ (directions.T @ noise[used])
        models.append(grain_model(residuals, used, design, 0.5))
        naive.append(noise_model(residuals, used, len(design)))
    variance = np.median([model.variance_dn2 for model in models])
    power = np.median([model.autocovariance_dn2.sum() for model in models])
    assert variance == pytest.approx(1.0 + white**2, rel=0.15)
    assert power == pytest.approx(correlation.sum() + white**2, rel=0.25)
    # Without the model nearly all of the power at low frequencies is lost: that is what it is for.
    assert np.median([model.autocovariance_dn2.sum() for model in naive]) < 0.5 * power

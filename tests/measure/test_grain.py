"""The grain behind the residuals of a small fit, against noise of known grain."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from measure.noise.grain import _KERNELS, GRAIN_PX, PATCH_PX, PLANE, grain_model
from measure.noise.noise_model import noise_model


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


def test_the_autocorrelations_are_those_of_noise_smeared_by_gaussians() -> None:
    """That of a Gaussian with itself, by sums over a fine grid."""
    x = np.arange(-400, 401) / 20.0
    for grain_px, kernel in zip(GRAIN_PX, _KERNELS[1:], strict=True):
        smear = np.exp(-(x**2) / (2.0 * grain_px**2))
        of_lag = [float(smear[: len(x) - 20 * lag] @ smear[20 * lag :]) / float(smear @ smear) for lag in range(4)]
        middle = len(kernel) // 2
        np.testing.assert_allclose(kernel[middle, middle : middle + 4], of_lag, atol=1e-6)
        np.testing.assert_allclose(kernel[middle + 1, middle + 1], of_lag[1] ** 2, atol=1e-6)


@pytest.mark.parametrize(("grain_px", "is_grain"), [(1.5, True), (2.8, False)])
def test_coarse_grain_is_distinguished_from_a_landscape(grain_px: float, is_grain: bool) -> None:
    """By how alike neighbours are: in noise smeared by a Gaussian of s px by exp(-1 / (4 s²)); 1.8 px is film's end.
    Nine directions of a fit take little of what is so coarse in a window so wide."""
    rng = np.random.default_rng(4)
    size, reach = 8 * PATCH_PX, 12
    grain = gaussian_filter(rng.standard_normal((size + 2 * reach,) * 2), grain_px)[reach:-reach, reach:-reach]
    grain /= grain.std()
    neighbours = float(np.mean(grain[:, 1:] * grain[:, :-1]))
    assert neighbours == pytest.approx(np.exp(-1 / (4 * grain_px**2)), abs=0.02)
    flat = grain.reshape(8, PATCH_PX, 8, PATCH_PX).swapaxes(1, 2).reshape(-1, PATCH_PX * PATCH_PX)
    patches = (flat - flat @ PLANE @ PLANE.T).reshape(-1, PATCH_PX, PATCH_PX)
    window = grain[:19, :19] - grain[:19, :19].mean()
    used, design = np.ones((19, 19), dtype=bool), np.ones((1, 19, 19))
    model = grain_model(window, used, design, neighbours, patches)
    assert model.is_grain is is_grain
    if is_grain:  # blank film that holds more pixels than the window alone tells how strong it is
        assert model.variance_dn2 == pytest.approx(1.0, rel=0.1)
        assert grain_model(3.0 * window, used, design, neighbours, patches).variance_dn2 == model.variance_dn2

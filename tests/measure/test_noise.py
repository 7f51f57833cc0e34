"""What residuals tell of the noise that made them: its model, grain, rounding, clipping."""

import numpy as np
import pytest
from drawn import chi_square, make_scan
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies
from true_marks import KIND, TrueMark, some_mark, whitened_rms

from measure import FiducialOptions, MarkFit, MatchOptions, match
from measure.detection.localisation import MarkPrediction
from measure.fiducials.mark_fit import detect_mark
from measure.matching.window import clipped_ends, noise_scale, read_window
from measure.noise.noise_model import (
    _KERNELS,
    GRAIN_PX,
    PATCH_PX,
    PLANE,
    grain_model,
    influence_covariances,
    noise_model,
    steadiness,
)
from measure.tone.curve import Tone, power

FULL = 65535.0


def test_the_variance_of_noise_is_that_before_the_fit_took_its_share() -> None:
    """Twelve unknowns of 64 pixels: a fit leaves less than there was, by as many."""
    rng, sigma, unknowns, variances = np.random.default_rng(4), 5.0, 12, []
    design = np.linalg.qr(rng.normal(size=(64, unknowns)))[0]
    for _ in range(400):
        noise = rng.normal(0, sigma, 64)
        left = (noise - design @ (design.T @ noise)).reshape(8, 8)
        used = np.ones((8, 8), bool)
        of_many = influence_covariances(np.ones((1, 1, 8, 8)), left[None], used[None], unknowns)[1]
        variances.append((noise_model(left, used, unknowns).variance_dn2, of_many.item()))
    np.testing.assert_allclose(np.mean(variances, axis=0), sigma**2, rtol=0.03)


def test_variances_of_few_pixels_are_positive_however_noisy_their_lags_are() -> None:
    """Corners of small squares had been measured with negative variances, which ended in a traceback."""
    rng, (row, column) = np.random.default_rng(1), np.indices((9, 9)) - 4
    used = (np.maximum(abs(row), abs(column)) < 4) & (rng.random((100, 9, 9)) < 0.85)
    white = rng.normal(size=(100, 9, 9))
    streaks = white + np.roll(white, 1, 2) + np.roll(white, 2, 2)
    alternating = np.stack([(-1.0) ** column, (-1.0) ** row]) * used[:, None]
    covariances, _ = influence_covariances(alternating, streaks * used, used, 5)
    assert np.linalg.eigvalsh(covariances).min() > 0.0


@pytest.mark.parametrize("grows", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("damaged", [0.0, 0.2])
def test_residuals_tell_how_noise_grows_with_light_and_damage_hardly_counts(grows: float, damaged: float) -> None:
    rng = np.random.default_rng(2)
    ground = np.ones((60, 60), bool)
    ground[20:32, 10:50] = False
    light = np.where(ground, 0.04, 0.64)
    residuals = (light / 0.04) ** grows * rng.standard_normal(light.shape)
    residuals[~ground & (rng.random(light.shape) < damaged)] += 30.0
    found = steadiness(residuals, light, ground, np.ones_like(ground))
    assert np.all(found[ground] == 1.0)
    assert found[~ground] == pytest.approx(16.0**-grows, rel=0.25 if not damaged else 0.4)
    everywhere = np.ones_like(ground)
    assert np.all(steadiness(residuals, np.full_like(light, 0.5), everywhere, everywhere) == 1.0)


@parametrize_with_studies("alike_in", ["code", "light"])
def test_a_light_mark_is_not_damaged_for_its_noise(alike_in: str) -> None:
    """Noise that is alike in grey values is in light several times as large on the mark as about it."""
    rng = np.random.default_rng(4)
    errors, covariances, damaged = [], [], []
    for _ in range(16):
        mark = some_mark(KIND["ring-cross"], 0.8, rng)
        noise = rng.standard_normal(mark.picture.shape)
        light = 0.02 + 0.7 * mark.picture
        if alike_in == "light":
            code = np.clip(light + 0.004 * noise, 0.0, 1.0) ** (1 / 2.2)
        else:
            code = light ** (1 / 2.2) + 0.02 * noise
        scan = make_scan(FULL * code).replace_tone(Tone(power(2.2)))
        window = read_window(scan, (0, 0, mark.size, mark.size))
        fit = match(window, mark.kind.shape, mark.place, MatchOptions(linear_sigma=0.05))
        assert fit.converged, fit.reason
        damaged.append(fit.damaged_fraction)
        errors.append(fit.center_px - mark.place[:, 2])
        covariances.append(fit.covariance_px2)
    assert np.mean(damaged) < 0.05
    assert 0.75 < whitened_rms(errors, covariances) < 1.3


@parametrize_with_studies("grain_px", [0.6, 0.8, 1.1], quick=(1,))
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
        models.append(grain_model(residuals, used, design, 0.5, np.zeros((0, PATCH_PX, PATCH_PX))))
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


CLIPPING_FULL, CONTRAST = 65535.0, 20000.0


def dark_mark(name: str, beyond: float, snr: float, rng: np.random.Generator) -> tuple[TrueMark, np.ndarray]:
    """A mark and its picture on a ground that lies beyond the range by so much of the contrast."""
    mark = some_mark(KIND[name], 1.0, rng)
    noise = rng.standard_normal((mark.size, mark.size)) / snr
    return mark, CLIPPING_FULL + CONTRAST * (beyond - mark.picture + noise)


def sighted(mark: TrueMark, grey: np.ndarray, polarity: int = -1) -> MarkFit:
    start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + (0.7, -0.6)])
    frame_sigma = mark.kind.known if np.isfinite(mark.kind.known) else None
    fit = detect_mark(
        make_scan(grey), MarkPrediction(mark.kind.shape, start, 3.0, polarity), FiducialOptions().match, frame_sigma
    ).fit
    assert fit is not None
    return fit


@pytest.mark.parametrize("name", ["cross", "ring-dot", "wing", "notch"])
@pytest.mark.parametrize("beyond", [0.0, 0.3])
def test_clipping_does_not_move_a_mark(name: str, beyond: float) -> None:
    rng = np.random.default_rng(1)
    mark, grey = dark_mark(name, beyond, np.inf, rng)
    np.testing.assert_allclose(sighted(mark, grey).center_px, mark.place[:, 2], atol=0.002)
    np.testing.assert_allclose(sighted(mark, CLIPPING_FULL - grey, 1).center_px, mark.place[:, 2], atol=0.002)


@pytest.mark.parametrize("within", [-1.0, 0.0, 1.0])
def test_noise_is_distinguished_from_what_is_visible_of_it_and_little_dust_does_not_change_that(within: float) -> None:
    noise = 3 * np.random.default_rng(4).standard_normal(20000)
    sides = (noise >= 3 * within).astype(np.int8)
    residuals = np.minimum(noise, 3 * within)
    assert noise_scale(residuals, sides, 4.0, 0.3) == pytest.approx(3.0, rel=0.02)
    residuals[:200], sides[:200] = -40.0, 0
    assert noise_scale(residuals, sides, 4.0, 0.3) == pytest.approx(3.0, rel=0.02)


def test_the_sigma_of_a_mark_on_ground_just_at_the_end_of_the_range_is_honest() -> None:
    rng = np.random.default_rng(5)
    mark = some_mark(KIND["ring-dot"], 1.0, rng)
    errors, covariances, best = [], [], []
    for _ in range(14):
        noise = rng.standard_normal((mark.size, mark.size)) / 20
        fit = sighted(mark, CLIPPING_FULL + CONTRAST * (noise - mark.picture))
        errors.append(fit.center_px - mark.place[:, 2])
        covariances.append(fit.covariance_px2)
        best.append(mark.best_errors(-noise, 1 / 20))
    claimed = np.sqrt(np.trace(np.mean(covariances, axis=0)) / np.trace(mark.bound(1 / 20)))
    assert 0.97 < claimed < 1.08
    assert np.mean(np.square(np.subtract(errors, best))) < 0.05 * np.trace(mark.bound(1 / 20)) / 2


def test_ends_of_the_range_are_those_of_the_converter() -> None:
    grey = np.full((40, 40), 9000.0)
    grey[3, 4], grey[5, 6] = 4095 << 4, 0
    sides = clipped_ends(make_scan(grey).samples(0, 0, 40, 40), 65535)
    assert sides[3, 4] == 1
    assert sides[5, 6] == -1
    assert np.count_nonzero(sides) == 2
    assert not clipped_ends(make_scan(grey).samples(10, 10, 20, 20), 65535).any()


def test_whites_cut_off_below_the_end_of_the_range_are_limits_too() -> None:
    rng = np.random.default_rng(3)
    for beyond in (-0.05, 0.3):
        mark = some_mark(KIND["wing"], 1.0, rng)
        natural = 250 + 100 * (beyond - mark.picture + rng.standard_normal((mark.size, mark.size)) / 20)
        scan = make_scan(np.minimum(natural, 250), 255)
        sides = clipped_ends(scan.samples(0, 0, mark.size, mark.size), 255)
        np.testing.assert_array_equal(sides == 1, np.rint(natural) >= 250)
        start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + (0.7, -0.6)])
        fit = detect_mark(
            scan, MarkPrediction(mark.kind.shape, start, 3, -1), FiducialOptions().match, mark.kind.known
        ).fit
        assert chi_square(fit, mark.place[:, 2]) < 13.8
    for sigma in np.geomspace(0.2, 20, 40):
        grey = 128 + sigma * rng.standard_normal((60, 60)) - 40 * (np.arange(60) > 40)
        assert not clipped_ends(make_scan(grey, 255).samples(0, 0, 60, 60), 255).any()

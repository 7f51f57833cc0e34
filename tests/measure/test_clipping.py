"""Marks whose ground, or whose own light, is beyond the scanner's range."""

import numpy as np
import pytest
from drawn import scan_of
from studies import parametrize_with_studies
from true_marks import KIND, TrueMark, some_mark, whitened_rms

from measure.detection.localisation import MarkPrediction
from measure.fiducials.mark_fit import detect_mark
from measure.fiducials.options import FiducialOptions
from measure.matching.window import censored, clipped_sides, noise_scale
from measure.results import MarkFit

FULL, CONTRAST = 65535.0, 20000.0


def dark_mark(name: str, beyond: float, snr: float, rng: np.random.Generator) -> tuple[TrueMark, np.ndarray]:
    """A mark and its picture on a ground that lies beyond the range by so much of the contrast."""
    mark = some_mark(KIND[name], 1.0, rng)
    noise = rng.standard_normal((mark.size, mark.size)) / snr
    return mark, FULL + CONTRAST * (beyond - mark.picture + noise)


def sighted(mark: TrueMark, grey: np.ndarray, polarity: int = -1) -> MarkFit:
    start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + (0.7, -0.6)])
    frame_sigma = mark.kind.known if np.isfinite(mark.kind.known) else None
    fit = detect_mark(
        scan_of(grey), MarkPrediction(mark.kind.shape, start, 3.0, polarity), FiducialOptions().match, frame_sigma
    ).fit
    assert fit is not None
    return fit


@pytest.mark.parametrize("name", ["cross", "ring-dot", "wing", "notch"])
@pytest.mark.parametrize("beyond", [0.0, 0.3])
def test_clipping_does_not_move_a_mark(name: str, beyond: float) -> None:
    rng = np.random.default_rng(1)
    mark, grey = dark_mark(name, beyond, np.inf, rng)
    np.testing.assert_allclose(sighted(mark, grey).center_px, mark.place[:, 2], atol=0.002)
    np.testing.assert_allclose(sighted(mark, FULL - grey, 1).center_px, mark.place[:, 2], atol=0.002)


@parametrize_with_studies("name", ["ring-dot", "wing"], quick=(1,))
def test_the_sigma_of_a_clipped_mark_says_what_was_lost(name: str) -> None:
    rng = np.random.default_rng(2)
    errors, covariances, whole = [], [], []
    for _ in range(8):
        mark, grey = dark_mark(name, 0.3, 20.0, rng)
        fit = sighted(mark, grey)
        errors.append(fit.center_px - mark.place[:, 2])
        covariances.append(fit.covariance_px2)
        whole.append(np.trace(mark.bound(1 / 20.0)))
    assert 0.7 < whitened_rms(errors, covariances) < 1.3
    assert np.mean([np.trace(each) for each in covariances]) > 1.4 * np.mean(whole)


def test_a_censored_residual_is_twice_the_log_probability_and_derivatives_agree() -> None:
    residuals, step = np.array([-30.0, -2.0, -0.3, 0.0, 0.8, 5.0, 300.0]), 1e-6
    upper = np.ones(len(residuals), np.int8)
    value, slope, information = censored(residuals, upper, 2.0)
    (more, steeper, _), (less, flatter, _) = (censored(residuals + off, upper, 2.0) for off in (step, -step))
    np.testing.assert_allclose(slope, (more - less) / (2 * step), atol=1e-5)
    np.testing.assert_allclose(information, (more * steeper - less * flatter) / (2 * step), atol=1e-3)
    assert value[3] == pytest.approx(2.0 * np.sqrt(2 * np.log(2)))
    np.testing.assert_allclose((value[0], value[-1]), (0.0, 300.0), atol=0.1)
    np.testing.assert_allclose(censored(-residuals, np.negative(upper), 2.0)[0], -value)


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
    for _ in range(24):
        noise = rng.standard_normal((mark.size, mark.size)) / 20
        fit = sighted(mark, FULL + CONTRAST * (noise - mark.picture))
        errors.append(fit.center_px - mark.place[:, 2])
        covariances.append(fit.covariance_px2)
        best.append(mark.best_errors(-noise, 1 / 20))
    claimed = np.sqrt(np.trace(np.mean(covariances, axis=0)) / np.trace(mark.bound(1 / 20)))
    assert 0.97 < claimed < 1.08
    assert np.mean(np.square(np.subtract(errors, best))) < 0.05 * np.trace(mark.bound(1 / 20)) / 2


def test_ends_of_the_range_are_those_of_the_converter() -> None:
    grey = np.full((40, 40), 9000.0)
    grey[3, 4], grey[5, 6] = 4095 << 4, 0
    sides = clipped_sides(scan_of(grey), 0, 0, 40, 40, None)
    assert sides[3, 4] == 1
    assert sides[5, 6] == -1
    assert np.count_nonzero(sides) == 2
    assert not clipped_sides(scan_of(grey), 10, 10, 20, 20, None).any()


def test_whites_cut_off_below_the_end_of_the_range_are_limits_too() -> None:
    rng = np.random.default_rng(3)
    for beyond in (-0.05, 0.3):
        mark = some_mark(KIND["wing"], 1.0, rng)
        natural = 250 + 100 * (beyond - mark.picture + rng.standard_normal((mark.size, mark.size)) / 20)
        scan = scan_of(np.minimum(natural, 250), 255)
        sides = clipped_sides(scan, 0, 0, mark.size, mark.size, None)
        np.testing.assert_array_equal(sides == 1, np.rint(natural) >= 250)
        start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + (0.7, -0.6)])
        fit = detect_mark(
            scan, MarkPrediction(mark.kind.shape, start, 3.0, -1), FiducialOptions().match, mark.kind.known
        ).fit
        assert fit is not None
        error = fit.center_px - mark.place[:, 2]
        assert error @ np.linalg.solve(fit.covariance_px2, error) < 13.8  # one in a thousand
    for sigma in np.geomspace(0.2, 20, 40):
        grey = 128 + sigma * rng.standard_normal((60, 60)) - 40 * (np.arange(60) > 40)
        assert not clipped_sides(scan_of(grey, 255), 0, 0, 60, 60, None).any()

"""Noise that is not alike on dark and on light ground."""

import numpy as np
import pytest
from drawn import scan_of
from studies import parametrize_with_studies
from true_marks import KIND, some_mark, whitened_rms

from measure.matching.match import match
from measure.matching.models import MatchOptions
from measure.matching.window import read_window
from measure.noise.noise_model import steadiness
from measure.tone.curve import Tone, power

FULL = 65535.0


@pytest.mark.parametrize("grows", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("damaged", [0.0, 0.2])
def test_how_noise_grows_with_light_is_known_by_residuals_and_damage_hardly_counts(
    grows: float, damaged: float
) -> None:
    rng = np.random.default_rng(2)
    ground = np.ones((60, 60), bool)
    ground[20:32, 10:50] = False
    light = np.where(ground, 0.04, 0.64)
    residuals = (light / 0.04) ** grows * rng.standard_normal(light.shape)
    residuals[~ground & (rng.random(light.shape) < damaged)] += 30.0
    found = steadiness(residuals, light, ground, np.ones_like(ground))
    assert np.all(found[ground] == 1.0)
    assert found[~ground] == pytest.approx(16.0**-grows, rel=0.25 if not damaged else 0.4)


def test_noise_that_is_alike_everywhere_says_nothing_else() -> None:
    residuals = np.random.default_rng(3).standard_normal((30, 30))
    same = np.ones((30, 30), bool)
    assert np.all(steadiness(residuals, 0.5 * np.ones((30, 30)), same, same) == 1.0)


@parametrize_with_studies("alike_in", ["code", "light"])
def test_a_light_mark_is_not_damaged_for_its_noise(alike_in: str) -> None:
    """Noise that is alike in grey values is in light several times as large on the mark as about it."""
    rng = np.random.default_rng(4)
    errors, covariances, damaged = [], [], []
    for _ in range(24):
        mark = some_mark(KIND["ring-cross"], 0.8, rng)
        noise = rng.standard_normal(mark.picture.shape)
        light = 0.02 + 0.7 * mark.picture
        if alike_in == "light":
            code = np.clip(light + 0.004 * noise, 0.0, 1.0) ** (1 / 2.2)
        else:
            code = light ** (1 / 2.2) + 0.02 * noise
        scan = scan_of(FULL * code).replace_tone(Tone(power(2.2)))
        window = read_window(scan, (0, 0, mark.size, mark.size))
        fit = match(window, mark.kind.shape, mark.place, MatchOptions(linear_sigma=0.05))
        assert fit.converged, fit.reason
        damaged.append(fit.damaged_fraction)
        errors.append(fit.center_px - mark.place[:, 2])
        covariances.append(fit.covariance_px2)
    assert np.mean(damaged) < 0.05
    assert 0.75 < whitened_rms(errors, covariances) < 1.3

"""What residuals tell of the noise that made them."""

import numpy as np
import pytest

from measure.noise.noise_model import noise_model


def test_the_variance_of_noise_is_that_before_the_fit_took_its_share() -> None:
    """Twelve unknowns of 64 pixels: a fit leaves less than there was, by as many."""
    rng, sigma, unknowns, variances = np.random.default_rng(4), 5.0, 12, []
    design = np.linalg.qr(rng.normal(size=(64, unknowns)))[0]
    for _ in range(400):
        noise = rng.normal(0, sigma, 64)
        left = (noise - design @ (design.T @ noise)).reshape(8, 8)
        variances.append(noise_model(left, np.ones((8, 8), bool), unknowns).variance_dn2)
    assert np.mean(variances) == pytest.approx(sigma**2, rel=0.03)

"""What residuals tell of the noise that made them."""

import numpy as np

from measure.noise.noise_model import influence_covariances, noise_model


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

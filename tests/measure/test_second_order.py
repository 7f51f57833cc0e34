"""The second order of a place's variance, against a mark whose integrals are known."""

import numpy as np
import pytest

from measure.matching.covariance import second_order


@pytest.mark.parametrize("noise_dn", [1.0, 10.0])
def test_second_order_of_a_gaussian_spot(noise_dn: float) -> None:
    """Of a spot of known width s its place and gain are unknown. With V the variance of a coordinate that of the gain
    is V / 2 s² of its square, and by the integrals of a Gaussian's derivatives the curvature is 3/2 V / s²."""
    gain, width = 100.0, 6.0
    row, col = np.mgrid[-70:71, -70:71].astype(float)
    col, row = col - 0.3, row + 0.2
    spot = np.exp(-(col**2 + row**2) / (2 * width**2))
    slopes = gain * spot * np.stack([col, row]) / width**2
    design = np.concatenate([slopes, np.stack([spot, np.ones_like(spot), col / 50, row / 50])])
    flat = design.reshape(len(design), -1)
    covariance = noise_dn**2 * np.linalg.inv(flat @ flat.T)
    variance = 2 * noise_dn**2 / (np.pi * gain**2)
    assert covariance[0, 0] == pytest.approx(variance, rel=0.01)
    share = second_order(design, np.ones_like(spot), np.ones(spot.shape, bool), covariance, np.zeros(len(design)))
    assert share == pytest.approx((3 / 2 + 2 / 2) * variance / width**2, rel=0.03)

import numpy as np

from measure.robust import damage


def test_damage_lies_about_its_speck_on_all_sides_alike() -> None:
    rng = np.random.default_rng(1)
    residuals = rng.standard_normal((41, 41))
    row, col = np.mgrid[:41, :41] - 20
    speck = 30 * np.exp(-(row**2 + col**2) / 4)
    residuals -= speck
    area = np.ones_like(residuals, dtype=bool)
    cut = damage(residuals, area, 3.2, 0.5)
    rows, cols = np.nonzero(cut)
    np.testing.assert_allclose((rows.mean(), cols.mean()), 20, atol=0.25)
    assert cut[speck > 1.5].all()
    assert not cut[np.hypot(row, col) > 5].any()
    np.testing.assert_array_equal(damage(residuals[::-1, ::-1], area, 3.2, 0.5)[::-1, ::-1], cut)

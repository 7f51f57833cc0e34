"""What residuals show of dust and scratches, on specks whose pixels are known."""

import numpy as np

from measure.noise.robust_estimation import damage


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


def test_where_compression_is_lossy_a_thin_tail_is_none_of_the_speck_and_its_neighbours_are() -> None:
    residuals = 0.5 * np.random.default_rng(2).standard_normal((41, 41))
    residuals[18:23, 18:23] += 60
    residuals[20, 23:35] += 6
    area = np.ones_like(residuals, dtype=bool)
    cut, cut_lossy = damage(residuals, area, 6.0, 0.4), damage(residuals, area, 6.0, 0.4, is_lossy=True)
    assert cut[20, 23:34].all()
    assert not cut_lossy[20, 28:].any()
    assert cut_lossy[18:23, 16:25].all()
    assert cut_lossy[:, :24].sum() > cut[:, :24].sum()

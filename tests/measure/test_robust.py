"""What residuals show of dust and scratches, on specks whose pixels are known."""

import numpy as np

from measure.noise.robust import damage, damage_where_lossy, tukey_loss, tukey_weights


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
    cut, cut_lossy = damage(residuals, area, 6.0, 0.4), damage_where_lossy(residuals, area, 6.0, 0.4)
    assert cut[20, 23:34].all()
    assert not cut_lossy[20, 28:].any()
    assert cut_lossy[18:23, 16:25].all()
    assert cut_lossy[:, :24].sum() > cut[:, :24].sum()


def test_tukeys_weights_are_the_published_ones_and_his_loss_has_them_as_slope() -> None:
    """Beaton and Tukey's biweight, with 4.685 standard deviations as its end: w = (1 - (r / c)²)², and rho' = r w."""
    share = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 2.0])
    residuals = 4.685 * 2.5 * share
    expected = [1.0, 0.87890625, 0.5625, 0.19140625, 0.0, 0.0]
    np.testing.assert_allclose(tukey_weights(residuals, 2.5), expected, atol=1e-12)
    step = 1e-5
    for residual, weight in zip(residuals, expected, strict=True):
        ends = [tukey_loss(np.array([residual + side * step]), 2.5) for side in (-1, 1)]
        np.testing.assert_allclose((ends[1] - ends[0]) / (2 * step), 2 * residual * weight, atol=1e-4)

"""Robust least squares against published weights, NumPy's own solutions, and data with planted outliers."""

import numpy as np
from numpy.typing import NDArray

from measure.noise.robust_estimation import (
    gauss_newton_step,
    least_distances,
    solution,
    student_weights,
    tukey_fit,
    tukey_loss,
    tukey_weights,
)


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


def test_students_weights_are_those_of_four_degrees_of_freedom() -> None:
    """(freedom + dimensions) / (freedom + squared distance): Lange, Little and Taylor 1989."""
    np.testing.assert_allclose(student_weights(np.array([0.0, 2.0, 16.0]), 2.0), [1.5, 1.0, 0.3])


def test_a_step_is_that_of_weighted_least_squares_in_any_units_and_damping_shortens_it() -> None:
    rng = np.random.default_rng(1)
    design, residuals = rng.standard_normal((5, 3, 40)), rng.standard_normal((5, 40))
    weights, units = rng.uniform(0.2, 1.0, (5, 40)), np.array([1.0, 1e4, 1e-4])
    step = gauss_newton_step(design, residuals, weights, 0.0)
    root = np.sqrt(weights)
    for number in range(5):
        exact = np.linalg.lstsq((design[number] * root[number]).T, residuals[number] * root[number])[0]
        np.testing.assert_allclose(step[number], exact, atol=1e-12)
    np.testing.assert_allclose(
        gauss_newton_step(design * units[:, None], residuals, weights, 0.1) * units,
        gauss_newton_step(design, residuals, weights, 0.1),
        rtol=1e-9,
    )
    alone = gauss_newton_step(design[:, :1], residuals, weights, 0.1)
    np.testing.assert_allclose(alone * 1.1, gauss_newton_step(design[:, :1], residuals, weights, 0.0))


def test_normal_equations_are_solved_for_what_is_free_and_refused_where_they_tell_nothing() -> None:
    design = np.random.default_rng(2).standard_normal((20, 3)) * [1.0, 1e5, 1e-5]
    truth, free = np.array([1.0, 2e-5, 3e5]), np.array([True, False, True])
    normal = design.T @ design
    found, held = solution(normal, normal @ truth, free | True), solution(normal, normal[:, free] @ truth[free], free)
    assert found is not None
    np.testing.assert_allclose(found, truth)
    assert held is not None
    np.testing.assert_allclose(held, [1.0, 0.0, 3e5])
    twice = design[:, [0, 0, 2]]
    assert solution(twice.T @ twice, truth, np.ones(3, bool)) is None
    assert solution(np.diag([1.0, 0.0, 1.0]), truth, np.ones(3, bool)) is None
    assert solution(np.diag([1.0, -1e-18, 1.0]), truth, np.ones(3, bool)) is None  # as rounding leaves it


def test_a_line_by_tukeys_weights_leaves_outliers_aside() -> None:
    along = np.arange(30.0)
    values = 3.0 - 0.2 * along + 0.01 * np.random.default_rng(3).standard_normal(30)
    values[[4, 11, 25]] += [5.0, -7.0, 9.0]
    fit = tukey_fit(np.stack([np.ones_like(along), along]), values, 20, 1e-3)
    np.testing.assert_allclose(fit.factors, [3.0, -0.2], atol=0.01)
    assert np.flatnonzero(fit.weights == 0.0).tolist() == [4, 11, 25]
    np.testing.assert_allclose(fit.residuals[[4, 11, 25]], [5.0, -7.0, 9.0], atol=0.05)


def test_least_distances_leave_false_places_aside() -> None:
    design, there = _mapped(FALSE)
    both = least_distances(np.stack([design, design]), np.stack([there, 2.0 * there]), 0.1, 30)
    np.testing.assert_allclose(both[0], MAP, atol=0.02)
    np.testing.assert_allclose(both[1], 2.0 * MAP, atol=0.04)


def test_least_distances_hold_to_what_a_map_usually_is() -> None:
    design, there = _mapped([])
    usual = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    held = least_distances(design, there, 5.0, 6, 1e9 * np.diag([0.0, 1.0, 1.0]), usual)
    np.testing.assert_allclose(held[1:], np.eye(2), atol=1e-4)
    np.testing.assert_allclose(least_distances(design, there, 5.0, 6, 1e-9 * np.diag([0.0, 1.0, 1.0]), usual), MAP)


MAP = np.array([[7.0, -4.0], [1.02, 0.1], [-0.1, 0.97]])
FALSE = [2, 7]


def _mapped(false: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    design = np.column_stack([np.ones(12), np.random.default_rng(4).uniform(-50, 50, (12, 2))])
    there = design @ MAP
    there[false] += 40.0
    return design, there

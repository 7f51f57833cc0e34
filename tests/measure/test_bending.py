"""Bendings of known variance, seen under noise of known covariance."""

import numpy as np
import pytest
from numpy.typing import NDArray

from measure.tie_points.multi_image import Bending, bending_variance

Array = NDArray[np.float64]

ON_PLACE = np.array([[-0.25, 0.02, -0.2, 0.01, 0.0, 0.03], [0.0, 0.01, 0.02, -0.22, 0.03, -0.25]])
ISOTROPIC = np.array([[0.75, 0.0, 0.25], [0.0, 1.0, 0.0], [0.25, 0.0, 0.75]])  # of a u² + b uv + c v², Z'' isotropic


def patches(rng: np.random.Generator, along: Array, count: int = 300) -> tuple[list[Bending], Array]:
    """Patches that bend along a direction (2,), px at their rims; and what that does to their places (n, 2)."""
    variance = np.kron(np.outer(along, along), ISOTROPIC)
    bendings, moved = [], []
    for _ in range(count):
        root = rng.normal(size=(6, 6))
        response = root @ root.T + 6.0 * np.eye(6)
        noise = response / 4.0
        bending = rng.multivariate_normal(np.zeros(6), variance)
        view = response @ bending + rng.multivariate_normal(np.zeros(6), noise)
        bendings.append(Bending(view, response, noise, ON_PLACE))
        moved.append(ON_PLACE @ bending)
    return bendings, np.array(moved)


def test_places_are_freed_of_the_bending_and_what_stays_is_as_large_as_stated() -> None:
    bendings, moved = patches(np.random.default_rng(1), np.array([0.5, 0.2]))
    variance = bending_variance(bendings)
    assert variance[1, 1] == pytest.approx(0.25, rel=0.3)
    assert variance[4, 4] == pytest.approx(0.04, rel=0.3)
    assert variance[1, 4] == pytest.approx(0.10, rel=0.3)
    found = [each.estimated(variance) for each in bendings]
    left = moved - np.array([shift for shift, _ in found])
    assert np.mean(left**2) < 0.5 * np.mean(moved**2)
    assert np.cov(left.T) == pytest.approx(np.mean([rest for _, rest in found], axis=0), abs=0.2 * np.var(left[:, 0]))


def test_without_noise_there_is_nothing_to_weigh_by() -> None:
    assert Bending(np.zeros(6), np.eye(6), np.eye(6), ON_PLACE).has_noise
    assert not Bending(np.zeros(6), np.eye(6), np.zeros((6, 6)), ON_PLACE).has_noise
    assert not Bending(np.zeros(6), np.eye(6), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -0.1]), ON_PLACE).has_noise


def test_flat_ground_and_few_patches_change_next_to_nothing() -> None:
    rng = np.random.default_rng(2)
    bendings, _ = patches(rng, np.zeros(2))
    assert np.abs(bending_variance(bendings)).max() < 0.02
    few, _ = patches(rng, np.array([0.5, 0.2]), 10)
    shift, left = few[0].estimated(bending_variance(few))
    assert not shift.any()
    assert not left.any()

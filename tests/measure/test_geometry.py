"""Affine transformations, against points taken through them by hand."""

import numpy as np
import pytest

from measure.geometry import Affine

QUARTER = Affine(np.array([[0.0, -2.0, 5.0], [2.0, 0.0, 1.0]]))  # a quarter turn at twice the size, then (5, 1) farther


def test_an_affine_transformation_takes_points_there_and_back() -> None:
    points = np.array([[[1.0, 0.0], [0.0, 3.0]]])
    np.testing.assert_allclose(QUARTER.apply(points), [[[5.0, 3.0], [-1.0, 1.0]]])
    np.testing.assert_allclose(QUARTER.inverse.apply(QUARTER.apply(points)), points)
    assert QUARTER.scale == pytest.approx(2.0)
    assert Affine.from_linear(np.diag([4.0, -1.0])).scale == pytest.approx(2.0)


def test_of_two_in_turn_the_first_is_taken_first() -> None:
    stretch, point = Affine.from_linear(np.diag([3.0, 1.0]), (0.0, 1.0)), np.array([1.0, 1.0])
    np.testing.assert_allclose(QUARTER.compose(stretch).apply(point), [1.0, 7.0])
    np.testing.assert_allclose(stretch.compose(QUARTER).apply(point), [9.0, 4.0])

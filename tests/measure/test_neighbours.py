"""Points of two frames over ground with relief, made up by a closed form: those that moved unlike their neighbours."""

import numpy as np
from numpy.typing import NDArray

from measure.tie_points.verification import neighbour_outliers

Array = NDArray[np.float64]

TREES_PX = 25.0  # from row to row


def seen_twice(rng: np.random.Generator, relief: float, count: int = 200) -> tuple[Array, Array]:
    """Places (count, 2) in two frames of 1500 px, flying along the columns: height moves them along the rows of these,
    by relief px, rms, in hills of some 300 px; 0.1 px of noise."""
    first = rng.uniform(0.0, 1500.0, (count, 2))
    phases = rng.uniform(0.0, 2 * np.pi, 6)
    turns = rng.normal(0.0, 1 / 150.0, (6, 2))
    height = relief * np.sqrt(2 / 6) * np.sin(first @ turns.T + phases).sum(axis=1)
    turned = np.array([[0.0, -1.01], [0.99, 0.0]])
    second = first @ turned.T + [1600.0, -300.0] + np.outer(height, [1.0, 0.0]) + rng.normal(0.0, 0.1, first.shape)
    return first, second


def test_a_tree_of_the_next_row_is_an_outlier() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        first, second = seen_twice(rng, relief=1.0)
        second[7] += [TREES_PX, 0.0]
        assert np.flatnonzero(neighbour_outliers(first, second)).tolist() == [7]


def test_in_which_frame_a_point_is_wrong_does_not_matter() -> None:
    first, second = seen_twice(np.random.default_rng(2), relief=2.0)
    first[7] += [0.0, 400.0]
    assert np.flatnonzero(neighbour_outliers(first, second)).tolist() == [7]


def test_a_false_point_takes_none_of_its_neighbours_with_it() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        first, second = seen_twice(rng, relief=1.0)
        false = np.sort(rng.choice(len(first), 8, replace=False))
        second[false] += rng.choice([-60.0, 60.0, 400.0], (8, 1)) * [1.0, 0.0]
        assert np.flatnonzero(neighbour_outliers(first, second)).tolist() == false.tolist()


def test_hills_are_no_outliers() -> None:
    rng = np.random.default_rng(3)
    alarms = sum(
        int(neighbour_outliers(*seen_twice(rng, relief)).sum()) for relief in (0.0, 2.0, 20.0) for _ in range(20)
    )
    assert alarms <= 4, "of 12,000 points 1.2 may be"


def test_too_few_points_tell_nothing() -> None:
    first, second = seen_twice(np.random.default_rng(4), relief=0.0, count=20)
    second[7] += [0.0, 400.0]
    assert not neighbour_outliers(first, second).any()

"""The pattern of the targets is recognised under a wrong prediction, missing and false marks; noise is not."""

import numpy as np

from pipeline.identification import assign, recognise


def test_pattern_is_named_right_with_targets_missing_and_marks_that_are_none() -> None:
    rng = np.random.default_rng(1)
    for _ in range(25):
        n, size = int(rng.integers(8, 60)), 3000.0
        predicted = rng.uniform(0.0, size, (n, 2))
        angle, scale = rng.normal(0.0, 0.03), 1.0 + rng.normal(0.0, 0.03)
        turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        true = predicted @ turn.T + rng.normal(0.0, 200.0, 2)
        tilt = (true - size / 2) / size
        true += 0.01 * size * tilt * tilt[:, :1] * rng.normal() + rng.normal(0.0, 3.0, true.shape)
        kept = np.flatnonzero(rng.random(n) > 0.2)
        found = np.concatenate([true[kept], rng.uniform(0.0, size, (int(0.3 * n), 2))])
        order = rng.permutation(len(found))
        matrix = recognise(predicted, found[order])
        assert matrix is not None
        pairs = assign(predicted @ matrix[:, :2].T + matrix[:, 2], found[order], 40.0)
        right = sum(order[j] < len(kept) and kept[order[j]] == i for i, j in pairs)
        assert right >= 0.8 * len(kept)


def test_marks_of_another_field_are_not_recognised() -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        assert recognise(rng.uniform(0.0, 3000.0, (25, 2)), rng.uniform(0.0, 3000.0, (25, 2))) is None


def test_assignment_is_one_to_one_and_gated() -> None:
    predicted = np.array([[0.0, 0.0], [1.0, 0.0], [100.0, 0.0]])
    found = np.array([[0.9, 0.0], [50.0, 0.0]])
    assert assign(predicted, found, 5.0) == [(1, 0)]

"""The pattern of the targets is recognised under a wrong prediction, missing and false marks; noise is not."""

import numpy as np
from studies import parametrize_with_studies

from pipeline.measuring.target_identification import assign, log10_of_chance, recognise


def test_pattern_is_named_right_with_targets_missing_and_marks_that_are_none() -> None:
    rng = np.random.default_rng(1)
    for _ in range(12):
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
        placement = recognise(predicted, found[order], 1500.0)
        assert placement is not None
        pairs = assign(placement[0], found[order], 40.0)
        right = sum(order[j] < len(kept) and kept[order[j]] == i for i, j in pairs)
        assert right >= 0.8 * len(kept)


@parametrize_with_studies(("targets", "strays"), [(4, 0), (8, 16), (25, 0), (25, 50)], quick=(1,))
def test_agreement_by_chance_is_distinguished_from_a_pattern(targets: int, strays: int) -> None:
    """A fifth of the pattern's marks missing; the other marks are placed as well as chance allows."""
    rng = np.random.default_rng([2, targets, strays])
    for _ in range(2):
        places = rng.uniform(0.0, 3000.0, (targets, 2))
        view = places[: max(round(0.8 * targets), 4)] + rng.normal(0.0, 1.0, (max(round(0.8 * targets), 4), 2))
        marks = np.concatenate([view, rng.uniform(0.0, 3000.0, (strays, 2))])
        placement = recognise(places, marks, 1500.0)
        assert placement is not None
        assert log10_of_chance(places, marks, 6.0, placement[1]) < -1.0
        other = rng.uniform(0.0, 3000.0, marks.shape)
        placement = recognise(places, other, 1500.0)
        for gate_px in (6.0, 30.0, 90.0):
            assert placement is None or (log10_of_chance(placement[0], other, gate_px, placement[1]) > -1.0)


def test_assignment_is_one_to_one_and_gated() -> None:
    predicted = np.array([[0.0, 0.0], [1.0, 0.0], [100.0, 0.0]])
    found = np.array([[0.9, 0.0], [50.0, 0.0]])
    assert assign(predicted, found, 5.0) == [(1, 0)]

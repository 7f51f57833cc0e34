"""The second method on marks drawn by brute force: as far off as noise makes it, farther where a mark is damaged."""

from dataclasses import replace

import numpy as np
import pytest
from brute_marks import Array, brute_picture, placed

from measure.match_options import MatchOptions
from measure.matching import match
from measure.shapes import Mark, MarkShape, polygon, ring_cross

SIZE, CONTRAST = 41, 500.0
RING_CROSS = MarkShape(ring_cross(1.0, 0.2, 1.6, 0.15))
WING = MarkShape(polygon(((0.0, 0.0), (1.5, 0.7), (1.5, -0.7))))
OPTIONS = MatchOptions(linear_sigma=0.05)


def chances(mark: Mark, grey: Array, place: Array, options: MatchOptions, count: int) -> Array:
    """The probabilities of the differences in so many noisy pictures."""
    rng = np.random.default_rng(7)
    found = []
    for _ in range(count):
        fit = match(1000 + CONTRAST * grey + rng.normal(0, 20.0, grey.shape), (0, 0), mark, place, options)
        assert fit.edges is not None
        found.append(fit.edges.chance)
    return np.array(found)


@pytest.mark.parametrize(("mark", "options"), [(RING_CROSS, OPTIONS), (WING, replace(OPTIONS, freedom="shift"))])
def test_noise_alone_makes_every_probability_as_likely(mark: MarkShape, options: MatchOptions) -> None:
    place = placed(10.0, (20.2, 19.7))
    found = chances(mark, brute_picture(mark, place, SIZE, SIZE, 1.0), place, options, 40)
    assert 0.33 < found.mean() < 0.67  # 0.5 within 3.7 of its standard deviations
    assert found.min() > 1e-4


def test_damage_that_no_mask_takes_out_is_seen() -> None:
    place = placed(10.0, (20.2, 19.7))
    grey = brute_picture(RING_CROSS, place, SIZE, SIZE, 1.0)
    grey[17:19, 21:34] = 1.0  # a scratch beside one arm
    assert chances(RING_CROSS, grey, place, replace(OPTIONS, damage_rounds=0), 5).max() < 1e-6

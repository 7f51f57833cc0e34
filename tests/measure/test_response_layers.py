"""What share of all places answers as strongly as one."""

import numpy as np

from measure.search.response_layers import HeldReaches, Layer

ORIGIN = np.array([7, 3])
MAP = np.random.default_rng(5).normal(size=(40, 50)).astype(np.float32)


def test_share_of_a_place_is_its_rank() -> None:
    exact = Layer(MAP, ORIGIN, 4.0, HeldReaches()).within(0.0)
    for rank, place in enumerate(np.argsort(-MAP, axis=None)[:60]):
        row, col = divmod(int(place), MAP.shape[1])
        assert np.isclose(exact.share(np.array([col + 0.3, row - 0.4]) + ORIGIN), (rank + 1) / MAP.size)


def test_places_about_the_strongest_answer_as_it_does() -> None:
    single = np.zeros_like(MAP)
    single[20, 30] = 1.0
    near = Layer(single, ORIGIN, 4.0, HeldReaches()).within(2.0)
    assert np.isclose(near.share(np.array([31.0, 19.0]) + ORIGIN), near.area_px / MAP.size)
    assert near.share(np.array([34.0, 20.0]) + ORIGIN) == 1.0


def test_only_the_reaches_asked_for_last_are_held() -> None:
    held = HeldReaches(2 * MAP.nbytes)
    layers = [Layer(k * MAP, ORIGIN, 4.0, held) for k in range(3)]
    first, second, third = (layer.wide for layer in layers)
    assert layers[2].wide is third
    assert layers[1].wide is second
    assert layers[0].wide is not first
    np.testing.assert_array_equal(layers[0].wide.map, first.map)
    assert layers[2].wide is not third

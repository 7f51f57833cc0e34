"""What share of all places answers as strongly as one."""

import numpy as np

from measure.detection.candidates import Responses
from measure.detection.correlation import Map
from measure.detection.response_layers import Layer, Reach, layers_of
from measure.detection.scan_maps import Held

ORIGIN = np.array([7, 3])
MAP = np.random.default_rng(5).normal(size=(40, 50)).astype(np.float32)


def layer(map_: Map, held: Held[Reach]) -> Layer:
    return layers_of(Responses({(0, 1): map_}, 1, ORIGIN[None]), held)[0, 1]


def test_share_of_a_place_is_its_rank() -> None:
    exact = layer(MAP, Held(1 << 30)).within(0.0)
    for rank, place in enumerate(np.argsort(-MAP, axis=None)[:60]):
        row, col = divmod(int(place), MAP.shape[1])
        assert np.isclose(exact.share(np.array([col + 0.3, row - 0.4]) + ORIGIN), (rank + 1) / MAP.size)


def test_places_about_the_strongest_answer_as_it_does() -> None:
    single = np.zeros_like(MAP)
    single[20, 30] = 1.0
    near = layer(single, Held(1 << 30)).within(2.0)
    assert np.isclose(near.share(np.array([31.0, 19.0]) + ORIGIN), near.area_px / MAP.size)
    assert near.share(np.array([34.0, 20.0]) + ORIGIN) == 1.0


def test_only_the_reaches_asked_for_last_are_held() -> None:
    held = Held[Reach](2 * MAP.nbytes)
    layers = [layer(k * MAP, held) for k in range(3)]
    first, second, third = (each.within(4.0) for each in layers)
    assert layers[2].within(4.0) is third
    assert layers[1].within(4.0) is second
    assert layers[0].within(4.0) is not first
    np.testing.assert_array_equal(layers[0].within(4.0).map, first.map)
    assert layers[2].within(4.0) is not third

"""Responses of a reduced scan to marks: maps of which a part is cached, and the shares of places that answer so."""

from pathlib import Path

import numpy as np

from measure.detection.correlation import WIDE, Map
from measure.detection.responses import ByteCache, Dilation, ResponseMap, Responses, ScanMaps, TemplateSet
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan

ORIGIN = np.array([7, 3])
MAP = np.random.default_rng(5).normal(size=(40, 50)).astype(np.float32)


def response_map(map_: Map, cache: ByteCache[Dilation]) -> ResponseMap:
    return Responses({(0, 1): map_}, (0,), 1, cache, ORIGIN[None]).by_key[0, 1]


def test_share_of_a_place_is_its_rank() -> None:
    exact = response_map(MAP, ByteCache(1 << 30)).dilated(0.0)
    for rank, place in enumerate(np.argsort(-MAP, axis=None)[:60]):
        row, col = divmod(int(place), MAP.shape[1])
        assert np.isclose(exact.share(np.array([col + 0.3, row - 0.4]) + ORIGIN), (rank + 1) / MAP.size)


def test_places_about_the_strongest_answer_as_it_does() -> None:
    single = np.zeros_like(MAP)
    single[20, 30] = 1.0
    near = response_map(single, ByteCache(1 << 30)).dilated(2.0)
    assert np.isclose(near.share(np.array([31.0, 19.0]) + ORIGIN), near.area_px / MAP.size)
    assert near.share(np.array([34.0, 20.0]) + ORIGIN) == 1.0


def test_only_the_dilations_used_last_are_cached() -> None:
    cache = ByteCache[Dilation](2 * MAP.nbytes)
    layers = [response_map(k * MAP, cache) for k in range(3)]
    first, second, third = (each.dilated(4.0) for each in layers)
    assert layers[2].dilated(4.0) is third
    assert layers[1].dilated(4.0) is second
    assert layers[0].dilated(4.0) is not first
    np.testing.assert_array_equal(layers[0].dilated(4.0).map, first.map)
    assert layers[2].dilated(4.0) is not third


RNG = np.random.default_rng(4)
SCAN = Scan(Path("noise.tif"), WholePicture(RNG.integers(0, 65535, (90, 110, 3), np.uint16)), NO_TAGS)
CHIPS = RNG.normal(size=(2, 9, 9))
TURNED = [np.rot90(chip, turn) for turn in range(4) for chip in CHIPS]  # in one pose after another
SET = TemplateSet(TURNED, [2.0, 3.0] * 4, (1, -1), WIDE, 100.0)
MAP_BYTES = 4 * 90 * 110


def maps(cache: ByteCache[Map]) -> ScanMaps:
    return ScanMaps(SCAN, 1, SET, cache)


def test_a_map_is_the_strongest_correlation_of_all_channels() -> None:
    given, inner = maps(ByteCache(100 * MAP_BYTES)), (slice(20, 60), slice(20, 80))
    for (kind, sign), map_ in given.items():
        whole = [SCAN.window(-4, -4, 118, 98, weights) for weights in np.eye(3).tolist()]
        detail = SET.details_px[kind]
        answers = [WIDE.correlated(WIDE.flattened(each, detail, 100.0), TURNED[kind], detail) for each in whole]
        assert map_.shape == (90, 110)
        np.testing.assert_array_equal(map_[inner], np.max([sign * each[inner] for each in answers], axis=0))


def test_what_is_not_cached_any_more_is_made_again() -> None:
    every, few = maps(ByteCache(100 * MAP_BYTES)), maps(ByteCache(5 * MAP_BYTES))
    assert few[0, 1] is few[0, 1]
    first = few[0, 1]
    for key, map_ in every.items():
        np.testing.assert_array_equal(few[key], map_)
    assert few[0, 1] is not first

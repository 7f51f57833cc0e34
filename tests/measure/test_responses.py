"""Responses of a reduced scan to marks: maps of which a part is cached, and the shares of places that answer so."""

import gc
import weakref
from pathlib import Path

import numpy as np
from brute_marks import brute_picture
from scipy import ndimage

from measure.detection.correlation import CLOSE, GRAINY, WIDE, Map, Surroundings, correlation
from measure.detection.responses import FULL, ByteCache, Dilation, ResponseMap, Responses, ScanMaps, TemplateSet
from measure.marks.shapes import MarkShape, cross, ring_cross
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan

ORIGIN = np.array([7, 3])
MAP = np.random.default_rng(5).normal(size=(40, 50)).astype(np.float32)


def responses_to(
    surroundings: Surroundings, grey: np.ndarray, template: np.ndarray, detail_px: float, faint_dn: float
) -> Map:
    """The correlation of a picture, freed of its ground, with a template."""
    flat = surroundings.flattened(grey.astype(np.float32), detail_px, faint_dn)
    return correlation(flat, *surroundings.pattern(template, detail_px, flat))


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


def test_responses_are_freed_with_the_search_and_not_by_the_next_garbage_collection() -> None:
    responses = Responses({(0, 1): MAP}, (0,), 1, ByteCache[Dilation](1 << 30))
    assert responses.by_key[0, 1].dilated(2.0).map.shape == MAP.shape
    alive = weakref.ref(responses)
    gc.disable()
    try:
        del responses
        assert alive() is None
    finally:
        gc.enable()


RNG = np.random.default_rng(4)
SCAN = Scan(Path("noise.tif"), WholePicture(RNG.integers(0, 65535, (90, 110, 3), np.uint16)), NO_TAGS)
CHIPS = RNG.normal(size=(2, 9, 9))
TURNED = [np.rot90(chip, turn) for turn in range(4) for chip in CHIPS]  # in one pose after another
SET = TemplateSet(TURNED, [2.0, 3.0] * 4, (1, -1), WIDE, 100.0)
MAP_BYTES = 4 * 90 * 110


def test_a_small_scan_caches_a_few_maps_of_its_size_and_a_large_one_what_the_effort_allows() -> None:
    assert FULL.scan_cache_bytes(1000**2) == 32 * 4 * 1000**2
    assert FULL.scan_cache_bytes(20_000**2) == FULL.cache_bytes


def maps(cache: ByteCache[Map]) -> ScanMaps:
    return ScanMaps(SCAN, 1, SET, cache)


def test_a_map_is_the_strongest_correlation_of_all_channels() -> None:
    given, inner = maps(ByteCache(100 * MAP_BYTES)), (slice(20, 60), slice(20, 80))
    for (kind, sign), map_ in given.items():
        whole = [SCAN.window(-4, -4, 118, 98, weights) for weights in np.eye(3).tolist()]
        detail = SET.details_px[kind]
        answers = [responses_to(WIDE, each, TURNED[kind], detail, 100.0) for each in whole]
        assert map_.shape == (90, 110)
        np.testing.assert_array_equal(map_[inner], np.max([sign * each[inner] for each in answers], axis=0))


def test_what_is_not_cached_any_more_is_made_again() -> None:
    every, few = maps(ByteCache(100 * MAP_BYTES)), maps(ByteCache(5 * MAP_BYTES))
    assert few[0, 1] is few[0, 1]
    first = few[0, 1]
    for key, map_ in every.items():
        np.testing.assert_array_equal(few[key], map_)
    assert few[0, 1] is not first


def test_a_faint_mark_next_to_the_frames_edge_is_what_answers_most() -> None:
    """The edge is nine times as strong as the mark on overexposed film."""
    rng = np.random.default_rng(1)
    mark = MarkShape(ring_cross(0.5, 0.1, 0.8, 0.1), "light")
    linear = np.diag([12.0, -12.0])
    grey = np.full((180, 180), 2000.0)
    grey[30:, 30:] = 56000.0
    place = np.array([46.0, 47.0])  # its ring ends six pixels from both edges
    grey += 6000.0 * brute_picture(mark, np.column_stack([linear, place]), 180, 180, 0.8)
    grey += rng.normal(0.0, 1000.0, grey.shape)
    template = brute_picture(mark, np.column_stack([linear, [12.0, 12.0]]), 25, 25, 0.6)
    response = responses_to(WIDE, grey, template, 1.2, 130.0)
    row, col = np.unravel_index(int(response.argmax()), response.shape)
    assert abs(col + 12 - place[0]) <= 1
    assert abs(row + 12 - place[1]) <= 1
    highest = response.max()
    response[row - 3 : row + 4, col - 3 : col + 4] = 0.0
    assert response.max() < 0.6 * highest


def test_lines_as_fine_as_the_grain_answer_at_closer_matching_by_what_the_grain_hides_least() -> None:
    """Pixels are alike about the crosses, which hides what is coarse of them."""
    rng = np.random.default_rng(2)
    mark, linear = MarkShape(cross(1.75, 0.12, 0.25, 45.0), "light"), np.diag([7.8, -7.8])
    places = np.array([[60.3, 60.0], [60.1, 240.4], [239.8, 60.2], [240.0, 239.7]])
    grain = ndimage.gaussian_filter(rng.standard_normal((300, 300)), 1.0)
    grey = 20000.0 + 1300.0 * grain / grain.std() + rng.normal(0.0, 300.0, grain.shape)
    for place in places:
        grey += 3100.0 * brute_picture(mark, np.column_stack([linear, place]), 300, 300, 0.6)
    template = brute_picture(mark, np.column_stack([linear, [16.0, 16.0]]), 33, 33, 0.6)

    def stronger_elsewhere(surroundings: Surroundings) -> int:
        response = responses_to(surroundings, grey, template, 1.0, 130.0)
        near = [np.s_[round(y) - 18 : round(y) - 13, round(x) - 18 : round(x) - 13] for x, y in places]
        weakest = min(response[each].max() for each in near)
        for each in near:
            response[each] = 0.0
        return int((response > weakest).sum())

    assert stronger_elsewhere(GRAINY) <= 2
    assert stronger_elsewhere(CLOSE) > 50

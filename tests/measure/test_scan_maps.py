"""The maps of a whole scan, of which only a part is held."""

from pathlib import Path

import numpy as np

from measure.detection.correlation import WIDE, Map
from measure.detection.scan_maps import Held, ScanMaps, Sought
from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan

RNG = np.random.default_rng(4)
SCAN = Scan(Path("noise.tif"), WholePicture(RNG.integers(0, 65535, (90, 110, 3), np.uint16)), NO_TAGS)
CHIPS = RNG.normal(size=(2, 9, 9))
TURNED = [np.rot90(chip, turn) for turn in range(4) for chip in CHIPS]  # in one pose after another
SOUGHT = Sought(TURNED, [2.0, 3.0] * 4, (1, -1), WIDE, 100.0)
MAP_BYTES = 4 * 90 * 110


def maps(held: Held[Map]) -> ScanMaps:
    return ScanMaps(SCAN, 1, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), SOUGHT, held)


def test_a_map_is_the_strongest_correlation_of_all_channels() -> None:
    given, inner = maps(Held(100 * MAP_BYTES)), (slice(20, 60), slice(20, 80))
    for (kind, sign), map_ in given.items():
        whole = [SCAN.window(-4, -4, 118, 98, weights) for weights in np.eye(3).tolist()]
        detail = SOUGHT.details_px[kind]
        answers = [WIDE.correlated(WIDE.flattened(each, detail, 100.0), TURNED[kind], detail) for each in whole]
        assert map_.shape == (90, 110)
        np.testing.assert_array_equal(map_[inner], np.max([sign * each[inner] for each in answers], axis=0))


def test_what_is_not_held_any_more_is_made_again() -> None:
    every, held = maps(Held(100 * MAP_BYTES)), Held[Map](5 * MAP_BYTES)
    few = maps(held)
    few.expect((0, 1), (2, 3, 4, 5, 6, 7))
    assert few[0, 1] is few[0, 1]
    first = few[0, 1]
    for key, map_ in every.items():
        np.testing.assert_array_equal(few[key], map_)
    assert few[0, 1] is not first

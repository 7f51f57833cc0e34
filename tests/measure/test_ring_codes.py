"""Ring codes read in any rotation, under perspective, in both polarities; other things about a dot are no code."""

from pathlib import Path

import numpy as np
import pytest
from drawn import drawn, scan_of, transformed
from numpy.typing import NDArray

from measure.scans.cache import WholePicture
from measure.scans.metadata import NO_TAGS
from measure.scans.scan import Scan
from measure.targets.block_search import Candidate
from measure.targets.ring_codes import RingCode, read_code

Array = NDArray[np.float64]
SIZE = 121
CENTER = np.array([60.3, 59.6])
SHAPE = np.array([[11.0, 2.5], [-1.0, 7.0]])
EIGHT = RingCode(8, (2.6, 4.1))
TWELVE = RingCode()


def ringed(number: int, code: RingCode, turn: float, light: bool = False, tilt: Array | None = None) -> Scan:
    """A dot with the code's segments about it, the first one at an angle `turn`, clockwise as seen; tilt (2,): how fast
    the scale changes over the picture, per px."""
    inverse = np.linalg.inv(SHAPE)
    bits = np.array([number >> bit & 1 for bit in range(code.bits)[::-1]], bool)

    def inside(col: Array, row: Array) -> Array:
        right, down = col - CENTER[0], row - CENTER[1]
        nearer = 1.0 if tilt is None else 1.0 + tilt[0] * right + tilt[1] * down
        x, y = transformed(inverse, right / nearer, down / nearer)
        radius, angle = np.hypot(x, y), np.arctan2(y, x)
        segment = (np.floor((angle - turn) / (2 * np.pi) * code.bits)).astype(int) % code.bits
        ring = (radius > code.ring[0]) & (radius < code.ring[1]) & bits[segment]
        return np.asarray((radius < 1) | ring)

    picture = drawn(inside, SIZE, SIZE, 0.9, fineness=4)
    noise = np.random.default_rng(number).normal(0, 600, picture.shape)
    return scan_of((12000 + 30000 * picture if light else 45000 - 30000 * picture) + noise)


def dot(light: bool = False, spin: float = 0.0) -> Candidate:
    """The dot as a search finds it: an ellipse, whose axes say nothing of its circle's turn."""
    turn = np.array([[np.cos(spin), -np.sin(spin)], [np.sin(spin), np.cos(spin)]])
    return Candidate(CENTER + np.array([0.2, -0.1]), 1.03 * SHAPE @ turn, 30000.0 if light else -30000.0)


@pytest.mark.parametrize(("code", "number"), [(EIGHT, 31), (EIGHT, 37), (EIGHT, 85), (TWELVE, 0b000001011011)])
def test_a_code_is_the_same_in_every_rotation(code: RingCode, number: int) -> None:
    for light, turn in ((False, 0.0), (True, 1.1), (False, 2.3), (True, 3.9), (False, 5.5)):
        scan = ringed(number, code, turn, light)
        assert read_code(scan, dot(light, spin=1.7 * turn), code) == number
        assert read_code(scan, replace_hand(dot(light)), code) == number


def replace_hand(candidate: Candidate) -> Candidate:
    """The same ellipse with its second axis the other way."""
    return Candidate(candidate.center_px, candidate.pixel_from_disk * (1.0, -1.0), candidate.contrast_dn)


def test_under_perspective() -> None:
    """The scale changes by a fifth over the ring."""
    scan = ringed(37, EIGHT, 0.7, tilt=np.array([0.0012, -0.0016]))
    assert read_code(scan, dot(), EIGHT) == 37


def test_every_number_of_eight_bits_is_read_as_the_least_of_its_rotations() -> None:
    for number in (1, 7, 19, 91, 127, 200):
        least = min((number << turn | number >> (8 - turn)) & 255 for turn in range(8))
        assert EIGHT.least_turn(number) == least
        assert read_code(ringed(number, EIGHT, 0.3), dot(), EIGHT) == least


def test_what_is_no_code() -> None:
    assert read_code(ringed(0, EIGHT, 0.0), dot(), EIGHT) is None  # a plain dot
    assert read_code(ringed(255, EIGHT, 0.0), dot(), EIGHT) is None  # a plain ring
    assert read_code(ringed(37, EIGHT, 0.0), dot(light=True), EIGHT) is None  # of the other polarity
    assert read_code(ringed(37, EIGHT, 0.0), dot(), RingCode(9, (2.6, 4.1))) is None  # of other segments


def test_impossible_codes_are_refused() -> None:
    with pytest.raises(ValueError, match="bits are 2"):
        RingCode(2)
    with pytest.raises(ValueError, match="inner one first"):
        RingCode(12, (3.0, 2.0))


def test_green_alone_is_the_grey_value_of_a_scan_requested_it() -> None:
    colours = np.random.default_rng(8).integers(0, 65535, (20, 30, 3)).astype(np.uint16)
    scan = Scan(Path("colours.tif"), WholePicture(colours), NO_TAGS)
    before = scan.window(2, 3, 10, 8)
    np.testing.assert_array_equal(scan.green_channel().window(2, 3, 10, 8), colours[3:11, 2:12, 1])
    np.testing.assert_array_equal(scan.window(2, 3, 10, 8), before)
    grey = scan_of(colours[..., 0].astype(float))
    np.testing.assert_array_equal(grey.green_channel().window(0, 0, 30, 20), colours[..., 0])


def test_the_published_choice_of_numbers() -> None:
    """As many as the published generator of the patent's codes gives: 516 of 14 bits."""
    assert len(RingCode(14).published_numbers()) == 516
    code = RingCode()
    numbers = code.published_numbers()
    assert all(code.least_turn(number) == number for number in numbers)


def test_a_ring_viewed_from_behind() -> None:
    code = RingCode()
    segments = np.array([0, 0, 0, 0, 0, 1, 0, 1, 1, 1, 0, 0], bool)
    assert code.mirrored(code.number(segments[::-1])) == code.number(segments)
    assert code.number(segments[::-1]) != code.number(segments)

"""What marks tell of one another's blur, size and rotation, against such drawn at random about the scan's own."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from measure.fiducials.mark_comparison import (
    SharedBlur,
    SharedShape,
    Touch,
    shared_blurs,
    shared_shapes,
    touch_of_round,
)

PIXEL = 1 / 12


def fits(seen_px: Any, sigmas: Any) -> list[Any]:
    """As matches have them: seen_px with the pixel's share."""
    blurs = np.sqrt(np.asarray(seen_px) ** 2 - PIXEL)
    return [SimpleNamespace(blur_px=blur, blur_sigma=sigma) for blur, sigma in zip(blurs, sigmas, strict=True)]


def test_a_faint_mark_gets_the_blur_of_the_others_and_those_need_none() -> None:
    shared = shared_blurs(fits([1.2, 1.2, 1.21, 1.19, 0.95], [0.01, 0.01, 0.02, 0.02, 0.2]))
    assert shared[:4] == [None] * 4
    assert shared[4] is not None
    assert np.hypot(shared[4].blur_px, np.sqrt(PIXEL)) == pytest.approx(1.2, rel=0.01)
    assert not shared[4].differs


def test_marks_of_one_blur_are_rarely_doubted_and_another_blur_is() -> None:
    rng = np.random.default_rng(1)
    doubted, found = 0, 0
    for _ in range(300):
        sigmas = rng.uniform(0.01, 0.15, 8)
        own = 1.1 * np.exp(rng.normal(0, np.hypot(sigmas, 0.05)))
        doubted += any(each is not None and each.differs for each in shared_blurs(fits(own, sigmas)))
        own[0], sigmas[0] = 0.6, 0.08
        shared = shared_blurs(fits(own, sigmas))[0]
        found += shared is not None and shared.differs
    assert doubted <= 12  # 1 in 100, and more for how much they differ is an estimate itself
    assert found > 270


def test_how_much_blurs_differ_from_mark_to_mark_comes_out_as_it_was_drawn() -> None:
    """By the moments of marks that tell their blurs unequally well: the square is unbiased."""
    rng, between, squares = np.random.default_rng(6), 0.25, []
    sigmas = np.array([0.03, 0.05, 0.08, 0.12, 0.2, 0.2, 0.1])
    for _ in range(400):
        own = 1.1 * np.exp(rng.normal(0, np.hypot(sigmas, between)))
        shared = shared_blurs(fits(np.append(own, 1.1), [*sigmas, 0.3]))[-1]
        assert shared is not None
        squares.append(shared.sigma**2)
    of_mean = 1 / np.sum(1 / (sigmas**2 + between**2 + 0.05**2))
    expected = between**2 + 0.05**2 + of_mean
    assert np.mean(squares) == pytest.approx(expected, rel=0.08)


def test_a_match_with_the_others_blur_rarely_contradicts_it_unless_its_own_is_another() -> None:
    rng, others_sigma, own_sigma = np.random.default_rng(3), 0.06, 0.1
    result, weight = SharedBlur(np.sqrt(1.1**2 - PIXEL), others_sigma, False), others_sigma**2 / (0.06**2 + 0.1**2)
    sigma = others_sigma * np.sqrt(1 - weight)  # of the weighted mean of both
    good = 1.1 * np.exp(weight * rng.normal(0, np.hypot(others_sigma, own_sigma), 2000))
    other = 1.1 * np.exp(weight * rng.normal(np.log(0.6), own_sigma, 2000))
    contradicted, found = (
        sum(not result.is_confirmed(fit) for fit in fits(view, [sigma] * len(view))) for view in (good, other)
    )
    assert 8 <= contradicted <= 34  # 1 in 100
    assert found > 1800
    assert not result.is_confirmed(fits([1.1], [np.inf])[0])


def test_too_few_marks_tell_nothing() -> None:
    assert shared_blurs(fits([1.2, 1.2, 1.2, 0.6], [0.01, np.inf, np.inf, 0.1])) == [None] * 4


def test_marks_of_one_size_are_rarely_doubted_and_another_size_is() -> None:
    rng = np.random.default_rng(2)
    doubted, found = 0, 0
    for _ in range(300):
        sigmas = rng.uniform(0.005, 0.05, 5)
        sizes = 1.08 * np.exp(rng.normal(0, np.hypot(sigmas, 0.014)))  # of all alike: the drawing's fault
        shared = shared_shapes(*sized(sizes, sigmas))
        doubted += any(size is not None and size.differs for size in shared)
        sizes[0], sigmas[0] = 0.85, 0.02
        odd = shared_shapes(*sized(sizes, sigmas))[0]
        found += odd is not None and odd.differs and abs(np.exp(odd.off[0]) - 0.79) < 0.08
    assert doubted <= 12
    assert found > 270


def test_what_touches_one_side_of_a_dot_widens_its_variance_and_chance_hardly_does() -> None:
    rng, angle = np.random.default_rng(3), np.radians(np.arange(360.0))
    radius_px, known_px = 5.4, 0.05
    outline = np.column_stack([np.ones(360), np.cos(angle), np.sin(angle)])
    off, widened, chance = [], [], []
    for _ in range(500):
        # One side of the outline lies elsewhere: the circle through it is what least squares make of it.
        moved = np.where(angle < rng.uniform(0.5, 2.0), rng.normal(0.0, 2.0), 0.0)
        size, *place = np.linalg.lstsq(outline, moved, rcond=None)[0] + rng.normal(0.0, known_px, 3)
        off.append(np.hypot(*place))
        widened.append(touch(1 + size / radius_px, known_px / radius_px, radius_px).variance_px2)
        chance.append(touch(np.exp(rng.normal(0.0, known_px / radius_px)), known_px / radius_px, radius_px))
    sigmas = np.array(off) / np.hypot(known_px, np.sqrt(widened))
    assert np.mean(np.array(off) > 0.5) > 0.2
    assert sigmas[np.array(off) > 0.5].max() < 5.0
    assert np.mean([each.variance_px2 for each in chance]) < 0.05 * known_px**2


def touch(ratio: float, sigma: float, radius_px: float, px_per_mm: float = 36.0) -> Touch:
    shape = SharedShape(np.log([ratio]), np.array([sigma]), differs=False)
    return touch_of_round(shape, radius_px, px_per_mm, is_damaged=False)


@pytest.mark.parametrize(("radius_px", "pitch_um"), [(5.0, 60.0), (50.0, 20.0), (150.0, 7.0)])
def test_a_speck_is_no_larger_next_to_a_large_mark(radius_px: float, pitch_um: float) -> None:
    """A mark of a fine scan, as large as all others, is known no worse for what might touch it."""
    for off in (-1.0, 0.0, 1.0):
        one = touch(1 + 0.007 * off, 0.007, radius_px, 1000 / pitch_um)
        assert one.variance_px2 < 1e-4
        assert one.exceedance(0.5) < 0.0015


def test_how_likely_a_touched_dot_is_far_off_is_what_drawing_at_random_finds() -> None:
    rng, radius_px, sigma = np.random.default_rng(4), 5.3, 0.022
    changes = rng.normal(0.0, 0.00125 * 36.0**2 / radius_px**2, 400_000)
    alike = np.abs(changes + rng.normal(0.0, sigma, len(changes)) + 0.054) < 0.002  # of those that look so small
    one = touch(np.exp(-0.054), sigma, radius_px)
    expected = float(np.mean(np.abs(2 * radius_px * changes[alike]) > 0.5))
    assert one.exceedance(0.5) / one.probability == pytest.approx(expected, abs=0.02)


def test_two_other_marks_tell_a_size_and_an_odd_one_does_not_spoil_the_others() -> None:
    small = shared_shapes(*sized(np.array([1.0, 1.002, 0.998, 0.9]), np.full(4, 0.01)))
    assert [size is not None and size.differs for size in small] == [False, False, False, True]
    assert small[0] is not None
    assert abs(small[0].off[0]) < 0.01
    assert all(shared_shapes(*sized(np.array([1.0, 1.0, 0.95]), np.full(3, 0.01))))
    pair = shared_shapes(*sized(np.array([1.0, 0.9]), np.array([0.01, 0.01])))
    assert pair == [None, None]


def sized(sizes: Any, sigmas: Any) -> tuple[Any, Any]:
    """Logarithms of sizes, and their standard deviations."""
    return np.log(sizes)[:, None], np.asarray(sigmas)[:, None]


def test_a_mark_with_another_shape_than_the_others_is_distinguished() -> None:
    rng, found, doubted = np.random.default_rng(7), 0, 0
    for _ in range(100):
        sigmas = rng.uniform(0.002, 0.01, (8, 2))
        changes = rng.normal(0.03, np.hypot(sigmas, 0.01))  # of all alike: the drawing's fault
        doubted += any(shape is not None and shape.differs for shape in shared_shapes(changes, sigmas))
        odd = shared_shapes(np.array([changes[0] + (0.0, 0.1), *changes[1:]]), sigmas)[0]
        found += odd is not None and odd.differs
    assert doubted <= 6
    assert found > 95

"""The second places of marks drawn by brute force: as far from the matched ones as noise makes them, farther where a
mark is damaged, and nearer the truth where its paint slopes."""

from dataclasses import replace

import numpy as np
from brute_marks import Array, brute_picture, placed
from drawn import drawn, ellipse
from studies import parametrize_with_studies

from measure.marks.shapes import Mark, MarkShape, polygon, ring_cross
from measure.matching.covariance import across_edges
from measure.matching.match import match
from measure.matching.models import MatchOptions
from measure.matching.window import ScanWindow
from measure.results import MarkFit, SecondPlace
from measure.targets.disks import UNIT_DISK

SIZE, CONTRAST = 41, 500.0
RING_CROSS = MarkShape(ring_cross(1.0, 0.2, 1.6, 0.15))
WING = MarkShape(polygon(((0.0, 0.0), (1.5, 0.7), (1.5, -0.7))))
OPTIONS = MatchOptions(linear_sigma=0.05)
DISK_SIZE, RADIUS = 31, 3.0
DISK_PLACE = np.array([15.2, 14.7])


def edge_chances(mark: Mark, grey: Array, place: Array, options: MatchOptions, count: int) -> Array:
    """The probabilities of the differences of the places by edges in so many noisy pictures."""
    rng = np.random.default_rng(7)
    noisy = [1000 + CONTRAST * grey + rng.normal(0, 20.0, grey.shape) for _ in range(count)]
    return chances([match(ScanWindow(each), mark, place, options).edges for each in noisy])


def disks(slope: float, sigma: float, count: int) -> list[MarkFit]:
    """Disks whose paint is darker by slope times the contrast a radius to the right."""
    start = np.column_stack([RADIUS * np.eye(2), DISK_PLACE])
    inside = ellipse(DISK_PLACE, RADIUS * np.eye(2))

    def painted(col: Array, row: Array) -> Array:
        return np.asarray(inside(col, row) * (1 + slope * (col - DISK_PLACE[0]) / RADIUS))

    grey, rng = 1000 - CONTRAST * drawn(painted, DISK_SIZE, DISK_SIZE, 1.0), np.random.default_rng(5)
    options = MatchOptions(freedom="ellipse")
    return [match(ScanWindow(grey + rng.normal(0, sigma, grey.shape)), UNIT_DISK, start, options) for _ in range(count)]


def chances(places: list[SecondPlace | None]) -> Array:
    assert all(place is not None for place in places)
    return np.array([place.chance for place in places if place is not None])


def assert_as_likely(found: Array) -> None:
    """Of forty probabilities: each as likely as any other."""
    assert len(found) == 40
    assert 0.33 < found.mean() < 0.67  # 0.5 within 3.7 of its standard deviations
    assert found.min() > 1e-4


@parametrize_with_studies(("mark", "options"), [(RING_CROSS, OPTIONS), (WING, replace(OPTIONS, freedom="shift"))])
def test_noise_alone_makes_every_probability_of_edges_as_likely(mark: MarkShape, options: MatchOptions) -> None:
    place = placed(10.0, (20.2, 19.7))
    assert_as_likely(edge_chances(mark, brute_picture(mark, place, SIZE, SIZE, 1.0), place, options, 40))


def test_damage_that_no_mask_takes_out_is_visible_by_the_edges() -> None:
    place = placed(10.0, (20.2, 19.7))
    grey = brute_picture(RING_CROSS, place, SIZE, SIZE, 1.0)
    grey[17:19, 21:34] = 1.0  # a scratch beside one arm
    assert edge_chances(RING_CROSS, grey, place, replace(OPTIONS, damage_rounds=0), 5).max() < 1e-6


def test_noise_alone_makes_every_probability_of_sloping_paint_as_likely() -> None:
    assert_as_likely(chances([fit.sloping for fit in disks(0.0, 20.0, 40)]))


def test_where_paint_slopes_its_place_is_nearer_than_the_matched_one() -> None:
    (fit,) = disks(0.1, 1.0, 1)
    assert fit.sloping is not None
    off = np.hypot(*(fit.center_px - DISK_PLACE))
    assert off > 0.05
    assert np.hypot(*(fit.center_px + fit.sloping.offset_px - DISK_PLACE)) < 0.7 * off
    assert fit.sloping.chance < 1e-6


def test_the_sums_are_of_second_derivatives_across_the_edges() -> None:
    """Of a picture with the same second derivatives everywhere, n'Hn summed over the edges' pixels is known."""
    rng = np.random.default_rng(8)
    slopes = np.zeros((2, SIZE, SIZE))
    slopes[:, 15:-15, 15:-15] = rng.normal(size=(2, SIZE - 30, SIZE - 30))
    weights = across_edges(slopes, 1.6)
    row, col = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    for hessian in (np.diag([1.0, 0.0]), np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[0.4, -0.7], [-0.7, 1.1]])):
        picture = (hessian[0, 0] * col**2 + 2 * hessian[0, 1] * col * row + hessian[1, 1] * row**2) / 2
        across = np.einsum("irc,ij,jrc->rc", slopes, hessian, slopes) / np.maximum((slopes**2).sum(axis=0), 1e-300)
        expected = (slopes * across).sum(axis=(1, 2))
        np.testing.assert_allclose((weights * picture).sum(axis=(1, 2)), expected, rtol=0.01, atol=0.02)

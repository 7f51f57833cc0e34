"""A wedge's own rotation and scale, where the frame gave others: as far from these as noise makes them, and right where
the wedge is another."""

import numpy as np
from drawn import Array, drawn, transformed

from measure.marks.shapes import MarkShape, Polygon
from measure.matching.match import match
from measure.matching.models import MatchOptions
from measure.matching.window import ScanWindow
from measure.results import MarkFit

SIZE, CONTRAST = 41, 500.0
PLACE = np.array([6.3, 20.2])
WEDGE = MarkShape((Polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35))),))
START = np.column_stack([np.diag([30.0, -30.0]), PLACE])
FRAME = MatchOptions(linear_sigma=4e-4, margin_px=7.0)


def fits(scale: float, turn: float, sigma: float, count: int) -> list[MarkFit]:
    """Wedges so much larger and turned against START, by half planes."""
    change = np.array([[1 + scale, -turn], [turn, 1 + scale]])
    mark_from_pixel = np.linalg.inv(change @ START[:, :2])

    def inside(col: Array, row: Array) -> Array:
        x, y = transformed(mark_from_pixel, col - PLACE[0], row - PLACE[1])
        return np.asarray((x < 0.8) & (np.abs(y) < x * 0.35 / 0.8))

    grey, rng = 1000 + CONTRAST * drawn(inside, SIZE, SIZE, 1.0), np.random.default_rng(6)
    return [match(ScanWindow(grey + rng.normal(0, sigma, grey.shape)), WEDGE, START, FRAME) for _ in range(count)]


def test_noise_alone_moves_them_by_their_standard_deviations() -> None:
    own = [fit.own_shape for fit in fits(0.0, 0.0, 25.0, 40)]
    ratios = np.array([shape.change / shape.sigma for shape in own if shape is not None])
    assert len(ratios) == 40
    assert 0.8 < np.sqrt(np.mean(ratios**2)) < 1.2  # 80 numbers: 1 within 2.5 of its standard deviations


def test_another_size_and_turn_are_reported_and_how_they_move_the_place() -> None:
    (fit,) = fits(0.012, 0.008, 2.0, 1)
    assert fit.own_shape is not None
    assert np.abs(fit.own_shape.change - (0.012, 0.008)).max() < 1e-3
    off = np.hypot(*(fit.center_px - PLACE))
    assert off > 0.03
    assert np.hypot(*(fit.center_px + fit.own_shape.on_place @ fit.own_shape.change - PLACE)) < off / 3

"""The place with sloping paint: as far from the matched one as noise makes it, and nearer the truth where it slopes."""

import numpy as np
from drawn import Array, drawn, ellipse

from measure.disks import UNIT_DISK
from measure.match_options import MatchOptions
from measure.matching import Match, match

SIZE, CONTRAST, RADIUS = 31, 500.0, 3.0
PLACE = np.array([15.2, 14.7])


def fits(slope: float, sigma: float, count: int) -> list[Match]:
    """Disks whose paint is darker by slope times the contrast a radius to the right."""
    start = np.column_stack([RADIUS * np.eye(2), PLACE])
    inside = ellipse(PLACE, RADIUS * np.eye(2))

    def painted(col: Array, row: Array) -> Array:
        return np.asarray(inside(col, row) * (1 + slope * (col - PLACE[0]) / RADIUS))

    grey, rng = 1000 - CONTRAST * drawn(painted, SIZE, SIZE, 1.0), np.random.default_rng(5)
    options = MatchOptions(freedom="ellipse")
    return [match(grey + rng.normal(0, sigma, grey.shape), (0, 0), UNIT_DISK, start, options) for _ in range(count)]


def test_noise_alone_makes_every_probability_as_likely() -> None:
    chances = [fit.sloping.chance for fit in fits(0.0, 20.0, 40) if fit.sloping is not None]
    assert len(chances) == 40
    assert 0.33 < np.mean(chances) < 0.67  # 0.5 within 3.7 of its standard deviations
    assert min(chances) > 1e-4


def test_where_paint_slopes_its_place_is_nearer_than_the_matched_one() -> None:
    (fit,) = fits(0.1, 1.0, 1)
    assert fit.sloping is not None
    off = np.hypot(*(fit.center_px - PLACE))
    assert off > 0.05
    assert np.hypot(*(fit.center_px + fit.sloping.offset_px - PLACE)) < 0.7 * off
    assert fit.sloping.chance < 1e-6

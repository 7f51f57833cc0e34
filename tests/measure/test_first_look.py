"""What is worth a fit: marks in noise, and noise alone."""

import numpy as np
import pytest
from drawn import scan_of
from scipy.ndimage import gaussian_filter
from true_marks import KIND, some_mark

from measure.detection.localisation import MarkPrediction, localise
from measure.fiducials.mark_fit import detect_mark
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import MarkShape, cross, polygon

GROUND, CONTRAST = 25000.0, 15000.0


@pytest.mark.parametrize("texture_px", [0.0, 1.0, 3.0])
def test_noise_is_rarely_worth_a_fit_however_coarse_it_is(texture_px: float) -> None:
    rng = np.random.default_rng(1)
    marks = [some_mark(KIND[name], 1.0, rng) for name in ("cross", "ring-dot", "dot")]
    tries, answers = 20, 0
    for mark in marks * tries:
        noise = rng.standard_normal((mark.size, mark.size))
        if texture_px:
            noise = gaussian_filter(noise, texture_px) * texture_px * 3
        expected = MarkPrediction(mark.kind.shape, mark.place, 3.0, 1)
        answers += localise(scan_of(GROUND + 3000 * noise), expected) is not None
    assert answers <= 13  # of sixty at a twentieth, sharp or soft: more in one run of a thousand


def test_a_soft_mark_that_hardly_stands_out_of_the_noise_is_measured() -> None:
    rng = np.random.default_rng(2)
    for _ in range(3):
        mark = some_mark(KIND["gap cross"], 2.5, rng)
        grey = GROUND + CONTRAST * (mark.picture + rng.standard_normal((mark.size, mark.size)) / 5)
        start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + rng.uniform(-1, 1, 2)])
        fit = detect_mark(scan_of(grey), MarkPrediction(mark.kind.shape, start, 3.0, 1), FiducialOptions().match).fit
        assert fit is not None
        error = fit.center_px - mark.place[:, 2]
        assert error @ np.linalg.solve(fit.covariance_px2, error) < 13.8  # one in a thousand
        assert np.trace(fit.covariance_px2) < 1.5**2 * np.trace(mark.bound(0.2))


def test_a_line_far_thinner_than_a_pixel_is_not_detected_in_noise_and_warns_of_nothing() -> None:
    mark = MarkShape(cross(1.5, 0.06), "dark")
    noise = np.random.default_rng(3).standard_normal((60, 60))
    place = np.array([[1.5, 0.0, 30.0], [0.0, -1.5, 30.0]])  # 0.67 mm a pixel
    assert localise(scan_of(GROUND + 3000 * noise), MarkPrediction(mark, place, 3.0, -1)) is None


def test_a_solid_mark_at_the_frames_border_is_visible_however_far_about_it_is_sought() -> None:
    """Its ground is that of the frame, not that of the border, of which the more is seen the smaller the window is."""
    rng, size, center = np.random.default_rng(4), 400, np.array([200.3, 199.6])
    block = MarkShape(polygon(((0.0, 0.0), (2.8, 0.0), (2.8, -1.4), (0.56, -1.4))), known_mm=((-9.0, -9.0), (1.9, 9.0)))
    place = np.column_stack([np.diag([36.0, -36.0]), center])
    x, y = np.moveaxis((np.stack(np.meshgrid(*[np.arange(size)] * 2), axis=-1) - center) / (36.0, -36.0), -1, 0)
    exposed = (x < 1.9) & ~((y < 0) & (y > -1.4) & (x > -0.4 * y))
    ground = 30000 + 2500 * 14 * gaussian_filter(rng.standard_normal((size, size)), 4.0)
    border = 14000 + 3000 * rng.standard_normal((size, size))
    light = gaussian_filter(exposed.astype(float), 1.0)
    scan = scan_of(light * ground + (1 - light) * border)
    for search_px in (5.0, 24.0):
        start = np.column_stack([place[:, :2], center + np.array([3.0, -2.0])])
        observation = localise(scan, MarkPrediction(block, start, search_px, -1))
        assert observation is not None
        assert observation[1] < 1e-3
        assert np.hypot(*(observation[0] - center)) < 6.0

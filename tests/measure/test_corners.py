"""Corners against pictures drawn by brute force, and the closed form against scipy's bivariate normal."""

import cv2
import numpy as np
import pytest
from drawn import draw, transformed, whitened
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import multivariate_normal
from studies import parametrize_with_studies

from measure import ScanWindow
from measure.array_types import Single
from measure.boards.corners import Corner, CornerStart, Surface, crossing, fit_corners, quarter
from measure.scans.jpeg import rounding_step_dn

Array = NDArray[np.float64]
SIZE, NOISE, CONTRAST = 25, 4.0, 100.0


@pytest.mark.parametrize("correlation", [-0.7, 0.0, 0.4])
@pytest.mark.parametrize("surface", [crossing, quarter])
def test_the_closed_form_and_its_derivatives(correlation: float, surface: Surface) -> None:
    rng = np.random.default_rng(1)
    u, v = rng.normal(0, 2, (2, 6))
    both = [multivariate_normal([0, 0], [[1, correlation], [correlation, 1]]).cdf(place) for place in np.c_[u, v]]
    truth = 4 * np.array(both) - 2 * ndtr(u) - 2 * ndtr(v) + 1 if surface is crossing else 2 * np.array(both) - 1
    value, *slopes = surface(*singles(u, v, correlation))
    np.testing.assert_allclose(value[0], truth, atol=2e-6)
    e = 0.02
    steps = ((e, 0, 0), (0, e, 0), (0, 0, e))
    for slope, (du, dv, dc) in zip(slopes, steps, strict=True):
        ahead, behind = (
            surface(*singles(u + way * du, v + way * dv, correlation + way * dc))[0] for way in (1.0, -1.0)
        )
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * e), atol=5e-4)


def singles(u: Array, v: Array, correlation: float) -> tuple[Single, Single, Single]:
    """Of one corner, in single precision."""
    return u[None].astype(np.float32), v[None].astype(np.float32), np.array([[correlation]], np.float32)


def board_steps(rng: np.random.Generator) -> Array:
    """Sides of a square seen at an angle."""
    first = rng.uniform(0, np.pi)
    second = first + np.pi / 2 + rng.uniform(-0.4, 0.4)
    return np.array([[np.cos(first), np.cos(second)], [np.sin(first), np.sin(second)]]) * (16.0, 14.0)


def square_picture(center: Array, steps: Array, blur_px: float, alone: bool) -> Array:
    """Squares about a corner, light between the steps; alone: that one square only."""
    inverse = np.linalg.inv(steps)

    def light(col: Array, row: Array) -> Array:
        s, t = transformed(inverse, col - center[0], row - center[1])
        return np.asarray((s > 0) & (t > 0) if alone else (np.floor(s) + np.floor(t)) % 2 == 0)

    return 50 + CONTRAST * draw(light, SIZE, SIZE, blur_px)


def fit_mark(window: Array, start: Array, steps: Array, alone: bool, rounding_step_dn: float = 0.0) -> Corner:
    outside = 4  # pixels that are none of the picture
    grey, valid = np.pad(window, outside), np.pad(np.ones(window.shape, bool), outside)

    def read(col: int, row: int, side: int) -> ScanWindow:
        part = slice(row + outside, row + outside + side), slice(col + outside, col + outside + side)
        return ScanWindow(grey[part], (col, row), valid[part])

    starts = [CornerStart(start, steps, np.array([6.0, 6.0]))]
    return fit_corners(read, starts, quarter if alone else crossing, rounding_step_dn)[0]


@parametrize_with_studies(("blur_px", "alone"), [(0.5, False), (0.9, False), (1.5, False), (0.8, True)], quick=(1,))
def test_errors_are_as_large_as_their_sigmas_say(blur_px: float, alone: bool) -> None:
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(8):
        center, steps = SIZE // 2 + rng.uniform(-0.5, 0.5, 2), board_steps(rng)
        clean = square_picture(center, steps, blur_px, alone)
        for _ in range(6):
            noisy = clean + rng.normal(0, NOISE, clean.shape)
            corner = fit_mark(noisy, center + rng.normal(0, 0.3, 2), steps, alone)
            assert not corner.reason
            errors.append(whitened(corner.center_px - center, corner.covariance.px2))
            assert corner.noise_dn == pytest.approx(NOISE, rel=0.35)
    assert 0.83 < np.sqrt(np.mean(np.square(errors))) < 1.17  # 96 numbers: 7.2 % standard deviation
    assert np.abs(np.mean(errors, axis=0)).max() < 0.4  # 2.8 standard deviations


@pytest.mark.parametrize(("quality", "alone"), [(5, False), (20, True)])
def test_what_jpeg_does_to_edges_is_in_the_standard_deviations(quality: int, alone: bool) -> None:
    """Residuals alone make them 2.5 and 2.3 times too small."""
    rng, errors = np.random.default_rng(5), []
    for _ in range(50):
        center, steps = SIZE // 2 + rng.uniform(-4, 4, 2), board_steps(rng)
        clean = square_picture(center, steps, 0.8, alone)
        noisy = np.rint(clean + rng.normal(0, 1.0, clean.shape)).astype(np.uint8)
        stored = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        grey = np.asarray(cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE), float)
        corner = fit_mark(grey, center, steps, alone, rounding_step_dn(stored.tobytes()))
        if not corner.reason:
            errors.append(whitened(corner.center_px - center, corner.covariance.px2))
    assert len(errors) >= 45
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.25  # 90 numbers: 7.5 % standard deviation


@pytest.mark.parametrize("blur_px", [0.5, 1.5])
def test_the_junction_lies_where_the_squares_meet(blur_px: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(8):
        center, steps = SIZE // 2 + rng.uniform(-0.5, 0.5, 2), board_steps(rng)
        corner = fit_mark(square_picture(center, steps, blur_px, False), center, steps, False)
        assert corner.junction_px is not None
        assert np.abs(corner.junction_px - center).max() < 0.03


def test_trap_pixel_locking() -> None:
    """Without noise the error stays below 0.004 px wherever the corner lies in its pixel: no grid of any kind."""
    rng = np.random.default_rng(3)
    steps = board_steps(rng)
    for phase in np.linspace(-0.5, 0.5, 9):
        center = SIZE // 2 + np.array([phase, -phase / 2])
        corner = fit_mark(square_picture(center, steps, 0.7, False), center + 0.2, steps, False)
        assert np.abs(corner.center_px - center).max() < 0.004


def test_a_bent_tone_curve_and_sharpening_do_not_move_a_crossing() -> None:
    rng = np.random.default_rng(4)
    for _ in range(4):
        center, steps = SIZE // 2 + rng.uniform(-0.5, 0.5, 2), board_steps(rng)
        linear = square_picture(center, steps, 0.8, False)
        bent = 255 * (np.clip(linear - 45, 0, None) / 255) ** 0.45
        corner = fit_mark(bent, center + rng.normal(0, 0.3, 2), steps, False)
        assert np.abs(corner.center_px - center).max() < 0.01


def test_a_stain_is_left_out() -> None:
    rng = np.random.default_rng(5)
    center, steps = np.array([12.1, 11.8]), np.diag([14.0, 14.0])
    window = square_picture(center, steps, 0.8, False) + rng.normal(0, 1.0, (SIZE, SIZE))
    window[7:9, 14:17] = 255
    corner = fit_mark(window, center, steps, False)
    assert not corner.reason
    assert 0.02 < corner.damaged_fraction < 0.1
    assert np.abs(corner.center_px - center).max() < 0.03


def test_where_no_corner_is_the_reason_is_stated() -> None:
    rng = np.random.default_rng(6)
    start, steps = np.array([12.0, 12.0]), np.diag([14.0, 14.0])
    assert fit_mark(rng.normal(100, 4, (SIZE, SIZE)), start, steps, False).reason
    assert fit_mark(np.full((SIZE, SIZE), 7.0), start, steps, False).reason

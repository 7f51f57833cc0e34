"""Least-squares matching: the driver, robust weights, marks drawn by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from drawn import Array, brute_picture, draw, transformed
from numpy.typing import NDArray

from measure import MatchOptions, ScanWindow, match
from measure.fiducials.mark_fit import strain_error_px
from measure.flags import NO_REASON, Cause, Code, Reason, Status
from measure.marks.shapes import MarkShape, Polygon, cross, polygon
from measure.matching.gauss_newton import UNDETERMINED, UNSETTLED, gauss_newton
from measure.noise.robust_estimation import (
    least_distances,
    solution,
    student_weights,
    tukey_loss,
    tukey_weights,
)
from measure.results import Covariance, MarkFit, MarkMeasurement
from measure.tie_points.multi_image import Bending, bending_variance

FAR = Reason("too far", Code.NO_FIT)


class Arctangent:
    """atan(x) is to be 0: full steps from |x| > 1.39 grow for ever."""

    def __init__(self, start: float) -> None:
        self.state = start

    def solve(self) -> np.ndarray | None:
        slope = 1 / (1 + self.state**2)
        return np.array([-np.arctan(self.state) / slope, 0.0]) if slope > 1e-12 else None

    def step(self, step: np.ndarray) -> float:
        self.state += float(step[0])
        return abs(float(step[0]))

    def failure(self) -> Reason:
        return FAR if abs(self.state) > 1e3 else NO_REASON

    def cost(self) -> float:
        return float(np.arctan(self.state) ** 2)


def test_steps_that_do_not_lessen_the_cost_are_halved_and_what_is_not_at_rest_says_so() -> None:
    assert gauss_newton(Arctangent(3.0), 1e-6, 30).reason == FAR
    model = Arctangent(3.0)
    assert not gauss_newton(model, 1e-6, 30, 4).reason
    assert model.state == pytest.approx(0.0, abs=1e-12)
    assert gauss_newton(Arctangent(1e7), 1e-6, 10).reason == UNDETERMINED
    assert gauss_newton(Arctangent(1.0), 1e-6, 2).reason == UNSETTLED


def test_tukeys_weights_are_the_published_ones_and_his_loss_has_them_as_slope() -> None:
    """Beaton and Tukey's biweight, with 4.685 standard deviations as its end: w = (1 - (r / c)²)², and rho' = r w."""
    share = np.array([0.0, 0.25, 0.5, 0.75, 1.0, 2.0])
    residuals = 4.685 * 2.5 * share
    expected = [1.0, 0.87890625, 0.5625, 0.19140625, 0.0, 0.0]
    np.testing.assert_allclose(tukey_weights(residuals, 2.5), expected, atol=1e-12)
    step = 1e-5
    for residual, weight in zip(residuals, expected, strict=True):
        ends = [tukey_loss(np.array([residual + side * step]), 2.5) for side in (-1, 1)]
        np.testing.assert_allclose((ends[1] - ends[0]) / (2 * step), 2 * residual * weight, atol=1e-4)


def test_students_weights_are_those_of_four_degrees_of_freedom() -> None:
    """(freedom + dimensions) / (freedom + squared distance): Lange, Little and Taylor 1989."""
    np.testing.assert_allclose(student_weights(np.array([0.0, 2.0, 16.0]), 2.0), [1.5, 1.0, 0.3])


def test_normal_equations_are_solved_for_what_is_free_and_refused_where_they_tell_nothing() -> None:
    design = np.random.default_rng(2).standard_normal((20, 3)) * [1.0, 1e5, 1e-5]
    truth, free = np.array([1.0, 2e-5, 3e5]), np.array([True, False, True])
    normal = design.T @ design
    found, held = solution(normal, normal @ truth, free | True), solution(normal, normal[:, free] @ truth[free], free)
    assert found is not None
    np.testing.assert_allclose(found, truth)
    assert held is not None
    np.testing.assert_allclose(held, [1.0, 0.0, 3e5])
    twice = design[:, [0, 0, 2]]
    assert solution(twice.T @ twice, truth, np.ones(3, bool)) is None
    assert solution(np.diag([1.0, 0.0, 1.0]), truth, np.ones(3, bool)) is None
    assert solution(np.diag([1.0, -1e-18, 1.0]), truth, np.ones(3, bool)) is None  # as rounding leaves it


def test_least_distances_leave_false_places_aside() -> None:
    design, there = _mapped(FALSE)
    both = least_distances(np.stack([design, design]), np.stack([there, 2.0 * there]), 0.1, 30)
    np.testing.assert_allclose(both[0], MAP, atol=0.02)
    np.testing.assert_allclose(both[1], 2.0 * MAP, atol=0.04)


def test_least_distances_hold_to_what_a_map_usually_is() -> None:
    design, there = _mapped([])
    usual = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    held = least_distances(design, there, 5.0, 6, 1e9 * np.diag([0.0, 1.0, 1.0]), usual)
    np.testing.assert_allclose(held[1:], np.eye(2), atol=1e-4)
    np.testing.assert_allclose(least_distances(design, there, 5.0, 6, 1e-9 * np.diag([0.0, 1.0, 1.0]), usual), MAP)


MAP = np.array([[7.0, -4.0], [1.02, 0.1], [-0.1, 0.97]])
FALSE = [2, 7]


def _mapped(false: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    design = np.column_stack([np.ones(12), np.random.default_rng(4).uniform(-50, 50, (12, 2))])
    there = design @ MAP
    there[false] += 40.0
    return design, there


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

    grey, rng = 1000 + CONTRAST * draw(inside, SIZE, SIZE, 1.0), np.random.default_rng(6)
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


WING = MarkShape(polygon(((0.0, 0.0), (0.8, 0.35), (0.8, -0.35))))
REFINEMENT_START = np.array([[36.0, 0.0, 30.3], [0.0, -36.0, 39.6]])


@pytest.mark.parametrize("mark", [WING, MarkShape(cross(0.5, 0.1))])
def test_a_stretch_moves_what_lies_to_one_side_of_its_centre(mark: MarkShape) -> None:
    true = REFINEMENT_START.copy()
    true[:, :2] = np.diag([1.003, 0.997]) @ true[:, :2]
    grey = 100.0 + 100.0 * brute_picture(mark, true, 81, 81, 1.0)
    grey += np.random.default_rng(1).normal(0.0, 2.0, grey.shape)
    off = match(ScanWindow(grey), mark, REFINEMENT_START, MatchOptions(freedom="shift")).center_px - true[:, 2]
    assert strain_error_px(mark, REFINEMENT_START[:, :2], true[:, :2], 0.0) == pytest.approx(np.hypot(*off), abs=0.025)
    assert (np.hypot(*off) > 0.05) == (mark is WING)
    assert strain_error_px(mark, 1.02 * true[:, :2], true[:, :2], 0.0) == pytest.approx(0.0, abs=1e-12)


ON_PLACE = np.array([[-0.25, 0.02, -0.2, 0.01, 0.0, 0.03], [0.0, 0.01, 0.02, -0.22, 0.03, -0.25]])
ISOTROPIC = np.array([[0.75, 0.0, 0.25], [0.0, 1.0, 0.0], [0.25, 0.0, 0.75]])  # of a u² + b uv + c v², Z'' isotropic


def patches(rng: np.random.Generator, along: Array, count: int = 300) -> tuple[list[Bending], Array]:
    """Patches that bend along a direction (2,), px at their rims; and what that does to their places (n, 2)."""
    variance = np.kron(np.outer(along, along), ISOTROPIC)
    bendings, moved = [], []
    for _ in range(count):
        root = rng.normal(size=(6, 6))
        response = root @ root.T + 6.0 * np.eye(6)
        noise = response / 4.0
        bending = rng.multivariate_normal(np.zeros(6), variance)
        view = response @ bending + rng.multivariate_normal(np.zeros(6), noise)
        bendings.append(Bending(view, response, noise, ON_PLACE))
        moved.append(ON_PLACE @ bending)
    return bendings, np.array(moved)


def test_places_are_freed_of_the_bending_and_what_stays_is_as_large_as_stated() -> None:
    bendings, moved = patches(np.random.default_rng(1), np.array([0.5, 0.2]))
    variance = bending_variance(bendings)
    assert variance[1, 1] == pytest.approx(0.25, rel=0.3)
    assert variance[4, 4] == pytest.approx(0.04, rel=0.3)
    assert variance[1, 4] == pytest.approx(0.10, rel=0.3)
    found = [each.estimated(variance) for each in bendings]
    left = moved - np.array([shift for shift, _ in found])
    assert np.mean(left**2) < 0.5 * np.mean(moved**2)
    assert np.cov(left.T) == pytest.approx(np.mean([rest for _, rest in found], axis=0), abs=0.2 * np.var(left[:, 0]))


def test_the_covariance_of_a_mark_is_the_sum_of_its_causes_in_their_order_and_goes_with_its_place() -> None:
    noise = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    tone = np.array([[1e-4, 0.0], [0.0, 0.0]])
    known = Covariance.from_noise(noise).plus(Cause.TONE, tone).plus(Cause.TONE, tone)
    mark = MarkMeasurement("1", "fiducial", np.zeros(2), known, Status.MEASURED)
    np.testing.assert_allclose(np.asarray(mark.covariance_px2), noise + 2 * tone)
    film = replace(mark, covariance=known.plus(Cause.FILM, 0.01 * np.eye(2)))
    np.testing.assert_allclose(np.asarray(film.covariance_px2), noise + 2 * tone + 0.01 * np.eye(2))

    known = Covariance({Cause.TONE: 4e-4 * np.eye(2), Cause.NOISE: 1e-4 * np.eye(2)})
    known = known.plus(Cause.COMPRESSION, np.zeros((2, 2)))
    assert known.sigmas_px == pytest.approx({Cause.NOISE: 0.01, Cause.TONE: 0.02})
    assert list(known.sigmas_px) == [Cause.NOISE, Cause.TONE]
    assert repr(known) == "Covariance(noise 0.01 px, tone 0.02 px)"
    stretch = np.array([[2.0, 1.0], [0.0, 1.0]])
    known = Covariance.from_noise(np.diag([1.0, 2.0])).plus(Cause.TONE, np.diag([0.0, 1.0]))
    moved = known.through(stretch)
    np.testing.assert_allclose(moved.px2, stretch @ known.px2 @ stretch.T)
    np.testing.assert_allclose(moved.parts[Cause.TONE], [[1.0, 1.0], [1.0, 1.0]])

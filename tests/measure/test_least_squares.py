"""Least-squares matching: the driver, robust weights, marks drawn by brute force."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from drawn import Array, brute_picture, draw, placed, transformed
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import MarkFit, MatchOptions, ScanWindow, match
from measure.fiducials.interior_orientation import fit_frame
from measure.fiducials.mark_fit import strain_error_px
from measure.fiducials.options import FiducialOptions
from measure.flags import NO_REASON, Cause, Code, Reason, Status
from measure.marks.shapes import Mark, MarkShape, Polygon, cross, dot, polygon, ring_cross, ring_dot
from measure.marks.templates import learn_template
from measure.matching.gauss_newton import UNDETERMINED, UNSETTLED, FitModel, PictureFit, gauss_newton
from measure.noise.robust_estimation import least_distances, solution, student_weights, tukey_loss, tukey_weights
from measure.results import Covariance, MarkMeasurement
from measure.targets.detection import DiskSearch
from measure.targets.identification import TargetPrediction
from measure.targets.ring_codes import RingCode
from measure.tie_points.multi_image import Bending, bending_variance
from measure.tone.curve import sampled_curve

FAR = Reason("too far", Code.NO_FIT)


class Arctangent(FitModel):
    """atan(x) is to be 0, for each of several x: full steps from |x| > 1.39 grow for ever."""

    def __init__(self, *starts: float) -> None:
        super().__init__(len(starts))
        self.state = np.array(starts)

    def solve(self, fits: NDArray[np.intp]) -> Array:
        slope = 1 / (1 + self.state[fits] ** 2)
        steps = np.stack([-np.arctan(self.state[fits]) / slope, 0 * slope], axis=1)
        return np.where(slope[:, None] > 1e-12, steps, np.nan)

    def step(self, fits: NDArray[np.intp], steps: Array) -> Array:
        self.state = self.state.copy()
        self.state[fits] += steps[:, 0]
        for number in fits:
            self.reasons[number] = FAR if abs(self.state[number]) > 1e3 else NO_REASON
        return np.abs(steps[:, 0])


class HalvedArctangent(PictureFit):
    """The same, of a fit of a mark, whose steps are halved."""

    def __init__(self, start: float) -> None:
        FitModel.__init__(self, 1)
        self.x, self.weighted, self.tolerance_px = start, None, 1e-6

    @property
    def state(self) -> Any:
        return self.x

    @state.setter
    def state(self, x: Any) -> None:
        self.x = x

    def solve(self, fits: NDArray[np.intp]) -> Array:
        return np.array([[-np.arctan(self.x) * (1 + self.x**2), 0.0]])

    def _move(self, step: Array) -> float:
        self.x += float(step[0])
        return abs(float(step[0]))

    def failure(self) -> Reason:
        return FAR if abs(self.x) > 1e3 else NO_REASON

    def cost(self) -> float:
        return float(np.arctan(self.x) ** 2)


def test_steps_that_do_not_lessen_the_cost_are_halved() -> None:
    model = HalvedArctangent(3.0)
    gauss_newton(model, model.every, 1e-6, 30)
    assert not model.reasons[0]
    assert model.x == pytest.approx(0.0, abs=1e-12)


def test_each_fit_of_a_batch_ends_for_itself_and_says_why() -> None:
    model, alone = Arctangent(3.0, 1.2, 0.5, 1e7, 0.9), Arctangent(0.5)
    moved = gauss_newton(model, np.arange(4), 1e-6, 5)
    assert model.reasons == [FAR, UNSETTLED, NO_REASON, UNDETERMINED, NO_REASON]
    np.testing.assert_array_equal(moved < 1e-6, [False, False, True, False])
    gauss_newton(alone, alone.every, 1e-6, 30)
    np.testing.assert_array_equal(model.state[[2, 4]], [alone.state[0], 0.9])


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
    np.testing.assert_allclose(found, truth)
    np.testing.assert_allclose(held, [1.0, 0.0, 3e5])
    twice = design[:, [0, 0, 2]]
    for singular in (twice.T @ twice, np.diag([1.0, 0.0, 1.0]), np.diag([1.0, -1e-18, 1.0])):  # as rounding leaves it
        assert np.isnan(solution(singular, truth, np.ones(3, bool))).all()


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
    own = [fit.own_shape for fit in fits(0.0, 0.0, 25.0, 24)]
    ratios = np.array([shape.change / shape.sigma for shape in own if shape is not None])
    assert len(ratios) == 24
    assert 0.75 < np.sqrt(np.mean(ratios**2)) < 1.25  # 48 numbers: 1 within 2.5 of its standard deviations


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


SCALE, GROUND = 10.0, 1000.0
MARKS = {
    "cross": MarkShape(cross(1.5, 0.15)),
    "ring-cross": MarkShape(ring_cross(1.0, 0.2, 1.6, 0.15, angle_deg=45.0)),
    "ring-dot": MarkShape(ring_dot(1.0, 0.15, 0.25)),
    "dot": MarkShape(dot(0.5)),
}
PHASES = 6


@cache
def draw_mark(name: str, blur_px: float) -> tuple[tuple[Array, Array], ...]:
    """Noise-free windows of a mark at several phases, slightly turned and scaled, with the places of the mark.

    Turned, for an upright edge falls between the rows of points that brute force asks.
    """
    rng = np.random.default_rng(3)
    result = []
    for _ in range(PHASES):
        center = tuple((SIZE - 1) / 2 + rng.uniform(-0.5, 0.5, 2))
        place = placed(SCALE * (1 + rng.normal(0, 0.004)), (center[0], center[1]), rng.uniform(0.02, 0.05))
        result.append((brute_picture(MARKS[name], place, SIZE, SIZE, blur_px), place))
    return tuple(result)


def measure_picture(
    grey: Array, mark: Mark, place: Array, rng: np.random.Generator, options: MatchOptions | None = None
) -> MarkFit:
    """The match from a start that is off by up to 0.7 px, with the drawn size and no turn."""
    start = placed(SCALE, tuple(place[:, 2] + rng.uniform(-0.7, 0.7, 2)))
    return match(ScanWindow(grey), mark, start, options)


@cache
def errors_and_sigmas(name: str, blur_px: float, snr: float, count: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(5)
    errors, sigmas = [], []
    for index in range(count):
        shown, place = draw_mark(name, blur_px)[index % PHASES]
        grey = GROUND + CONTRAST * shown + rng.normal(0, CONTRAST / snr, shown.shape)
        fit = measure_picture(grey, MARKS[name], place, rng)
        assert fit.converged, fit.reason
        errors.append(fit.center_px - place[:, 2])
        sigmas.append(np.sqrt(np.diag(fit.covariance_px2)))
    return np.array(errors), np.array(sigmas)


@parametrize_with_studies(
    ("name", "blur_px", "count"),
    [("cross", 0.7, 54), ("ring-cross", 1.0, 60), ("ring-dot", 1.0, 54), ("dot", 0.8, 54)],
    quick=(3,),
)
def test_sigmas_are_those_of_the_errors(name: str, blur_px: float, count: int) -> None:
    errors, sigmas = errors_and_sigmas(name, blur_px, 25.0, count)
    ratio = np.sqrt(np.mean((errors / sigmas) ** 2))
    assert 0.86 < ratio < 1.15  # 108 numbers: 6.8 % standard deviation
    assert np.abs(errors.mean(axis=0)).max() < 4 * sigmas.mean() / np.sqrt(len(errors))


@parametrize_with_studies(("name", "blur_px"), list(product(MARKS, (0.6, 1.2))), quick=(0, 3, 4, 7))
def test_clean_marks_are_unbiased_at_every_phase(name: str, blur_px: float) -> None:
    """Trap: a 0.1 px grid left by sub-pixel refinement, and a half pixel lost in refining."""
    rng = np.random.default_rng(7)
    for shown, place in draw_mark(name, blur_px):
        fit = measure_picture(GROUND + CONTRAST * shown + rng.normal(0, 0.5, shown.shape), MARKS[name], place, rng)
        assert np.abs(fit.center_px - place[:, 2]).max() < 0.003
        assert fit.blur_px == pytest.approx(blur_px, abs=0.03)
        assert fit.contrast_dn == pytest.approx(CONTRAST, rel=0.03)


def test_dust_is_cut_out() -> None:
    rng = np.random.default_rng(13)
    clean, dusty, ratios, fractions = [], [], [], []
    for index in range(12):
        shown, place = draw_mark("ring-cross", 1.0)[index % PHASES]
        grey = GROUND + CONTRAST * shown + rng.normal(0, 25, shown.shape)
        clean.append(measure_picture(grey, MARKS["ring-cross"], place, rng).center_px - place[:, 2])
        for _ in range(3):
            speck = brute_picture(MarkShape(dot(0.2)), placed(SCALE, tuple(rng.uniform(6, 35, 2))), SIZE, SIZE, 0.7, 16)
            grey = grey + 1.5 * CONTRAST * speck
        fit = measure_picture(grey, MARKS["ring-cross"], place, rng)
        dusty.append(fit.center_px - place[:, 2])
        ratios.append(dusty[-1] / np.sqrt(np.diag(fit.covariance_px2)))
        fractions.append(fit.damaged_fraction)
    assert np.sqrt(np.mean(np.square(dusty))) < 1.6 * np.sqrt(np.mean(np.square(clean)))
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.35
    assert 0.02 < np.mean(fractions) < 0.25


@parametrize_with_studies("name", ["ring-cross", "ring-dot", "dot"], quick=(1,))
def test_a_mark_half_of_which_was_redrawn_has_the_shift_in_its_sigma(name: str) -> None:
    """The match lies between the halves, 0.5 px off each, and takes what is left of either for damage."""
    rng = np.random.default_rng(19)
    squares = []
    for shown, place in draw_mark(name, 1.0):
        angle = rng.uniform(0, 2 * np.pi)
        shifted = placed(SCALE, tuple(place[:, 2] + (np.cos(angle), np.sin(angle))), 0.03)
        rows, cols = np.indices(shown.shape)
        redrawn = brute_picture(MARKS[name], shifted, SIZE, SIZE, 1.0)
        halves = (
            np.where(cols > place[0, 2], redrawn, shown)
            if angle > np.pi
            else np.where(rows > place[1, 2], redrawn, shown)
        )
        grey = GROUND + CONTRAST * halves + rng.normal(0, CONTRAST / 100, shown.shape)
        fit = measure_picture(grey, MARKS[name], place, rng)
        error = fit.center_px - place[:, 2]
        squares.append(error @ np.linalg.solve(fit.covariance_px2, error))
    assert np.sqrt(np.max(squares)) < 5.0


@parametrize_with_studies("grain_px", [0.8, 1.3])
def test_sigmas_hold_in_correlated_grain(grain_px: float) -> None:
    rng = np.random.default_rng(17)
    ratios = []
    for index in range(24):
        shown, place = draw_mark("ring-cross", 1.0)[index % PHASES]
        grain = gaussian_filter(rng.normal(0, 1, (SIZE, SIZE)), grain_px, mode="wrap")
        fit = measure_picture(GROUND + CONTRAST * shown + 25 * grain / grain.std(), MARKS["ring-cross"], place, rng)
        assert fit.converged, fit.reason
        assert not fit.covariance_is_white
        error = fit.center_px - place[:, 2]
        ratios.append(error / np.sqrt(np.diag(fit.covariance_px2)))
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.3  # 48 numbers: 10 % standard deviation


def test_a_drawing_is_fitted_where_it_is_true() -> None:
    """Whatever else than its drawing shows there, the rest of a wedge counts for nothing."""
    wedge, rng = polygon(((0.0, 0.0), (-0.9, 1.8), (0.9, 1.8))), np.random.default_rng(29)
    about, place = MarkShape(wedge, true_mm=((-1.0, -0.8), (1.0, 1.0))), placed(SCALE, (20.31, 25.38))
    plain = GROUND + CONTRAST * brute_picture(about, place, SIZE, SIZE, 0.8) + rng.normal(0, 10, (SIZE, SIZE))
    other = plain + 2 * CONTRAST * (np.hypot(*np.subtract(np.mgrid[:SIZE, :SIZE], [[[9]], [[20]]])) < 6)
    start, options = placed(SCALE, (20.0, 25.0)), MatchOptions(freedom="shift")
    places = [match(ScanWindow(grey), about, start, options).center_px for grey in (plain, other)]
    np.testing.assert_allclose(places[1], places[0], atol=1e-3)
    np.testing.assert_allclose(places[0], place[:, 2], atol=0.15)
    whole = match(ScanWindow(other), MarkShape(wedge), start, options)
    assert not whole.converged or np.hypot(*(whole.center_px - place[:, 2])) > 0.15


def test_nothing_is_not_a_mark() -> None:
    rng = np.random.default_rng(31)
    place = placed(SCALE, (20.0, 20.0))
    flat = match(ScanWindow(np.full((SIZE, SIZE), 7.0)), MARKS["cross"], place)
    assert not flat.converged
    assert flat.reason
    noise = match(ScanWindow(rng.normal(0, 10, (SIZE, SIZE))), MARKS["ring-cross"], place)
    assert not noise.converged or noise.likeness < 0.35
    outside = match(ScanWindow(np.zeros((SIZE, SIZE)), (500, 500)), MARKS["cross"], place)
    assert "outside" in outside.reason
    shown, place = draw_mark("ring-cross", 1.0)[0]
    valid = np.zeros(shown.shape, dtype=bool)
    valid[:, 24:] = True
    half = match(ScanWindow(shown, valid=valid), MARKS["ring-cross"], place)
    assert "outside of the scan" in half.reason


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MatchOptions(blur_px=0.0), "is right"),
        (lambda: MatchOptions(margin_px=-1.0), "is right"),
        (lambda: MatchOptions(linear_sigma=float("nan")), "is right"),
        (lambda: MatchOptions(damage_rounds=-1), "is right"),
        (lambda: FiducialOptions(pose="45"), "auto or one of 0, 90"),
        (lambda: DiskSearch((1.0, 5.0)), "the smallest first"),
        (lambda: DiskSearch((9.0, 5.0)), "the smallest first"),
        (lambda: RingCode(2), "bits are 2"),
        (lambda: RingCode(12, (3.0, 2.0)), "inner one first"),
        (lambda: TargetPrediction("a", np.zeros(2), np.eye(2), 0.0), "a positive number is right"),
        (lambda: TargetPrediction("a", np.zeros(2), np.zeros((2, 3)), 5.0), r"pixel_from_disk \(2, 2\)"),
        (lambda: sampled_curve(np.array([0.0, 0.5, 0.4, 1.0])), "grows"),
        (lambda: learn_template([], 3.0), "needs a picture"),
        (lambda: fit_frame(np.zeros((1, 2)), np.zeros((1, 2)), np.ones(1), np.eye(2)), "two or more"),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()

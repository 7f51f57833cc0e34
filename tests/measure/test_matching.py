"""Least-squares matching against marks drawn by brute force: at the bound, with honest standard deviations."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from drawn import Array, brute_picture, placed
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import MarkFit, MatchOptions, ScanWindow, match
from measure.fiducials.interior_orientation import fit_frame
from measure.fiducials.options import FiducialOptions
from measure.marks.shapes import Mark, MarkShape, cross, dot, polygon, ring_cross, ring_dot
from measure.marks.templates import learn_template
from measure.targets.detection import DiskSearch
from measure.targets.identification import TargetPrediction
from measure.targets.ring_codes import RingCode
from measure.tone.curve import sampled_curve

SIZE, SCALE, CONTRAST, GROUND = 41, 10.0, 500.0, 1000.0
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


@pytest.mark.parametrize("name", MARKS)
@pytest.mark.parametrize("blur_px", [0.6, 1.2])
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
    for index in range(18):
        shown, place = draw_mark("ring-cross", 1.0)[index % PHASES]
        grey = GROUND + CONTRAST * shown + rng.normal(0, 25, shown.shape)
        clean.append(measure_picture(grey, MARKS["ring-cross"], place, rng).center_px - place[:, 2])
        for _ in range(3):
            speck = brute_picture(MarkShape(dot(0.2)), placed(SCALE, tuple(rng.uniform(6, 35, 2))), SIZE, SIZE, 0.7)
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
    for index in range(36):
        shown, place = draw_mark("ring-cross", 1.0)[index % PHASES]
        grain = gaussian_filter(rng.normal(0, 1, (SIZE, SIZE)), grain_px, mode="wrap")
        fit = measure_picture(GROUND + CONTRAST * shown + 25 * grain / grain.std(), MARKS["ring-cross"], place, rng)
        assert fit.converged, fit.reason
        assert not fit.covariance_is_white
        error = fit.center_px - place[:, 2]
        ratios.append(error / np.sqrt(np.diag(fit.covariance_px2)))
    assert 0.85 < np.sqrt(np.mean(np.square(ratios))) < 1.25  # 72 numbers: 8.3 % standard deviation


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

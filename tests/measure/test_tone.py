"""Tone curves: what is believed of them, what pictures say of them, and marks measured through them."""

from dataclasses import replace

import numpy as np
import pytest
from drawn import ALIKE, frame_picture, make_scan, pixel_from_camera
from studies import parametrize_with_studies
from true_marks import KIND, Kind, TrueMark, some_mark, whitened_rms

from measure import FiducialOptions, MarkFit, MarkShape, MatchOptions, match, polygon
from measure.detection.localisation import MarkPrediction
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.mark_fit import Detection, detect_mark, options_for
from measure.fiducials.measure_frame import measure_frame, shift_to_curve
from measure.marks.shapes import FiducialLayout, LayoutMark
from measure.matching.window import read_window
from measure.tone.curve import LINEAR, Tone, ToneInformation, power, sampled_curve, srgb
from measure.tone.estimate import FrameTone, MarkTone, tone_score
from synthetic_images.tone_curve import coded

FULL = 65535.0
DARK, LIGHT = 0.06, 0.55
SETTLED = 1e-5  # the square of how far a curve may still move, in its prior standard deviations
CURVES: tuple[float | str, ...] = (1.0, 2.2, "srgb", "s-curve")
# A half-wedge that grows out of the border: its tip, and no more, holds it along its axis.
TIP = Kind(
    "tip", MarkShape(polygon(((0.0, 0.0), (-2.6, 6.0), (2.6, 6.0))), known_mm=((-3.0, -2.0), (3.0, 1.8))), (), 1e-4
)


def encode_mark(mark: TrueMark, curve: float | str, snr: float, rng: np.random.Generator) -> np.ndarray:
    light = DARK + (LIGHT - DARK) * (mark.picture + rng.standard_normal(mark.picture.shape) / snr)
    return FULL * coded(np.clip(light, 0.0, 1.0).astype(np.float32), curve)


def fit_mark(mark: TrueMark, code: np.ndarray, tone: Tone) -> MarkFit:
    scan = make_scan(code).replace_tone(tone)
    options = options_for(mark.kind.shape, MatchOptions(linear_sigma=0.05), mark.kind.known)
    return match(read_window(scan, (0, 0, mark.size, mark.size)), mark.kind.shape, mark.place, options)


def settled(marks: list[TrueMark], codes: list[np.ndarray], prior: Tone) -> tuple[list[MarkFit], FrameTone]:
    """From the first start at which the marks agree on the curve that they were matched by, or the best."""
    tried = []
    for start in (prior, prior.shift_to_power(1.0), prior.shift_to_power(2.2)):
        tried.append(settled_from(start, marks, codes, prior))
        if tried[-1][1].disagreement < SETTLED:
            break
    return min(tried, key=lambda each: each[1].disagreement)


def settled_from(
    tone: Tone, marks: list[TrueMark], codes: list[np.ndarray], prior: Tone
) -> tuple[list[MarkFit], FrameTone]:
    for _ in range(5):
        fits = [fit_mark(mark, code, tone) for mark, code in zip(marks, codes, strict=True)]
        estimate = {n: fit.tone for n, fit in enumerate(fits) if fit.tone is not None}
        found = FrameTone.from_marks(prior, estimate, tone)
        if found.apart < SETTLED:
            break
        tone = found.next_curve(tone)
    return fits, found


@pytest.mark.parametrize(("tone", "code", "light"), [
    (LINEAR, 1000.0, 1000.0),
    (Tone(power(2.2)), FULL / 2, FULL * 0.5**2.2),
    (Tone(srgb()), 0.5 * FULL, FULL * 0.21404),  # IEC 61966-2-1
    (Tone(sampled_curve(np.linspace(0, 1, 9) ** 2)), FULL * 0.5, FULL * 0.25),
])  # fmt: skip
def test_light_of_a_code_and_back(tone: Tone, code: float, light: float) -> None:
    assert tone.light(np.array([code]), FULL)[0] == pytest.approx(light, rel=1e-3)
    assert tone.code(np.array([light]), FULL)[0] == pytest.approx(code, rel=1e-3)


def test_departures_change_light_as_their_derivatives_say() -> None:
    tone, codes = Tone.unknown(), np.linspace(0.1, 0.9, 9) * FULL
    for k in range(5):
        step = np.eye(5)[k] * 1e-3
        more, less = (tone.replace_departures(way * step).light(codes, FULL).astype(float) for way in (1, -1))
        by_departure = (more - less) / 2e-3
        result = tone.derivatives(tone.light(codes, FULL), FULL)[k]
        gain = np.polyfit(tone.light(codes, FULL).astype(float), by_departure - result, 1)  # but for gain and offset
        assert np.allclose(
            np.polyval(gain, tone.light(codes, FULL)), by_departure - result, atol=1e-3 * np.ptp(result) + 1
        )


def test_a_declared_curve_holds_until_pictures_contradict_it() -> None:
    declared = Tone.declared(power(2.2), "the file says so")
    assert declared.equivalent_power(0.1, 0.9)[0] == pytest.approx(2.2, abs=0.01)
    linear = -1.2 / 0.6 * np.eye(5)[0]  # departures that make a power of 1 of it
    strong, faint = (tone_information(linear, w) for w in (400.0, 0.1))
    believed = declared.estimate([faint])[0]
    assert believed.equivalent_power(0.1, 0.9)[0] == pytest.approx(2.2, abs=0.05)
    assert "contradict" not in believed.source
    believed = declared.estimate([strong] * 3)[0]
    assert believed.equivalent_power(0.1, 0.9)[0] == pytest.approx(1.0, abs=0.1)
    assert "contradict" in believed.source


@parametrize_with_studies("curve", CURVES, quick=(1,))
def test_the_tip_of_a_wedge_is_where_it_was_drawn_whatever_the_curve(curve: float | str) -> None:
    rng = np.random.default_rng(3)
    errors, covariances, off = [], [], []
    for _ in range(3):
        marks = [some_mark(TIP, 1.0, rng) for _ in range(4)]
        codes = [encode_mark(mark, curve, 80.0, rng) for mark in marks]
        fits, found = settled(marks, codes, Tone.unknown())
        for mark, fit in zip(marks, fits, strict=True):
            assert fit.tone is not None
            errors.append(fit.center_px - mark.place[:, 2])
            covariances.append(fit.covariance_px2 + found.covariance_px2(fit.tone))
            axis = mark.place[:, 1] / np.hypot(*mark.place[:, 1])
            off.append(float(errors[-1] @ axis))
            assert np.hypot(*errors[-1]) < 5 * np.sqrt(np.linalg.eigvalsh(covariances[-1])[-1])
    assert abs(np.mean(off)) < 0.15  # taken as light: 0.5 to 1 px
    assert whitened_rms(errors, covariances) < 2.2  # of three scans, in fact: the tips of one are off together


def test_a_refit_weighs_noise_that_grows_with_light_as_a_fit_from_scratch_does() -> None:
    """Even noise of the stored grey values: in light it grows, most where it is light."""
    rng, tone = np.random.default_rng(5), Tone(power(2.2))
    mark = some_mark(KIND["cross"], 1.0, rng)
    code = FULL * coded((DARK + (LIGHT - DARK) * mark.picture).astype(np.float32), 2.2)
    scan = make_scan(code + rng.normal(0, 1500, code.shape)).replace_tone(tone)
    window = read_window(scan, (0, 0, mark.size, mark.size))
    options = options_for(mark.kind.shape, MatchOptions(linear_sigma=0.05), mark.kind.known)
    fit = match(window, mark.kind.shape, mark.place, options)
    again = match(window, mark.kind.shape, mark.place, options, before=fit)
    assert again.covariance_px2 == pytest.approx(fit.covariance_px2, rel=0.05, abs=2e-5)
    assert np.hypot(*(again.center_px - fit.center_px)) < 0.002


def test_a_picture_that_contradicts_the_others_hardly_moves_the_curve() -> None:
    agreed = [mark_tone(np.eye(5)[0]).information] * 4
    alone, prior = mark_tone(-3 * np.ones(5)).information, Tone.unknown()
    tone, scatter = prior.estimate([*agreed, alone])
    assert prior.estimate(agreed)[1] == 0.0
    assert scatter > 0.3
    off = tone.mean - np.eye(5)[0]
    assert np.sqrt(off @ np.linalg.solve(tone.covariance, off)) < 3


def test_many_scans_in_jpeg_tell_the_curve_no_better_than_rounding_lets_them() -> None:
    """The same wedge of 8 bits, as if sixteen scans showed it so: what noise makes of it averages, rounding by 12 grey
    values does not."""
    rng = np.random.default_rng(9)
    mark = some_mark(TIP, 1.0, rng)
    code = encode_mark(mark, 2.2, 80.0, rng) / 257
    known = []
    for step_dn in (0.0, 12.0):
        scan = make_scan(code, 255, step_dn).replace_tone(Tone.unknown())
        expected = MarkPrediction(mark.kind.shape, mark.place, 3.0, 1)
        fit = detect_mark(scan, expected, MatchOptions(linear_sigma=0.05), mark.kind.known).fit
        assert fit is not None
        assert fit.tone is not None
        estimate = [ToneInformation.pooled([fit.tone.information] * count).scanner_information for count in (1, 16)]
        known.append([np.linalg.norm(information.matrix, 2) for information in estimate])
    (one, many), (one_rounded, many_rounded) = known
    assert many == pytest.approx(16 * one)
    assert many_rounded < 4 * one_rounded


def test_noise_that_is_cut_off_at_black_feigns_no_curve() -> None:
    """Light that is stored as it is, on ground so near black that a third of its noise is cut off: its mean is too
    light, and an edge out of it as bent as by a curve."""
    rng = np.random.default_rng(11)
    linear, moved = Tone(power(1.0), covariance=np.eye(5)), []
    for _ in range(12):
        mark = some_mark(TIP, 1.3, rng)
        light = 0.02 + 0.5 * (mark.picture + rng.standard_normal(mark.picture.shape) / 12)
        estimate = fit_mark(mark, FULL * np.clip(light, 0.0, 1.0), linear).tone
        assert estimate is not None
        found = linear.estimate([estimate.information])[0]
        moved.append(float(mark.place[:, 1] @ estimate.on_place @ found.mean / np.hypot(*mark.place[:, 1])))
    assert abs(np.mean(moved)) < 4 * np.std(moved) / np.sqrt(len(moved))


def mark_tone(departures: np.ndarray) -> MarkTone:
    """A mark that says them with a standard deviation of 0.1, and moves by 1 px for each."""
    return MarkTone(tone_information(departures, 100.0), np.eye(2, 5), 0.1, 0.7)


def tone_information(departures: np.ndarray, weight: float) -> ToneInformation:
    """Each of them known to 1 / sqrt(weight)."""
    return ToneInformation(weight * np.eye(5), weight * departures, weight * float(departures @ departures), 5)


def test_a_mark_whose_detail_alone_was_fitted_moves_with_the_curve_and_says_nothing_of_it() -> None:
    rng = np.random.default_rng(7)
    mark, prior = some_mark(KIND["cross"], 1.0, rng), Tone.unknown()
    row, col = np.mgrid[: mark.size, : mark.size]
    landscape = 1 + 0.15 * (np.sin(col / 5) * np.sin(row / 5) - 1)
    estimate = fit_mark(mark, landscape * encode_mark(mark, 2.2, 100.0, rng), prior).tone
    assert estimate is not None
    assert estimate.information.count == 0
    found = FrameTone.from_marks(prior, {0: estimate}, prior)
    assert found.scatter == 0.0
    assert np.array_equal(found.tone.covariance, prior.covariance)
    assert 0.005 < np.sqrt(np.trace(found.covariance_px2(estimate))) < 0.1


def test_a_score_is_what_unknowns_and_priors_leave_of_the_departures() -> None:
    """A least-squares fit of all at once has the departures that score and information give, for one picture as for
    each of several."""
    rng = np.random.default_rng(8)
    design, changes, residuals = rng.normal(size=(3, 4, 50)), rng.normal(size=(3, 5, 50)), rng.normal(size=(3, 50))
    priors, departures = np.array([0.0, 9.0, 4.0, 0.0]), np.array([0.0, 0.3, -0.2, 0.0])
    each = tone_score(design, changes, residuals)
    for k in range(3):
        (*_, expected) = np.split(
            np.linalg.lstsq(np.vstack([design[k], changes[k]]).T, -residuals[k], rcond=None)[0], [4]
        )
        np.testing.assert_allclose(np.linalg.solve(each.normal[k], each.value[k]), expected, atol=1e-9)
    rows = np.vstack([np.vstack([design[0], changes[0]]).T, np.hstack([np.diag(np.sqrt(priors)), np.zeros((4, 5))])])
    wanted = -np.concatenate([residuals[0], -np.sqrt(priors) * departures])
    expected = np.linalg.lstsq(rows, wanted, rcond=None)[0][4:]
    score = tone_score(design[0], changes[0], residuals[0], priors, departures)
    np.testing.assert_allclose(np.linalg.solve(score.normal, score.value), expected, atol=1e-9)


@pytest.mark.parametrize(("tone", "powers"), [
    (Tone.unknown(), [1.0, 0.5, 2.4]),
    (Tone.declared(power(2.2), "the file says so"), [1.0, 1.6, 0.5]),
    (Tone(power(2.2)), []),
])  # fmt: skip
def test_curves_to_begin_with_are_others_than_the_one_believed(tone: Tone, powers: list[float]) -> None:
    starts = tone.starting_curves
    assert [start.equivalent_power(0.1, 0.9)[0] for start in starts] == pytest.approx(powers, abs=0.04)
    assert all(start.prior is tone and np.array_equal(start.covariance, tone.covariance) for start in starts)


def test_a_curve_far_from_the_first_one_is_reached_from_another_start() -> None:
    """Light stored as its power of 1.5: the first linearisation led to a power of 0.3, which no scanner has."""
    matrix = pixel_from_camera("0", turn_rad=0.004)
    light = (6000.0 + 40000.0 * (frame_picture(ALIKE, matrix) - 7382.0) / 7500.0) / FULL
    scan = make_scan(FULL * np.clip(light, 0.0, 1.0) ** 1.5).replace_tone(Tone.unknown())
    placement = Placement("0", matrix, 4.0, 4, 1, 1, (0.05, 0.05))
    frame = measure_frame(scan, ALIKE, placement, FiducialOptions(pose="0"))
    power, sigma = frame.tone.tone.equivalent_power(frame.tone.least, frame.tone.greatest)
    assert abs(power - 1 / 1.5) < 3 * sigma < 0.2
    for fit, given in zip(frame.inlier_fits.values(), ALIKE.marks, strict=True):
        assert np.hypot(*(fit.center_px - matrix @ (*given.xy_mm, 1.0))) < 4 * fit.sigma_px


def test_the_last_step_of_the_curve_moves_a_mark_as_another_fit_does() -> None:
    """A tip that moves by 0.3 px along its axis from a power of 1.6 to one of 2."""
    mark, before = some_mark(TIP, 1.0, np.random.default_rng(2)), Tone.unknown()
    after, code = before.shift_to_power(2.0), encode_mark(mark, 2.2, 30.0, np.random.default_rng(3))
    fit, expected = (fit_mark(mark, code, tone) for tone in (before, after))
    scan, placement = make_scan(code).replace_tone(before), Placement("0", mark.place, 1.0, 1, 1, 1, (0.1, 0.1))
    layout = FiducialLayout((LayoutMark("1", (0.0, 0.0), (0.01, 0.01), TIP.shape),), (1.0, 1.0))
    frame = Frame.from_placement(scan, layout, placement, FiducialOptions("0"))
    frame = replace(frame, detections=(Detection(fit.center_px, True, fit),), tone=FrameTone(after))
    (shifted,) = shift_to_curve(frame).detections
    refitted = expected.center_px - fit.center_px
    assert shifted.fit is not None
    assert np.hypot(*refitted) > 0.2
    np.testing.assert_allclose(shifted.fit.center_px - fit.center_px, refitted, atol=0.02)

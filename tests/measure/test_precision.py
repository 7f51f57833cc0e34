"""Marks at the Cramér-Rao bound, by the error that the best linear estimate makes in the very same noise."""

from dataclasses import replace

import numpy as np
import pytest
from drawn import scan_of
from studies import parametrize_with_studies
from true_marks import (
    ALL_MOVES,
    KIND,
    WING,
    Kind,
    TrueMark,
    grain_correlation,
    grainy,
    some_mark,
    whitened_rms,
)

from measure.detection.localisation import MarkPrediction
from measure.fiducials.mark_fit import detect_mark
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Cause
from measure.marks.shapes import Disk, FiducialLayout, LayoutMark, MarkShape, cross, polygon, turned
from measure.results import MarkFit
from measure.targets.disks import fit_disk
from measure.tone.curve import Tone

GROUND, CONTRAST, SNR = 25000.0, 15000.0, 20.0


def sighted(mark: TrueMark, grey: np.ndarray, rng: np.random.Generator, rounding_step_dn: float = 0.0) -> MarkFit:
    start = np.column_stack([mark.place[:, :2], mark.place[:, 2] + rng.uniform(-1, 1, 2)])
    frame_sigma = mark.kind.known if np.isfinite(mark.kind.known) else None
    scan, options = scan_of(grey, rounding_step_dn=rounding_step_dn), FiducialOptions().match
    fit = detect_mark(scan, MarkPrediction(mark.kind.shape, start, 3.0, 1), options, frame_sigma).fit
    assert fit is not None
    return fit


@parametrize_with_studies(("name", "grain_px"), [("ring-dot", 0.0), ("wing", 0.0), ("dot", 1.0)])
def test_marks_are_at_the_bound_with_honest_sigmas_in_white_noise_and_in_grain(name: str, grain_px: float) -> None:
    rng = np.random.default_rng(1)
    correlation = grain_correlation(grain_px) if grain_px else None
    marks = [some_mark(KIND[name], 1.0, rng) for _ in range(2)]
    errors, covariances, best, bounds = [], [], [], []
    for number in range(16):
        mark = marks[number % len(marks)]
        unit = grainy(mark.size, grain_px, rng) if grain_px else rng.standard_normal((mark.size, mark.size))
        fit = sighted(mark, GROUND + CONTRAST * (mark.picture + unit / SNR), rng)
        errors.append(fit.center_px - mark.place[:, 2])
        covariances.append(fit.covariance_px2)
        best.append(mark.best_errors(unit / SNR, 1 / SNR, None, correlation))
        bounds.append(mark.bound(1 / SNR, None, correlation))
    assert np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(best))) < 1.12
    assert 0.9 < whitened_rms(errors, covariances) / whitened_rms(best, bounds) < 1.1


def test_marks_say_how_well_the_frame_s_stretch_and_shear_are_known_that_move_them() -> None:
    """A few marks close together, say, that are given a little off: all their tips are then off alike."""
    rng, roughly = np.random.default_rng(8), 2e-3
    dots = MarkShape((*cross(0.5, 0.15), *(Disk((1.6, y), 0.18) for y in (-0.5, 0.0, 0.5))))
    errors, covariances, best, bounds = [], [], [], []
    for kind in (KIND["wedge"], KIND["wing"], Kind("identification dots", dots, ALL_MOVES)):
        true = some_mark(replace(kind, known=roughly), 1.0, rng)
        for _ in range(6):
            unit = rng.standard_normal((true.size, true.size)) / 200
            off = rng.normal(0, roughly, len(ALL_MOVES))
            result = (np.eye(2) + np.tensordot(off, np.reshape(ALL_MOVES, (-1, 2, 2)), 1)) @ true.place[:, :2]
            predicted = TrueMark(true.kind, np.column_stack([result, true.place[:, 2]]), true.size, 1.0)
            fit = sighted(predicted, GROUND + CONTRAST * (true.picture + unit), rng)
            errors.append(fit.center_px - true.place[:, 2])
            covariances.append(fit.covariance_px2)
            best.append(true.best_errors(unit, 1 / 200, told=off))
            bounds.append(true.bound(1 / 200))
    assert np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(best))) < 1.15
    assert 0.9 < whitened_rms(errors, covariances) / whitened_rms(best, bounds) < 1.1


def test_a_disk_on_plain_ground_uses_more_of_it() -> None:
    rng = np.random.default_rng(2)
    mark = some_mark(KIND["ellipse"], 1.0, rng)
    grey = GROUND + CONTRAST * mark.picture + 300 * rng.standard_normal((mark.size, mark.size))
    plain = fit_disk(scan_of(grey), mark.place[:, 2] + 0.3, mark.place[:, :2])
    near = fit_disk(scan_of(grey), mark.place[:, 2] + 0.3, mark.place[:, :2], longest_margin_px=2.5)
    col = np.arange(mark.size) - mark.place[0, 2]
    neighbour = fit_disk(scan_of(grey + 9000 * (col > 10)), mark.place[:, 2] + 0.3, mark.place[:, :2])
    assert np.trace(plain.covariance_px2) < 0.85 * np.trace(near.covariance_px2)
    np.testing.assert_allclose(neighbour.center_px, mark.place[:, 2], atol=0.06)
    assert not neighbour.reason


def test_faint_soft_disks_are_at_the_bound() -> None:
    rng = np.random.default_rng(7)
    mark = some_mark(KIND["ellipse"], 2.5, rng)
    beyond = []
    for _ in range(10):
        noise = rng.standard_normal((mark.size, mark.size)) / 5
        start = mark.place[:, 2] + rng.normal(0, 0.4, 2), mark.place[:, :2] * rng.uniform(0.9, 1.1)
        disk = fit_disk(scan_of(GROUND + CONTRAST * (mark.picture + noise)), *start)
        assert not disk.reason
        beyond.append(disk.center_px - mark.place[:, 2] - mark.best_errors(noise, 1 / 5))
    assert np.square(beyond).sum() < 10 * 0.3 * np.trace(mark.bound(1 / 5))


def test_wings_take_rotation_and_scale_from_their_frame() -> None:
    rng = np.random.default_rng(3)
    places = [(-25.0, 0.0, 90.0), (25.0, 0.0, -90.0), (0.0, 25.0, 0.0), (3.0, -25.0, 180.0)]
    marks = tuple(
        LayoutMark(str(number), (x, y), (0.01, 0.01), turned(MarkShape(polygon(WING)), turn))
        for number, (x, y, turn) in enumerate(places)
    )
    c, s = np.cos(0.026), np.sin(0.026)
    linear = 9.93 * np.array([[c, -s], [-s, -c]])
    grey, true = np.full((640, 640), GROUND), []
    for mark in marks:
        center = np.array([320.3, 319.8]) + linear @ mark.xy_mm
        corner = np.floor(center).astype(int) - 40
        kind = Kind("wing", MarkShape(mark.mark.parts) if isinstance(mark.mark, MarkShape) else KIND["wing"].shape)
        shown = TrueMark(kind, np.column_stack([linear, center - corner]), 81, 1.0).picture
        grey[corner[1] : corner[1] + 81, corner[0] : corner[0] + 81] += CONTRAST * shown
        true.append(center)
    grey += 150 * rng.standard_normal(grey.shape)
    result = measure_fiducials(scan_of(grey), FiducialLayout(marks, (60.0, 60.0)), (100.7, 100.7))
    errors = [np.asarray(mark.center_px) - place for mark, place in zip(result.marks, true, strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) < 0.009  # of a placement's rotation alone: 0.012 and more


def test_what_compression_hides_of_a_faint_mark_is_added_to_its_sigma() -> None:
    rng = np.random.default_rng(4)
    mark = some_mark(KIND["ring-dot"], 1.0, rng)
    grey = GROUND + CONTRAST * (mark.picture + grainy(mark.size, 1.0, rng) / 100)
    film, fine, coarse = (sighted(mark, grey, np.random.default_rng(5), step * CONTRAST) for step in (0.0, 0.01, 0.3))
    assert np.trace(film.covariance_px2) / 2 < 0.006**2
    assert np.trace(fine.covariance_px2) / 2 < 0.012**2
    assert 0.02**2 < np.trace(coarse.covariance_px2) / 2 < 0.03**2


def test_a_notch_in_a_soft_scan_is_matched_with_enough_of_its_ground() -> None:
    rng = np.random.default_rng(6)
    shares = []
    for _ in range(3):
        mark = some_mark(KIND["notch"], 1.6, rng)
        fit = sighted(mark, GROUND + CONTRAST * (mark.picture + rng.standard_normal((mark.size, mark.size)) / SNR), rng)
        shares.append(np.trace(fit.place_covariance.parts[Cause.NOISE]) / np.trace(mark.bound(1 / SNR)))
    assert np.sqrt(np.mean(shares)) < 1.08  # with four standard deviations of the blur: 1.11 and more


def test_lines_far_wider_than_the_mark_s_are_not_the_mark() -> None:
    """Handwriting, say: drawn as finely as the mark it would need more contrast than a scan has."""
    wide, fine = (MarkShape(cross(1.5, line_mm)) for line_mm in (0.5, 0.03))
    mark = TrueMark(Kind("wide cross", wide), np.array([[10.0, 0.0, 40.3], [0.0, -10.0, 39.8]]), 81, 3.0)
    grey = 30 + 200 * mark.picture + np.random.default_rng(1).normal(0, 3, mark.picture.shape)
    detection = detect_mark(scan_of(grey, 255), MarkPrediction(fine, mark.place, 3.0, 1), FiducialOptions().match)
    assert detection.fit is None
    assert "far wider than the mark's lines" in detection.reason


def test_what_compression_makes_of_the_tone_curve_is_alike_in_all_marks() -> None:
    rng = np.random.default_rng(4)
    mark = some_mark(KIND["wedge"], 1.0, rng)
    grey = GROUND + CONTRAST * (mark.picture + rng.standard_normal((mark.size, mark.size)) / 100)
    expected = MarkPrediction(mark.kind.shape, mark.place, 3.0, 1)
    for step, alike in ((0.0, 0.0), (0.1, 0.35**2)):  # 3.5 times the step over the contrast
        scan = scan_of(grey, rounding_step_dn=step * CONTRAST).replace_tone(Tone.unknown())
        fit = detect_mark(scan, expected, FiducialOptions().match, mark.kind.known).fit
        assert fit is not None
        assert fit.tone is not None
        assert fit.tone.information.matrix.any()
        assert fit.tone.information.common_variance == pytest.approx(alike, rel=0.1)

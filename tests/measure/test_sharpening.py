"""Scans that were sharpened by an unsharp mask: undone, estimated from marks, and marks measured in them."""

from dataclasses import replace

import numpy as np
import pytest
from drawn import scan_of
from scipy.ndimage import gaussian_filter
from true_marks import KIND, some_mark

from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.flags import Cause, Status
from measure.marks.shapes import FiducialLayout, LayoutMark
from measure.results import FrameMeasurement
from measure.tone.curve import Tone, ToneInformation
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import Sharpening

FULL, PX_PER_MM, SIDE_PX = 65535.0, 10.0, 320
PLACES = ((8.0, -8.0), (-8.0, -8.0), (-8.0, 8.0), (8.0, 8.0))
Array = np.ndarray


def sharpened(codes: Array, amount: float, radius_px: float) -> Array:
    return np.asarray(codes + amount * (codes - gaussian_filter(codes, radius_px, mode="nearest")))


def frame(
    rng: np.random.Generator, amount: float, radius_px: float, tone: float = 1.6
) -> tuple[FrameMeasurement, Array]:
    """Four dark crosses on film with grain, coded and sharpened, as they were measured, and where they are."""
    kind, linear, middle = KIND["cross"], PX_PER_MM * np.diag([1.0, -1.0]), SIDE_PX / 2 + rng.uniform(-0.5, 0.5, 2)
    light, true_px = 0.5 + 0.008 * rng.standard_normal((SIDE_PX, SIDE_PX)), []
    for place in PLACES:
        mark = some_mark(kind, 0.8, rng)
        corner = np.rint(linear @ place + middle).astype(int) - mark.size // 2
        mark = replace(mark, place=np.column_stack([linear, linear @ place + middle - corner]))
        light[corner[1] :, corner[0] :][: mark.size, : mark.size] -= 0.25 * mark.picture
        true_px.append(linear @ place + middle)
    marks = tuple(LayoutMark(str(n), place, (0.005, 0.005), kind.shape) for n, place in enumerate(PLACES))
    scan = scan_of(FULL * np.clip(sharpened(light ** (1 / tone), amount, radius_px), 0.0, 1.0))
    options, pitch_um = FiducialOptions(pose="0"), 1000 / PX_PER_MM
    layout = FiducialLayout(tuple(marks), (17.0, 17.0))
    return measure_fiducials(scan.replace_tone(Tone.unknown()), layout, (pitch_um, pitch_um), options), np.array(
        true_px
    )


@pytest.mark.parametrize(("amount", "radius_px"), [(0.5, 0.7), (1.5, 1.2), (2.0, 3.0)])
def test_what_an_unsharp_mask_did_is_undone(amount: float, radius_px: float) -> None:
    codes = gaussian_filter(np.random.default_rng(1).standard_normal((120, 110)), 1.0)
    mask = Sharpening(amount, radius_px)
    reach = mask.reach_px
    undone = mask.undone(sharpened(codes, amount, radius_px))
    inner = np.s_[reach:-reach, reach:-reach] if 2 * reach < 100 else np.s_[40:-40, 40:-40]
    np.testing.assert_allclose(undone[inner], codes[inner], atol=0.01 * codes.std())
    step = 1e-4
    more = Sharpening(amount + step, radius_px), Sharpening(amount, radius_px * np.exp(step))
    for change, other in zip(mask.changes(undone), more, strict=True):
        by_step = (undone - other.undone(mask_codes := sharpened(codes, amount, radius_px))) / step
        assert mask_codes.shape == change.shape
        np.testing.assert_allclose(change[inner], by_step[inner], atol=0.02 * np.abs(change).max())


def test_a_window_is_read_as_it_was_before_the_scan_was_sharpened() -> None:
    codes = 30000 + 8000 * gaussian_filter(np.random.default_rng(2).standard_normal((150, 150)), 1.5)
    mask = Sharpening(1.5, 1.2)
    scan = scan_of(sharpened(codes, 1.5, 1.2)).replace_tone(Tone().sharpened(mask))
    np.testing.assert_allclose(scan.light(60, 50, 40, 30), codes[50:80, 60:100], atol=20)


def test_sharpening_is_estimated_from_marks_which_are_measured_where_they_are() -> None:
    result, true_px = frame(np.random.default_rng(4), 1.5, 1.2)
    assert result.tone is not None
    found = result.tone.tone.sharpening
    off = np.array([found.amount - 1.5, np.log(found.radius_px / 1.2)])
    assert off @ np.linalg.solve(found.covariance, off) < 14  # two figures, p = 0.001
    assert 0.7 < found.amount < 2.5
    assert "sharpened, by an amount of" in result.tone.note
    for mark, place in zip(result.marks, true_px, strict=True):
        assert mark.status is Status.MEASURED, mark.reason
        assert mark.center_px is not None
        assert mark.covariance is not None
        error = mark.center_px - place
        assert error @ np.linalg.solve(mark.covariance.px2, error) < 14
        assert Cause.SHARPENING in mark.covariance.parts
        assert mark.quality["damaged_fraction"] < 0.05


def test_a_scan_that_is_not_sharpened_is_not_taken_for_one() -> None:
    result, _ = frame(np.random.default_rng(4), 0.0, 1.0)
    assert result.tone is not None
    assert not result.tone.tone.sharpening
    assert "sharpened" not in result.tone.note
    assert all(mark.covariance and Cause.SHARPENING not in mark.covariance.parts for mark in result.marks)


def test_scans_of_a_scanner_say_together_how_it_sharpens() -> None:
    own = [Sharpening(amount, 1.2, np.diag([0.04, 0.01])) for amount in (1.3, 1.5, 1.7)]
    pooled = Sharpening.pooled(own)
    assert pooled.amount == pytest.approx(1.5)
    assert pooled.radius_px == pytest.approx(1.2)
    assert 0.1 < np.sqrt(pooled.covariance[0, 0]) < 0.3
    assert not Sharpening.pooled([own[0], Sharpening(), Sharpening()])  # most are not
    information = [replace(ToneInformation.empty(), sharpening=each) for each in own]
    known = Tone.unknown().include_information(information).sharpening
    assert known.amount == pytest.approx(1.5)
    assert known.prior is not None  # a scan's own marks add to it


@pytest.mark.parametrize(("value", "is_taken"), [(0.8, True), (0.2, False), (-0.1, False), (4.5, False)])
def test_a_curve_that_no_scanner_has_is_not_taken(value: float, is_taken: bool) -> None:
    prior = Tone.unknown()
    text = prior.shift_to_power(value).mean
    matrix = 400.0 * np.eye(len(text))
    information = ToneInformation(matrix, matrix @ text, float(text @ matrix @ text), len(text))
    mark = MarkTone(information, np.full((2, len(text)), 0.1), 0.1, 0.9)
    found = FrameTone.from_marks(prior, dict.fromkeys(range(8), mark), prior)
    assert (found.tone.equivalent_power(0.1, 0.9)[0] == pytest.approx(value, abs=0.1)) == is_taken
    assert ("was not taken" in found.note) == (not is_taken)
    grown = np.trace(found.covariance_px2(mark)) > np.trace(FrameTone(prior).covariance_px2(mark))
    assert grown == (not is_taken)

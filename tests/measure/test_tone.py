"""Tone curves: what is believed of them, what pictures say of them, and marks measured through them."""

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from drawn import ALIKE, brute_picture, chi_square, frame_picture, make_scan, pixel_from_camera, placed
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies
from true_marks import KIND, Kind, TrueMark, some_mark, whitened_rms

import measure
from measure import FiducialLayout, LayoutMark, Status, read_window
from measure.detection.localisation import MarkPrediction
from measure.fiducials.constellation import Placement
from measure.fiducials.mark_fit import Detection, detect_mark, options_for
from measure.fiducials.measure_frame import Frame, measure_frame, shift_to_curve
from measure.flags import Cause
from measure.scans.jpeg import covariance_of_compression, quantisation_step_dn
from measure.scans.opening import crop_scan, declared_tone
from measure.tone.curve import LINEAR, Tone, ToneInformation, curve_of_profile, power, sampled_curve, srgb
from measure.tone.estimate import FrameTone, MarkTone, tone_score
from measure.tone.sharpening import Sharpening, SharpeningScore, estimate_sharpening
from synthetic_images.tone_curve import coded

FULL = 65535.0
DARK, LIGHT = 0.06, 0.55
SETTLED = 1e-5  # the square of how far a curve may still move, in its prior standard deviations
CURVES: tuple[float | str, ...] = (1.0, 2.2, "srgb", "s-curve")
# A half-wedge that grows out of the border: its tip, and no more, holds it along its axis.
TIP = Kind(
    "tip",
    measure.MarkShape(measure.polygon(((0.0, 0.0), (-2.6, 6.0), (2.6, 6.0))), known_mm=((-3.0, -2.0), (3.0, 1.8))),
    (),
    1e-4,
)


def encode_mark(mark: TrueMark, curve: float | str, snr: float, rng: np.random.Generator) -> np.ndarray:
    light = DARK + (LIGHT - DARK) * (mark.picture + rng.standard_normal(mark.picture.shape) / snr)
    return FULL * coded(np.clip(light, 0.0, 1.0).astype(np.float32), curve)


def fit_mark(mark: TrueMark, code: np.ndarray, tone: Tone) -> measure.MarkFit:
    scan = make_scan(code).replace_tone(tone)
    options = options_for(mark.kind.shape, measure.MatchOptions(linear_sigma=0.05), mark.kind.known)
    return measure.match(read_window(scan, (0, 0, mark.size, mark.size)), mark.kind.shape, mark.place, options)


def settled(marks: list[TrueMark], codes: list[np.ndarray], prior: Tone) -> tuple[list[measure.MarkFit], FrameTone]:
    """From the first start at which the marks agree on the curve that they were matched by, or the best."""
    tried = []
    for start in (prior, prior.shift_to_power(1.0), prior.shift_to_power(2.2)):
        tried.append(settled_from(start, marks, codes, prior))
        if tried[-1][1].disagreement < SETTLED:
            break
    return min(tried, key=lambda each: each[1].disagreement)


def settled_from(
    tone: Tone, marks: list[TrueMark], codes: list[np.ndarray], prior: Tone
) -> tuple[list[measure.MarkFit], FrameTone]:
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
    (Tone(power(2.2)), 0.0, 0.0),
])  # fmt: skip
def test_light_of_a_code_and_back(tone: Tone, code: float, light: float) -> None:
    assert tone.light(np.array([code]), FULL)[0] == pytest.approx(light, rel=1e-3)
    assert tone.code(np.array([light]), FULL)[0] == pytest.approx(code, rel=1e-3)
    if not tone.is_identity:
        assert tone.light(np.array([-0.5]), FULL)[0] == 0.0


def test_departures_change_light_as_their_derivatives_say() -> None:
    tone, codes = Tone.unknown(), np.linspace(0.1, 0.9, 9) * FULL
    for k in range(5):
        step = np.eye(5)[k] * 1e-3
        more, less = (replace(tone, mean=way * step).light(codes, FULL).astype(float) for way in (1, -1))
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
    marks = [some_mark(TIP, 1.0, rng) for _ in range(4)]
    codes = [encode_mark(mark, curve, 80.0, rng) for mark in marks]
    fits, found = settled(marks, codes, Tone.unknown())
    for mark, fit in zip(marks, fits, strict=True):
        assert fit.tone is not None
        errors.append(fit.center_px - mark.place[:, 2])
        covariances.append(fit.covariance_px2 + found.covariance_px2(fit.tone))
        axis = mark.place[:, 1] / np.hypot(*mark.place[:, 1])
        off.append(float(errors[-1] @ axis))
    assert abs(np.mean(off)) < 0.15  # taken as light: 0.5 to 1 px
    assert whitened_rms(errors, covariances) < 2.2  # of one scan, whose tips are off together


def test_a_refit_weighs_noise_that_grows_with_light_as_a_fit_from_scratch_does() -> None:
    """Even noise of the stored grey values: in light it grows, most where it is light."""
    rng, tone = np.random.default_rng(5), Tone(power(2.2))
    mark = some_mark(KIND["cross"], 1.0, rng)
    code = FULL * coded((DARK + (LIGHT - DARK) * mark.picture).astype(np.float32), 2.2)
    scan = make_scan(code + rng.normal(0, 1500, code.shape)).replace_tone(tone)
    window = read_window(scan, (0, 0, mark.size, mark.size))
    options = options_for(mark.kind.shape, measure.MatchOptions(linear_sigma=0.05), mark.kind.known)
    fit = measure.match(window, mark.kind.shape, mark.place, options)
    again = measure.match(window, mark.kind.shape, mark.place, options, before=fit)
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
        fit = detect_mark(scan, expected, measure.MatchOptions(linear_sigma=0.05), mark.kind.known).fit
        assert fit is not None
        assert fit.tone is not None
        estimate = [ToneInformation.pool([fit.tone.information] * count).scanner_information for count in (1, 16)]
        known.append([np.linalg.norm(information.matrix, 2) for information in estimate])
    (one, many), (one_rounded, many_rounded) = known
    assert many == pytest.approx(16 * one)
    assert many_rounded < 4 * one_rounded


def test_noise_that_is_cut_off_at_black_feigns_no_curve() -> None:
    """Light that is stored as it is, on ground so near black that a third of its noise is cut off: its mean is too
    light, and an edge out of it as bent as by a curve."""
    rng = np.random.default_rng(11)
    linear, moved = Tone(power(1.0), covariance=np.eye(5)), []
    for _ in range(8):
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
    frame = measure_frame(scan, ALIKE, placement, measure.FiducialOptions(pose="0"))
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
    frame = Frame.from_placement(scan, layout, placement, measure.FiducialOptions("0"))
    frame = replace(frame, detections=(Detection(fit.center_px, True, fit),), tone=FrameTone(after))
    (shifted,) = shift_to_curve(frame).detections
    refitted = expected.center_px - fit.center_px
    assert shifted.fit is not None
    assert np.hypot(*refitted) > 0.2
    np.testing.assert_allclose(shifted.fit.center_px - fit.center_px, refitted, atol=0.02)


GREY = np.linspace(0, 255, 256).astype(np.uint8).reshape(16, 16)
HALF = 0.5  # of full scale


def light(tone: Tone | None, code: float = HALF) -> float:
    assert tone is not None
    return float(tone.light(np.array([code]), 1.0)[0])


def profile(curve: bytes) -> bytes:
    """An ICC profile of one tag, the curve of grey."""
    return bytes(128) + struct.pack(">I4sII", 1, b"kTRC", 144, len(curve)) + curve


GAMMA = b"curv" + bytes(4) + struct.pack(">IH", 1, round(1.8 * 256))
TABLE = b"curv" + bytes(4) + struct.pack(">I", 256) + (np.arange(256) ** 2).astype(">u2").tobytes()
SRGB = b"para" + bytes(4) + struct.pack(">HH", 3, 0) + struct.pack(
    ">5i", *(round(v * 65536) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))
)  # fmt: skip


@pytest.mark.parametrize(
    ("curve", "expected"), [(GAMMA, HALF**1.8), (TABLE, HALF**2), (SRGB, 0.21404), (b"curv" + bytes(8), HALF)]
)
def test_profiles_of_every_kind_of_curve(curve: bytes, expected: float, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, GREY, iccprofile=profile(curve))
    data = imagecodecs.jpeg2k_encode(GREY, codecformat="jp2")
    at, body = data.index(b"colr") - 4, b"colr\2\0\0" + profile(curve)  # a restricted profile for an enumerated colour
    jp2h = data.index(b"jp2h") - 4
    old, whole = (struct.unpack_from(">I", data, place)[0] for place in (at, jp2h))
    head = struct.pack(">I", whole - old + len(body) + 4) + data[jp2h + 4 : at]
    box = struct.pack(">I", len(body) + 4) + body
    path.with_suffix(".jp2").write_bytes(data[:jp2h] + head + box + data[at + old :])
    for each in (path, path.with_suffix(".jp2")):
        tone = declared_tone(each)
        assert light(tone) == pytest.approx(expected, abs=0.003)
        assert tone is not None
        assert tone.is_declared
        assert "ICC" in tone.source


def test_a_profile_of_another_program_agrees_with_its_own_curve(tmp_path: Path) -> None:
    made = imagecodecs.cms_profile("gray", gamma=2.2)
    curve = curve_of_profile(made)
    assert curve is not None
    assert np.interp(HALF, np.linspace(0, 1, len(curve)), curve) == pytest.approx(HALF**2.2, abs=0.003)
    tifffile.imwrite(tmp_path / "a.tif", GREY, iccprofile=made)
    assert light(declared_tone(tmp_path / "a.tif")) == pytest.approx(HALF**2.2, abs=0.003)


def test_a_transfer_function(tmp_path: Path) -> None:
    values = tuple(int(v) for v in 65535 * np.linspace(0, 1, 256) ** 1.5)
    tifffile.imwrite(tmp_path / "a.tif", GREY, photometric="minisblack", extratags=[(301, 3, 256, values, True)])
    assert light(declared_tone(tmp_path / "a.tif")) == pytest.approx(HALF**1.5, abs=0.003)


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@pytest.mark.parametrize(
    ("chunks", "expected"),
    [
        (chunk(b"gAMA", struct.pack(">I", 45455)), HALF**2.2),
        (chunk(b"sRGB", b"\0") + chunk(b"gAMA", struct.pack(">I", 100000)), 0.21404),
        (chunk(b"iCCP", b"grey\0\0" + zlib.compress(profile(GAMMA))) + chunk(b"sRGB", b"\0"), HALF**1.8),
    ],
)
def test_chunks_of_png_files_in_their_order_of_precedence(chunks: bytes, expected: float, tmp_path: Path) -> None:
    data = cv2.imencode(".png", GREY)[1].tobytes()
    (tmp_path / "a.png").write_bytes(data[:33] + chunks + data[33:])
    assert light(declared_tone(tmp_path / "a.png")) == pytest.approx(expected, abs=0.003)


def test_jpeg_files_with_a_profile_and_with_exif(tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", GREY)[1].tobytes()
    whole = profile(TABLE)
    pieces = [whole[:300], whole[300:]]
    segments = b"".join(
        b"\xff\xe2" + struct.pack(">H", 16 + len(piece)) + b"ICC_PROFILE\0" + bytes((number, 2)) + piece
        for number, piece in reversed(list(enumerate(pieces, 1)))
    )
    (tmp_path / "a.jpg").write_bytes(data[:2] + segments + data[2:])
    assert light(declared_tone(tmp_path / "a.jpg")) == pytest.approx(HALF**2, abs=0.003)
    # One directory with a pointer to Exif's own, which has ColorSpace = 1.
    exif = b"MM\0*" + struct.pack(">I", 8)
    exif += struct.pack(">HHHII", 1, 34665, 4, 1, 26) + struct.pack(">I", 0)
    exif += struct.pack(">HHHIHH", 1, 0xA001, 3, 1, 1, 0) + struct.pack(">I", 0)
    body = b"Exif\0\0" + exif
    (tmp_path / "b.jpg").write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(body)) + body + data[2:])
    assert light(declared_tone(tmp_path / "b.jpg")) == pytest.approx(0.21404, abs=0.003)


def test_a_file_that_says_nothing_or_nonsense_says_no_curve(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY)
    assert declared_tone(tmp_path / "a.tif") is None
    falling = b"curv" + bytes(4) + struct.pack(">I", 3) + np.array([9, 5, 1]).astype(">u2").tobytes()
    for number, broken in enumerate((b"short", profile(falling), profile(b"curv" + bytes(3)), bytes(200))):
        path = tmp_path / f"{number}.tif"
        tifffile.imwrite(path, GREY, iccprofile=broken)
        assert declared_tone(path) is None
    assert declared_tone(tmp_path / "missing.tif") is None


PX_PER_MM, SIDE_PX = 10.0, 320
PLACES = ((8.0, -8.0), (-8.0, -8.0), (-8.0, 8.0), (8.0, 8.0))
Array = np.ndarray


def sharpened(codes: Array, amount: float, radius_px: float) -> Array:
    return np.asarray(codes + amount * (codes - gaussian_filter(codes, radius_px, mode="nearest")))


def frame(
    rng: np.random.Generator, amount: float, radius_px: float, tone: float = 1.6
) -> tuple[measure.FrameMeasurement, Array]:
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
    scan = make_scan(FULL * np.clip(sharpened(light ** (1 / tone), amount, radius_px), 0.0, 1.0))
    options, pitch_um = measure.FiducialOptions(pose="0"), 1000 / PX_PER_MM
    layout = FiducialLayout(tuple(marks), (17.0, 17.0))
    return measure.measure_fiducials(
        scan.replace_tone(Tone.unknown()), layout, (pitch_um, pitch_um), options
    ), np.array(true_px)


@pytest.mark.parametrize(("amount", "radius_px"), [(0.5, 0.7), (1.5, 1.2), (2.0, 3.0)])
def test_what_an_unsharp_mask_did_is_undone(amount: float, radius_px: float) -> None:
    codes = gaussian_filter(np.random.default_rng(1).standard_normal((120, 110)), 1.0)
    mask = Sharpening(amount, radius_px)
    reach = mask.reach_px
    undone = mask.unsharpen(sharpened(codes, amount, radius_px))
    inner = np.s_[reach:-reach, reach:-reach] if 2 * reach < 100 else np.s_[40:-40, 40:-40]
    np.testing.assert_allclose(undone[inner], codes[inner], atol=0.01 * codes.std())
    step = 1e-4
    more = Sharpening(amount + step, radius_px), Sharpening(amount, radius_px * np.exp(step))
    for change, other in zip(mask.changes(undone), more, strict=True):
        by_step = (undone - other.unsharpen(mask_codes := sharpened(codes, amount, radius_px))) / step
        assert mask_codes.shape == change.shape
        np.testing.assert_allclose(change[inner], by_step[inner], atol=0.02 * np.abs(change).max())


def test_a_window_is_read_as_it_was_before_the_scan_was_sharpened() -> None:
    codes = 30000 + 8000 * gaussian_filter(np.random.default_rng(2).standard_normal((150, 150)), 1.5)
    mask = Sharpening(1.5, 1.2)
    scan = make_scan(sharpened(codes, 1.5, 1.2)).replace_tone(Tone().replace_sharpening(mask))
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
        assert chi_square(mark, place) < 14
        assert mark.covariance
        assert Cause.SHARPENING in mark.covariance.parts
        assert mark.quality["damaged_fraction"] < 0.05


def test_a_scan_that_is_not_sharpened_is_not_taken_for_one() -> None:
    result, _ = frame(np.random.default_rng(4), 0.0, 1.0)
    assert result.tone is not None
    assert not result.tone.tone.sharpening
    assert "sharpened" not in result.tone.note
    assert all(mark.covariance and Cause.SHARPENING not in mark.covariance.parts for mark in result.marks)


def test_a_sharpening_is_the_same_from_scores_of_marks_fitted_with_different_ones() -> None:
    """Of linear scores, each counted from the sharpening of its own fit."""
    rng, truth = np.random.default_rng(3), Sharpening(1.2, 1.1)
    fitted = [
        Sharpening(amount, radius, np.eye(2)) for amount, radius in ((0.8, 1.0), (1.0, 1.3), (1.4, 0.9), (1.1, 1.1))
    ]
    scores = []
    for each in fitted:
        design = rng.normal(size=(3, 40))
        normal = design @ design.T * 1e4
        value = normal @ np.concatenate([[0.0], truth.values - each.values])
        scores.append(SharpeningScore(value, normal, normal, np.zeros((2, 2)), each))
    unsharpened = SharpeningScore(np.ones(5), np.eye(5), np.eye(5), np.zeros((2, 4)))
    for before in fitted:
        found = estimate_sharpening(before, [*scores, unsharpened], 1)
        assert found is not None
        np.testing.assert_allclose(found.values, truth.values, atol=1e-3)
        assert found.is_determined


def test_a_sharpening_is_determined_where_it_is_better_known_than_before() -> None:
    assert not Sharpening().is_determined
    assert Sharpening(0.8, 1.0, np.diag([0.5, 0.1])).is_determined
    assert not Sharpening(0.8, 1.0, np.diag([0.01, 0.25])).is_determined  # the radius as before
    pooled = Sharpening.pool([Sharpening(0.8, 1.0, np.diag([0.01, 0.01]))] * 3)
    assert not pooled.is_determined
    assert replace(pooled, covariance=pooled.covariance / 2).is_determined


def test_scans_of_a_scanner_say_together_how_it_sharpens() -> None:
    own = [Sharpening(amount, 1.2, np.diag([0.04, 0.01])) for amount in (1.3, 1.5, 1.7)]
    pooled = Sharpening.pool(own)
    assert pooled.amount == pytest.approx(1.5)
    assert pooled.radius_px == pytest.approx(1.2)
    assert 0.1 < np.sqrt(pooled.covariance[0, 0]) < 0.3
    assert not Sharpening.pool([own[0], Sharpening(), Sharpening()])  # most are not
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


# Annex K of ITU-T T.81, luminance, the first 15 in zigzag order: what "quality 50" is.
COARSE = (16, 11, 12, 14, 12, 10, 16, 14, 13, 14, 18, 17, 16, 19, 24)


@pytest.mark.parametrize(("quality", "share"), [(50, 1.0), (75, 0.5), (90, 0.2)])
def test_the_step_is_that_of_the_luminance_table(quality: int, share: float) -> None:
    grey = np.random.default_rng(1).integers(0, 255, (40, 40), np.uint8)
    for picture in (grey, cv2.merge([grey, grey[::-1], grey])):
        data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()
        expected = np.mean([max(int(step * share + 0.5), 1) for step in COARSE])
        assert quantisation_step_dn(data) == pytest.approx(expected)


def test_tiff_files_have_it_too_and_what_is_not_compressed_with_loss_has_none(tmp_path: Path) -> None:
    grey = np.random.default_rng(1).integers(0, 255, (64, 64), np.uint8)
    for level, least, most in ((50, 14.0, 16.0), (90, 2.0, 4.0)):
        path = tmp_path / f"{level}.tif"
        tifffile.imwrite(path, grey, tile=(32, 32), compression="jpeg", compressionargs={"level": level})
        with measure.open_scan(path) as scan:
            assert least < scan.quantisation_step_dn < most
            assert scan.is_lossy
    tifffile.imwrite(tmp_path / "whole.tif", grey, compression="lzw")
    with measure.open_scan(tmp_path / "whole.tif") as scan:
        assert scan.quantisation_step_dn == 0.0
        assert not scan.is_lossy


def film() -> NDArray[np.uint8]:
    """Grain on a ground that changes slowly, in grey values that JPEG has not seen."""
    rng, cols = np.random.default_rng(3), np.arange(401)
    grain = cv2.GaussianBlur(rng.normal(0.0, 60.0, (397, 401)), (0, 0), 1.0)
    return np.asarray(np.clip(120 + 40 * np.sin(cols / 90) + grain, 0, 255).round().astype(np.uint8))


def stored_after_jpeg(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8)


@parametrize_with_studies(("quality", "share"), [(50, 1.0), (75, 0.5), (90, 0.2)])
def test_a_file_without_loss_tells_that_its_picture_was_jpeg(quality: int, share: float, tmp_path: Path) -> None:
    """Cropped, in colour, in 16 bits; and stored as a finer JPEG."""
    was = stored_after_jpeg(film(), quality)[3:, 5:]
    colour = stored_after_jpeg(np.dstack([film(), film()[::-1], film()]), quality)
    expected = np.mean([max(int(step * share + 0.5), 1) for step in COARSE])
    tifffile.imwrite(tmp_path / "grey.tif", was)
    tifffile.imwrite(tmp_path / "deep.tif", was.astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "colour.png"), colour)
    cv2.imwrite(str(tmp_path / "again.jpg"), was, (cv2.IMWRITE_JPEG_QUALITY, 98))
    for name, unit in (("grey.tif", 1), ("deep.tif", 257), ("colour.png", 1), ("again.jpg", 1)):
        with measure.open_scan(tmp_path / name) as scan:
            col, row = (0, 0) if name == "colour.png" else (3, 5)  # where blocks begin behind 5 columns and 3 rows
            assert scan.first_block_px == (col, row)
            assert crop_scan(scan, (10, 20, 300, 300)).first_block_px == ((col - 10) % 8, (row - 20) % 8)
            assert scan.quantisation_step_dn == pytest.approx(unit * expected, rel=0.05)
            assert "was compressed as JPEG before" in scan.notes[-1]


def test_faint_marks_that_jpeg_rounds_are_as_far_off_as_is_stated() -> None:
    """Of a contrast of three, four and six rounding steps: the rms error over the claim, both measured at once. What
    residuals do not show falls with the square of the contrast: one that fell with it would be twice too large."""
    rng, mark, ratios = np.random.default_rng(2), KIND["ring-cross"].shape, []
    even = np.zeros((48, 48), np.uint8)
    step_dn = quantisation_step_dn(cv2.imencode(".jpg", even, (cv2.IMWRITE_JPEG_QUALITY, 30))[1].tobytes())
    for number in range(18):
        middle = 23.5 + rng.uniform(-4, 4, 2)
        place = placed(10.0, (middle[0], middle[1]), rng.uniform(0.02, 0.05))
        picture, noise = brute_picture(mark, place, 48, 48, 1.2, 16), rng.normal(0, 3, (48, 48))
        contrast_dn = (3, 4, 6)[number % 3] * step_dn
        grey = np.clip(np.rint(60 + contrast_dn * picture + noise), 0, 255).astype(np.uint8)
        start = placed(10.0, tuple(place[:, 2] + rng.uniform(-0.5, 0.5, 2)))
        fit = measure.match(measure.ScanWindow(stored_after_jpeg(grey, 30).astype(float), is_lossy=True), mark, start)
        variance = np.trace(fit.covariance_px2 + covariance_of_compression(step_dn, fit.contrast_dn)) / 2
        ratios.append((fit.center_px - place[:, 2]) / np.sqrt(variance))
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.25

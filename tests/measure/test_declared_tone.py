"""Tone curves, declared and estimated; scans that were sharpened."""

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from drawn import chi_square, make_scan
from scipy.ndimage import gaussian_filter
from true_marks import KIND, some_mark

from measure import FiducialLayout, FiducialOptions, FrameMeasurement, LayoutMark, measure_fiducials
from measure.flags import Cause, Status
from measure.scans.opening import declared_tone
from measure.tone.curve import Tone, ToneInformation
from measure.tone.declared import curve_of_profile
from measure.tone.estimate import FrameTone, MarkTone
from measure.tone.sharpening import Sharpening

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
    tone = declared_tone(path)
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
    scan = make_scan(FULL * np.clip(sharpened(light ** (1 / tone), amount, radius_px), 0.0, 1.0))
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
    scan = make_scan(sharpened(codes, 1.5, 1.2)).replace_tone(Tone().sharpened(mask))
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

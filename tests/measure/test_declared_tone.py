"""What files say of their tone curve, written as other programs write it."""

import struct
import zlib
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile

from measure.scans.opening import declared_tone
from measure.tone.curve import Tone
from measure.tone.declared import curve_of_profile

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
    ("curve", "expected"),
    [(GAMMA, HALF**1.8), (TABLE, HALF**2), (SRGB, 0.21404), (b"curv" + bytes(8), HALF)],
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

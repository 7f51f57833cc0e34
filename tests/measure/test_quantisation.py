"""How coarsely files round, against the tables that the standard prints."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from drawn import brute_picture, placed
from numpy.typing import NDArray

from measure import MarkShape, ScanWindow, match, open_scan, ring_cross
from measure.scans.jpeg import covariance_of_compression, rounding_step_dn

# Annex K of ITU-T T.81, luminance, the first 15 in zigzag order: what "quality 50" is.
COARSE = (16, 11, 12, 14, 12, 10, 16, 14, 13, 14, 18, 17, 16, 19, 24)


@pytest.mark.parametrize(("quality", "share"), [(50, 1.0), (75, 0.5), (90, 0.2)])
def test_the_step_is_that_of_the_luminance_table(quality: int, share: float) -> None:
    grey = np.random.default_rng(1).integers(0, 255, (40, 40), np.uint8)
    for picture in (grey, cv2.merge([grey, grey[::-1], grey])):
        data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()
        expected = np.mean([max(int(step * share + 0.5), 1) for step in COARSE])
        assert rounding_step_dn(data) == pytest.approx(expected)


def test_tiff_files_have_it_too_and_what_is_not_compressed_with_loss_has_none(tmp_path: Path) -> None:
    grey = np.random.default_rng(1).integers(0, 255, (64, 64), np.uint8)
    for level, least, most in ((50, 14.0, 16.0), (90, 2.0, 4.0)):
        path = tmp_path / f"{level}.tif"
        tifffile.imwrite(path, grey, tile=(32, 32), compression="jpeg", compressionargs={"level": level})
        with open_scan(path) as scan:
            assert least < scan.rounding_step_dn < most
            assert scan.is_lossy
    tifffile.imwrite(tmp_path / "whole.tif", grey, compression="lzw")
    with open_scan(tmp_path / "whole.tif") as scan:
        assert scan.rounding_step_dn == 0.0
        assert not scan.is_lossy


def film() -> NDArray[np.uint8]:
    """Grain on a ground that changes slowly, in grey values that JPEG has not seen."""
    rng, cols = np.random.default_rng(3), np.arange(401)
    grain = cv2.GaussianBlur(rng.normal(0.0, 60.0, (397, 401)), (0, 0), 1.0)
    return np.asarray(np.clip(120 + 40 * np.sin(cols / 90) + grain, 0, 255).round().astype(np.uint8))


def stored_after_jpeg(picture: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, quality))[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8)


@pytest.mark.parametrize(("quality", "share"), [(50, 1.0), (75, 0.5), (90, 0.2)])
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
        with open_scan(tmp_path / name) as scan:
            assert scan.rounding_step_dn == pytest.approx(unit * expected, rel=0.05)
            assert "was compressed as JPEG before" in scan.notes[-1]


def test_faint_marks_that_jpeg_rounds_are_as_far_off_as_is_stated() -> None:
    """Of a contrast of three, four and six rounding steps: the rms error over the claim, both measured at once. What
    residuals do not show falls with the square of the contrast: one that fell with it would be twice too large."""
    rng, mark, ratios = np.random.default_rng(2), MarkShape(ring_cross(1.0, 0.2, 1.6, 0.15, angle_deg=45.0)), []
    even = np.zeros((48, 48), np.uint8)
    step_dn = rounding_step_dn(cv2.imencode(".jpg", even, (cv2.IMWRITE_JPEG_QUALITY, 30))[1].tobytes())
    for number in range(24):
        middle = 23.5 + rng.uniform(-4, 4, 2)
        place = placed(10.0, (middle[0], middle[1]), rng.uniform(0.02, 0.05))
        picture, noise = brute_picture(mark, place, 48, 48, 1.2), rng.normal(0, 3, (48, 48))
        contrast_dn = (3, 4, 6)[number % 3] * step_dn
        grey = np.clip(np.rint(60 + contrast_dn * picture + noise), 0, 255).astype(np.uint8)
        start = placed(10.0, tuple(place[:, 2] + rng.uniform(-0.5, 0.5, 2)))
        fit = match(ScanWindow(stored_after_jpeg(grey, 30).astype(float), is_lossy=True), mark, start)
        variance = np.trace(fit.covariance_px2 + covariance_of_compression(step_dn, fit.contrast_dn)) / 2
        ratios.append((fit.center_px - place[:, 2]) / np.sqrt(variance))
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.25

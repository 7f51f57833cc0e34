"""How coarsely files round, against the tables that the standard prints."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from measure.scans.quantisation import UNKNOWN_DN, rounding_step_dn
from measure.scans.scan import open_scan

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


def test_a_file_without_tables_is_taken_for_a_poor_one() -> None:
    assert rounding_step_dn(b"\xff\xd8\xff\xd9") == UNKNOWN_DN

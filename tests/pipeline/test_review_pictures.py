"""Windows of scans for the review page: what they show, and the memory that they take."""

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import tifffile

from pipeline.review.pictures import Pictures, _overlapping_pixels


def test_a_wide_window_takes_little_memory_and_shows_the_scan_in_its_place(tmp_path: Path) -> None:
    """60,000 px of a scan of 700: 125 px become one. Strips of the whole window were held at once: gigabytes."""
    grey = np.zeros((700, 700), np.uint8)
    grey[375:] = 250
    tifffile.imwrite(tmp_path / "a.tif", grey)
    pictures = Pictures()
    tracemalloc.start()
    png = pictures.window(str(tmp_path / "a.tif"), -250, -250, 60_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    pictures.close()
    assert peak < 20e6
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert shown is not None
    assert shown.shape == (480, 480)
    assert set(np.unique(shown[:2])) == set(np.unique(shown[8:])) == {128}  # beyond the scan
    assert shown[2:5, 2:7].max() == 0
    assert shown[5:7, 2:7].min() == 255


def test_reduced_pixels_on_a_scan_are_those_that_touch_it() -> None:
    rng = np.random.default_rng(4)
    for start, extent, side, step in zip(*rng.integers((-100, 1, 1, 2), (120, 80, 30, 9), (500, 4)).T, strict=True):
        touching = [k for k in range(side) if start + k * step < extent and start + (k + 1) * step > 0]
        assert list(_overlapping_pixels(int(start), int(extent), int(side), int(step))) == touching

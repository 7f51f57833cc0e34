"""A second frame beside the one that was measured is named, with the windows of both."""

import re
from pathlib import Path

import numpy as np
import pytest
from brute_marks import written_scan
from drawn_frames import ALIKE, FRAME_PX, PITCH_UM, frame_picture, pixel_from_camera
from studies import parametrize_with_studies

from measure.fiducials.measurement import measure_fiducials, second_frame
from measure.fiducials.options import FiducialOptions
from measure.results import moved_frame
from measure.scans.opening import crop_scan


@parametrize_with_studies(("second", "is_named"), [("0", True), ("90", True), (None, False)])
def test_a_second_frame_is_named_with_the_windows_of_both(second: str | None, is_named: bool, tmp_path: Path) -> None:
    """Above the one that was measured, in any pose; bare ground is none."""
    first = frame_picture(ALIKE, pixel_from_camera("0"))
    other = frame_picture(ALIKE, pixel_from_camera(second), 7) if second else first[::-1, :1] * np.ones((1, FRAME_PX))
    options = FiducialOptions()
    with written_scan(np.vstack([other, first]), tmp_path) as scan:
        window = (0, FRAME_PX, FRAME_PX, FRAME_PX)
        frame = measure_fiducials(crop_scan(scan, window), ALIKE, (PITCH_UM, PITCH_UM), options)
        result = second_frame(scan, ALIKE, moved_frame(frame, np.array([0.0, FRAME_PX])), options)
    assert bool(result) == is_named
    if is_named:
        windows = re.findall(r'"(\d+) (\d+) (\d+) (\d+)"', result)
        (_, lower, _, _), (_, upper, _, height) = [tuple(map(int, window)) for window in windows]
        assert lower == pytest.approx(FRAME_PX + 27, abs=6)  # 17 mm about the middle, row 197.6
        assert upper == pytest.approx(27, abs=6)
        assert height == pytest.approx(343, abs=8)

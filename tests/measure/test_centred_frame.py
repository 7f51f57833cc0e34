"""Frames in the middle of large scans: measured from the windows about their marks, and by a whole search where not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brute_marks import Array, written_scan
from drawn_frames import CORNERS, NUMBERED, assert_right, frame_picture, layout_of, pixel_from_camera

from measure import fiducials
from measure.fiducials import measure_fiducials
from measure.marks.shapes import FiducialLayout, MarkShape, ring_cross
from measure.results import FrameMeasurement
from measure.scans.scan import Scan
from measure.search.centred_frame import is_lattice
from measure.search.frame_search import FrameSearch
from measure.status import Status

PITCH_UM = (50.0, 50.0)


@pytest.fixture(autouse=True)
def _small_scans_count_as_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("measure.search.centred_frame._LARGE_PX", 1)


def measured(
    grey: Array, layout: FiducialLayout, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[FrameMeasurement, bool]:
    """And whether the whole scan was searched."""
    searches: list[FrameSearch] = []
    anywhere = fiducials._anywhere

    def noted(search: FrameSearch, *given: Any) -> Any:
        searches.append(search)
        return anywhere(search, *given)

    monkeypatch.setattr(fiducials, "_anywhere", noted)
    with written_scan(grey, folder) as scan:
        return measure_fiducials(scan, layout, PITCH_UM), bool(searches)


@pytest.mark.parametrize("pose", ["0", "270m"])
def test_a_frame_in_the_middle_is_found_and_named_without_the_whole_scan(
    pose: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = pixel_from_camera(pose)
    monkeypatch.setattr(Scan, "reduced", None)
    result, whole = measured(frame_picture(NUMBERED, matrix), NUMBERED, tmp_path, monkeypatch)
    assert not whole
    assert result.pose is not None
    assert (result.pose.name, result.pose.decided) == (pose, True)
    assert_right(result, NUMBERED, matrix)


@pytest.mark.parametrize("center", [(225.0, 180.0), (202.3, 197.6)])
def test_a_frame_off_the_middle_or_with_a_mark_hidden_is_searched_everywhere(
    center: tuple[float, float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = pixel_from_camera("0", center=center)
    grey = frame_picture(NUMBERED, matrix)
    hidden = center == (202.3, 197.6)
    if hidden:
        col, row = np.rint(matrix @ (*CORNERS[2], 1.0)).astype(int)
        grey[row - 40 : row + 40, col - 40 : col + 40] = 3000
    result, whole = measured(grey, NUMBERED, tmp_path, monkeypatch)
    assert whole
    seen = [mark.status.is_observation for mark in result.marks]
    assert seen == [True, True, not hidden, True]
    off = [
        np.abs(mark.center_px - matrix @ (*given.xy_mm, 1.0)).max()
        for mark, given in zip(result.marks, NUMBERED.marks, strict=True)
        if mark.status is Status.MEASURED and mark.center_px is not None
    ]
    assert max(off) < 0.1


def test_a_lattice_is_told_from_a_frame() -> None:
    cross = MarkShape(ring_cross(0.5, 0.1, 0.8, 0.1))
    places = [(10.0 * i, 10.0 * j) for i in range(5) for j in range(5)]
    sides = ((7.7, 0.0), (0.0, 7.7), (-7.7, 0.0), (0.0, -7.7))
    assert is_lattice(layout_of([cross] * 25, places))
    assert not is_lattice(layout_of([cross] * 4))
    assert not is_lattice(layout_of([cross] * 8, CORNERS + sides))

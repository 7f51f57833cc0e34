"""Frames in the middle of large scans: measured from the windows about their marks, and by a whole search where not."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from drawn import (
    CORNERS,
    NUMBERED,
    RING_CROSS,
    Array,
    assert_right,
    found_pose,
    frame_picture,
    lay_out,
    make_scan,
    pixel_from_camera,
)
from studies import parametrize_with_studies

from measure import FiducialOptions, FrameMeasurement, Scan, Status, measure_fiducials, open_scan
from measure.fiducials.search import FrameSearch, PitchHypothesis, is_lattice
from measure.fiducials.significance import false_placements
from measure.marks.shapes import FiducialLayout, MarkShape, ring_cross
from measure.scans.metadata import Samples

PITCH_UM = (50.0, 50.0)


@pytest.fixture(autouse=True)
def _small_scans_count_as_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("measure.fiducials.search._LARGE_PX", 1)


def measure_picture(
    grey: Array, layout: FiducialLayout, monkeypatch: pytest.MonkeyPatch
) -> tuple[FrameMeasurement, bool]:
    """And whether the whole scan was searched."""
    searches: list[FrameSearch] = []
    search_scan = FrameSearch.search_scan

    def noted(search: FrameSearch, *given: Any) -> Any:
        searches.append(search)
        return search_scan(search, *given)

    monkeypatch.setattr(FrameSearch, "search_scan", noted)
    scan = make_scan(grey)
    return measure_fiducials(scan, layout, PITCH_UM), bool(searches)


@parametrize_with_studies("pose", ["0", "270m"])
def test_a_frame_in_the_middle_is_found_and_named_without_the_whole_scan(
    pose: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = pixel_from_camera(pose)
    monkeypatch.setattr(Scan, "reduced", None)
    result, whole = measure_picture(frame_picture(NUMBERED, matrix), NUMBERED, monkeypatch)
    assert not whole
    assert found_pose(result) == (pose, True)
    assert_right(result, NUMBERED, matrix)


@parametrize_with_studies("center", [(225.0, 180.0), (202.3, 197.6)])
def test_a_frame_off_the_middle_or_with_a_mark_hidden_is_searched_everywhere(
    center: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = pixel_from_camera("0", center=center)
    grey = frame_picture(NUMBERED, matrix)
    hidden = center == (202.3, 197.6)
    if hidden:
        col, row = np.rint(matrix @ (*CORNERS[2], 1.0)).astype(int)
        grey[row - 40 : row + 40, col - 40 : col + 40] = 3000
    result, whole = measure_picture(grey, NUMBERED, monkeypatch)
    assert whole
    measured_marks = [mark.status.is_observation for mark in result.marks]
    assert measured_marks == [True, True, not hidden, True]
    off = [
        np.abs(mark.center_px - matrix @ (*given.xy_mm, 1.0)).max()
        for mark, given in zip(result.marks, NUMBERED.marks, strict=True)
        if mark.status is Status.MEASURED and mark.center_px is not None
    ]
    assert max(off) < 0.1


@parametrize_with_studies("bent_mm", [0.0, 0.03])
def test_of_a_large_scan_with_all_marks_clear_only_windows_are_read(
    bent_mm: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of eight marks lies farther off than most, by next to nothing or as much as film bends: none is missing, and
    no more of the file is read. How much is, a reader counts that decodes its tiles."""
    places = [(4.5 * x, 4.5 * y) for x, y in (*CORNERS, (7.0, 0.0), (-7.0, 0.0), (0.0, 7.0), (0.0, -7.0))]
    layout = lay_out([MarkShape(RING_CROSS)] * 8, places, (66.0, 66.0))
    matrix = pixel_from_camera("0", center=(705.3, 694.6))
    first = layout.marks[0]
    bent = replace(first, xy_mm=(first.xy_mm[0] - bent_mm, first.xy_mm[1] + bent_mm))
    grey = frame_picture(FiducialLayout((bent, *layout.marks[1:]), layout.frame_mm), matrix, size=1400)
    stored = np.clip(np.rint(grey), 0, 65535).astype(np.uint16)
    tifffile.imwrite(tmp_path / "s.tif", stored, tile=(64, 64), compression="zlib")
    with open_scan(tmp_path / "s.tif") as scan:
        read, decode = set[tuple[int, int]](), scan._segments.read

        def counting(row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
            read.add((row, column))
            return decode(row, column, stored)

        monkeypatch.setattr(scan._segments, "read", counting)
        result = measure_fiducials(scan, layout, PITCH_UM)
    assert all(mark.status.is_observation for mark in result.marks)
    assert len(read) * 64**2 < 0.4 * grey.size


def test_a_lattice_is_distinguished_from_a_frame() -> None:
    cross = MarkShape(ring_cross(0.5, 0.1, 0.8, 0.1))
    places = [(10.0 * i, 10.0 * j) for i in range(5) for j in range(5)]
    sides = ((7.7, 0.0), (0.0, 7.7), (-7.7, 0.0), (0.0, -7.7))
    assert is_lattice(lay_out([cross] * 25, places))
    assert not is_lattice(lay_out([cross] * 4))
    assert not is_lattice(lay_out([cross] * 8, CORNERS + sides))


@pytest.mark.parametrize("center", [(225.0, 180.0), (190.0, 206.0)])
def test_a_frame_that_the_scan_holds_is_found_by_windows_as_by_the_whole(
    center: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    matrix = pixel_from_camera("90", center=center)
    pitch_mm = (PITCH_UM[0] / 1000, PITCH_UM[1] / 1000)
    scan = make_scan(frame_picture(NUMBERED, matrix))
    hypothesis = [PitchHypothesis(pitch_mm, 0.02, pitch_mm)]
    options = FiducialOptions()
    whole = FrameSearch(scan, NUMBERED, options).search_scan(options, hypothesis).placements[0]
    monkeypatch.setattr("measure.fiducials.search._WINDOWS_SHARE", np.inf)
    monkeypatch.setattr(FrameSearch, "search_scan", None)
    result = FrameSearch(scan, NUMBERED, options).search_room(options, hypothesis)
    found = result.placements[0]
    assert false_placements(result, found) < 0.01
    neighbour = np.add(found.pixel_from_camera, [[0.0, 0.0, 9999.0], [0.0, 0.0, 0.0]])
    assert np.isinf(false_placements(result, replace(found, pixel_from_camera=neighbour)))
    assert found.pose == whole.pose
    assert found.same_place(whole)
    assert np.hypot(*(found.pixel_from_camera - matrix)[:, 2]) < 3.0

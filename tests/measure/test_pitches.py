"""Scans whose pixels are not as given: what is found nevertheless, and what is not believed."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
from brute_marks import written_scan
from drawn_frames import (
    ALIKE,
    PITCH_UM,
    RING_CROSS,
    assert_right,
    frame_picture,
    layout_of,
    measured,
    paint,
    pixel_from_camera,
)
from scipy.ndimage import gaussian_filter

from measure.fiducials.constellation import NARROW, Placement
from measure.fiducials.measure_frame import measure_frame
from measure.fiducials.measurement import measure_fiducials
from measure.fiducials.options import FiducialOptions
from measure.fiducials.rows import pitch_problem
from measure.fiducials.search import PitchHypothesis, slightly_longer
from measure.fiducials.stages import _pitch_to_try
from measure.marks.shapes import MarkShape
from measure.scans.opening import open_scan

AERIAL = ((106.0, -106.0), (-106.0, -106.0), (-106.0, 106.0), (106.0, 106.0))
# A frame of 14 mm with a hundredth of the usual tolerances bends as little as one of 140 mm.
STIFF = FiducialOptions(pose="0", misfit_mm=0.03, affinity=1e-4, gate_mm=0.03)


def test_pixels_longer_one_way_are_found_out(tmp_path: Path) -> None:
    matrix = pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.012, 0.988]) @ matrix[:, :2]
    result = measured(frame_picture(ALIKE, matrix), ALIKE, tmp_path, STIFF)
    assert_right(result, ALIKE, matrix)
    (stretched,) = [problem for problem in result.problems if "more than film deforms" in problem]
    assert "a pixel is 49.4 µm wide and 50.6 µm tall, but 50.0 x 50.0 µm is given" in stretched  # 50 / 1.012, / 0.988


def test_wrong_resolution_tags_are_named_with_the_pitch_of_the_marks(tmp_path: Path) -> None:
    """Tags that say pixels of 50 x 50 µm, and of 50 x 52 µm, where they are of 50 x 51 µm."""
    matrix = pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.0, 50 / 51]) @ matrix[:, :2]
    stored = np.clip(np.rint(frame_picture(ALIKE, matrix)), 0, 65535).astype(np.uint16)
    for down_um in (50.0, 52.0):
        density = (10000 / 50.0, 10000 / down_um)
        tifffile.imwrite(tmp_path / "tags.tif", stored, resolution=density, resolutionunit="CENTIMETER")
        with open_scan(tmp_path / "tags.tif") as scan:
            pitch_um = scan.pitch_um
            assert pitch_um is not None
            result = measure_fiducials(scan, ALIKE, pitch_um, STIFF)
        (problem,) = [problem for problem in result.problems if "more than film deforms" in problem]
        assert f"the file's resolution tags say 50.0 x {down_um:.1f} µm" in problem
        assert "The likely cause is wrong resolution tags: set pitch_um = [" in problem
        wide, tall = map(float, problem.partition("pitch_um = [")[2].partition("]")[0].split(","))
        assert (wide, tall) == pytest.approx((50.0, 51.0), abs=0.1)
        assert pitch_problem(result, ALIKE, pitch_um, "the scan's file") is None  # once is enough


@pytest.mark.study
def test_marks_outside_of_the_scan_are_named_where_the_others_are_too_few(tmp_path: Path) -> None:
    """Four side marks, of which the upper and the lower one are cut off."""
    layout = layout_of(
        [MarkShape(RING_CROSS)] * 4, ((-10.0, 0.0), (10.0, 0.3), (0.0, 10.0), (0.2, -10.0)), (22.0, 22.0)
    )
    matrix = np.column_stack([pixel_from_camera("0", 0.0)[:, :2], (260.0, 260.0)])
    result = measured(frame_picture(layout, matrix, size=520)[100:420], layout, tmp_path)
    (problem,) = result.problems
    assert "only 2 of 4 marks were found where the others put them, and these put 3, 4 outside of the scan" in problem


def test_two_marks_are_stated_to_give_a_similarity(tmp_path: Path) -> None:
    layout = layout_of([MarkShape(RING_CROSS)] * 2, ((-7.0, 0.0), (7.0, 0.2)))
    result = measured(frame_picture(layout, pixel_from_camera("0")), layout, tmp_path)
    assert any("a similarity on 2 fiducials has no redundancy" in problem for problem in result.problems)


def test_pixels_given_as_longer_one_way_need_no_attention(tmp_path: Path) -> None:
    matrix = pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.012, 0.988]) @ matrix[:, :2]
    with written_scan(frame_picture(ALIKE, matrix), tmp_path) as scan:
        result = measure_fiducials(scan, ALIKE, (PITCH_UM / 1.012, PITCH_UM / 0.988), STIFF)
    assert_right(result, ALIKE, matrix)
    assert not any("more than film deforms" in problem for problem in result.problems)


@pytest.mark.study
def test_three_of_many_marks_that_lie_as_the_cameras_are_no_frame(tmp_path: Path) -> None:
    """With pixels longer one way three of sixty strewn marks fit, which is no wonder; three of three are a frame."""
    places = ((10.0, -10.0), (-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0))
    layout, matrix = layout_of([MarkShape(RING_CROSS)] * 4, places, (23.0, 23.0)), pixel_from_camera("0", 0.0)
    matrix = np.diag([1.012, 0.988]) @ np.column_stack([matrix[:, :2], (260.0, 261.0)])
    rng = np.random.default_rng(5)
    alone = 8000 + 1000 * gaussian_filter(rng.normal(0, 1, (520, 520)), 2.0) / 0.14 + rng.normal(0, 100.0, (520, 520))
    for given in layout.marks[:3]:
        paint(alone, given.mark, given.xy_mm, matrix, 9000.0)
    result = measured(alone, layout, tmp_path, STIFF)
    assert [mark.status.is_observation for mark in result.marks] == [True, True, True, False]
    another = np.zeros((61, 61))
    paint(another, MarkShape(RING_CROSS), (0.0, 0.0), np.column_stack([matrix[:, :2], (30.3, 29.6)]), 9000.0)
    for col, row in np.random.default_rng(4).integers(32, 488, (60, 2)):
        alone[row - 30 : row + 31, col - 30 : col + 31] += another
    result = measured(alone, layout, tmp_path, STIFF)
    assert not any(mark.status.is_observation for mark in result.marks)
    (problem,) = result.problems
    assert "under another pitch 3 of them fit, which may be a false alarm: try pitch_um = [" in problem


def test_the_pitch_to_try_is_what_the_marks_say(tmp_path: Path) -> None:
    matrix = pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.012, 0.988]) @ matrix[:, :2]
    pair_mm = (PITCH_UM / 1012, PITCH_UM / 988)
    with written_scan(frame_picture(ALIKE, matrix), tmp_path) as scan:
        frame = measure_frame(scan, ALIKE, Placement("0", matrix, 1.0, 4, 1, 1, pair_mm), STIFF)
    result = _pitch_to_try([frame])
    assert result.startswith("; under another pitch 4 of them fit, which may be a false alarm: try pitch_um = [")
    pair = [float(number) for number in result.split("[")[1].rstrip("]").split(", ")]
    assert pair == pytest.approx([1000 * mm for mm in pair_mm], rel=1e-3)
    assert _pitch_to_try([]) == ""


def test_closer_matching_tries_pixels_slightly_longer_one_way_so_that_no_mark_lies_beyond_its_reach() -> None:
    """Of an aerial camera, pixels longer by up to 1 % either way."""
    layout, options = layout_of([MarkShape(RING_CROSS)] * 4, AERIAL, (228.0, 228.0)), FiducialOptions()
    near, longer = slightly_longer(PitchHypothesis((0.127, 0.127), 0.04, (0.127, 0.127)), 0.015)
    tried = np.array([each.mm for each in (*near, *longer)]) / 0.127
    for stretch in np.linspace(-0.01, 0.01, 9):
        true = np.array([1 + stretch / 2, 1 - stretch / 2])
        off_mm = np.hypot(*((true / tried - 1) * AERIAL[0]).T).min()
        assert off_mm < NARROW * options.search_mm(layout)

"""Fiducial marks of whole frames drawn by brute force: the right names in every pose, and honest words where not."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Literal

import drawn as draw
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from studies import parametrize_with_studies

from measure import Code, FiducialLayout, FiducialOptions, MarkShape, Status, dot, polygon
from measure.fiducials import measurement
from measure.fiducials.measure_frame import Frame, rename_frame
from measure.fiducials.stages import find_frame
from measure.geometry import POSES
from measure.marks.shapes import Disk, Part, finest_detail_mm


@parametrize_with_studies("pose", POSES, quick=(0, 7))
def test_identification_dots_decide_each_of_eight_poses(pose: str) -> None:
    matrix = draw.pixel_from_camera(pose)
    result = draw.measure_grey(draw.frame_picture(draw.NUMBERED, matrix), draw.NUMBERED)
    assert draw.found_pose(result) == (pose, True), result.pose
    draw.assert_right(result, draw.NUMBERED, matrix)
    assert result.pixel_from_camera is not None
    np.testing.assert_allclose(result.pixel_from_camera, matrix, atol=0.02)
    assert result.problems == ()


def test_like_marks_leave_the_pose_assumed_and_say_so() -> None:
    matrix = draw.pixel_from_camera("0")
    result = draw.measure_grey(draw.frame_picture(draw.ALIKE, matrix), draw.ALIKE)
    assert draw.found_pose(result) == ("0", False)
    assert result.pose
    assert "alike" in result.pose.evidence[0]
    draw.assert_right(result, draw.ALIKE, matrix)


def test_writing_next_to_one_mark_names_no_pose() -> None:
    """Three dots beside a mark of a camera whose first mark has none, and whose others have one to three."""
    matrix = draw.pixel_from_camera("0")
    grey = draw.frame_picture(draw.ALIKE, matrix)
    draw.paint(
        grey, MarkShape(tuple(Disk((1.0, 0.3 * k - 0.3), 0.08) for k in range(3))), draw.CORNERS[1], matrix, 9000.0
    )
    result = draw.measure_grey(grey, draw.NUMBERED)
    assert not draw.found_pose(result)[1], result.pose


def test_what_covers_a_dot_and_resembles_a_smaller_one_is_doubted() -> None:
    dot, speck = MarkShape((Disk((0.0, 0.0), 0.4),)), MarkShape((Disk((0.01, -0.015), 0.34),))
    matrix = draw.pixel_from_camera("0")
    given = draw.lay_out([dot] * 4)
    result = draw.measure_grey(draw.frame_picture(draw.lay_out([dot, dot, dot, speck]), matrix), given)
    assert [mark.status for mark in result.marks] == [Status.MEASURED] * 3 + [Status.WEAK]
    assert "0.85 times as large as the other marks" in result.marks[3].reason


def test_one_mark_gives_no_frame_and_no_error() -> None:
    alone = draw.lay_out([MarkShape(draw.RING_CROSS)], draw.CORNERS[:1])
    result = draw.measure_grey(draw.frame_picture(alone, draw.pixel_from_camera("0")), alone)
    assert [mark.status for mark in result.marks] == [Status.ABSENT]
    assert result.problems


@pytest.mark.parametrize(
    ("mark", "pitch", "width"), [(draw.RING_CROSS, True, "2.0"), (draw.RING_CROSS, False, "2.4"), (dot(0.4), True, "")]
)
def test_a_scan_without_a_frame_says_if_its_pixels_are_large(mark: tuple[Part, ...], pitch: bool, width: str) -> None:
    """Lines of 0.1 mm at 50 µm a pixel are 2 px wide, at 42.5 µm, where a frame of 17 mm fills the scan, 2.4 px; a dot
    of 0.8 mm is 16 px wide."""
    grain = np.random.default_rng(5).normal(8000.0, 200.0, (400, 400))
    (problem,) = draw.measure_grey(grain, draw.lay_out([MarkShape(mark)] * 4), pitch=pitch).problems
    coarse = f"the finest detail of the marks, 100 µm, is {width} px wide. Scan at 33 µm or finer."
    assert (coarse in problem, Code.SMALL in problem.codes) == (bool(width), bool(width))


def test_a_search_without_a_frame_keeps_nothing_but_why() -> None:
    """Placements and frames took a fifth of the memory of a scan in which a negative was searched for after them."""
    one, layout = (draw.lay_out([MarkShape(draw.RING_CROSS)] * n, draw.CORNERS[:n]) for n in (1, 4))
    scan = draw.make_scan(draw.frame_picture(one, draw.pixel_from_camera("0")))
    found = find_frame(scan, layout, (draw.PITCH_UM, draw.PITCH_UM), FiducialOptions("0"))
    assert found.misfit
    assert (found.frame, found.faint, found.unsure, found.result.placements) == (None, None, (), ())


def test_the_finest_detail_of_an_outline_is_an_edge_and_no_piece_of_an_arc() -> None:
    arc = [(float(np.cos(t)), float(np.sin(t))) for t in np.linspace(0.0, np.pi, 31)]
    assert finest_detail_mm(MarkShape(polygon(arc))) == pytest.approx(1 / 3, abs=1e-6)  # of its height of 1 mm
    blunt = MarkShape(polygon([(0.0, 0.0), (2.0, 0.0), (1.0, 3.0), (0.8, 3.0)]))
    assert finest_detail_mm(blunt) == pytest.approx(0.2)


def test_a_pose_of_the_user_that_the_picture_contradicts_is_reported() -> None:
    matrix = draw.pixel_from_camera("90m")
    result = draw.measure_grey(draw.frame_picture(draw.NUMBERED, matrix), draw.NUMBERED, FiducialOptions(pose="0"))
    assert draw.found_pose(result) == ("0", True)
    assert any(
        "scan orientation 0 is set in the project, but the marks of this frame show 90m" in problem
        and "identification dots" in problem
        for problem in result.problems
    )


@pytest.mark.study
def test_a_set_orientation_in_which_nothing_fits_is_named_with_the_one_that_does() -> None:
    """As where y of the given coordinates has the wrong sign: tone or camera were blamed."""
    uneven = draw.lay_out([MarkShape(draw.RING_CROSS)] * 4, ((7.0, -7.0), (-7.0, -6.4), (-7.0, 5.6), (5.8, 7.0)))
    matrix = draw.pixel_from_camera("180m")
    result = draw.measure_grey(draw.frame_picture(uneven, matrix), uneven, FiducialOptions(pose="0"))
    assert not any(mark.status.is_observation for mark in result.marks)
    assert result.problems[0].startswith("the marks fit in the scan orientation 180m, not in 0: this, or the sign or")


@pytest.mark.parametrize(("found", "said"), [("90", ["the marks fit in the scan orientation 90, not in 0"]), ("0", [])])
def test_the_set_orientation_is_not_contradicted_by_itself(
    found: str, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = SimpleNamespace(unblemished={0: None})
    monkeypatch.setattr(measurement, "find_frame", lambda *_: SimpleNamespace(frame=frame))
    monkeypatch.setattr(measurement, "decide_scan_orientation", lambda *_: SimpleNamespace(name=found))
    scan, layout = draw.make_scan(np.zeros((9, 9))), draw.lay_out([MarkShape(draw.RING_CROSS)], ((0.0, 0.0),))
    reasons = measurement._fitting_pose(scan, layout, None, FiducialOptions(pose="0"))
    assert [each.split(":")[0] for each in reasons] == said


def test_marks_places_decide_where_they_are_not_symmetric() -> None:
    uneven = draw.lay_out([MarkShape(draw.RING_CROSS)] * 4, ((7.0, -7.0), (-7.0, -7.0), (-7.0, 6.0), (6.5, 7.0)))
    matrix = draw.pixel_from_camera("90")
    result = draw.measure_grey(draw.frame_picture(uneven, matrix), uneven)
    assert draw.found_pose(result) == ("90", True), result.pose
    draw.assert_right(result, uneven, matrix)


def test_marks_renamed_are_drawn_without_the_strain_of_their_names_before() -> None:
    """Noise had been twice as large, and places that are right within 0.02 px were known to 0.4 px."""
    places = (6.9, 6.55), (-7.0, 6.85), (-6.4, -7.0), (6.7, -6.35)
    uneven = draw.lay_out([MarkShape(draw.RING_CROSS)] * 4, places)
    scan = draw.make_scan(draw.frame_picture(uneven, draw.pixel_from_camera("180m")))
    pitch_um = draw.PITCH_UM, draw.PITCH_UM
    turned, known = (find_frame(scan, uneven, pitch_um, FiducialOptions(pose=pose)).frame for pose in ("90", "180m"))
    assert turned is not None
    assert known is not None
    assert (turned.placement.pose, known.placement.pose) == ("90", "180m")
    renamed = rename_frame(turned, "180m").inlier_fits
    for index, fit in known.inlier_fits.items():
        assert renamed[index].noise_dn == pytest.approx(fit.noise_dn, rel=0.05)
        np.testing.assert_allclose(renamed[index].center_px, fit.center_px, atol=0.003)


def test_dark_marks_and_an_unknown_pitch() -> None:
    matrix = draw.pixel_from_camera("0")
    result = draw.measure_grey(20000 - draw.frame_picture(draw.NUMBERED, matrix), draw.NUMBERED, pitch=False)
    assert draw.found_pose(result)[0] == "0"
    draw.assert_right(result, draw.NUMBERED, matrix)


def test_a_negative_is_measured_as_it_is() -> None:
    matrix = draw.pixel_from_camera("0")
    result = draw.measure_grey(20000 - draw.frame_picture(draw.NUMBERED, matrix), polarised("light"))
    draw.assert_right(result, draw.NUMBERED, matrix)
    assert "a negative of what the camera file draws" in result.notes[0]


def test_a_positive_is_no_negative() -> None:
    positive = draw.measure_grey(draw.frame_picture(draw.NUMBERED, draw.pixel_from_camera("0")), polarised("light"))
    assert not any("negative" in note for note in positive.notes)


def test_a_negative_is_rather_measured_than_a_faint_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "measure.fiducials.measurement.find_frame", lambda scan, _, *more: find_frame(scan, draw.NUMBERED, *more)
    )
    monkeypatch.setattr(Frame, "is_faint", True)
    matrix = draw.pixel_from_camera("0")
    result = draw.measure_grey(20000 - draw.frame_picture(draw.NUMBERED, matrix), polarised("light"))
    assert "a negative of what the camera file draws" in result.notes[0]


def polarised(polarity: Literal["light", "auto"]) -> FiducialLayout:
    marks = (replace(mark, mark=replace(mark.mark, polarity=polarity)) for mark in draw.NUMBERED.marks)
    return replace(draw.NUMBERED, marks=tuple(marks))


def test_zero_marks_give_no_silent_identity() -> None:
    rng = np.random.default_rng(5)
    for grey in (np.full((300, 300), 700.0), 8000 + rng.normal(0, 2000, (400, 400))):
        result = draw.measure_grey(grey, draw.ALIKE)
        assert result.pixel_from_camera is None
        assert {mark.status for mark in result.marks} == {Status.ABSENT}
        assert all(mark.center_px is None and mark.reason for mark in result.marks)
        assert all(mark.reason.codes == (Code.NO_FRAME,) for mark in result.marks)
        assert "no fiducial was measured" in result.problems[0]
        assert "within 6 degrees of upright or of a quarter turn" in result.problems[0]


@pytest.mark.study
def test_the_scan_of_another_camera_is_refused_with_a_count() -> None:
    smaller = draw.lay_out([MarkShape(draw.RING_CROSS)] * 4, ((5.6, -5.6), (-5.6, -5.9), (-4.9, 5.6), (5.8, 5.6)))
    result = draw.measure_grey(draw.frame_picture(smaller, draw.pixel_from_camera("0")), draw.ALIKE)
    assert result.pixel_from_camera is None
    assert not any(mark.status.is_observation for mark in result.marks)
    assert "does not fit: only" in result.problems[0]


def test_predicted_marks_are_not_written_as_measured() -> None:
    """And an affine on three marks is not printed as good."""
    matrix = draw.pixel_from_camera("0")
    grey = draw.frame_picture(draw.ALIKE, matrix)
    col, row = np.rint(matrix @ (*draw.CORNERS[2], 1.0)).astype(int)
    rng = np.random.default_rng(3)
    grey[row - 30 : row + 31, col - 30 : col + 31] = 3000 + rng.normal(0, draw.NOISE_DN, (61, 61))
    result = draw.measure_grey(grey, draw.ALIKE, FiducialOptions(pose="0"))
    covered = result.marks[2]
    assert covered.status is Status.PREDICTED
    assert covered.reason
    assert covered.covariance_px2 is None
    np.testing.assert_allclose(draw.center(covered), matrix @ (*draw.CORNERS[2], 1.0), atol=0.3)
    assert [mark.status.is_observation for mark in result.marks] == [True, True, False, True]
    assert any("no check" in problem for problem in result.problems)


def test_a_mark_beyond_the_edge_is_absent() -> None:
    six = draw.lay_out([MarkShape(draw.RING_CROSS)] * 6, (*draw.CORNERS, (7.0, 0.0), (-7.0, 0.0)))
    matrix = draw.pixel_from_camera("0", center=(202.3, 123.0))
    result = draw.measure_grey(draw.frame_picture(six, matrix), six)
    beyond = [mark.status is Status.ABSENT for mark in result.marks]
    # Four marks of six lie as well on the other four: what is seen has no certain name.
    assert beyond in ([given.xy_mm[1] * side > 0 for given in six.marks] for side in (1, -1))
    assert all(mark.status is Status.REJECTED for mark, out in zip(result.marks, beyond, strict=True) if not out)
    assert "outside of the scan" in result.marks[beyond.index(True)].reason


def test_the_neighbouring_frames_marks_are_not_taken_for_this_frames() -> None:
    matrix = draw.pixel_from_camera("0", turn_rad=0.0)
    grey = draw.frame_picture(draw.ALIKE, matrix, size=540)
    neighbour = matrix.copy()
    neighbour[0, 2] += 18.5 * draw.PX_PER_MM
    for place in draw.CORNERS[1:3]:  # its left marks reach into this scan, brighter than our own
        draw.paint(grey, MarkShape(draw.RING_CROSS), place, neighbour, 14000.0)
    result = draw.measure_grey(grey, draw.ALIKE, FiducialOptions(pose="0"))
    draw.assert_right(result, draw.ALIKE, matrix)


def test_of_two_whole_frames_in_a_scan_none_is_taken_in_silence() -> None:
    matrix = draw.pixel_from_camera("0")
    grey = np.hstack([draw.frame_picture(draw.NUMBERED, matrix, seed) for seed in (1, 2)])
    grey[:, draw.FRAME_PX :] = gaussian_filter(grey[:, draw.FRAME_PX :], 1.0)  # this one answers less
    result = draw.measure_grey(grey, draw.NUMBERED)
    assert draw.found_pose(result) == ("0", False)
    assert any("the scan shows another frame (20.0, " in text for text in result.problems)


def test_a_mark_off_the_constellation_is_no_observation() -> None:
    places = (*draw.CORNERS, (0.0, -7.0), (0.0, 7.0))
    marks = [MarkShape(draw.RING_CROSS)] * 6
    given = draw.lay_out(marks, places)
    moved = draw.lay_out(marks, (*places[:5], (0.55, 7.0)))
    matrix = draw.pixel_from_camera("0")
    result = draw.measure_grey(draw.frame_picture(moved, matrix), given, FiducialOptions(pose="0"))
    assert [mark.status for mark in result.marks[:5]] == [Status.MEASURED] * 5
    assert result.marks[5].status is Status.PREDICTED
    assert "no mark like its drawing within 6 px" in result.marks[5].reason
    assert result.marks[5].center_px == pytest.approx(matrix @ (0.0, 7.0, 1.0), abs=0.1)


@parametrize_with_studies(
    ("blot_dn", "said"), [(20000.0, "no candidate within"), (500.0, "the background at its place is so dark")]
)
def test_a_missing_mark_is_stated_to_be_hidden_only_where_its_ground_hides_it(blot_dn: float, said: str) -> None:
    """Nothing but the marks is dark in the scan, so that its darkest half per cent is lighter than they are."""
    places = [(7.0 * i, 7.0 * j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    dark = draw.lay_out([MarkShape(draw.RING_CROSS, "dark")] * 9, places)
    matrix = draw.pixel_from_camera("0")
    grey = np.random.default_rng(3).normal(20000.0, draw.NOISE_DN, (draw.FRAME_PX, draw.FRAME_PX))
    for given in dark.marks[:8]:
        draw.paint(grey, given.mark, given.xy_mm, matrix, -12000.0)
    col, row = np.rint(matrix @ (*dark.marks[8].xy_mm, 1.0)).astype(int)
    grey[row - 30 : row + 31, col - 30 : col + 31] += blot_dn - 20000.0
    result = draw.measure_grey(np.clip(grey, 0.0, None), dark, FiducialOptions(pose="0"))
    assert [mark.status for mark in result.marks] == [*[Status.MEASURED] * 8, Status.PREDICTED]
    assert result.marks[8].reason.startswith(said)

"""Frames that show three marks of four: plain ones are believed, and specks among specks are not."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from brute_marks import Array, brute_picture
from drawn import scan_of
from drawn_frames import layout_of, paint
from numpy.typing import NDArray

from measure.fiducials import measurement
from measure.fiducials.constellation import Placement
from measure.fiducials.frame import Frame
from measure.fiducials.measure_frame import measure_frame
from measure.fiducials.options import FiducialOptions
from measure.fiducials.orientation_pictures import SPOILT, MarkSite, PosedMark
from measure.fiducials.rows import present_frame
from measure.fiducials.scan_orientation import decide_pose
from measure.fiducials.search import FrameSearch, PitchHypothesis, pitch_hypotheses
from measure.fiducials.stages import doubt_frame
from measure.flags import Status
from measure.geometry import POSES, up_from_camera
from measure.marks.shapes import Disk, FiducialLayout, MarkShape, dot
from measure.marks.templates import cut, learn_template
from measure.results import Pose
from measure.scans.scan import Scan

PX_PER_MM = 20.0
CONTRAST_DN = 8000.0
CORNERS = ((7.0, -7.0), (-7.0, -7.0), (-7.0, 7.0), (7.0, 7.0))
DOT = MarkShape(dot(0.2), "light")
DOTS = layout_of([DOT] * 4, CORNERS, (16.0, 16.0))
OPTIONS = FiducialOptions()


def placement(pose: str) -> Placement:
    linear = np.diag([PX_PER_MM, -PX_PER_MM]) @ up_from_camera(pose)
    matrix = np.column_stack([linear, [190.3, 189.6]])
    return Placement(pose, matrix, 1.0, 4, 1, 1, (1 / PX_PER_MM, 1 / PX_PER_MM))


def picture(layout: FiducialLayout, pose: str, hidden: int | None = None) -> Array:
    """Marks on a plain ground, one of them under tape."""
    grey = np.full((380, 380), 20000.0)
    for index, mark in enumerate(layout.marks):
        if index != hidden:
            paint(grey, mark.mark, mark.xy_mm, placement(pose).pixel_from_camera, CONTRAST_DN, half=24)
    return noisy(grey)


def strewn(places_px: NDArray[np.int_]) -> Array:
    """Specks: dots with a corner gone."""
    place = np.column_stack([np.diag([PX_PER_MM, -PX_PER_MM]), [8.0, 8.0]])
    speck = CONTRAST_DN * brute_picture(DOT, place, 17, 17, 0.8)
    speck[:8, :8] = 0.0
    grey = np.full((380, 380), 20000.0)
    for col, row in places_px:
        grey[row - 8 : row + 9, col - 8 : col + 9] = 20000.0 + speck
    return noisy(grey)


def noisy(grey: Array) -> Array:
    return np.asarray(grey + np.random.default_rng(2).normal(0.0, 400.0, grey.shape))


def centers_px(layout: FiducialLayout, pose: str) -> Array:
    return np.array([placement(pose).pixel_from_camera @ (*mark.xy_mm, 1.0) for mark in layout.marks])


def make_frame(scan: Scan, layout: FiducialLayout) -> Frame:
    return measure_frame(scan, layout, placement("0"), OPTIONS)


def test_three_plain_dots_of_four_are_no_chance() -> None:
    scan = scan_of(picture(DOTS, "0", hidden=1))
    frame = make_frame(scan, DOTS)
    assert frame.inliers.tolist() == [True, False, True, True]
    assert doubt_frame(FrameSearch(scan, DOTS, OPTIONS), frame) == ""


def test_a_frame_moved_on_by_the_distance_of_two_marks_is_known_by_its_marks() -> None:
    """It has the left and the middle ones under the names of the middle and the right ones; the rest is outside."""
    layout = layout_of([DOT] * 8, (*CORNERS, (0.0, -7.0), (-7.0, 0.0), (0.0, 7.0), (7.0, 0.0)), (16.0, 16.0))
    scan = scan_of(picture(layout, "0", hidden=7))
    frame = make_frame(scan, layout)
    moved_on = placement("0").pixel_from_camera - np.array([[0.0, 0.0, 7.0 * PX_PER_MM], [0.0, 0.0, 0.0]])
    other = measure_frame(scan, layout, replace(placement("0"), pixel_from_camera=moved_on), OPTIONS)
    assert (int(frame.inliers.sum()), int(other.inliers.sum())) == (7, 4)
    assert frame.contains(other)
    assert not other.contains(frame)
    assert not frame.contains(frame)


def test_three_marks_of_the_neighbouring_frame_are_no_frame_next_to_five_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three of eight may be chance, although each is plainly a mark, and answer more strongly than the five."""
    layout = layout_of([DOT] * 8, (*CORNERS, (0.0, -7.0), (-7.0, 0.0), (0.0, 7.0), (7.0, 0.0)), (16.0, 16.0))
    aside_px, own, neighbours = np.array([50.0, 0.0]), (0, 1, 3, 4, 7), (1, 2, 5)
    grey, true = np.full((380, 430), 20000.0), placement("0").pixel_from_camera
    shifted = true + np.column_stack([np.zeros((2, 2)), aside_px])
    for index, matrix in [*((index, true) for index in own), *((index, shifted) for index in neighbours)]:
        paint(grey, layout.marks[index].mark, layout.marks[index].xy_mm, matrix, CONTRAST_DN, half=24)
    whole = FrameSearch.search_scan

    def false_first(search: FrameSearch, hypotheses: Sequence[PitchHypothesis]) -> list[Placement]:
        found = whole(search, hypotheses)
        return [replace(found[0], pixel_from_camera=shifted), *found]

    monkeypatch.setattr(FrameSearch, "search_scan", false_first)
    monkeypatch.setattr(measurement, "pitch_hypotheses", lambda *given: pitch_hypotheses(*given)[:1])
    result = measurement.measure_fiducials(scan_of(noisy(grey)), layout, (50.0, 50.0), replace(OPTIONS, pose="0"))
    # Five of the eight fit shifted by 2.5 mm, too: the problem says so, and none is more than weak.
    assert [mark.status is Status.WEAK for mark in result.marks] == [index in own for index in range(8)]
    for index in own:
        assert result.marks[index].center_px == pytest.approx(true @ (*layout.marks[index].xy_mm, 1.0), abs=0.3)


def test_specks_that_lie_as_three_marks_of_four_are_doubted_with_numbers() -> None:
    as_marks = np.rint(centers_px(DOTS, "0")).astype(int)
    elsewhere = np.random.default_rng(1).integers(10, 360, (300, 2))
    free = np.hypot(*(elsewhere[:, None] - as_marks).T).min(axis=0) > 22
    scan = scan_of(strewn(np.concatenate([elsewhere[free], as_marks[1:]])))
    frame = make_frame(scan, DOTS)
    assert frame.inliers.tolist() == [False, True, True, True]
    sentence = doubt_frame(FrameSearch(scan, DOTS, OPTIONS), frame)
    assert "only 3 of 4 marks were found, and 1 of 64 random places match as well (p = 0.06)" in sentence


def test_a_frame_that_chance_is_likelier_to_have_made_than_not_gives_no_observation() -> None:
    """Two marks of four: a similarity goes through any two."""
    grey = picture(DOTS, "0", hidden=1)
    at = np.rint(centers_px(DOTS, "0")[2]).astype(int)
    grey[at[1] - 24 : at[1] + 25, at[0] - 24 : at[0] + 25] = 20000.0
    scan = scan_of(grey)
    frame = make_frame(scan, DOTS)
    chance = doubt_frame(FrameSearch(scan, DOTS, OPTIONS), frame)
    assert "(p = 1.00): the frame may lie elsewhere" in chance
    result = present_frame(frame, Pose("0", False), (50.0, 50.0), (), chance)
    assert [mark.status for mark in result.marks] == [Status.PREDICTED] * 4
    assert all(mark.reason == chance and mark.covariance is None for mark in result.marks)
    for mark, place in zip(result.marks, centers_px(DOTS, "0"), strict=True):
        assert mark.center_px == pytest.approx(place, abs=5.0)
    assert result.pixel_from_camera is None


@pytest.mark.study
def test_specks_that_lie_as_all_marks_are_doubted_too() -> None:
    as_marks = np.rint(centers_px(DOTS, "0")).astype(int)
    elsewhere = np.random.default_rng(1).integers(10, 360, (300, 2))
    free = np.hypot(*(elsewhere[:, None] - as_marks).T).min(axis=0) > 22
    result = measurement.measure_fiducials(
        scan_of(strewn(np.concatenate([elsewhere[free], as_marks]))), DOTS, (50.0, 50.0)
    )
    assert Status.MEASURED not in {mark.status for mark in result.marks}
    assert result.pose is None or not result.pose.decided


def test_one_mark_and_the_places_of_the_others_tell_the_pose() -> None:
    """Marks that differ by their identification dots are not found under one another's names."""
    ids = [tuple(Disk((0.9, 0.4 * k - 0.4), 0.12) for k in range(count)) for count in range(4)]
    layout = layout_of([MarkShape((*dot(0.2), *dots), "light") for dots in ids], CORNERS, (16.0, 16.0))
    scan = scan_of(picture(layout, "90"))
    frame = replace(make_frame(scan, layout), inliers=np.array([True, False, False, False]))
    pose = decide_pose(scan, [placement(pose) for pose in POSES], frame)
    assert (pose.name, pose.decided) == ("90", True)


@pytest.mark.parametrize(("chips", "agreeing", "decided"), [(True, 4, True), (True, 3, False), (False, 3, True)])
def test_pictures_of_one_scan_alone_decide_a_pose_only_beyond_chance(
    chips: bool, agreeing: int, decided: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among eight poses four marks agree on one by chance in one of 512 frames; three of them, whichever they are, in
    one of 18. What is drawn, or was averaged over scans, has no landscape that could agree."""
    scan = scan_of(picture(DOTS, "0"))
    frame = make_frame(scan, DOTS)
    with_chips = [
        replace(mark, mark=learn_template([cut(scan, centred(mark.xy_mm), 2.0)], 2.0)) if chips else mark
        for mark in DOTS.marks
    ]
    sites = iter(range(4))

    def best(_: MarkSite, shown: Sequence[PosedMark]) -> Array:
        likelihoods = np.full(len(shown), np.log(SPOILT))
        likelihoods[1 if next(sites) < agreeing else 2] = 0.0
        return likelihoods

    monkeypatch.setattr(MarkSite, "likelihoods", best)
    placements = [placement(pose) for pose in POSES]
    pose = decide_pose(scan, placements, replace(frame, layout=replace(DOTS, marks=tuple(with_chips))))
    assert pose.decided is decided, pose.evidence
    assert pose.name == POSES[1]


def centred(xy_mm: tuple[float, float]) -> Array:
    matrix = placement("0").pixel_from_camera
    return np.column_stack([matrix[:, :2], matrix @ (*xy_mm, 1.0)])

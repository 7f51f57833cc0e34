"""Own figures of a plate's marks: a cross of short arms in all frames is not damaged, one covered in a frame is."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from brute_marks import brute_picture
from drawn_frames import frame_picture, layout_of, measured, pixel_from_camera
from numpy.typing import NDArray

from measure.fiducials.across_frames import check_frames
from measure.fiducials.mark_comparison import OwnFigure, check_own_figures, unlike_blur, unlike_others
from measure.flags import Cause, Code, Reason, Status
from measure.marks.shapes import Bar, MarkShape, cross
from measure.matching.match import match, measure_arms
from measure.matching.window import ScanWindow
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose

GIVEN = MarkShape(cross(0.8, 0.1))
SHORT = MarkShape((Bar((-0.7, 0.0), (0.7, 0.0), 0.1), Bar((0.0, -0.8), (0.0, 0.7), 0.1)))
COVERED = MarkShape((Bar((-0.8, 0.0), (0.8, 0.0), 0.1), Bar((0.0, -0.8), (0.0, 0.5), 0.1)))
PLACES = tuple((7.0 * x, 7.0 * y) for y in (1, 0, -1) for x in (-1, 0, 1))
LAYOUT, PITCH = layout_of([GIVEN] * 9, PLACES), (50.0, 50.0)


def plate_frame(number: int, folder: Path, covered: bool = False) -> FrameMeasurement:
    """A frame of a plate whose third cross has three short arms; an arm of the sixth one may be covered."""
    plate = layout_of([SHORT if k == 2 else COVERED if k == 5 and covered else GIVEN for k in range(9)], PLACES)
    matrix = pixel_from_camera("0", 0.008 + 0.001 * number, (202.3 + 0.3 * number, 197.6 - 0.4 * number))
    return replace(measured(frame_picture(plate, matrix, seed=number), LAYOUT, folder), image=str(number))


def test_what_is_alike_in_all_frames_is_the_plates_and_what_one_has_is_damage(tmp_path: Path) -> None:
    frames = [plate_frame(number, tmp_path, covered=number == 3) for number in range(1, 4)]
    assert any("times as large as the other marks" in frame.marks[2].reason for frame in frames)
    checked = check_frames(frames, LAYOUT, [PITCH] * 3).frames
    assert [frame.marks[2].status for frame in checked] == [Status.MEASURED] * 3
    weak = {(frame.image, mark.point): mark.reason for frame in checked for mark in frame.marks if mark.reason}
    assert list(weak) == [("3", "6")]
    assert "one of its arms is 0." in weak["3", "6"]
    assert "what it is" not in weak["3", "6"]
    assert Code.COVERED in weak["3", "6"].codes
    pair = check_frames(frames[:2], LAYOUT, [PITCH] * 2).frames
    assert [frame.marks[2].status for frame in pair] == [frame.marks[2].status for frame in frames[:2]]


def test_lengths_of_arms_are_those_drawn_and_known_as_well_as_they_are_said_to_be() -> None:
    rng, place = np.random.default_rng(1), np.array([[27.0, 0.3, 40.3], [0.25, -27.0, 39.6]])
    drawn = MarkShape((Bar((-0.8, 0.0), (0.72, 0.0), 0.1), Bar((0.0, -0.8), (0.0, 0.64), 0.1)))
    truth, shown = np.array((1.0, 0.9, 1.0, 0.8)), 6000 * brute_picture(drawn, place, 80, 80, 1.0) + 3000
    errors, normalised = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    for _ in range(12):
        window = ScanWindow(shown + rng.normal(0.0, 500.0, shown.shape))
        lengths, sigmas = measure_arms(window, GIVEN, place, match(window, GIVEN, place))
        errors.append(lengths - truth)
        normalised.append(errors[-1] / sigmas)
    assert np.abs(errors).max() < 0.05
    assert np.abs(np.mean(errors, axis=0)).max() < 0.016  # the estimate is linear in the lengths
    assert 0.7 < np.std(normalised, axis=0).mean() < 1.3


def test_good_figures_are_doubted_as_seldom_as_stated_and_frames_that_do_not_agree_tell_nothing() -> None:
    rng, off = np.random.default_rng(2), list[float]()
    for _ in range(300):
        sigmas = rng.uniform(0.005, 0.03, 8)
        own = OwnFigure.from_frames(rng.normal(-0.1, np.hypot(sigmas, 0.014)), sigmas, is_blur=False)
        assert own is not None
        assert own.value == pytest.approx(-0.1, abs=5 * own.sigma)
        off += (own.off / own.off_sigma).tolist()
    assert 0.85 < np.std(off) < 1.15
    apart, sigmas = np.array([-0.1, 0.0, 0.1, 0.2]), np.full(4, 0.01)
    assert OwnFigure.from_frames(apart, sigmas, is_blur=False) is None
    assert OwnFigure.from_frames(np.full(2, -0.1), sigmas[:2], is_blur=False) is None


@pytest.mark.parametrize(("poses", "agree"), [(("0", "0", "0m"), True), (("0", "0", "0"), False)])
def test_a_turn_is_compared_as_the_camera_has_it(poses: tuple[str, ...], agree: bool) -> None:
    """Two frames have the mark turned by 3 degrees to the left, one to the right: the same turn if that is mirrored."""
    frames = []
    for pose, turn_rad in zip(poses, (0.051, 0.054, -0.054), strict=True):
        quality = {"size_ratio": 1.0, "size_sigma": 0.002, "turn_rad": turn_rad, "turn_sigma": 0.002}
        place = Covariance({Cause.NOISE: 0.01 * np.eye(2)})
        mark = MarkMeasurement("1", "fiducial", np.zeros(2), place, Status.MEASURED, quality=quality)
        frames.append(FrameMeasurement(pose, (mark,), Pose(pose, True)))
    assert [frame.marks[0].status is Status.MEASURED for frame in check_own_figures(frames)] == [True, True, agree]


def make_frames(figures: Sequence[Mapping[str, float]], doubt: Reason) -> list[FrameMeasurement]:
    """A frame for each of these figures of a mark, weak for that doubt, beside two crosses as drawn."""
    place, arms = Covariance({Cause.NOISE: 0.01 * np.eye(2)}), {f"arm{k}_ratio": 1.0 for k in range(1, 5)}
    sigmas = {f"{name}_sigma": 0.01 for name in ("size", "blur", "arm1", "arm2", "arm3", "arm4")}
    frames = []
    for number, own in enumerate(figures):
        longer = own.get("arm1_ratio", 1.0) if own.get("arm1_ratio", 1.0) > 1 else 1.0
        others = {"size_ratio": 1.0, "blur_ratio": 1.0, **dict.fromkeys(arms, longer)}
        marks = [
            MarkMeasurement("1", "fiducial", np.zeros(2), place, Status.WEAK, doubt, {**others, **own, **sigmas}),
            *(
                MarkMeasurement(name, "fiducial", np.ones(2), place, Status.MEASURED, quality={**others, **sigmas})
                for name in "23"
            ),
        ]
        frames.append(FrameMeasurement(str(number), tuple(marks), Pose("0", True)))
    return frames


@pytest.mark.parametrize(
    ("figures", "doubt", "status"),
    [
        # Its arms are as drawn in all frames: they do not explain a small cross, which another thing makes then.
        ([{"size_ratio": 0.83}] * 3, unlike_others(0.83, None), Status.WEAK),
        ([{"size_ratio": 0.9, "arm2_ratio": 0.88}] * 3, unlike_others(0.9, None), Status.MEASURED),
        ([{"blur_ratio": 1.6}] * 3, unlike_blur(1.6), Status.MEASURED),
        ([{"blur_ratio": 1.6}, {}, {}], unlike_blur(1.6), Status.WEAK),
        # More light makes the arms of a whole frame longer.
        ([{"size_ratio": 0.9, "arm1_ratio": 1.1, "arm2_ratio": 0.97}, *[{"arm2_ratio": 0.88}] * 2],
         unlike_others(0.9, None), Status.MEASURED),
    ],
)  # fmt: skip
def test_a_doubt_is_dropped_where_the_plate_explains_it(
    figures: Sequence[Mapping[str, float]], doubt: Reason, status: Status
) -> None:
    assert check_own_figures(make_frames(figures, doubt))[0].marks[0].status is status

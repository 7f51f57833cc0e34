"""Frames of a camera judged together: wrong marks, bent films, perspectives, on made-up places."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from drawn import center, measured_mark
from studies import parametrize_with_studies

from measure import Code, FiducialLayout, FrameMeasurement, LayoutMark, MarkShape, Reason, Status, cross
from measure.fiducials.across_frames import CheckedFrames, check_frames
from measure.fiducials.consistency import FrameMarks, frame_p_value
from measure.fiducials.options import BelievedFilm
from measure.flags import FALSE_DOUBT, Cause
from measure.geometry import UP_FROM_CAMERA
from measure.results import ScanOrientation

PX_PER_MM, SIGMA_PX, FILM_MM = 50.0, 0.02, 0.003
PITCH = (1000 / PX_PER_MM, 1000 / PX_PER_MM)
EIGHT = [(106.0 * x, 106.0 * y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)]
FOUR = [(x, y) for x, y in EIGHT if x and y]


def make_layout(places: list[tuple[float, float]], sigma_mm: float = 0.005) -> FiducialLayout:
    shape = MarkShape(cross(1.0, 0.1))
    marks = [LayoutMark(str(k), place, (sigma_mm, sigma_mm), shape) for k, place in enumerate(places)]
    return FiducialLayout(tuple(marks), (228.0, 228.0))


def make_frames(
    layout: FiducialLayout,
    count: int,
    rng: np.random.Generator,
    camera_mm: float = 0.0,
    film_mm: float = FILM_MM,
    poses: Sequence[str] = ("0",),
    scanner_mm: float = 0.0,
) -> list[FrameMeasurement]:
    """Frames under affinities of their own; camera_mm: how far the camera's marks lie from their given places;
    scanner_mm: by how much the scanner bends its scans, as x y and x²."""
    made = np.array([mark.xy_mm for mark in layout.marks])
    made += rng.normal(0.0, camera_mm, made.shape)
    frames = []
    for number in range(count):
        pose, turn = poses[number % len(poses)], UP_FROM_CAMERA[poses[number % len(poses)]]
        linear = PX_PER_MM * (np.diag([1.0, -1.0]) + rng.normal(0.0, 1e-3, (2, 2))) @ turn
        matrix = np.column_stack([linear, rng.uniform(5000.0, 6000.0, 2)])
        scatter = np.hypot(SIGMA_PX, film_mm * PX_PER_MM)
        x, y = (made @ turn.T / 100.0).T
        bent = scanner_mm * PX_PER_MM * np.column_stack([x * y, -(x**2)])
        centers = made @ linear.T + matrix[:, 2] + rng.normal(0.0, scatter, made.shape) + bent
        places = zip(layout.marks, centers, strict=True)
        marks = tuple(measured_mark(mark.id, center, SIGMA_PX) for mark, center in places)
        frames.append(FrameMeasurement(str(number), marks, ScanOrientation(pose, True), matrix))
    return frames


def checked_together(frames: list[FrameMeasurement], layout: FiducialLayout) -> tuple[FrameMeasurement, ...]:
    return check_frames(frames, layout, [PITCH] * len(frames)).frames


def shift_mark(frame: FrameMeasurement, mark: int, by_px: tuple[float, float]) -> FrameMeasurement:
    marks = list(frame.marks)
    marks[mark] = replace(marks[mark], center_px=center(marks[mark]) + by_px)
    return replace(frame, marks=tuple(marks))


def weak(frames: tuple[FrameMeasurement, ...]) -> set[tuple[str, str]]:
    return {(frame.image, mark.point) for frame in frames for mark in frame.marks if mark.status is Status.WEAK}


def test_a_mark_that_only_one_frame_has_elsewhere_is_weak() -> None:
    rng = np.random.default_rng(2)
    layout = make_layout(EIGHT, sigma_mm=1.0)
    frames = make_frames(layout, 5, rng, camera_mm=0.05)
    frames[3] = shift_mark(frames[3], 2, (1.5, -1.5))
    checked = checked_together(frames, layout)
    assert weak(checked) == {("3", "2")}
    mark = checked[3].marks[2]
    assert "from where the camera's other frames have it" in mark.reason
    assert mark.covariance_px2 is not None
    np.testing.assert_allclose(np.sqrt(mark.covariance_px2[0, 0]), 1.5, rtol=0.3)


def test_of_four_marks_it_is_the_frame_that_does_not_fit() -> None:
    """A mark of four may be off, or film bent: the frame says so, and its marks are known no better than that."""
    rng = np.random.default_rng(3)
    layout = make_layout(FOUR, sigma_mm=1.0)
    frames = make_frames(layout, 5, rng)
    frames[1] = shift_mark(frames[1], 0, (4.0, 4.0))
    result = check_frames(frames, layout, [(20.0, 20.0)] * 5)
    assert weak(result.frames) == set()
    assert [len(frame.problems) for frame in result.frames] == [0, 1, 0, 0, 0]
    assert "Or one of its marks is wrong: look at all of them." in result.frames[1].problems[0]
    most = re.search(r"by up to (0\.\d+) mm", result.frames[1].problems[0])
    assert most is not None
    assert float(most[1]) == pytest.approx(0.028, abs=0.006)  # a quarter of 0.113 mm at each mark
    assert result.film_sigma_mm[0] == 0.005
    assert result.film_sigma_mm[1] == pytest.approx(0.04, rel=0.3)  # half of it in two degrees of freedom
    stated = check_frames(frames, layout, [(20.0, 20.0)] * 5, BelievedFilm(0.005, is_stated=True))
    for each in (result, stated):  # any of the four may be the wrong one, and none is better known than it is then off
        added = [mark.covariance.sigmas_px[Cause.FILM] for mark in each.frames[1].marks if mark.covariance]
        np.testing.assert_allclose(added, 4.0, rtol=0.2)


def test_one_frame_names_the_mark_that_alone_is_off() -> None:
    rng = np.random.default_rng(4)
    layout = make_layout(EIGHT)
    (frame,) = make_frames(layout, 1, rng)
    assert weak(checked_together([frame], layout)) == set()
    checked = checked_together([shift_mark(frame, 1, (3.0, 0.0))], layout)
    assert weak(checked) == {("0", "1")}
    assert "from where the other marks have it" in checked[0].marks[1].reason
    known = checked[0].marks[1].covariance
    assert known is not None
    assert known.sigmas_px[Cause.GIVEN_PLACES] == pytest.approx(3.0 / np.sqrt(2), rel=0.1)


@pytest.mark.parametrize("count", [1, 4])
def test_a_bent_frame_is_a_problem_of_the_frame(count: int) -> None:
    rng, layout = np.random.default_rng(7), make_layout(EIGHT)
    frames = make_frames(layout, count, rng)
    frames[0] = make_frames(layout, 1, rng, film_mm=0.08)[0]
    result = check_frames(frames, layout, [(20.0, 20.0)] * count)
    assert weak(result.frames) == set()
    assert [len(frame.problems) for frame in result.frames] == [1] + [0] * (count - 1)
    assert ("one frame does not tell" in result.frames[0].problems[0]) == (count == 1)
    assert 0.04 < result.film_sigma_mm[0] < 0.14


@pytest.mark.parametrize("step_px", [(4.5, 0.0), (0.0, -4.5)])
def test_a_jump_within_a_scan_is_a_problem_of_the_frame(step_px: tuple[float, float]) -> None:
    """By 90 µm, which each mark shows by a part only: an affine transformation takes up most of it."""
    layout, named = make_layout(EIGHT), 0
    for seed in range(10):
        (frame,) = make_frames(layout, 1, np.random.default_rng(seed), film_mm=0.005)
        for mark in np.flatnonzero([place[0] > -50.0 for place in EIGHT]).tolist():
            frame = shift_mark(frame, mark, step_px)
        (checked,) = checked_together([frame], layout)
        assert weak((checked,)) == set()
        (problem,) = checked.problems
        jump = re.search(r"jump of the scanner.*of (0.\d+) mm", problem)
        named += jump is not None
        if jump:
            assert float(jump[1]) == pytest.approx(0.09, abs=0.03)
    assert named >= 6


@parametrize_with_studies(
    ("sigma_mm", "model"),
    [(0.001, "affine"), (0.005, "affine"), (0.02, "affine"), (0.005, "projective"), (0.005, "bilinear")],
    quick=(1, 3),
)
def test_an_ordinary_frame_is_flagged_as_often_as_stated(sigma_mm: float, model: str) -> None:
    """Film that scatters as its prior says, with four degrees of freedom; affinities are free in the other models."""
    rng, given, frames = np.random.default_rng(11), np.array(EIGHT), 300
    flagged = 0
    for _ in range(frames):
        film_mm = 0.005 * np.sqrt(4.0 / rng.chisquare(4.0))
        places = given + rng.normal(0.0, np.hypot(film_mm, sigma_mm), given.shape)
        marks = FrameMarks.from_places(given, places, np.tile(sigma_mm**2 * np.eye(2), (len(given), 1, 1)), model)
        flagged += frame_p_value(marks) < FALSE_DOUBT
    assert flagged < 3 * FALSE_DOUBT * frames


@pytest.mark.parametrize(("places", "count"), [(FOUR, 1), (FOUR, 3), (EIGHT, 2), (EIGHT, 6)])
def test_given_coordinates_that_all_frames_contradict(places: list[tuple[float, float]], count: int) -> None:
    rng, layout = np.random.default_rng(8), make_layout(places)
    result = check_frames(make_frames(layout, count, rng, camera_mm=0.4), layout, [(20.0, 20.0)] * count)
    assert weak(result.frames) == set()
    for frame in result.frames:
        (problem,) = frame.problems
        assert "given coordinates" in problem
        assert "p = " in problem
    if count > 1:
        assert set(result.film_sigma_mm) == {0.005}


def test_what_is_alike_in_scan_axes_is_the_scanners() -> None:
    rng, layout = np.random.default_rng(9), make_layout(EIGHT)
    frames = make_frames(layout, 8, rng, poses=("0", "90", "180", "270m"), scanner_mm=0.06)
    result = check_frames(frames, layout, [(20.0, 20.0)] * 8)
    assert weak(result.frames) == set()
    assert all("scanner's axes" in frame.problems[0] and len(frame.problems) == 1 for frame in result.frames)
    alike = check_frames(make_frames(layout, 8, rng, scanner_mm=0.06), layout, [(20.0, 20.0)] * 8).frames
    assert all("The scanner may do the same" in frame.problems[0] for frame in alike)
    turned = make_frames(layout, 8, rng, camera_mm=0.05, poses=("0", "90", "180", "270m"))
    of_places = check_frames(turned, layout, [(20.0, 20.0)] * 8).frames
    assert all("given coordinates" in frame.problems[0] and "scanner" not in frame.problems[0] for frame in of_places)


def test_ordinary_frames_have_no_problem() -> None:
    """One camera in a hundred has one, by each of the tests."""
    rng, own_result = np.random.default_rng(10), 0
    for number in range(12):
        layout = make_layout(FOUR if number % 2 else EIGHT)
        frames = make_frames(layout, 1 + number % 4, rng, camera_mm=0.005, film_mm=0.005, poses=("0", "90m"))
        result = check_frames(frames, layout, [(20.0, 20.0)] * len(frames))
        own_result += any(frame.problems for frame in result.frames) or bool(weak(result.frames))
    assert own_result <= 1


def test_two_frames_of_another_size_do_not_make_three_right_ones_stretched() -> None:
    rng = np.random.default_rng(4)
    frames = make_frames(make_layout(FOUR), 3, rng)
    larger = make_frames(make_layout([(1.03 * x, 1.03 * y) for x, y in FOUR]), 2, rng)
    other = [
        replace(each, problems=(Reason("the marks' separations suggest another pitch", Code.PITCH),)) for each in larger
    ]
    checked = checked_together([*frames, *other], make_layout(FOUR))
    assert [len(frame.problems) for frame in checked] == [0, 0, 0, 1, 1]
    assert weak(checked) == set()


WRONG_MARKS_SIGMA_PX = 0.03
AFFINITY = 2e-4


def make_frame(name: str, film_mm: np.ndarray, rng: np.random.Generator) -> FrameMeasurement:
    """A frame whose marks lie at film_mm (n, 2), laid upright on the scanner."""
    up = np.diag([1.0, -1.0])
    centers = PX_PER_MM * film_mm @ up + 6000.0 + rng.normal(0.0, WRONG_MARKS_SIGMA_PX, film_mm.shape)
    marks = tuple(measured_mark(str(k), center, WRONG_MARKS_SIGMA_PX) for k, center in enumerate(centers))
    return FrameMeasurement(
        name, marks, ScanOrientation("0", True), np.column_stack([PX_PER_MM * up, [6000.0, 6000.0]])
    )


def bent_film(rng: np.random.Generator, bend_mm: float) -> np.ndarray:
    """Four marks on film that is stretched, and bent as x y."""
    size, stretch, shear = rng.normal(0.0, AFFINITY, 3)
    angle, given = rng.uniform(0.0, 2 * np.pi), np.array(FOUR)
    bend = bend_mm * np.outer(np.sign(given[:, 0] * given[:, 1]), (np.cos(angle), np.sin(angle)))
    return np.asarray(given @ np.array([[1 + size + stretch, shear], [shear, 1 + size - stretch]]) + bend)


def check_network(frames: list[FrameMeasurement]) -> CheckedFrames:
    return check_frames(frames, make_layout(FOUR), [PITCH] * len(frames))


def named(result: CheckedFrames) -> set[tuple[str, str]]:
    return {(frame.image, mark.point) for frame in result.frames for mark in frame.marks if mark.reason}


def folder(rng: np.random.Generator, count: int) -> tuple[list[FrameMeasurement], int, np.ndarray]:
    """Frames on film bent by 0.02 to 0.1 mm, one mark of the first 1 mm off; which one, and its error in mm."""
    films = [bent_film(rng, rng.uniform(0.02, 0.1)) for _ in range(count)]
    wrong, angle = int(rng.integers(4)), rng.uniform(0.0, 2 * np.pi)
    error_mm = np.array([np.cos(angle), np.sin(angle)])
    films[0][wrong] += error_mm
    return [make_frame(str(k), film, rng) for k, film in enumerate(films)], wrong, error_mm


def test_a_mark_of_four_that_is_wrong_is_named_next_to_ten_frames_and_no_other_is() -> None:
    rng, right = np.random.default_rng(3), 0
    for _ in range(3):
        frames, wrong, _ = folder(rng, 10)
        found = named(check_network(frames))
        assert found <= {("0", str(wrong))}
        right += bool(found)
    assert right >= 2  # in nine of ten of 200 folders


@pytest.mark.parametrize("count", [2, 3])
def test_standard_deviations_cover_a_wrong_mark_in_a_small_folder(count: int) -> None:
    """The scatter that a frame is tested by comes from the others, so that it does not hide its own wrong mark."""
    rng, covered = np.random.default_rng(6), 0
    for _ in range(8):
        frames, wrong, error_mm = folder(rng, count)
        mark = check_network(frames).frames[0].marks[wrong]
        assert mark.covariance is not None
        covered += bool((np.abs(error_mm) < 3.0 * np.sqrt(np.diag(mark.covariance.px2)) / PX_PER_MM).all())
    assert covered >= 6  # of 60 folders 56 (two frames) and 50 (three); with the own frame in the scatter 16 and 22


def test_film_that_scatters_more_than_expected_is_a_problem_of_all_frames() -> None:
    """Next to two frames that are bent as well, a mark that is 1 mm off does not stand out."""
    rng = np.random.default_rng(4)
    for _ in range(2):
        frames, wrong, _ = folder(rng, 3)
        result = check_network(frames)
        assert named(result) <= {("0", str(wrong))}
        assert all("state film_sigma_um" in frame.problems[-1] for frame in result.frames)
        stated = check_frames(frames, make_layout(FOUR), [(1e3 / PX_PER_MM,) * 2] * 3, BelievedFilm(1, is_stated=True))
        assert not any(frame.problems for frame in stated.frames)


@parametrize_with_studies("count", [1, 10])
def test_of_four_good_marks_on_bent_film_none_is_called_wrong(count: int) -> None:
    rng = np.random.default_rng(5)
    for _ in range(5):
        bends = [0.15] + [rng.uniform(0.0, 0.02) for _ in range(count - 1)]
        result = check_network([make_frame(str(k), bent_film(rng, bend), rng) for k, bend in enumerate(bends)])
        assert named(result) == set()
        assert result.frames[0].problems


@pytest.mark.parametrize("tilt_deg", [0.5, 1.0, 2.0, 5.0])
def test_a_perspective_is_named_where_films_are_affine(tilt_deg: float) -> None:
    """Eight marks as a pinhole 600 mm away pictures them."""
    rng, tilt = np.random.default_rng(6), np.deg2rad(tilt_deg)
    x, y = np.array(EIGHT).T
    film = np.column_stack([x * np.cos(tilt), y]) / (1 + x * np.sin(tilt) / 600.0)[:, None]
    frame = make_frame("0", film, rng)
    affine = check_frames([frame], make_layout(EIGHT), [PITCH]).frames[0]
    assert {mark.status for mark in affine.marks} == {Status.MEASURED}
    assert 'set transformation = "projective"' in affine.problems[0]
    projective = check_frames([frame], make_layout(EIGHT), [PITCH], BelievedFilm(model="projective")).frames[0]
    assert not projective.problems
    for mark in projective.marks:
        assert mark.covariance_px2 is not None
        np.testing.assert_allclose(np.sqrt(np.diag(mark.covariance_px2)), WRONG_MARKS_SIGMA_PX)


# Weak marks: what made them weak may have moved them, by what the frame's misfit shows.


def weaken(frame: FrameMeasurement, *numbers: int) -> FrameMeasurement:
    """The frame with some marks of the status weak."""
    reason = Reason("its contrast is low", Code.CONTRAST)
    marks = [
        replace(mark, status=Status.WEAK, reason=reason) if i in numbers else mark for i, mark in enumerate(frame.marks)
    ]
    return replace(frame, marks=tuple(marks))


def added_px(frame: FrameMeasurement, cause: Cause = Cause.GIVEN_PLACES) -> list[float]:
    return [mark.covariance.sigmas_px.get(cause, 0.0) for mark in frame.marks if mark.covariance]


@pytest.mark.parametrize(("count", "off_px"), [(4, (1.2, 0.9)), (3, (120.0, -90.0))])
def test_a_weak_mark_is_known_no_better_than_its_frame_shows(count: int, off_px: tuple[float, float]) -> None:
    """The frame does not stand out: the error is small, or film may stretch three marks as much."""
    layout = make_layout(FOUR[:count])
    (frame,) = make_frames(layout, 1, np.random.default_rng(4))
    (checked,) = checked_together([weaken(shift_mark(frame, 1, off_px), 1)], layout)
    assert checked.problems == ()
    added = added_px(checked)
    assert 0.3 < added.pop(1) / np.hypot(*off_px) < 1.5
    assert not any(added)


def test_weak_marks_of_sound_frames_keep_their_covariances() -> None:
    """An estimated variance is positive by chance, and then about as large as what is known."""
    layout, rng = make_layout(FOUR), np.random.default_rng(5)
    frames = [weaken(frame, 0, 1, 2, 3) for frame in make_frames(layout, 40, rng, camera_mm=0.005)]
    added = [max(added_px(checked_together([frame], layout)[0])) for frame in frames]
    assert np.mean(np.array(added) > 0) < 0.4
    assert max(added) < 4 * np.hypot(SIGMA_PX, 0.005 * PX_PER_MM)

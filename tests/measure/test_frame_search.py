"""The search for a frame: the list of attempts, hypotheses, and what is found at a closer look or not believed."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from drawn import ALIKE, make_scan, measured_mark
from numpy.typing import NDArray

from measure import FiducialOptions, Scan
from measure.detection.responses import ByteCache, Responses
from measure.fiducials import stages
from measure.fiducials.constellation import Bounds, Placement, PlacementSearch, same_picture
from measure.fiducials.frame import Frame
from measure.fiducials.measure_frame import fit_lines_and_sharpening
from measure.fiducials.measurement import _lacks_its_own
from measure.fiducials.rows import pitch_problem
from measure.fiducials.search import PitchHypothesis, SearchResult
from measure.fiducials.stages import Found, Kind, Stage, find_frame
from measure.flags import FRAMES_BY_CHANCE, NO_REASON, Reason
from measure.geometry import POSES, UP_FROM_CAMERA
from measure.marks.shapes import FiducialLayout, LayoutMark, MarkShape, dot
from measure.results import FrameMeasurement
from measure.tone.curve import Tone
from measure.tone.sharpening import Sharpening

DOT = MarkShape(dot(0.3), "light")
PLACES = ((100.0, -100.0), (-100.0, -100.0), (-100.0, 100.0), (100.0, 100.0), (0.0, -103.0), (0.0, 95.0))
MARKS = [LayoutMark(str(index), place, (0.01, 0.01), DOT) for index, place in enumerate(PLACES)]
BOUNDS = Bounds(0.04, 0.1, 0.6)
NEAR_MM = 0.06
PITCH_MM = 0.5


def responses(places_px: NDArray[np.float64], heights: NDArray[np.float64], seed: int = 1) -> Responses:
    """A faint noisy map with peaks two pixels wide."""
    rng = np.random.default_rng(seed)
    light = rng.normal(0, 0.06, (520, 540)).astype(np.float32)
    for (col, row), height in zip(np.rint(places_px).astype(int), heights, strict=True):
        light[row - 1 : row + 2, col - 1 : col + 2] = 0.6 * height
        light[row, col] = height
    return Responses({(0, 1): light}, (0,), 1, ByteCache(1 << 30))


def placements(pose: str, answers: Responses) -> list[Placement]:
    return PlacementSearch(MARKS, answers, (PITCH_MM, PITCH_MM), BOUNDS).find_placements(pose, [0] * 6)


def view_marks(pose: str, scale: float = 1.015, angle: float = 0.03) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    up = np.array(PLACES) @ (scale * np.array([[c, -s], [s, c]]) @ UP_FROM_CAMERA[pose]).T
    return np.asarray(up * (1, -1) / PITCH_MM + (265.0, 255.0))


def predicted(placement: Placement) -> NDArray[np.float64]:
    return np.asarray(np.array(PLACES) @ placement.pixel_from_camera[:, :2].T + placement.pixel_from_camera[:, 2])


def test_the_place_is_found_among_brighter_false_answers() -> None:
    """Text, dials and trees answer more strongly than the marks; only the marks answer together."""
    rng = np.random.default_rng(3)
    for pose in POSES:
        true = view_marks(pose)
        false = rng.uniform(20, 500, (40, 2))
        places = np.concatenate([true, false])
        heights = np.concatenate([np.full(6, 0.6), rng.uniform(0.5, 0.9, 40)])
        found = placements(pose, responses(places, heights))
        assert np.abs(predicted(found[0]) - true).max() < 1.5
        assert found[0].supported == 6


def test_a_lattice_of_more_marks_than_candidates_is_not_a_step_off() -> None:
    """The hundred strongest answers, all in one corner, tell how it lies and not where it begins."""
    steps = 9.0 * (np.arange(23) - 11)
    lattice = [LayoutMark(f"{x}, {y}", (float(x), float(y)), (0.01, 0.01), DOT) for x in steps for y in steps]
    camera = np.array([mark.xy_mm for mark in lattice])
    true = camera @ np.array([[1.01, 0.02], [0.02, -1.01]]) / PITCH_MM + (268.0, 257.0)
    heights = np.interp(camera.min(axis=1), [-99.0, 99.0], [0.4, 0.7])
    answers = responses(true, heights)
    search = PlacementSearch(lattice, answers, (PITCH_MM, PITCH_MM), BOUNDS)
    best = search.find_placements("0", [0] * len(lattice))[0]
    found = camera @ best.pixel_from_camera[:, :2].T + best.pixel_from_camera[:, 2]
    assert np.abs(found - true).max() < 1.5


def test_a_lattice_whose_marks_cover_a_tenth_of_the_scan_is_not_its_own_background() -> None:
    steps = 6.0 * (np.arange(33) - 16)
    lattice = [LayoutMark(f"{x}, {y}", (float(x), float(y)), (0.01, 0.01), DOT) for x in steps for y in steps]
    camera = np.array([mark.xy_mm for mark in lattice])
    true = camera @ np.array([[1.01, 0.02], [0.02, -1.01]]) / PITCH_MM + 265.0
    answers = replace(responses(true, np.full(len(true), 0.8)), marks=len(lattice))
    search = PlacementSearch(lattice, answers, (PITCH_MM, PITCH_MM), Bounds(0.04, 0.1, 1.5))
    best = search.find_placements("0", [0] * len(lattice))[0]
    assert best.supported == len(lattice)
    assert np.abs(best.places_px(camera) - true).max() < 1.5


def test_a_lattice_named_one_step_off_lacks_the_line_that_it_alone_has(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = 5.0 * (np.arange(9) - 4)
    marks = tuple(LayoutMark(f"{x}, {y}", (float(x), float(y)), (0.01, 0.01), DOT) for x in steps for y in steps)
    layout = FiducialLayout(marks, (50.0, 50.0))
    off, right = (
        Placement("0", np.array([[8.0, 0.0, 250.0 + shift], [0.0, -8.0, 250.0]]), 1.0, 80, 1, 1, (0.125, 0.125))
        for shift in (40.0, 0.0)
    )
    for placement, lacks in ((off, True), (right, False)):
        frame = Frame.from_placement(make_scan(np.zeros((500, 500))), layout, placement, FiducialOptions())
        is_shown = [place[0] < 415.0 for place in frame.predicted_px]
        monkeypatch.setattr(Frame, "fits", [object() if shown else None for shown in is_shown])
        frame = replace(frame, detections=tuple(replace(each, inside=True) for each in frame.detections))
        assert _lacks_its_own(frame, right if placement is off else off) == lacks


def test_without_marks_that_tell_the_sharpening_stays_as_it_is_known() -> None:
    known = Sharpening(0.8, 1.2, 0.01 * np.eye(2))
    scan = make_scan(np.zeros((400, 400))).replace_tone(Tone.unknown().sharpened(known))
    placement = Placement("0", np.array([[1.0, 0.0, 200.0], [0.0, -1.0, 200.0]]), 1.0, 6, 1, 1, (1.0, 1.0))
    frame = Frame.from_placement(scan, FiducialLayout(tuple(MARKS), (220.0, 220.0)), placement, FiducialOptions())
    assert fit_lines_and_sharpening(frame) is frame


def test_a_square_is_alike_in_all_poses_and_six_marks_do_not() -> None:
    first = ("0", [0] * 4)
    assert all(same_picture(MARKS[:4], first, (pose, [0] * 4), NEAR_MM) for pose in POSES)
    others = [pose for pose in POSES if not same_picture(MARKS, ("0", [0] * 6), (pose, [0] * 6), NEAR_MM)]
    assert set(others) == set(POSES) - {"0", "0m"}


def test_a_posed_placement_is_moved_by_what_the_coordinates_differ() -> None:
    """Marks opposite each other whose coordinates are not: shifted, turned and larger, as the names are changed."""
    camera_mm = np.array([(-109.0, 0.3), (109.4, 0.0), (0.0, 109.2), (0.2, -109.0)])
    placement = Placement("0", np.array([[16.0, 0.3, 2350.0], [0.3, -16.0, 2340.0]]), 1.0, 4, 1, 4, (0.0625, 0.0625))
    turned = placement.posed("180", camera_mm)
    opposite = [1, 0, 3, 2]
    before, after = placement.places_px(camera_mm), turned.places_px(camera_mm)[opposite]
    assert turned.names(before, camera_mm).tolist() == opposite
    plain = camera_mm[opposite] @ (-placement.pixel_from_camera[:, :2]).T + placement.pixel_from_camera[:, 2]
    assert np.hypot(*(plain - before).T).min() > 3.0
    # What no similarity takes up is left: the sides' lengths differ by 0.2 mm.
    assert np.hypot(*(after - before).T).max() < 2.5
    np.testing.assert_allclose((after - before).mean(axis=0), 0.0, atol=1e-9)


GIVEN = PitchHypothesis((0.05, 0.05), 0.04, (0.05, 0.05))
SCAN = make_scan(np.zeros((400, 400)))


class Stand:
    """What an attempt finds, in a frame's stead."""

    def __init__(self, name: str) -> None:
        self.name, self.is_complete, self.accepted, self.measured_count = name, False, False, 0
        self.is_sure, self.agrees, self.is_faint, self.scan = False, False, False, SCAN
        self.failed_fits: list[int] = []
        self.inliers, self.pixel_from_camera = np.ones(3, bool), np.eye(2, 3)

    def is_nearer_than(self, other: "Stand | None") -> bool:
        return other is None


def search_attempts(
    monkeypatch: pytest.MonkeyPatch, *expected: float | None, given: int = 1, at_given: int | None = None
) -> tuple[Found, list[int]]:
    """What a list of attempts comes to, each of two hypotheses and with so many frames that chance is expected to make
    a hypothesis, and how many hypotheses each was judged by. given: how many of them believe what they find; at_given:
    which of the others is under the given pitch."""
    checked: list[int] = []

    def stage(number: int) -> Stage:
        kind = "given" if number < given else "pitch" if number != at_given else "faint"
        return Stage(cast(Kind, kind), [GIVEN, GIVEN], FiducialOptions(), at_given=number == at_given)

    made = [stage(number) for number in range(len(expected))]

    def measure(scan: Scan, layout: FiducialLayout, stage: Stage, result: SearchResult, tried: int) -> Any:
        number = made.index(stage)
        each = expected[number]
        checked.append(tried)
        return [] if each is None else [(tried * each, cast(Frame, Stand(str(number))))]

    monkeypatch.setattr(stages, "list_stages", lambda *_: made)
    monkeypatch.setattr(stages, "search_stage", lambda *_: SearchResult())
    monkeypatch.setattr(stages, "measure_stage", measure)
    monkeypatch.setattr(stages, "doubt_frame", lambda *_: NO_REASON)
    monkeypatch.setattr(stages, "explain_misfit", lambda stand: Reason(f"not {stand.name}"))
    return find_frame(SCAN, ALIKE, None, FiducialOptions()), checked


def name(found: Found) -> str:
    return cast(Stand, found.frame).name if found.frame else ""


def test_each_attempt_is_tested_by_all_hypotheses_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be taken by itself may be chance after so many others; its pitch is worth to be given then."""
    found, checked = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 5)
    assert checked == [2, 4, 6]
    assert name(found) == ""
    assert [cast(Stand, frame).name for frame in found.unsure] == ["2"]
    assert found.misfit.startswith("not 0; under another pitch 3 of them fit")
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 7)
    assert (name(found), found.is_taken) == ("2", True)


def test_attempts_under_the_given_pitch_are_tested_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    found, checked = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 5, at_given=2)
    assert checked == [2, 4, 4]
    assert name(found) == "2"
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, FRAMES_BY_CHANCE / 3, at_given=2)
    assert (name(found), found.unsure) == ("", ())
    assert "3 faint marks fit, where 0.01 such false alarms are expected" in found.misfit
    assert "another pitch does not separate them; click the visible marks in `reseau review`" in found.misfit
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, 0.3, at_given=2)
    assert found.misfit == "not 0"  # chance makes more than one


def test_under_another_pitch_the_marks_together_decide_on_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """None of them is clear, and fewer than 0.001 such placements are expected by chance."""
    frame = cast(Any, Stand("faint"))
    frame.agrees, frame.accepted, frame.options, frame.inlier_fits = True, False, FiducialOptions(pose="0"), {}
    frame.placement = Placement("0", np.eye(2, 3), 1.0, 3, 1, 1, (0.05, 0.05))
    for function, value in (("measure_frame", frame), ("false_placements", 1e-4), ("false_frames", 0.5)):
        monkeypatch.setattr(stages, function, lambda *_, value=value: value)
    monkeypatch.setattr(stages, "shows_marks", lambda *_: True)
    stage = Stage("pitch", [GIVEN], FiducialOptions())
    ((expected, found),) = stages.measure_stage(SCAN, ALIKE, stage, SearchResult((frame.placement,)), 5)
    assert found is frame
    assert expected == pytest.approx(1e-3)  # two criteria, five hypotheses


def test_where_nothing_was_detected_the_reason_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    found, _ = search_attempts(monkeypatch, None, None)
    assert name(found) == ""
    assert found.misfit == "no two of the camera's marks were found in the scan"


def layout(sigma_mm: float) -> FiducialLayout:
    places = [(-106.0, -106.0), (106.0, 106.0), (-106.0, 106.0), (106.0, -106.0)]
    marks = [LayoutMark(str(k), place, (sigma_mm, sigma_mm), MarkShape(dot(0.1))) for k, place in enumerate(places)]
    return FiducialLayout(tuple(marks), (228.0, 228.0))


def frame(across_um: float, down_um: float) -> FrameMeasurement:
    """A frame turned by 90 degrees."""
    matrix = np.array([[0.0, 1000.0 / across_um, 5000.0], [1000.0 / down_um, 0.0, 5000.0]])
    marks = [measured_mark(mark.id, matrix @ (*mark.xy_mm, 1.0), 1.0) for mark in layout(1.0).marks]
    return FrameMeasurement("a", tuple(marks), None, matrix)


@pytest.mark.parametrize(
    ("pitch_um", "sigma_mm", "is_wrong"),
    [
        ((20.1, 19.9), 0.01, False),  # film may do that
        ((21.17, 20.0), 0.01, True),
        ((20.6, 20.6), 3.0, False),  # separations known to a few millimetres say little
        ((20.6, 20.6), 0.1, True),
    ],
)
def test_a_pitch_that_film_and_separations_do_not_allow_is_named(
    pitch_um: tuple[float, float], sigma_mm: float, is_wrong: bool
) -> None:
    problem = pitch_problem(frame(*pitch_um), layout(sigma_mm), (20.0, 20.0), "the project")
    assert (problem is not None) == is_wrong
    if problem is not None:
        assert "the project gives a pitch of 20.00 x 20.00 µm" in problem
        assert f"set pitch_um = [{pitch_um[0]:.2f}, {pitch_um[1]:.2f}]" in problem

"""The frame through its marks against closed forms and simulation; frames of three marks."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from drawn import ALIKE, Array, brute_picture, lay_out, make_scan, measured_mark, paint
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from adjust.functional_model.transformation import FILM_NAMES, HIGHEST_ORDER, film_parameter_names
from measure import FiducialOptions, Scan, Status
from measure.detection.correlation import GRAINY, WIDE, Surroundings
from measure.detection.responses import ByteCache, Responses
from measure.fiducials import consistency, measurement, stages
from measure.fiducials import measure_frame as steps
from measure.fiducials.across_frames import check_frames
from measure.fiducials.constellation import Bounds, Placement, PlacementSearch, same_picture
from measure.fiducials.interior_orientation import AFFINITY_SIGMA, FrameFit, film_terms, fit_frame
from measure.fiducials.measure_frame import Frame, detect_frame, detect_some, fit_lines_and_sharpening, measure_frame
from measure.fiducials.measurement import _lacks_its_own, pitch_problem, present_frame
from measure.fiducials.scan_orientation import DISTURBANCE_P, MarkSite, OrientedMark, decide_scan_orientation
from measure.fiducials.search import FrameSearch, PitchHypothesis, SearchResult
from measure.fiducials.stages import Kind, Stage, StageResult, doubt_frame, find_frame
from measure.flags import MAX_FALSE_FRAMES, NO_REASON, Code, Reason
from measure.geometry import POSES, UP_FROM_CAMERA
from measure.marks.shapes import Disk, FiducialLayout, LayoutMark, MarkShape, cross, dot, ring_cross
from measure.marks.templates import cut, learn_template
from measure.results import FrameMeasurement, MarkFit, ScanOrientation
from measure.tone.curve import Tone
from measure.tone.sharpening import Sharpening

SQUARE = np.array([(100.0, -100.0), (-100.0, -100.0), (-100.0, 100.0), (100.0, 100.0)])
EIGHT = np.array([*SQUARE, (100.0, 0.0), (-100.0, 0.0), (0.0, 100.0), (0.0, -100.0)])


def view_marks(camera: Array, turn: Array, scale: float = 1.01, angle: float = 0.02) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(camera @ (scale * np.array([[c, -s], [s, c]]) @ turn).T + (12.0, -34.0))


def predicted_mm(fit: FrameFit) -> Array:
    """Places of `EIGHT` in the scan by a fit."""
    straight = EIGHT @ fit.up_from_camera[:, :2].T + fit.up_from_camera[:, 2]
    return np.asarray(straight if fit.film is None else fit.film.places_mm(EIGHT))


@pytest.mark.parametrize("pose", POSES)
def test_a_similarity_is_found_without_residuals_in_every_pose(pose: str) -> None:
    turn = UP_FROM_CAMERA[pose]
    fit = fit_frame(EIGHT, view_marks(EIGHT, turn), np.full(8, 0.005), turn)
    np.testing.assert_allclose(predicted_mm(fit), view_marks(EIGHT, turn), atol=1e-9)
    assert fit.chi_square == pytest.approx(0.0, abs=1e-9)
    assert fit.redundancy == 12
    assert np.sign(np.linalg.det(fit.up_from_camera[:, :2])) == (-1 if pose.endswith("m") else 1)


def test_a_pose_mirrors_first_and_then_turns() -> None:
    np.testing.assert_allclose(UP_FROM_CAMERA["90m"] @ (1.0, 0.0), (0.0, -1.0))
    np.testing.assert_allclose(UP_FROM_CAMERA["90m"] @ (0.0, 1.0), (-1.0, 0.0))
    np.testing.assert_allclose(UP_FROM_CAMERA["90"] @ (1.0, 0.0), (0.0, 1.0))


def test_halving_a_marks_sigma_changes_its_share_of_the_residual() -> None:
    """Trap: a weight matrix that is the covariance instead of its inverse."""
    turn, disturbed = UP_FROM_CAMERA["0"], view_marks(EIGHT, UP_FROM_CAMERA["0"])
    disturbed[0] += (0.05, 0.0)
    sizes = []
    for sigma in (0.02, 0.01, 0.005):
        sigmas = np.full(8, 0.01)
        sigmas[0] = sigma
        sizes.append(np.hypot(*(disturbed - predicted_mm(fit_frame(EIGHT, disturbed, sigmas, turn)))[0]))
    assert sizes[0] > 1.1 * sizes[1] > 1.2 * sizes[2]


def outlying(camera: Array, up: Array) -> list[int]:
    marks = consistency.FrameMarks.from_places(camera, up, np.tile(1e-6 * np.eye(2), (len(camera), 1, 1)))
    return np.flatnonzero(consistency.gross_errors(marks, consistency.Scatter(0.005, 4.0), 0.3)).tolist()


GRID = np.array([(10.0 * i, 10.0 * j) for i in range(-2, 3) for j in range(-2, 3)])
LARGE = np.array([(5.0 * i, 5.0 * j) for i in range(-4, 5) for j in range(-4, 5)])


@pytest.mark.parametrize(
    ("camera", "off_mm"),
    [
        (EIGHT, {}),
        (EIGHT, {2: (0.9, -0.4), 5: (0.0, 0.6)}),
        (GRID, {7: (0.1, 0.0)}),  # well inside of the gate, far outside of the others' scatter
        (GRID[:20], {3: (0.28, 0.0), 16: (-0.25, 0.05)}),  # neither hides the other
        (LARGE, {k: (0.08 * (-1) ** k, 0.1) for k in range(5, 75, 10)}),  # of many marks some are removed at once
    ],
)
def test_gross_errors_are_found_and_no_others(camera: Array, off_mm: dict[int, tuple[float, float]]) -> None:
    up = view_marks(camera, UP_FROM_CAMERA["180"]) + np.random.default_rng(4).normal(0, 0.005, camera.shape)
    for mark, by in off_mm.items():
        up[mark] += by
    assert outlying(camera, up) == list(off_mm)


@pytest.mark.parametrize("model", ["affine", "projective"])
def test_many_marks_are_tested_as_by_a_matrix_of_all_of_them(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, results = np.random.default_rng(5), []
    grid = np.array([(10.0 * i, 10.0 * j) for i in range(11) for j in range(11)])
    covariances = rng.uniform(1e-6, 4e-5, (121, 1, 1)) * np.array([[1.0, 0.4], [0.4, 0.7]])
    up = view_marks(grid, UP_FROM_CAMERA["90"]) + rng.normal(0.0, 0.006, grid.shape)
    up[7] += 0.05
    for dense in (100, 1000):
        monkeypatch.setattr(consistency, "_DENSE", dense)
        marks = consistency.FrameMarks.from_places(grid, up, covariances, model)
        found, among = consistency.frame_consistency(marks), np.arange(121) < 9
        assert found.wrong_mark == 7
        results.append(
            [
                *(marks.chi_square(0.004), marks.log_density(0.004), 1e6 * marks.film_variance_mm2()),
                *(
                    1e6 * marks.added_variance_mm2(among, 0.005, consistency.LONE_AFFINITY),
                    np.log(consistency.frame_p_value(marks)),
                ),
                *(found.log_odds.max(), 1e3 * found.off_mm[7, 0], 1e-6 * marks.precision(0.004)[3, 8]),
            ]
        )
    np.testing.assert_allclose(results[0], results[1], rtol=1e-6)


@pytest.mark.parametrize("order", range(1, HIGHEST_ORDER + 1))
@pytest.mark.parametrize("name", FILM_NAMES)
def test_every_film_model_of_the_adjustment_has_its_terms(name: str, order: int) -> None:
    """As many as the adjustment has parameters beyond those of an affine transformation, or of a similarity."""
    model = name.replace("(n)", f"({order})")
    beyond = len(film_parameter_names(model)) - (4 if "conformal" in name else 6)
    assert film_terms(model, EIGHT).shape == (16, max(beyond, 0))
    assert np.linalg.matrix_rank(film_terms(model, EIGHT / 100.0)[:, :4]) == min(max(beyond, 0), 4)
    assert FiducialOptions(film_model=model).film_model == model


@pytest.mark.parametrize("model", ["helmert", "polynomial", "conformal(x)", "projective2"])
def test_a_film_model_that_is_not_known_is_refused(model: str) -> None:
    with pytest.raises(ValueError, match="one of none, congruent, similarity, affine, projective"):
        FiducialOptions(film_model=model)


@pytest.mark.parametrize("pose", POSES)
def test_a_perspective_is_fitted_without_residuals(pose: str) -> None:
    """By the closed form of a pinhole 600 mm away, tilted by 5 degrees, in every scan orientation."""
    turn, tilt = UP_FROM_CAMERA[pose], np.deg2rad(5.0)
    x, y = EIGHT.T
    pictured = np.column_stack([x * np.cos(tilt), y]) / (1 + x * np.sin(tilt) / 600.0)[:, None]
    up = view_marks(pictured, turn)
    fit = fit_frame(EIGHT, up, np.full(8, 0.005), turn, "projective")
    assert np.abs(up - predicted_mm(fit)).max() < 0.002  # what is believed of tilts beforehand takes the rest
    assert fit.film is not None
    step = 1e-3
    around = np.array([(50.0 + step, 30.0), (50.0 - step, 30.0)])
    x, y = around.T
    moved = view_marks(np.column_stack([x * np.cos(tilt), y]) / (1 + x * np.sin(tilt) / 600.0)[:, None], turn)
    np.testing.assert_allclose(fit.film.places_mm(around), moved, atol=5e-4)
    placement = Placement(pose, np.eye(2, 3), 1.0, 8, 1, 1, (0.05, 0.05), film=fit.film)
    linear = np.diag([0.05, -0.05]) @ placement.linear(np.array([50.0, 30.0]))
    np.testing.assert_allclose(linear[:, 0], (moved[0] - moved[1]) / (2 * step), atol=1e-4)
    marks = consistency.FrameMarks.from_places(EIGHT, up, np.tile(1e-6 * np.eye(2), (8, 1, 1)), "projective")
    assert not consistency.gross_errors(marks, consistency.Scatter(0.005, 4.0), 0.3).any()
    assert np.sqrt(marks.film_variance_mm2()) < 1e-4


@pytest.mark.parametrize("stretch", [0.0008, 0.003])
def test_the_affinity_is_estimated_with_the_standard_deviation_that_film_has(stretch: float) -> None:
    """Bayes for one number: marks that tell the stretch to s give it the share S² / (S² + s²), S being the film's. On
    the square x² sums to y², so that stretch and scale are not correlated, and its s is sigma / sqrt(sum r²)."""
    camera, sigma = 0.01 * SQUARE, 0.006  # as small as leaves the affinity open
    up = camera * (1 + stretch, 1 - stretch)
    fit = fit_frame(camera, up, np.full(4, sigma), np.eye(2))
    result = sigma / np.sqrt((camera**2).sum())
    expected = stretch * AFFINITY_SIGMA**2 / (AFFINITY_SIGMA**2 + result**2)
    found = (fit.up_from_camera[0, 0] - fit.up_from_camera[1, 1]) / 2
    assert 0.2 * stretch < expected < 0.95 * stretch  # or nothing would be tested
    assert found == pytest.approx(expected, rel=1e-6)


THREE = {"1": (26.0, -26.0), "2": (-26.0, -25.0), "3": (-25.5, 26.0)}
MM, SIGMA_PX = 0.04, 0.05
SCANNER = np.array([[1.002, 0.001], [0.0, 0.999]])


def make_layout(places: dict[str, tuple[float, float]], sigma_mm: float = 0.02) -> FiducialLayout:
    shape = MarkShape(cross(1.0, 0.1))
    marks = [LayoutMark(name, place, (sigma_mm, sigma_mm), shape) for name, place in places.items()]
    return FiducialLayout(tuple(marks), (56.0, 56.0))


def make_frame(
    rng: np.random.Generator,
    name: str = "a",
    off_mm: dict[str, tuple[float, float]] | None = None,
    pitch_mm: tuple[float, float] = (MM, MM),
    mirror: bool = False,
    film: float = 2e-4,
) -> FrameMeasurement:
    """A frame turned by up to a degree, under an affinity of film by its standard deviation, its marks off_mm beside
    their places."""
    turn = rng.uniform(-0.02, 0.02)
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    stretched = SCANNER @ turned @ (np.eye(2) + rng.normal(0.0, film, (2, 2))) @ np.diag([-1.0 if mirror else 1.0, 1.0])
    linear = np.diag([1 / pitch_mm[0], -1 / pitch_mm[1]]) @ stretched
    marks = []
    for point, place in THREE.items():
        center = linear @ (np.array(place) + (off_mm or {}).get(point, (0.0, 0.0))) + 700.0
        marks.append(measured_mark(point, center + rng.normal(0.0, SIGMA_PX, 2), SIGMA_PX))
    return FrameMeasurement(name, tuple(marks), None, np.column_stack([linear, [700.0, 700.0]]))


@pytest.mark.parametrize("mirror", [False, True])
def test_a_triangle_that_a_mark_or_a_pitch_explains_is_a_problem_of_its_frame(mirror: bool) -> None:
    """Half a millimetre of 52: in one of six frames alone along a side, as film may be stretched or a mark be off. Each
    mark may be that, and counts as known to what the triangle does not fit by."""
    rng = np.random.default_rng(2)
    frames = [make_frame(rng, str(k), {"1": (0.5, 0.0)} if k == 4 else None, mirror=mirror) for k in range(6)]
    checked = check_frames(frames, make_layout(THREE, 1.0), [(1000 * MM, 1000 * MM)] * 6).frames
    assert all(mark.status is Status.MEASURED for frame in checked for mark in frame.marks)
    (problem,) = checked[4].problems
    assert "its three marks 1, 2, 3 do not have the shape" in problem
    assert "One of the marks is off, or the pitch is wrong." in problem
    known = checked[4].marks[0].covariance_px2
    assert known is not None
    assert 0.2 < MM * np.sqrt(known[0, 0]) < 1.0


def test_a_triangle_that_a_wrong_pitch_alone_explains_says_so() -> None:
    """Pixels longer by 8 % one way: a mark alone would have to lie 4 mm off. Its place is as certain as before."""
    frame = make_frame(np.random.default_rng(3), pitch_mm=(1.04 * MM, 0.96 * MM))
    (checked,) = check_frames([frame], make_layout(THREE), [(1000 * MM, 1000 * MM)]).frames
    (problem,) = checked.problems
    assert "A wrong pitch, or film that is stretched more, explains it best" in problem
    for mark in checked.marks:
        assert mark.status is Status.MEASURED
        assert mark.covariance_px2 is not None
        assert np.sqrt(mark.covariance_px2[0, 0]) == pytest.approx(SIGMA_PX)


def test_a_triangle_that_other_frames_have_otherwise_is_a_problem_of_its_frame() -> None:
    """0.3 mm of 52: no more than a scanner may do, but not in one of six frames alone. Film bent by as much is a
    hypothesis too: no mark is named, and the one that is off is known no better than it is."""
    rng = np.random.default_rng(4)
    frames = [make_frame(rng, str(k), {"2": (0.2, 0.22)} if k == 4 else None) for k in range(6)]
    layout, pitches = make_layout(THREE, 1.0), [(1000 * MM, 1000 * MM)] * 6
    assert not check_frames(frames[4:5], layout, pitches[:1]).frames[0].problems
    checked = check_frames(frames, layout, pitches).frames
    assert [len(frame.problems) for frame in checked] == [0, 0, 0, 0, 1, 0]
    known = checked[4].marks[1].covariance_px2
    assert known is not None
    assert MM * np.sqrt(known[0, 0]) == pytest.approx(0.297 / np.sqrt(2), rel=0.2)


PX_PER_MM = 20.0
CONTRAST_DN = 8000.0
CORNERS = ((7.0, -7.0), (-7.0, -7.0), (-7.0, 7.0), (7.0, 7.0))
DOT = MarkShape(dot(0.2), "light")
DOTS = lay_out([DOT] * 4, CORNERS, (16.0, 16.0))
OPTIONS = FiducialOptions()


def placement(pose: str) -> Placement:
    linear = np.diag([PX_PER_MM, -PX_PER_MM]) @ UP_FROM_CAMERA[pose]
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


def make_frame_chance(scan: Scan, layout: FiducialLayout) -> Frame:
    return measure_frame(scan, layout, placement("0"), OPTIONS)


def test_marks_by_which_a_placement_was_tried_are_not_detected_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scan, sought = make_scan(picture(DOTS, "0", hidden=0)), list[list[int]]()
    begun = detect_some(scan, DOTS, placement("0"), OPTIONS, range(4))
    assert begun is not None
    assert [each.inside for each in begun.detections] == [True, True, False, False]  # up to the first clear one

    def record(frame: Frame, indices: Sequence[int], _: float) -> Frame:
        sought.append(list(indices))
        return frame

    monkeypatch.setattr(steps, "_detect", record)
    monkeypatch.setattr(steps, "detect_missing_marks", lambda each: each)
    frame = detect_frame(scan, DOTS, placement("0"), OPTIONS, begun)
    assert sought == [[2, 3]]
    assert np.hypot(*(frame.inlier_fits[1].center_px - centers_px(DOTS, "0")[1])) < 0.2
    plain = make_scan(noisy(np.full((380, 380), 20000.0)))
    assert detect_some(plain, DOTS, placement("0"), OPTIONS, range(4)) is None


def test_three_plain_dots_of_four_are_no_chance() -> None:
    scan = make_scan(picture(DOTS, "0", hidden=1))
    frame = make_frame_chance(scan, DOTS)
    assert frame.inliers.tolist() == [True, False, True, True]
    assert doubt_frame(SearchResult(), frame) == ""


def test_a_lattice_named_by_a_step_or_two_farther_on_is_not_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lower six of nine dots are there. As the upper six they fit as well, as the left six only four of them do."""
    lattice = lay_out([DOT] * 9, [(x, y) for y in (-7.0, 0.0, 7.0) for x in (-7.0, 0.0, 7.0)], (16.0, 16.0))
    shown = FiducialLayout(lattice.marks[:6], lattice.frame_mm)
    frame = make_frame_chance(make_scan(picture(shown, "0")), lattice)
    assert frame.inliers.tolist() == [True] * 6 + [False] * 3
    whole = cast(Any, SimpleNamespace(is_exhaustive=lambda _: True))
    monkeypatch.setattr(measurement, "false_placements", lambda *_: 0.0)
    monkeypatch.setattr(measurement, "measure_frame", lambda *_: pytest.fail("it is measured again"))

    def moved(x: float, y: float) -> Placement:
        matrix = placement("0").pixel_from_camera.copy()
        matrix[:, 2] += matrix[:, :2] @ (x, y)
        return replace(placement("0"), pixel_from_camera=matrix)

    assert measurement._is_another_frame(whole, moved(0.0, -7.0), frame)
    assert not measurement._is_another_frame(whole, moved(-7.0, 0.0), frame)


def test_a_placement_from_which_the_same_marks_are_found_is_no_rival() -> None:
    """1.8 % larger about one mark: the opposite one lies beyond its first search, as a coarse search leaves it."""
    best = replace(placement("0"), supported=4)
    frame = measure_frame(make_scan(picture(DOTS, "0")), DOTS, best, OPTIONS)
    matrix, at = best.pixel_from_camera, best.places_px(frame.camera_mm[:1])[0]
    larger = np.column_stack([1.018 * matrix[:, :2], 1.018 * (matrix[:, 2] - at) + at])
    rival = replace(best, pixel_from_camera=larger)
    off_px = np.hypot(*(rival.places_px(frame.camera_mm) - best.places_px(frame.camera_mm)).T)
    assert off_px.max() > frame.first_search_px
    assert not best.same_place(rival)
    assert not measurement._rivals(cast(Any, SimpleNamespace(placements=(best, rival))), frame)


@pytest.mark.parametrize(("moved_px", "times"), [(0.0, 1), (0.2, 1), (1.0, 2)])
def test_faint_marks_are_sought_again_only_where_predictions_moved(
    moved_px: float, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, rounds = make_frame_chance(make_scan(picture(DOTS, "0")), DOTS), list[Frame]()

    def move(each: Frame, _: float) -> Frame:
        rounds.append(each)
        return replace(each, pixel_from_camera=each.pixel_from_camera + np.array([0.0, 0.0, moved_px]))

    monkeypatch.setattr(Frame, "is_certain_of_places", True)
    monkeypatch.setattr(steps, "detect_faint_marks", move)
    monkeypatch.setattr(steps, "orient_frame", lambda each: each)
    steps.detect_missing_marks(frame)
    assert len(rounds) == times


@pytest.mark.parametrize("surroundings", [WIDE, GRAINY])
def test_faint_marks_of_an_uncertain_frame_are_sought_nearer(
    surroundings: Surroundings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In texture: what lies within 6 px, 0.3 mm of film, would become marks; 2.5 px do where marks are not certain."""
    reached = list[float]()
    frame = make_frame_chance(make_scan(picture(DOTS, "0")), DOTS)
    frame = replace(frame, placement=replace(frame.placement, surroundings=surroundings))

    def record(each: Frame, reach_px: float) -> Frame:
        reached.append(reach_px)
        return each

    monkeypatch.setattr(steps, "MANY", 3)
    monkeypatch.setattr(Frame, "is_certain_of_places", False)
    monkeypatch.setattr(steps, "detect_faint_marks", record)
    steps.detect_missing_marks(frame)
    assert reached == [frame.gate_px if surroundings is WIDE else pytest.approx(2.5, abs=0.1)]


def test_a_frame_moved_on_by_the_distance_of_two_marks_is_known_by_its_marks() -> None:
    """It has the left and the middle ones under the names of the middle and the right ones; the rest is outside."""
    layout = lay_out([DOT] * 8, (*CORNERS, (0.0, -7.0), (-7.0, 0.0), (0.0, 7.0), (7.0, 0.0)), (16.0, 16.0))
    scan = make_scan(picture(layout, "0", hidden=7))
    frame = make_frame_chance(scan, layout)
    moved_on = placement("0").pixel_from_camera - np.array([[0.0, 0.0, 7.0 * PX_PER_MM], [0.0, 0.0, 0.0]])
    other = measure_frame(scan, layout, replace(placement("0"), pixel_from_camera=moved_on), OPTIONS)
    assert (int(frame.inliers.sum()), int(other.inliers.sum())) == (7, 4)
    assert frame.contains(other)
    assert not other.contains(frame)
    assert not frame.contains(frame)


def test_a_negative_whose_pitch_is_wrong_is_searched_for_where_it_fills_the_scan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listed = list[Stage]()

    def record(_scan: Scan, _layout: FiducialLayout, tried: Sequence[Stage], _options: FiducialOptions) -> StageResult:
        listed[:] = tried
        return StageResult()

    monkeypatch.setattr(stages, "_find_in_stages", record)
    for pitch_mm in (1 / PX_PER_MM, 4 / PX_PER_MM):
        stages.find_in_negative(make_scan(picture(DOTS, "0")), DOTS, (1000 * pitch_mm,) * 2, OPTIONS)
        ratios = [each.mm[0] * PX_PER_MM for stage in listed for each in stage.hypotheses]
        assert any(abs(ratio - 1) < 0.1 for ratio in ratios)


def test_specks_that_lie_as_three_marks_of_four_are_doubted_with_numbers() -> None:
    as_marks = np.rint(centers_px(DOTS, "0")).astype(int)
    elsewhere = np.random.default_rng(1).integers(10, 360, (300, 2))
    free = np.hypot(*(elsewhere[:, None] - as_marks).T).min(axis=0) > 22
    scan = make_scan(strewn(np.concatenate([elsewhere[free], as_marks[1:]])))
    frame = make_frame_chance(scan, DOTS)
    assert frame.inliers.tolist() == [False, True, True, True]
    sentence = doubt_frame(SearchResult(), frame)
    assert "only 3 of 4 marks were found, and 1 of 64 random places match as well (p = 0.06)" in sentence
    assert Code.NO_FRAME in sentence.codes


def test_marks_that_a_sharpened_scan_shows_far_wider_than_drawn_stand_out_from_random_places() -> None:
    """Lines of 8 px, drawn as 1 px, cut off by an unsharp mask, on texture: a sharp template finds but their edges."""
    drawn, shown = (lay_out([MarkShape(ring_cross(0.5, line, 0.8, line))] * 4, CORNERS) for line in (0.05, 0.4))
    grey, (row, col) = picture(shown, "0", hidden=0), np.indices((380, 380))
    away = np.min([np.hypot(col - x, row - y) for x, y in centers_px(drawn, "0")], axis=0) > 24
    grey[away] += np.random.default_rng(5).normal(0.0, 6000.0, grey.shape)[away]
    sharpened = np.clip(grey + 2.0 * (grey - gaussian_filter(grey, 2.5)), 18000.0, 24000.0)
    frame = make_frame_chance(make_scan(sharpened), drawn)
    assert frame.inliers.tolist() == [False, True, True, True]
    assert not doubt_frame(SearchResult(), frame)


def test_random_places_lie_beyond_the_response_of_large_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disks of 18 px, sought within fewer of their places: at 2.5 times that their own edges would match."""
    disks = lay_out([MarkShape(dot(0.9), "light")] * 4, CORNERS, (16.0, 16.0))
    frame, places = make_frame_chance(make_scan(picture(disks, "0")), disks), list[Array]()

    def record(_frame: Frame, _index: int, place_px: Array, radius_px: float, _blur_px: float) -> Any:
        if radius_px != steps.FITTED_PX:
            places.append(place_px)
        return SimpleNamespace(height=0.0, false_alarms=1.0)

    monkeypatch.setattr(Frame, "peak", record)
    steps.random_matches(frame, range(4))
    apart_px = np.hypot(*(np.array(places)[:, None] - centers_px(disks, "0")).T)
    assert apart_px.min() > frame.first_search_px + 0.95 * 0.9 * PX_PER_MM


@pytest.mark.parametrize("uneven_mm", [0.6, 0.0])
def test_a_frame_is_measured_in_the_orientations_that_score_as_well(
    uneven_mm: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One mark of four lies 0.6 mm farther out: in the wrong orientation two are sought where they are not. Of a
    symmetric frame no other orientation is measured."""
    places = ((7.0 + uneven_mm, -7.0), *CORNERS[1:])
    layout = lay_out([DOT] * 4, places, (16.0, 16.0))
    scan, placements = make_scan(picture(layout, "180")), (placement("0"), placement("180"))
    search = cast(Any, {placements[0].pitch_mm: SimpleNamespace(same_mm=0.04)})
    result = SearchResult(placements, search)
    found = StageResult(result, measure_frame(scan, layout, placements[0], OPTIONS))
    if not uneven_mm:
        monkeypatch.setattr(Frame, "is_sure", False)
        monkeypatch.setattr(stages, "measure_frame", lambda *_: pytest.fail("it is measured again"))
    taken = stages._try_other_orientations(scan, layout, OPTIONS, found)
    assert taken.is_taken == bool(uneven_mm)
    assert taken.frame is not None
    places_px = {index: fit.center_px for index, fit in taken.frame.inlier_fits.items()}
    truth = centers_px(layout, "180" if uneven_mm else "0")
    assert sorted(places_px) == [0, 1, 2, 3]
    assert all(np.hypot(*(place - truth[index])) < 0.2 for index, place in places_px.items())


def test_a_frame_that_chance_is_likelier_to_have_made_than_not_gives_no_observation() -> None:
    """Two marks of four: a similarity goes through any two."""
    grey = picture(DOTS, "0", hidden=1)
    at = np.rint(centers_px(DOTS, "0")[2]).astype(int)
    grey[at[1] - 24 : at[1] + 25, at[0] - 24 : at[0] + 25] = 20000.0
    scan = make_scan(grey)
    frame = make_frame_chance(scan, DOTS)
    chance = doubt_frame(SearchResult(), frame)
    assert "(p = 1.00): the frame may lie elsewhere" in chance
    result = present_frame(frame, ScanOrientation("0", False), (50.0, 50.0), (), chance)
    assert [mark.status for mark in result.marks] == [Status.PREDICTED] * 4
    assert all(mark.reason == chance and mark.covariance is None for mark in result.marks)
    for mark, place in zip(result.marks, centers_px(DOTS, "0"), strict=True):
        assert mark.center_px == pytest.approx(place, abs=5.0)
    assert result.pixel_from_camera is None


def test_a_frame_whose_names_are_ambiguous_gives_no_observation() -> None:
    """Any of its marks may be another's; their places are kept for the review."""
    frame = make_frame_chance(make_scan(picture(DOTS, "0")), DOTS)
    shifted = Reason("the constellation fits nearly as well shifted", Code.AMBIGUOUS)
    for problems, status in (((), Status.MEASURED), ((shifted,), Status.REJECTED)):
        result = present_frame(frame, ScanOrientation("0", False), (50.0, 50.0), problems, NO_REASON)
        assert [mark.status for mark in result.marks] == [status] * 4
        for mark, place in zip(result.marks, centers_px(DOTS, "0"), strict=True):
            assert mark.center_px == pytest.approx(place, abs=0.1)
    assert {mark.reason for mark in result.marks} == {shifted}
    (checked,) = check_frames([result], DOTS, [(50.0, 50.0)]).frames
    assert {mark.status for mark in checked.marks} == {Status.REJECTED}


def test_one_mark_and_the_places_of_the_others_tell_the_pose() -> None:
    """Marks that differ by their identification dots are not found under one another's names."""
    ids = [tuple(Disk((0.9, 0.4 * k - 0.4), 0.12) for k in range(count)) for count in range(4)]
    layout = lay_out([MarkShape((*dot(0.2), *dots), "light") for dots in ids], CORNERS, (16.0, 16.0))
    scan = make_scan(picture(layout, "90"))
    frame = replace(make_frame_chance(scan, layout), inliers=np.array([True, False, False, False]))
    pose = decide_scan_orientation(frame)
    assert (pose.name, pose.decided) == ("90", True)


@pytest.mark.parametrize(("chips", "agreeing", "decided"), [(True, 4, True), (True, 3, False), (False, 3, True)])
def test_one_scan_decides_its_pose(chips: bool, agreeing: int, decided: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Among eight poses four marks agree on one by chance in one of 512 frames; three of them, whichever they are, in
    one of 18. What is drawn, or was averaged over scans, has no landscape that could agree."""
    scan = make_scan(picture(DOTS, "0"))
    frame = make_frame_chance(scan, DOTS)
    with_chips = [
        replace(mark, mark=learn_template([cut(scan, centred(mark.xy_mm), 2.0)], 2.0)) if chips else mark
        for mark in DOTS.marks
    ]
    sites = iter(range(4))

    def best(_: MarkSite, shown: Sequence[OrientedMark]) -> Array:
        likelihoods = np.full(len(shown), np.log(DISTURBANCE_P))
        likelihoods[1 if next(sites) < agreeing else 2] = 0.0
        return likelihoods

    monkeypatch.setattr(MarkSite, "likelihoods", best)
    pose = decide_scan_orientation(replace(frame, layout=replace(DOTS, marks=tuple(with_chips))))
    assert pose.decided is decided, pose.evidence
    assert pose.name == POSES[1]


def centred(xy_mm: tuple[float, float]) -> Array:
    matrix = placement("0").pixel_from_camera
    return np.column_stack([matrix[:, :2], matrix @ (*xy_mm, 1.0)])


SMALL_DOT = MarkShape(dot(0.3), "light")
PLACES = ((100.0, -100.0), (-100.0, -100.0), (-100.0, 100.0), (100.0, 100.0), (0.0, -103.0), (0.0, 95.0))
MARKS = [LayoutMark(str(index), place, (0.01, 0.01), SMALL_DOT) for index, place in enumerate(PLACES)]
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


def view_found(pose: str, scale: float = 1.015, angle: float = 0.03) -> NDArray[np.float64]:
    c, s = np.cos(angle), np.sin(angle)
    up = np.array(PLACES) @ (scale * np.array([[c, -s], [s, c]]) @ UP_FROM_CAMERA[pose]).T
    return np.asarray(up * (1, -1) / PITCH_MM + (265.0, 255.0))


def predicted(placement: Placement) -> NDArray[np.float64]:
    return np.asarray(np.array(PLACES) @ placement.pixel_from_camera[:, :2].T + placement.pixel_from_camera[:, 2])


def test_the_place_is_found_among_brighter_false_answers() -> None:
    """Text, dials and trees answer more strongly than the marks; only the marks answer together."""
    rng = np.random.default_rng(3)
    for pose in POSES:
        true = view_found(pose)
        false = rng.uniform(20, 500, (40, 2))
        places = np.concatenate([true, false])
        heights = np.concatenate([np.full(6, 0.6), rng.uniform(0.5, 0.9, 40)])
        found = placements(pose, responses(places, heights))
        assert np.abs(predicted(found[0]) - true).max() < 1.5
        assert found[0].supported == 6


def test_a_lattice_whose_marks_cover_a_tenth_of_the_scan_is_not_its_own_background() -> None:
    steps = 6.0 * (np.arange(33) - 16)
    lattice = [LayoutMark(f"{x}, {y}", (float(x), float(y)), (0.01, 0.01), SMALL_DOT) for x in steps for y in steps]
    camera = np.array([mark.xy_mm for mark in lattice])
    true = camera @ np.array([[1.01, 0.02], [0.02, -1.01]]) / PITCH_MM + 265.0
    answers = replace(responses(true, np.full(len(true), 0.8)), marks=len(lattice))
    search = PlacementSearch(lattice, answers, (PITCH_MM, PITCH_MM), Bounds(0.04, 0.1, 1.5))
    best = search.find_placements("0", [0] * len(lattice))[0]
    assert best.supported == len(lattice)
    assert np.abs(best.places_px(camera) - true).max() < 1.5


def test_both_names_of_a_lattice_are_found_of_which_one_column_lies_outside() -> None:
    """Four columns of five; the pairs that score best all have the same names."""
    steps = 60.0 * (np.arange(5) - 2)
    lattice = [LayoutMark(f"{x}, {y}", (float(x), float(y)), (0.01, 0.01), SMALL_DOT) for x in steps for y in steps]
    true = np.array([mark.xy_mm for mark in lattice]) @ np.diag([1.0, -1.0]) / PITCH_MM + (210.4, 260.0)
    rng = np.random.default_rng(1)
    answers = replace(responses(true[5:], rng.uniform(0.5, 0.9, 20)), marks=len(lattice))
    search = PlacementSearch(lattice, answers, (PITCH_MM, PITCH_MM), Bounds(0.04, 0.1, 1.5))
    best = [each for each in search.find_placements("0", [0] * len(lattice)) if each.supported == 20]
    assert sorted(round(float(each.pixel_from_camera[0, 2])) for each in best) == [210, 330]


def test_a_lattice_named_one_step_off_lacks_the_line_that_it_alone_has(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = 5.0 * (np.arange(9) - 4)
    marks = tuple(LayoutMark(f"{x}, {y}", (float(x), float(y)), (0.01, 0.01), SMALL_DOT) for x in steps for y in steps)
    layout = FiducialLayout(marks, (50.0, 50.0))
    off, right = (
        Placement("0", np.array([[8.0, 0.0, 250.0 + shift], [0.0, -8.0, 250.0]]), 1.0, 80, 1, 1, (0.125, 0.125))
        for shift in (40.0, 0.0)
    )
    for placement, lacks in ((off, True), (right, False)):
        frame = Frame.from_placement(make_scan(np.zeros((500, 500))), layout, placement, FiducialOptions())
        is_shown = [place[0] < 415.0 for place in frame.predicted_px]
        monkeypatch.setattr(Frame, "inlier_fits", dict.fromkeys(np.flatnonzero(is_shown).tolist(), object()))
        frame = replace(frame, detections=tuple(replace(each, inside=True) for each in frame.detections))
        assert _lacks_its_own(frame, right if placement is off else off) == lacks


def test_without_marks_that_tell_the_sharpening_stays_as_it_is_known() -> None:
    known = Sharpening(0.8, 1.2, 0.01 * np.eye(2))
    scan = make_scan(np.zeros((400, 400))).replace_tone(Tone.unknown().replace_sharpening(known))
    placement = Placement("0", np.array([[1.0, 0.0, 200.0], [0.0, -1.0, 200.0]]), 1.0, 6, 1, 1, (1.0, 1.0))
    frame = Frame.from_placement(scan, FiducialLayout(tuple(MARKS), (220.0, 220.0)), placement, FiducialOptions())
    assert fit_lines_and_sharpening(frame) is frame


@pytest.mark.parametrize(("sigma", "times"), [(0.1, 0), (2.0, 1)])
def test_a_sharpening_that_is_determined_is_not_estimated_again(
    sigma: float, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    known, estimated = Sharpening(0.8, 1.2, sigma**2 * np.eye(2)), list[Frame]()
    scan = make_scan(np.zeros((400, 400))).replace_tone(Tone.unknown().replace_sharpening(known))
    placement = Placement("0", np.array([[1.0, 0.0, 200.0], [0.0, -1.0, 200.0]]), 1.0, 6, 1, 1, (1.0, 1.0))
    layout, options = FiducialLayout(tuple(MARKS), (220.0, 220.0)), FiducialOptions()
    frame, steps = Frame.from_placement(scan, layout, placement, options), "measure.fiducials.measure_frame"

    def estimate(each: Frame) -> Frame:
        estimated.append(each)
        return each

    monkeypatch.setattr(f"{steps}.detect_frame", lambda *_: frame)
    monkeypatch.setattr(f"{steps}.fit_lines_and_sharpening", estimate)
    monkeypatch.setattr(f"{steps}.refit_frame", lambda each: each)
    assert measure_frame(scan, layout, placement, options) is frame
    assert len(estimated) == times


def test_a_square_is_alike_in_all_poses_and_six_marks_do_not() -> None:
    first = ("0", [0] * 4)
    assert all(same_picture(MARKS[:4], first, (pose, [0] * 4), NEAR_MM) for pose in POSES)
    others = [pose for pose in POSES if not same_picture(MARKS, ("0", [0] * 6), (pose, [0] * 6), NEAR_MM)]
    assert set(others) == set(POSES) - {"0", "0m"}


def test_a_posed_placement_is_moved_by_what_the_coordinates_differ() -> None:
    """Marks opposite each other whose coordinates are not: shifted, turned and larger, as the names are changed."""
    camera_mm = np.array([(-109.0, 0.3), (109.4, 0.0), (0.0, 109.2), (0.2, -109.0)])
    placement = Placement("0", np.array([[16.0, 0.3, 2350.0], [0.3, -16.0, 2340.0]]), 1.0, 4, 1, 4, (0.0625, 0.0625))
    turned = placement.reorient("180", camera_mm)
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
        self.name, self.accepted = name, False
        self.is_sure, self.agrees, self.is_faint, self.scan = False, False, False, SCAN
        self.failed_fits: list[int] = []
        self.unblemished: list[int] = []
        self.inlier_fits: dict[int, MarkFit] = {}
        self.clear_fits = self.inlier_fits
        self.inliers, self.pixel_from_camera = np.ones(3, bool), np.eye(2, 3)


def search_attempts(
    monkeypatch: pytest.MonkeyPatch, *expected: float | None, given: int = 1, at_given: int | None = None
) -> tuple[StageResult, list[int]]:
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
    monkeypatch.setattr(FrameSearch, "search_scan", lambda *_: SearchResult())
    monkeypatch.setattr(stages, "measure_stage", measure)
    monkeypatch.setattr(stages, "doubt_frame", lambda *_: NO_REASON)
    monkeypatch.setattr(stages, "explain_misfit", lambda stand: Reason(f"not {stand.name}"))
    return find_frame(SCAN, ALIKE, None, FiducialOptions()), checked


def name(found: StageResult) -> str:
    return cast(Stand, found.frame).name if found.frame else ""


def test_each_attempt_is_tested_by_all_hypotheses_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be taken by itself may be chance after so many others; its pitch is worth to be given then."""
    found, checked = search_attempts(monkeypatch, np.inf, 1.0, MAX_FALSE_FRAMES / 5)
    assert checked == [2, 4, 6]
    assert name(found) == ""
    assert found.misfit.startswith("not 0; under another pitch 3 of them fit")
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, MAX_FALSE_FRAMES / 7)
    assert (name(found), found.is_taken) == ("2", True)


def test_attempts_under_the_given_pitch_are_tested_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    found, checked = search_attempts(monkeypatch, np.inf, 1.0, MAX_FALSE_FRAMES / 5, at_given=2)
    assert checked == [2, 4, 4]
    assert name(found) == "2"
    found, _ = search_attempts(monkeypatch, np.inf, 1.0, MAX_FALSE_FRAMES / 3, at_given=2)
    assert name(found) == ""
    assert "under another pitch" not in found.misfit
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
    monkeypatch.setattr(stages, "detect_some", lambda *_: None)
    stage = Stage("pitch", [GIVEN], FiducialOptions())
    ((expected, found),) = stages.measure_stage(SCAN, ALIKE, stage, SearchResult((frame.placement,)), 5)
    assert found is frame
    assert expected == pytest.approx(1e-3)  # two criteria, five hypotheses
    monkeypatch.setattr(stages, "false_placements", lambda *_: 1.0)  # then a clear mark is wanted
    assert stages.measure_stage(SCAN, ALIKE, stage, SearchResult((frame.placement,)), 5) == []


def test_of_frames_that_are_all_significant_the_one_with_most_marks_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lattice one step off has fewer marks in its scan, and may have found a larger share of them."""
    placements, frames = list[Placement](), dict[int, Any]()
    for marks, expected in ((19, 1e-36), (21, 1e-33), (22, 10.0)):
        placements.append(Placement("0", np.eye(2, 3) + 900 * marks * np.eye(2, 3, 2), 1.0, marks, 1, 1, (0.05, 0.05)))
        frames[marks] = cast(Any, Stand(f"{marks} marks"))
        frames[marks].agrees, frames[marks].options = True, FiducialOptions(pose="0")
        frames[marks].inlier_fits, frames[marks].expected = dict.fromkeys(range(marks)), expected
        frames[marks].placement = placements[-1]
    monkeypatch.setattr(stages, "distinct_places", lambda *_: placements)
    for function in ("measure_frame", "detect_some"):
        monkeypatch.setattr(stages, function, lambda _, __, place, *___: frames[place.supported])
    monkeypatch.setattr(stages, "false_placements", lambda *_: 0.5)
    monkeypatch.setattr(stages, "false_frames", lambda _, frame, __: frame.expected)
    stage = Stage("pitch", [GIVEN], FiducialOptions())
    ranked = stages.measure_stage(SCAN, ALIKE, stage, SearchResult(tuple(placements)), 5)
    assert [cast(Stand, frame).name for _, frame in ranked] == ["21 marks", "19 marks", "22 marks"]


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
def test_a_pitch_beyond_that_of_film_is_named(pitch_um: tuple[float, float], sigma_mm: float, is_wrong: bool) -> None:
    problem = pitch_problem(frame(*pitch_um), layout(sigma_mm), (20.0, 20.0), "the project")
    assert (problem is not None) == is_wrong
    if problem is not None:
        assert "the project gives a pitch of 20.00 x 20.00 µm" in problem
        assert f"set pitch_um = [{pitch_um[0]:.2f}, {pitch_um[1]:.2f}]" in problem

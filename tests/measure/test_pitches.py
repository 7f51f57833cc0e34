"""Frames of other pitches, in the middle of large scans, clicked, in colour, photographed obliquely."""

import re
import sys
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import drawn as draw
import numpy as np
import pytest
import tifffile
from drawn import Array, center
from small_scene import hidden_field
from studies import parametrize_with_studies

from measure import FiducialOptions, FrameMeasurement, Scan, Status, measure_fiducials, open_scan
from measure.detection.responses import SearchEffort
from measure.fiducials import stages
from measure.fiducials.channel_weights import best_weights, registered_channels
from measure.fiducials.measure_frame import Frame, measure_frame
from measure.fiducials.measurement import coarseness, other_frames, pitch_problem
from measure.fiducials.options import CLICK_SIGMA_PX, Click
from measure.fiducials.search import FrameSearch, PitchHypothesis, SearchResult, false_placements, is_lattice
from measure.flags import Cause, Code, Reason
from measure.geometry import POSES
from measure.marks.shapes import Disk, FiducialLayout, LayoutMark, MarkShape, cross, ring_cross
from measure.marks.templates import cut
from measure.results import Covariance, MarkMeasurement, shift_frame
from measure.scans.metadata import Samples
from measure.scans.opening import crop_scan
from measure.tone.curve import LINEAR
from synthetic_images import scene as scenes
from synthetic_images.areas import disk
from synthetic_images.render import render_scene

# A frame of 14 mm with a hundredth of the usual tolerances bends as little as one of 140 mm.
STIFF = FiducialOptions(pose="0", misfit_mm=0.03, affinity=1e-4, gate_mm=0.03)


def test_pixels_longer_one_way_are_found_out() -> None:
    matrix = draw.pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.012, 0.988]) @ matrix[:, :2]
    scan = draw.make_scan(draw.frame_picture(draw.ALIKE, matrix))
    as_given = measure_fiducials(scan, draw.ALIKE, (draw.PITCH_UM / 1.012, draw.PITCH_UM / 0.988), STIFF)
    assert not any("more than film deforms" in problem for problem in as_given.problems)
    result = measure_fiducials(scan, draw.ALIKE, (draw.PITCH_UM, draw.PITCH_UM), STIFF)
    draw.assert_right(result, draw.ALIKE, matrix)
    (stretched,) = [problem for problem in result.problems if "more than film deforms" in problem]
    assert "a pixel is 49.4 µm wide and 50.6 µm tall, but 50.0 x 50.0 µm is given" in stretched  # 50 / 1.012, / 0.988


def test_wrong_resolution_tags_are_named_with_the_pitch_of_the_marks(tmp_path: Path) -> None:
    """Tags that say pixels of 50 x 52 µm where they are of 50 x 51 µm."""
    matrix = draw.pixel_from_camera("0", turn_rad=0.0)
    matrix[:, :2] = np.diag([1.0, 50 / 51]) @ matrix[:, :2]
    stored = np.clip(np.rint(draw.frame_picture(draw.ALIKE, matrix)), 0, 65535).astype(np.uint16)
    density = (10000 / 50.0, 10000 / 52.0)
    tifffile.imwrite(tmp_path / "tags.tif", stored, resolution=density, resolutionunit="CENTIMETER")
    with open_scan(tmp_path / "tags.tif") as scan:
        pitch_um = scan.pitch_um
        assert pitch_um is not None
        result = measure_fiducials(scan, draw.ALIKE, pitch_um, STIFF)
    (problem,) = [problem for problem in result.problems if "more than film deforms" in problem]
    assert "the file's resolution tags say 50.0 x 52.0 µm" in problem
    assert "The likely cause is wrong resolution tags: set pitch_um = [" in problem
    wide, tall = map(float, problem.partition("pitch_um = [")[2].partition("]")[0].split(","))
    assert (wide, tall) == pytest.approx((50.0, 51.0), abs=0.1)
    assert pitch_problem(result, draw.ALIKE, pitch_um, "the scan's file") is None  # once is enough


def test_a_wrong_tag_costs_a_thumbnail_one_search_and_one_measured_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine crosses 7 mm apart; at four times their pitch four of them lie on others."""
    places = [(7.0 * column, 7.0 * row) for column in (-1, 0, 1) for row in (-1, 0, 1)]
    layout, matrix = draw.lay_out([MarkShape(draw.RING_CROSS)] * 9, places), draw.pixel_from_camera("0")
    scan = draw.make_scan(draw.frame_picture(layout, matrix))
    searched_um, measured_um = list[float](), list[float]()
    search_scan = FrameSearch.search_scan

    def counted_search(self: FrameSearch, options: FiducialOptions, hypotheses: Any, surroundings: Any) -> SearchResult:
        searched_um.extend(1000 * each.drawn_mm[0] for each in hypotheses)
        return search_scan(self, options, hypotheses, surroundings)

    def counted_measurement(*given: Any) -> Frame:
        measured_um.append(1000 * given[2].pitch_mm[0])
        return measure_frame(*given)

    monkeypatch.setattr(FrameSearch, "search_scan", counted_search)
    monkeypatch.setattr(stages, "measure_frame", counted_measurement)
    tracemalloc.start()
    result = measure_fiducials(scan, layout, (4 * draw.PITCH_UM, 4 * draw.PITCH_UM))
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    draw.assert_right(result, layout, matrix)
    assert searched_um == pytest.approx([4 * draw.PITCH_UM, draw.PITCH_UM], rel=0.02)
    assert measured_um == pytest.approx([draw.PITCH_UM], rel=0.02)
    assert peak_bytes < 32 * 4 * draw.FRAME_PX**2  # 23 maps of single precision; 63 where all pitches were searched


def test_the_pitch_that_would_do_is_a_third_of_the_finest_detail() -> None:
    layout = draw.lay_out([MarkShape(cross(2.0, 0.3))] * 4, frame_mm=(228.0, 228.0))
    assert not coarseness(layout, (1000, 900), (100.0, 99.0)).is_too_coarse
    assert coarseness(layout, (1000, 900), (101.0, 99.0)) == pytest.approx((300.0, 101.0))
    assert coarseness(layout, (1000, 900), (101.0, 99.0)).needed_um == pytest.approx(100.0)
    assert coarseness(layout, (1000, 900), None).pixel_um == pytest.approx(228.0)  # as if the frame filled the scan
    assert coarseness(layout, (1000, 900), None).is_too_coarse


@pytest.mark.study
def test_marks_outside_of_the_scan_are_named_where_the_others_are_too_few() -> None:
    """Four side marks, of which the upper and the lower one are cut off."""
    layout = draw.lay_out(
        [MarkShape(draw.RING_CROSS)] * 4, ((-10.0, 0.0), (10.0, 0.3), (0.0, 10.0), (0.2, -10.0)), (22.0, 22.0)
    )
    matrix = np.column_stack([draw.pixel_from_camera("0", 0.0)[:, :2], (260.0, 260.0)])
    result = draw.measure_grey(draw.frame_picture(layout, matrix, size=520)[100:420], layout)
    (problem,) = result.problems
    assert "only 2 of 4 marks were found where the others put them, and these put 3, 4 outside of the scan" in problem


def test_two_marks_are_stated_to_give_a_similarity() -> None:
    layout = draw.lay_out([MarkShape(draw.RING_CROSS)] * 2, ((-7.0, 0.0), (7.0, 0.2)))
    result = draw.measure_grey(draw.frame_picture(layout, draw.pixel_from_camera("0")), layout)
    assert any("a similarity on 2 fiducials has no redundancy" in problem for problem in result.problems)


FAR_TURN_RAD = 0.35  # twenty degrees: no search looks for a frame that is laid so


def make_clicks(matrix: Array, points: str, off_px: tuple[float, float] = (1.2, -0.9)) -> tuple[Click, ...]:
    """As a person clicks, a pixel or so off."""
    return tuple(Click(point, *(matrix @ (*draw.CORNERS[int(point) - 1], 1.0) + off_px)) for point in points)


@parametrize_with_studies("pose", POSES, quick=(1, 6))
def test_three_clicks_find_a_frame_in_any_pose_that_no_search_finds(pose: str) -> None:
    matrix = draw.pixel_from_camera(pose, FAR_TURN_RAD)
    grey = draw.frame_picture(draw.ALIKE, matrix)
    result = draw.measure_grey(grey, draw.ALIKE, FiducialOptions(clicks=make_clicks(matrix, "124")))
    assert draw.found_pose(result) == (pose, True)
    draw.assert_right(result, draw.ALIKE, matrix)


def test_clicks_that_contradict_the_set_pose_give_no_observation() -> None:
    """As in a viewer that turns the picture: the names would be those of other marks."""
    matrix = draw.pixel_from_camera("180")
    grey = draw.frame_picture(draw.ALIKE, matrix)
    result = draw.measure_grey(grey, draw.ALIKE, FiducialOptions("0", clicks=make_clicks(matrix, "124")))
    assert {mark.status for mark in result.marks} == {Status.REJECTED}
    assert "show the scan orientation 180, and 0 is set" in result.problems[0]


def test_clicks_tell_the_pitch_where_nothing_else_does() -> None:
    matrix = draw.pixel_from_camera("0", FAR_TURN_RAD)
    options = FiducialOptions(clicks=make_clicks(matrix, "123"))
    result = draw.measure_grey(draw.frame_picture(draw.ALIKE, matrix), draw.ALIKE, options, pitch=False)
    assert result.px_per_mm == pytest.approx(20.0, rel=1e-3)
    draw.assert_right(result, draw.ALIKE, matrix)


def test_marks_on_a_line_do_not_tell_the_pose() -> None:
    places = (*draw.CORNERS, (0.0, 0.0))
    layout = draw.lay_out([MarkShape(draw.RING_CROSS)] * 5, places)
    matrix = draw.pixel_from_camera("0")
    clicks = tuple(Click(str(k), *(matrix @ (*places[k - 1], 1.0))) for k in (1, 3, 5))
    result = draw.measure_grey(draw.frame_picture(layout, matrix), layout, FiducialOptions(clicks=clicks))
    assert not draw.found_pose(result)[1]


@pytest.mark.study
def test_a_click_where_nothing_is_matched_counts_as_well_as_one_points() -> None:
    """The mark's corner is bare ground: with the others' frame alone it would only be predicted."""
    matrix = draw.pixel_from_camera("0")
    result = bare_corner(matrix, ())
    assert row(result, "3").status is Status.PREDICTED
    (click,) = make_clicks(matrix, "3", (0.0, 0.0))
    mark = row(bare_corner(matrix, (click,)), "3")
    assert mark.status is Status.WEAK
    np.testing.assert_array_equal(center(mark), (click.col_px, click.row_px))
    assert mark.covariance is not None
    np.testing.assert_array_equal(mark.covariance.parts[Cause.CLICK], CLICK_SIGMA_PX**2 * np.eye(2))


def test_a_click_outside_of_the_scan_is_named_and_moves_nothing() -> None:
    """It was an observation, and the camera's other frames were blamed."""
    matrix = draw.pixel_from_camera("0")
    grey = draw.frame_picture(draw.ALIKE, matrix)
    options = FiducialOptions(pose="0")
    expected = draw.measure_grey(grey, draw.ALIKE, options)
    result = draw.measure_grey(grey, draw.ALIKE, replace(options, clicks=(Click("4", 99999.0, 5.0),)))
    assert [(mark.status, *center(mark)) for mark in result.marks] == [
        (mark.status, *center(mark)) for mark in expected.marks
    ]
    (problem,) = result.problems
    assert "pointed for mark 4 is outside of the scan" in problem


def test_a_click_says_which_of_two_marks_is_meant() -> None:
    """A mark as good as any lies a millimetre and a half from where the others put it."""
    matrix = draw.pixel_from_camera("0")
    grey = draw.frame_picture(draw.ALIKE, matrix)
    meant = matrix.copy()
    meant[:, 2] += (30.0, 0.0)
    grey_neighbour = draw.frame_picture(draw.ALIKE, meant)
    col, line = np.rint(meant @ (*draw.CORNERS[3], 1.0)).astype(int)
    grey[line - 25 : line + 26, col - 10 : col + 26] = grey_neighbour[line - 25 : line + 26, col - 10 : col + 26]
    click = Click("4", *(meant @ (*draw.CORNERS[3], 1.0)))
    mark = row(draw.measure_grey(grey, draw.ALIKE, FiducialOptions(clicks=(click,))), "4")
    assert mark.status.is_observation, mark.reason
    np.testing.assert_allclose(center(mark), (click.col_px, click.row_px), atol=0.1)


def bare_corner(matrix: Array, clicks: tuple[Click, ...]) -> FrameMeasurement:
    grey = draw.frame_picture(draw.ALIKE, matrix)
    col, line = np.rint(matrix @ (*draw.CORNERS[2], 1.0)).astype(int)
    rng = np.random.default_rng(4)
    grey[line - 40 : line + 41, col - 40 : col + 41] = 3000 + rng.normal(0, draw.NOISE_DN, (81, 81))
    return draw.measure_grey(grey, draw.ALIKE, FiducialOptions(clicks=clicks))


def row(result: FrameMeasurement, point: str) -> MarkMeasurement:
    return next(mark for mark in result.marks if mark.point == point)


RED, GREEN, BLUE = np.eye(3)
AS_LIGHT = 0.299 / 0.587  # of green that is lost for a mark of more red to be as light as its ground
MATRIX = draw.pixel_from_camera("90", center=(202.2, 197.6))


@cache
def red_on_grey() -> Array:
    rng = np.random.default_rng(9)
    planes = np.full((3, draw.FRAME_PX, draw.FRAME_PX), 26000.0)
    for mark in draw.NUMBERED.marks:
        draw.paint(planes[0], mark.mark, mark.xy_mm, MATRIX, 16000.0)
        draw.paint(planes[1], mark.mark, mark.xy_mm, MATRIX, -16000.0 * AS_LIGHT)
    return np.moveaxis(planes + rng.normal(0.0, 200.0, planes.shape), 0, -1)


def test_red_marks_as_light_as_their_grey_ground_are_found_and_right() -> None:
    """The search answers to the green here, in which they are dark."""
    result = draw.measure_grey(red_on_grey(), draw.NUMBERED)
    assert draw.found_pose(result) == ("90", True)
    draw.assert_right(result, draw.NUMBERED, MATRIX)
    assert result.weights is not None
    np.testing.assert_allclose(result.weights, RED, atol=0.06)


def test_channels_are_those_of_the_polarity_or_of_the_better_one() -> None:
    places = [
        (mark.mark, np.column_stack([MATRIX[:, :2], MATRIX @ (*mark.xy_mm, 1.0)])) for mark in draw.NUMBERED.marks
    ]
    scan = draw.make_scan(red_on_grey())
    dark, light = ([(*place, sign) for place in places] for sign in (-1, 1))
    for marks, signs, weights, sign in (
        (dark, (1,), GREEN, 1),
        (light, (1,), RED, 1),
        (dark, (1, -1), RED, -1),
        (light, (1, -1), RED, 1),
    ):
        best = best_weights(scan, marks, signs)
        assert best is not None
        np.testing.assert_allclose(best[0], weights, atol=0.06)  # noise makes it some 0.02
        assert best[1] == sign
    assert best_weights(scan, [], (1, -1)) is None


def test_where_channels_do_not_coincide_marks_are_measured_in_those_that_do() -> None:
    """Green lies three columns to the right: marks had been `measured` where the channels' mean has them."""
    red = draw.frame_picture(draw.NUMBERED, MATRIX, seed=3)
    grain = np.random.default_rng(2).normal(0.0, draw.NOISE_DN, (2, *red.shape))
    result = draw.measure_grey(np.dstack([red, np.roll(red + grain[0], 3, axis=1), red + grain[1]]), draw.NUMBERED)
    draw.assert_right(result, draw.NUMBERED, MATRIX)
    assert result.weights is not None
    assert result.weights[1] == 0.0
    (note,) = result.notes
    assert "green lies (+3.0, " in note
    assert "measured in red and blue alone" in note


def test_channels_coincide_where_their_peaks_do_or_are_not_the_marks() -> None:
    """Of marks at four places, with blue shifted by less than half a pixel, and with blue peaks anywhere."""
    places, rng = np.array([(10.0, 10.0), (90.0, 12.0), (88.0, 95.0), (7.0, 91.0)]), np.random.default_rng(3)
    for blue in (places + np.array([0.3, 0.0]), places + rng.uniform(-9.0, 9.0, (4, 2))):
        peaks = [[(place, 0.8) for place in of_mark] for of_mark in zip(places, places, blue, strict=True)]
        assert registered_channels(peaks) == ([0, 1, 2], "")


def test_learned_marks_are_cut_in_the_measured_channels() -> None:
    """Else the same mark has another contrast there, which counts as changed light."""
    place = np.column_stack([MATRIX[:, :2], MATRIX @ (*draw.NUMBERED.marks[0].xy_mm, 1.0)])
    scan = draw.make_scan(red_on_grey())
    red, grey = (cut(scan, place, 2.0, weights).grey for weights in (RED.tolist(), None))
    assert np.ptp(red) > 14000.0
    assert np.ptp(grey) < 2000.0


PLACES = {f"{x}{y}": (106.0 * x, 106.0 * y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y}
RADIUS_MM, OBLIQUE_FILM_PITCH_UM, FRAME_MM = 1.5, 250.0, (228.0, 228.0)


EIGHT, COLUMNS, ROWS = (
    tuple(name for name in PLACES if name not in left_out) for left_out in ((), ("0-1", "01"), ("-10", "10"))
)


@pytest.mark.parametrize(
    ("model", "tilt_deg", "names", "pose"),
    [
        ("affine", 2.0, COLUMNS, "auto"),
        ("affine", 4.0, COLUMNS, "0"),
        ("affine", 6.5, COLUMNS, "0"),
        ("affine", 6.5, ROWS, "0"),
        ("affine", 6.5, EIGHT, "0"),
        ("projective", 10.0, EIGHT, "0"),
    ],
)
def test_balls_under_a_perspective_are_found_and_the_perspective_is_named(
    tmp_path: Path, model: str, tilt_deg: float, names: tuple[str, ...], pose: str
) -> None:
    """A slight one leaves all marks near an affinity, and is no evidence on how the film lies in the scanner."""
    ball, places = scenes.DrawnMark((disk((0.0, 0.0), RADIUS_MM),)), {name: PLACES[name] for name in names}
    fiducials = tuple(scenes.SceneFiducial(*one, ball) for one in places.items())
    camera = scenes.SceneCamera("film", FRAME_MM, 150.0, fiducials=fiducials)
    film = scenes.SceneFilm("projective", tilt_deg=tilt_deg, tilt_direction_deg=5.0)
    scanner = scenes.SceneScanner((OBLIQUE_FILM_PITCH_UM, OBLIQUE_FILM_PITCH_UM), margin_mm=6.0, noise=0.01)
    image = scenes.SceneImage("f", (0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    scene = scenes.Scene("film", 1, camera, hidden_field(), (image,), scanner, film, scenes.Tones(contrast=0.0))
    (truth,) = render_scene(scene, tmp_path).frames
    shape = MarkShape((Disk((0.0, 0.0), RADIUS_MM),), "light")
    layout = FiducialLayout(tuple(LayoutMark(k, xy, (0.002, 0.002), shape) for k, xy in places.items()), FRAME_MM)
    with open_scan(tmp_path / "scans" / "f.tif") as scan:
        options, pitch_um = FiducialOptions(pose, film_model=model), (OBLIQUE_FILM_PITCH_UM, OBLIQUE_FILM_PITCH_UM)
        frame = measure_fiducials(scan.replace_tone(LINEAR), layout, pitch_um, options)
    measured = [mark for mark in frame.marks if mark.status is Status.MEASURED]
    assert len(measured) == len(names) - (tilt_deg == 4.0)  # one that it displaces is not enough to prove it
    for mark in measured:
        assert np.abs(center(mark) - truth.fiducials[mark.point].center_px).max() < 0.05
    assert frame.pose is not None
    assert set(frame.pose.rivals) == ({"180", "0m", "180m"} if pose == "auto" else set())
    if model == "projective" or tilt_deg < 5.0:
        assert frame.problems == ()
    else:
        (problem,) = (each for each in frame.problems if Code.PERSPECTIVE in each.codes)
        assert 'transformation = "projective"' in problem


@parametrize_with_studies(("second", "is_named"), [("0", True), ("90", True), (None, False)])
def test_a_second_frame_is_named_with_the_windows_of_both(second: str | None, is_named: bool) -> None:
    """Above the one that was measured, in any pose; bare ground is none."""
    first = draw.frame_picture(draw.ALIKE, draw.pixel_from_camera("0"))
    other = (
        draw.frame_picture(draw.ALIKE, draw.pixel_from_camera(second), 7)
        if second
        else first[::-1, :1] * np.ones((1, draw.FRAME_PX))
    )
    options = FiducialOptions()
    both = np.vstack([other, first])
    file = draw.make_scan(np.pad(both, ((21, 0), (13, 0)), mode="edge"))
    scan = crop_scan(file, (13, 21, both.shape[1], both.shape[0]))  # the windows are those of the whole file
    window = (0, draw.FRAME_PX, draw.FRAME_PX, draw.FRAME_PX)
    frame = measure_fiducials(crop_scan(scan, window), draw.ALIKE, (draw.PITCH_UM, draw.PITCH_UM), options)
    result = other_frames(scan, draw.ALIKE, shift_frame(frame, np.array([0.0, draw.FRAME_PX])), options)
    assert bool(result) == is_named
    if is_named:
        windows = re.findall(r'"(\d+) (\d+) (\d+) (\d+)"', result)
        (left, lower, _, _), (_, upper, _, height) = [tuple(map(int, window)) for window in windows]
        assert lower == pytest.approx(21 + draw.FRAME_PX + 27, abs=6)  # 17 mm about the middle, row 197.6
        assert upper == pytest.approx(21 + 27, abs=6)
        assert left == pytest.approx(13 + 30, abs=8)
        assert height == pytest.approx(343, abs=8)


def test_every_further_frame_is_named() -> None:
    """Three side by side, of which the middle one was measured."""
    pictures = [draw.frame_picture(draw.ALIKE, draw.pixel_from_camera("0"), seed) for seed in (1, 2, 3)]
    scan, pitch_um = draw.make_scan(np.hstack(pictures)), (draw.PITCH_UM, draw.PITCH_UM)
    window = (draw.FRAME_PX, 0, draw.FRAME_PX, draw.FRAME_PX)
    frame = measure_fiducials(crop_scan(scan, window), draw.ALIKE, pitch_um, FiducialOptions("0"))
    shown = shift_frame(frame, np.array([draw.FRAME_PX, 0.0]))
    result = other_frames(scan, draw.ALIKE, shown, FiducialOptions("0"))
    assert "shows 3 frames" in result
    assert "List all in images.csv" in result
    first_columns = sorted(int(column) for column in re.findall(r'"(\d+) \d+ \d+ \d+"', result))
    np.testing.assert_allclose(first_columns, draw.FRAME_PX * np.arange(3) + 30, atol=8)


NOISE = Covariance.from_noise(np.diag([0.04, 0.09]))
FOUND = MarkMeasurement("1", "fiducial", np.array([10.0, 20.0]), NOISE, Status.MEASURED)
ABSENT = MarkMeasurement("2", "fiducial", None, None, Status.ABSENT, Reason("outside the scan", Code.OUTSIDE))
FRAME = FrameMeasurement("a", (FOUND, ABSENT))


def test_it_has_a_row_for_every_mark() -> None:
    pytest.importorskip("pandas", reason="pandas is missing: make test installs it")
    table = FRAME.to_pandas()
    assert list(table.point) == ["1", "2"]
    assert list(table.status) == ["measured", "absent"]
    numbers = table[["column_px", "row_px", "sigma_column_px", "sigma_row_px"]]
    np.testing.assert_allclose(numbers.iloc[0], [10.0, 20.0, 0.2, 0.3])
    assert table.column_px.isna().tolist() == [False, True]
    assert table.reason[1] == "outside the scan"


def test_without_pandas_one_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="Install: pip install pandas"):
        FRAME.to_pandas()


LARGE_PITCH_UM = (50.0, 50.0)


def measure_picture(
    grey: Array, layout: FiducialLayout, monkeypatch: pytest.MonkeyPatch
) -> tuple[FrameMeasurement, bool]:
    """And whether the whole scan was searched. It counts as a large one."""
    monkeypatch.setattr("measure.fiducials.search._LARGE_PX", 1)
    searches: list[FrameSearch] = []
    search_scan = FrameSearch.search_scan

    def noted(search: FrameSearch, *given: Any) -> Any:
        searches.append(search)
        return search_scan(search, *given)

    monkeypatch.setattr(FrameSearch, "search_scan", noted)
    scan = draw.make_scan(grey)
    return measure_fiducials(scan, layout, LARGE_PITCH_UM), bool(searches)


@parametrize_with_studies("pose", ["0", "270m"])
def test_a_frame_in_the_middle_is_named_without_the_whole_scan(pose: str, monkeypatch: pytest.MonkeyPatch) -> None:
    matrix = draw.pixel_from_camera(pose)
    monkeypatch.setattr(Scan, "reduced", None)
    result, whole = measure_picture(draw.frame_picture(draw.NUMBERED, matrix), draw.NUMBERED, monkeypatch)
    assert not whole
    assert draw.found_pose(result) == (pose, True)
    draw.assert_right(result, draw.NUMBERED, matrix)


@parametrize_with_studies("center", [(225.0, 180.0), (202.3, 197.6)])
def test_a_frame_off_the_middle_is_searched_for(center: tuple[float, float], monkeypatch: pytest.MonkeyPatch) -> None:
    matrix = draw.pixel_from_camera("0", center=center)
    grey = draw.frame_picture(draw.NUMBERED, matrix)
    hidden = center == (202.3, 197.6)
    if hidden:
        col, row = np.rint(matrix @ (*draw.CORNERS[2], 1.0)).astype(int)
        grey[row - 40 : row + 40, col - 40 : col + 40] = 3000
    result, whole = measure_picture(grey, draw.NUMBERED, monkeypatch)
    assert whole
    measured_marks = [mark.status.is_observation for mark in result.marks]
    assert measured_marks == [True, True, not hidden, True]
    off = [
        np.abs(mark.center_px - matrix @ (*given.xy_mm, 1.0)).max()
        for mark, given in zip(result.marks, draw.NUMBERED.marks, strict=True)
        if mark.status is Status.MEASURED and mark.center_px is not None
    ]
    assert max(off) < 0.1


@parametrize_with_studies("bent_mm", [0.0, 0.03])
def test_of_a_large_scan_windows_are_read(bent_mm: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of eight marks lies farther off than most, by next to nothing or as much as film bends: none is missing, and
    no more of the file is read. How much is, a reader counts that decodes its tiles."""
    places = [(4.5 * x, 4.5 * y) for x, y in (*draw.CORNERS, (7.0, 0.0), (-7.0, 0.0), (0.0, 7.0), (0.0, -7.0))]
    layout = draw.lay_out([MarkShape(draw.RING_CROSS)] * 8, places, (66.0, 66.0))
    matrix = draw.pixel_from_camera("0", center=(705.3, 694.6))
    first = layout.marks[0]
    bent = replace(first, xy_mm=(first.xy_mm[0] - bent_mm, first.xy_mm[1] + bent_mm))
    grey = draw.frame_picture(FiducialLayout((bent, *layout.marks[1:]), layout.frame_mm), matrix, size=1400)
    stored = np.clip(np.rint(grey), 0, 65535).astype(np.uint16)
    tifffile.imwrite(tmp_path / "s.tif", stored, tile=(64, 64), compression="zlib")
    with open_scan(tmp_path / "s.tif") as scan:
        read, decode = set[tuple[int, int]](), scan._segments.read

        def counting(row: int, column: int, stored: Sequence[bytes] = ()) -> Samples:
            read.add((row, column))
            return decode(row, column, stored)

        monkeypatch.setattr(scan._segments, "read", counting)
        monkeypatch.setattr("measure.fiducials.search._LARGE_PX", 1)
        result = measure_fiducials(scan, layout, LARGE_PITCH_UM)
    assert all(mark.status.is_observation for mark in result.marks)
    assert len(read) * 64**2 < 0.45 * grey.size  # 0.3 of so small a scan are the strips that tell nearest neighbours


def test_a_lattice_is_distinguished_from_a_frame() -> None:
    cross = MarkShape(ring_cross(0.5, 0.1, 0.8, 0.1))
    places = [(10.0 * i, 10.0 * j) for i in range(5) for j in range(5)]
    sides = ((7.7, 0.0), (0.0, 7.7), (-7.7, 0.0), (0.0, -7.7))
    assert is_lattice(draw.lay_out([cross] * 25, places))
    assert not is_lattice(draw.lay_out([cross] * 4))
    assert not is_lattice(draw.lay_out([cross] * 8, draw.CORNERS + sides))


@parametrize_with_studies("center", [(225.0, 180.0), (190.0, 206.0)])
def test_windows_find_the_frame_of_the_scan(center: tuple[float, float], monkeypatch: pytest.MonkeyPatch) -> None:
    matrix = draw.pixel_from_camera("90", center=center)
    pitch_mm = (LARGE_PITCH_UM[0] / 1000, LARGE_PITCH_UM[1] / 1000)
    scan = draw.make_scan(draw.frame_picture(draw.NUMBERED, matrix))
    hypothesis = [PitchHypothesis(pitch_mm, 0.02, pitch_mm)]
    options = FiducialOptions()
    whole = FrameSearch(scan, draw.NUMBERED, options).search_scan(options, hypothesis).placements[0]
    monkeypatch.setattr("measure.fiducials.search._WINDOWS_SHARE", np.inf)
    monkeypatch.setattr(FrameSearch, "search_scan", None)
    result = FrameSearch(scan, draw.NUMBERED, options).search_room(options, hypothesis)
    found = result.placements[0]
    assert false_placements(result, found) < 0.01
    neighbour = np.add(found.pixel_from_camera, [[0.0, 0.0, 9999.0], [0.0, 0.0, 0.0]])
    assert np.isinf(false_placements(result, replace(found, pixel_from_camera=neighbour)))
    assert found.pose == whole.pose
    assert found.same_place(whole)
    assert np.hypot(*(found.pixel_from_camera - matrix)[:, 2]) < 3.0


def test_orientations_with_equal_marks_are_searched_once_for_a_camera() -> None:
    scan = draw.make_scan(draw.frame_picture(draw.ALIKE, draw.pixel_from_camera("0")))
    pitch_mm, options = (draw.PITCH_UM / 1000, draw.PITCH_UM / 1000), FiducialOptions()
    hypothesis = [PitchHypothesis(pitch_mm, 0.02, pitch_mm)]
    efforts = SearchEffort(), SearchEffort(every_pose=False)
    every, once = (
        FrameSearch(scan, draw.ALIKE, options, effort).search_room(options, hypothesis).placements for effort in efforts
    )
    assert {placement.pose for placement in every} == set(POSES)
    assert {placement.pose for placement in once} == {"0"}
    np.testing.assert_array_equal(once[0].pixel_from_camera, every[0].pixel_from_camera)

"""The verdict: the tests behind it against published tables, and a problem for everything that needs a look."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_calibration import set_adjustment as changed
from made_up_calibration import set_frames, set_mark
from projects import present

from adjust.solution.explanations import Explanation
from measure import Code, MarkMeasurement, Pose, Reason, Status
from measure.results import FrameMeasurement
from pipeline.report import Problem, ReportData, judge
from pipeline.report.data import frames
from pipeline.report.frame_problems import fraction_test, places_px
from pipeline.report.parameters import spoken_name
from pipeline.report.verdict import NEEDS_A_LOOK, critical_w, sigma0_bounds
from pipeline.results.adjustment_record import Quantity
from pipeline.results.assessment_record import SuspectRecord
from pipeline.results.stage_files import Check


def test_bounds_are_those_of_published_tables() -> None:
    """Chi-square with 10 degrees of freedom: 2.156 and 25.188 (any table, 0.005 and 0.995)."""
    low, high = sigma0_bounds(10)
    assert (low, high) == pytest.approx((np.sqrt(0.2156), np.sqrt(2.5188)), abs=1e-4)
    # One test: 2.576; a hundred: 0.01 / 100 two-sided, 3.891 (normal table).
    assert critical_w(1) == pytest.approx(2.576, abs=1e-3)
    assert critical_w(100) == pytest.approx(3.891, abs=1e-3)


ONE_LINE = 150  # letters in the width of the report at 1300 px


def describe(data: ReportData) -> str:
    """All problems in one text, for a calibration that is not good."""
    verdict = judge(data)
    assert verdict.level == "look"
    assert verdict.exit_code == 1
    assert [problem.remedy for problem in verdict.problems if len(problem.remedy) > ONE_LINE] == []
    return " ".join(f"{problem.what} {problem.next_step}" for problem in verdict.problems)


def test_good(adjusted_data: ReportData) -> None:
    """σ₀ may be better than promised."""
    verdict = judge(adjusted_data)
    assert (verdict.level, verdict.exit_code, verdict.problems) == ("good", 0, ())
    for sigma0, words in ((0.5, "σ₀ = 0.50 is below 0.89"), (0.8864, "σ₀ = 0.886 is below 0.887")):
        verdict = judge(changed(adjusted_data, sigma0=sigma0))
        assert verdict.exit_code == 0
        assert words in " ".join(verdict.notes)
    alone = judge(replace(adjusted_data, comparator=(), measurement=None))
    assert (alone.level, alone.sentence[:40]) == ("good", "Calibrated from 160 marks in 5 frames: R")
    rows = present(adjusted_data.adjustment).residuals
    some = changed(adjusted_data, residuals=tuple(row for row in rows if row.image != rows[0].image))
    assert judge(some).sentence.startswith("Calibrated from 128 marks in 4 frames: ")


NOT_SQUARE = (Explanation("pixels", "The pixels are not square.", "Give b1.", 1e-9, (1.6, 1.0)),)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"sigma0": 1.6}, ["σ₀ = 1.60 is above 1.11", "film_sigma_um", "(target 1.02, fiducial 0.97)"]),
        ({"sigma0": 1.6, "explanations": NOT_SQUARE}, ["deviations given. The pixels are not square. Give b1."]),
        ({"explanations": NOT_SQUARE}, ["The pixels are not square. Give b1."]),
        ({"warnings": ("c is carried by its prior.",)}, ["c is carried by its prior."]),
    ],
)
def test_what_the_adjustment_finds_is_a_problem(adjusted_data: ReportData, values: Any, words: list[str]) -> None:
    text = describe(changed(adjusted_data, **values))
    assert [word for word in words if word not in text] == []
    assert "gross errors" not in text or "explanations" not in values


def suspect(**values: Any) -> tuple[SuspectRecord]:
    numbers = (86.5, 2, 20.0, -9.3, -9.3, 4.0)
    row = SuspectRecord("target 1 in image f2", "target", "f2", "1", ("x", "y"), *numbers, (0.03, 0.0), (), False)
    return (replace(row, **values),)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, ["1 gross error suspected: target 1 in image f2 (w = −9.3).", "snooping = true", "Look at the picture"]),
        ({"alike": ("control point 1 Z",)}, ["f2 (w = −9.3; not distinguishable from control point 1 Z)."]),
        ({"name": "given 7 x", "group": "datum", "removed": True}, ["Left out as gross errors: given 7 x (w = −9.3)."]),
        ({"name": "given c (camera RC 20)", "group": "interior"}, ["Correct the given value in the camera's file"]),
    ],
)
def test_gross_errors_are_named(adjusted_data: ReportData, values: dict[str, Any], words: list[str]) -> None:
    text = describe(changed(adjusted_data, suspects=suspect(**values)))
    assert [word for word in words if word not in text] == []
    assert ("Look at the picture" in text) == (values.get("group") != "interior")


def test_suspects_have_the_advice_of_their_kind(adjusted_data: ReportData) -> None:
    given = suspect(name="given c (camera RC 20)", group="interior")
    text = describe(changed(adjusted_data, suspects=(*given, *suspect())))
    assert "Look at the picture" in text
    assert "Correct the given value in the camera's file" in text
    of_one = tuple(suspect(name=f"target {k} in image f2")[0] for k in range(8))
    assert "marks of f2: look for wrong point numbers" in describe(changed(adjusted_data, suspects=of_one))
    of_two = tuple(replace(each, owner=f"f{k % 2}") for k, each in enumerate(of_one))
    assert "look for wrong point numbers" not in describe(changed(adjusted_data, suspects=of_two))


def test_an_assumed_pose_needs_attention_once(measured_data: ReportData, adjusted_data: ReportData) -> None:
    pose = Pose("0", False, ("The marks are symmetric to 3 µm.",))  # nothing is decided
    data = set_frames(measured_data, lambda frame: replace(frame, pose=pose))
    assert len(judge(data).problems) == 1
    assert "f1, f2, f3, f4, f5: pose assumed (0). The marks are symmetric to 3 µm." in describe(data)
    assert 'pose = "90"' in describe(data)
    cameras = present(adjusted_data.adjustment).cameras
    unknown = {name: replace(each, principal_distance_mm=Quantity(153.0, np.nan)) for name, each in cameras.items()}
    bare = changed(adjusted_data, cameras=unknown)
    check = Check(verdict="not possible", reason="No camera is calibrated.", cameras={})
    verdict = judge(replace(set_frames(bare, lambda frame: replace(frame, pose=pose)), check=check))
    assert verdict.exit_code == 1
    assert "pose assumed (0). The marks are symmetric to 3 µm." in verdict.problems[0].what
    result = " ".join(verdict.notes)
    assert "if two scans bear each other's names, nothing here shows it" in result
    assert "OpenCV cannot check" not in result


def test_the_table_of_exit_code_1_is_that_of_the_code() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "results.md").read_text(encoding="utf-8")
    table = page.split("| test | passed when | false alarms |\n|---|---|---|\n")[1].split("\n\n")[0]
    assert [line.split(" | ")[0].removeprefix("| ") for line in table.splitlines()] == list(NEEDS_A_LOOK)


def test_problems_and_notes_of_frames_and_callers_are_kept(measured_data: ReportData) -> None:
    dark = (Reason("nearly black.", Code.NO_FRAME),)
    data = set_frames(measured_data, lambda frame: replace(frame, problems=dark) if frame.image == "f4" else frame)
    data = replace(data, problems=(Problem("points.csv: 99 was not measured."),))
    assert "f4: nearly black." in describe(data)
    assert "99 was not measured" in describe(data)
    note = "The file's orientation tag (6) is not applied."
    scans = {name: replace(scan, notes=(note,)) for name, scan in present(measured_data.measurement).items()}
    verdict = judge(replace(measured_data, measurement=scans))
    assert verdict.level == "good"
    assert f"f1, f2, f3, f4, f5: {note}" in verdict.notes


def lose(data: ReportData, kind: str, reason: str) -> ReportData:
    """Without the marks of a kind in f2."""
    rows = (
        replace(row, status=Status.ABSENT, reason=reason) if (row.image, row.kind) == ("f2", kind) else row
        for row in data.comparator
    )
    return replace(data, comparator=tuple(rows))


def test_what_a_frame_lacks_is_reported_once(measured_data: ReportData) -> None:
    assert describe(lose(measured_data, "fiducial", "Nothing there.")).count("Nothing there") == 1
    lost = lose(measured_data, "target", "Outside the scan.")
    assert "f2: none of its 24 targets was measured." in describe(lost)
    copied = (Reason("its file is byte for byte that of f1: its marks count once.", Code.COPY),)
    problems = describe(set_frames(lost, lambda one: replace(one, problems=copied) if one.image == "f2" else one))
    assert "f2: its file is byte for byte that of f1" in problems
    assert "none of its 24 targets" not in problems
    assert judge(set_mark(measured_data, -1, Status.ABSENT, "Outside the scan.")).level == "good"


def test_weights_that_the_adjustment_changed_are_noted(adjusted_data: ReportData) -> None:
    rows = [*present(adjusted_data.adjustment).residuals]
    rows[5] = replace(rows[5], weight=0.25)
    factors: dict[str, Any] = {"variance_factors": {"target": 4.0}, "variance_sigmas": {"target": 0.4}}
    notes = " ".join(judge(changed(adjusted_data, residuals=tuple(rows), **factors)).notes)
    assert "lowered the weight of 1 observation, most that of f1/6, to 0.25" in notes
    assert "the sigmas of the group target were multiplied by 2.00 ± 0.10" in notes
    cannot = replace(adjusted_data, check=Check(verdict="not possible", reason="One flat frame.", cameras={}))
    assert judge(cannot).level == "good"  # where it differs, a test of the page has it
    assert "OpenCV cannot check this calibration. One flat frame." in judge(cannot).notes


def test_without_a_solution_there_is_no_result(adjusted_data: ReportData) -> None:
    assert judge(ReportData("none")).level == "failed"
    stopped = changed(
        adjusted_data, converged=False, termination="iteration limit", iterations=50, warnings=("Not final.",)
    )
    verdict = judge(stopped)
    assert verdict.level == "failed"
    assert "There is no calibration: the iteration did not come to rest." in verdict.sentence
    assert "iteration limit, 50 iterations" in verdict.problems[0].what
    assert verdict.problems[1].what == "Not final."


def test_positions_that_prefer_parts_of_a_pixel_are_distinguished_from_even_ones() -> None:
    rng = np.random.default_rng(2)
    even = rng.uniform(0.0, 2000.0, 800)
    assert not fraction_test(even).is_locked
    pulled = np.round(even) + 0.6 * (even - np.round(even))
    assert fraction_test(pulled).is_locked
    assert fraction_test(even[:20]).probability is None
    assert fraction_test(even).counts.sum() == 800
    # 0.03 px towards the pixel's centre, as interpolating methods have it.
    rng = np.random.default_rng(4)
    true = rng.uniform(0.0, 4000.0, 20000)
    test = fraction_test(true - 0.03 * np.sin(2.0 * np.pi * true))
    assert test.is_locked
    assert test.bias_px == pytest.approx(0.03, abs=0.003)
    # However many marks show it, a bias that harms nobody is left alone.
    many = (np.arange(400000) + 0.5) / 1000.0
    test = fraction_test(many - 0.005 * np.sin(2.0 * np.pi * many))
    assert test.probability is not None
    assert test.probability < 1e-9
    assert not test.is_locked


def near_a_column(mark: MarkMeasurement, off_px: float) -> MarkMeasurement:
    """The mark so far off a whole column."""
    assert mark.center_px is not None
    return replace(mark, center_px=np.array([round(mark.center_px[0]) + off_px, mark.center_px[1]]))


def test_locked_positions_need_attention_and_recurring_ones_do_not(measured_data: ReportData) -> None:
    def locked(frame: FrameMeasurement) -> FrameMeasurement:
        return replace(frame, marks=tuple(near_a_column(mark, 0.02) for mark in frame.marks))

    text = describe(set_frames(measured_data, locked))
    assert "The column positions of the marks prefer parts of a pixel" in text
    assert "The row positions" not in text
    # A frame that lies in the same place of every scan: 4 marks, 38 times within 0.01 px of the same places.
    rng = np.random.default_rng(6)
    (name, scan), *_ = (measured_data.measurement or {}).items()
    marks = [tuple(near_a_column(mark, rng.normal(0.0, 0.01)) for mark in scan.frame.marks[:4]) for _ in range(38)]
    scans = {f"{name}-{k}": replace(scan, frame=replace(scan.frame, marks=own)) for k, own in enumerate(marks)}
    recurring = replace(measured_data, comparator=(), measurement=scans)
    shots = frames(recurring)
    assert sum(mark.status.is_observation for frame in shots for mark in frame.marks) == 4 * 38
    assert all(len(positions) <= 4 for positions in places_px(shots).values())
    assert judge(recurring).level == "good"
    # A reseau of 20 x 20 crosses, 120.04 px apart: 20 columns and 20 rows, each measured 20 times.
    places = np.stack(np.meshgrid(*[100.7 + 120.04 * np.arange(20)] * 2), axis=-1).reshape(-1, 2)
    places += np.random.default_rng(8).normal(0.0, 0.01, places.shape)
    mark = scan.frame.marks[0]
    crosses = tuple(replace(mark, point=str(index), center_px=place) for index, place in enumerate(places))
    scans = {name: replace(scan, frame=replace(scan.frame, marks=crosses))}
    lattice = replace(measured_data, comparator=(), measurement=scans)
    assert len(frames(lattice)[0].marks) == 400
    assert judge(lattice).level == "good"


def test_quantities_are_called_as_in_the_tables() -> None:
    names = ["IO.RC 20.c", "IO.RC 20.x0", "FID.RC 20.7.1.x", "EO.f1.Z0"]
    assert [spoken_name(name, ["RC 20"]) for name in names] == ["c", "x₀′", "x′ of fiducial 7.1", "Z0 of image f1"]
    assert spoken_name("IO.A.B.k3", ["A", "A.B"]) == "k3, A.B"

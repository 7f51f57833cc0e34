"""The verdict: the tests behind it against published tables, and a problem for everything that needs a look."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import made_up_calibration
import numpy as np
import pytest

from adjust.solution.explanations import Explanation
from measure import Code, MarkMeasurement, Pose, Reason, Status
from pipeline.report import Problem, ReportData, judge
from pipeline.report.data import frames
from pipeline.report.frame_problems import fraction_test, places_px
from pipeline.report.parameters import spoken_name
from pipeline.report.verdict import NEEDS_A_LOOK, critical_w, sigma0_bounds
from pipeline.results.adjustment_record import Quantity
from pipeline.results.assessment_record import SuspectRecord
from pipeline.results.check_file import Check
from pipeline.results.measured_record import MeasuredScan


@pytest.fixture
def measured_data() -> ReportData:
    return made_up_calibration.measured_report()


@pytest.fixture
def adjusted_data() -> ReportData:
    return made_up_calibration.adjusted_report()


def test_the_bounds_of_sigma0_are_those_of_the_chi_square_table() -> None:
    """Chi-square with 10 degrees of freedom: 2.156 and 25.188 (any table, 0.005 and 0.995)."""
    low, high = sigma0_bounds(10)
    assert (low, high) == pytest.approx((np.sqrt(0.2156), np.sqrt(2.5188)), abs=1e-4)


def test_the_critical_w_grows_with_the_number_of_tests() -> None:
    """One test: 2.576; a hundred: 0.01 / 100 two-sided, 3.891 (normal table)."""
    assert critical_w(1) == pytest.approx(2.576, abs=1e-3)
    assert critical_w(100) == pytest.approx(3.891, abs=1e-3)


def changed(data: ReportData, **values: Any) -> ReportData:
    assert data.adjustment is not None
    return replace(data, adjustment=replace(data.adjustment, **values))


def describe(data: ReportData) -> str:
    """All problems in one text, for a calibration that is not good."""
    verdict = judge(data)
    assert verdict.level == "look"
    assert verdict.exit_code == 1
    return " ".join(f"{problem.what} {problem.next_step}" for problem in verdict.problems)


def test_good(adjusted_data: ReportData) -> None:
    verdict = judge(adjusted_data)
    assert (verdict.level, verdict.exit_code, verdict.problems) == ("good", 0, ())


def test_sigma0_above_and_below_its_bounds(adjusted_data: ReportData) -> None:
    assert "σ₀ = 1.60 is above 1.11" in describe(changed(adjusted_data, sigma0=1.6))
    assert "film_sigma_um" in describe(changed(adjusted_data, sigma0=1.6))
    assert "(target 1.02, fiducial 0.97)" in describe(changed(adjusted_data, sigma0=1.6)), "no group without a check"
    for sigma0, words in ((0.5, "σ₀ = 0.50 is below 0.89"), (0.8864, "σ₀ = 0.886 is below 0.887")):
        verdict = judge(changed(adjusted_data, sigma0=sigma0))
        assert verdict.exit_code == 0, "better than promised is no harm"
        assert words in " ".join(verdict.notes)


def test_what_explains_a_large_sigma0_stands_in_place_of_advice_on_gross_errors(adjusted_data: ReportData) -> None:
    found = (Explanation("pixels", "The pixels are not square.", "Give b1.", 1e-9, (1.6, 1.0)),)
    text = describe(changed(adjusted_data, sigma0=1.6, explanations=found))
    assert "larger than the standard deviations given. The pixels are not square. Give b1." in text
    assert "gross errors" not in text
    assert describe(changed(adjusted_data, explanations=found)) == "The pixels are not square. Give b1."


def suspect(**values: Any) -> tuple[SuspectRecord]:
    numbers = (86.5, 2, 20.0, -9.3, -9.3, 4.0)
    row = SuspectRecord("target 1 in image f2", "target", "f2", "1", ("x", "y"), *numbers, (0.03, 0.0), (), False)
    return (replace(row, **values),)


def test_a_gross_error_is_named_with_its_image(adjusted_data: ReportData) -> None:
    text = describe(changed(adjusted_data, suspects=suspect()))
    assert "1 gross error suspected: target 1 in image f2 (w = −9.3)." in text
    assert "snooping = true" in text


def test_a_given_value_that_is_suspect_is_no_mark_in_a_picture(adjusted_data: ReportData) -> None:
    given = suspect(name="given c (camera RC 20)", group="interior")
    text = describe(changed(adjusted_data, suspects=given))
    assert "Correct the given value in the camera's file" in text
    assert "Look at the picture" not in text
    both = describe(changed(adjusted_data, suspects=(*given, *suspect())))
    assert "Look at the picture" in both
    assert "Correct the given value in the camera's file" in both


def test_suspects_of_one_image_ask_for_its_numbers(adjusted_data: ReportData) -> None:
    of_one = tuple(suspect(name=f"target {k} in image f2")[0] for k in range(8))
    assert "marks of f2: look for wrong point numbers" in describe(changed(adjusted_data, suspects=of_one))
    of_two = tuple(replace(each, owner=f"f{k % 2}") for k, each in enumerate(of_one))
    assert "look for wrong point numbers" not in describe(changed(adjusted_data, suspects=of_two))


def test_pictures_without_fiducial_marks_are_no_film(adjusted_data: ReportData) -> None:
    """Where a camera found no solution, its summary spoke of film transformations and fiducial marks."""
    stored = adjusted_data.adjustment
    assert stored is not None
    uncalibrated = {
        name: replace(camera, principal_distance_mm=Quantity(152.0, np.inf)) for name, camera in stored.cameras.items()
    }
    assert changed(adjusted_data, cameras=uncalibrated).is_film_alone
    digital = {name: replace(camera, fiducials={}) for name, camera in uncalibrated.items()}
    assert not changed(adjusted_data, cameras=digital).is_film_alone


def test_what_could_as_well_be_wrong_is_named_too(adjusted_data: ReportData) -> None:
    text = describe(changed(adjusted_data, suspects=suspect(alike=("control point 1 Z",))))
    assert "target 1 in image f2 (w = −9.3; not distinguishable from control point 1 Z)." in text


def test_what_was_left_out_needs_attention(adjusted_data: ReportData) -> None:
    given = suspect(name="given fiducial 7 (camera RC 20)", group="datum", removed=True)
    text = describe(changed(adjusted_data, suspects=given))
    assert "Left out as gross errors: given fiducial 7 (camera RC 20) (w = −9.3)." in text


def test_warnings_of_the_adjustment_need_attention(adjusted_data: ReportData) -> None:
    assert "c is carried by its prior." in describe(changed(adjusted_data, warnings=("c is carried by its prior.",)))


def test_no_convergence_is_no_result(adjusted_data: ReportData) -> None:
    stopped: dict[str, Any] = {
        "converged": False,
        "termination": "iteration limit",
        "iterations": 50,
        "warnings": ("Not final.",),
    }
    verdict = judge(changed(adjusted_data, **stopped))
    assert verdict.level == "failed"
    assert "There is no calibration: the iteration did not come to rest." in verdict.sentence
    assert "iteration limit, 50 iterations" in verdict.problems[0].what
    assert verdict.problems[1].what == "Not final."


def posed(data: ReportData) -> dict[str, MeasuredScan]:
    """Its scans, of whose poses nothing is decided."""
    pose = Pose("0", False, ("The marks are symmetric to 3 µm.",))
    return {name: set_frame(scan, pose=pose) for name, scan in (data.measurement or {}).items()}


def set_frame(scan: MeasuredScan, **changes: Any) -> MeasuredScan:
    return replace(scan, frame=replace(scan.frame, **changes))


def test_an_assumed_pose_needs_attention_once_for_all_frames(measured_data: ReportData) -> None:
    assert measured_data.measurement is not None
    data = replace(measured_data, measurement=posed(measured_data))
    assert len(judge(data).problems) == 1
    assert "f1, f2, f3, f4, f5: pose assumed (0). The marks are symmetric to 3 µm." in describe(data)
    assert 'pose = "90"' in describe(data)


def test_a_pose_assumed_needs_attention_where_fiducials_are_all_there_is_too(adjusted_data: ReportData) -> None:
    assert adjusted_data.adjustment is not None
    assert adjusted_data.measurement is not None
    scans = posed(adjusted_data)
    bare = {
        name: replace(camera, principal_distance_mm=Quantity(153.0, np.nan))
        for name, camera in adjusted_data.adjustment.cameras.items()
    }
    check = Check(verdict="not possible", reason="No camera is calibrated.", cameras={})
    data = replace(changed(adjusted_data, cameras=bare), measurement=scans, check=check)
    verdict = judge(data)
    assert verdict.exit_code == 1
    assert "pose assumed (0). The marks are symmetric to 3 µm." in verdict.problems[0].what
    result = " ".join(verdict.notes)
    assert "if two scans bear each other's names, nothing here shows it" in result
    assert "OpenCV cannot check" not in result


def test_the_table_of_exit_code_1_is_that_of_the_code() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "results.md").read_text(encoding="utf-8")
    table = page.split("| test | passed when | false alarms |\n|---|---|---|\n")[1].split("\n\n")[0]
    assert [line.split(" | ")[0].removeprefix("| ") for line in table.splitlines()] == list(NEEDS_A_LOOK)


def test_problems_of_a_frame_and_of_the_caller_are_passed_on(measured_data: ReportData) -> None:
    assert measured_data.measurement is not None
    dark = set_frame(measured_data.measurement["f4"], problems=(Reason("nearly black.", Code.NO_FRAME),))
    scans = {**measured_data.measurement, "f4": dark}
    data = replace(measured_data, measurement=scans, problems=(Problem("points.csv: 99 was not measured."),))
    assert "f4: nearly black." in describe(data)
    assert "99 was not measured" in describe(data)


def test_what_a_scans_file_does_unusually_is_noted_once(measured_data: ReportData) -> None:
    assert measured_data.measurement is not None
    note = "The file's orientation tag (6) is not applied."
    scans = {name: replace(scan, notes=(note,)) for name, scan in measured_data.measurement.items()}
    verdict = judge(replace(measured_data, measurement=scans))
    assert verdict.level == "good"
    assert f"f1, f2, f3, f4, f5: {note}" in verdict.notes


def test_marks_lost_for_one_reason_are_reported_it_once(measured_data: ReportData) -> None:
    rows = [
        replace(row, status=Status.ABSENT, reason="Nothing there.")
        if (row.image, row.kind) == ("f2", "fiducial")
        else row
        for row in measured_data.comparator
    ]
    assert describe(replace(measured_data, comparator=rows)).count("Nothing there") == 1


def test_a_frame_without_any_target_needs_attention(measured_data: ReportData) -> None:
    rows = [
        replace(row, status=Status.ABSENT, reason="Outside the scan.")
        if (row.image, row.kind) == ("f2", "target")
        else row
        for row in measured_data.comparator
    ]
    assert "f2: none of its 24 targets was measured." in describe(replace(measured_data, comparator=rows))
    copied = Reason("its file is byte for byte that of f1: its marks count once.", Code.COPY)
    scans = dict(measured_data.measurement or {})
    scans["f2"] = set_frame(scans["f2"], problems=(copied,))
    problems = describe(replace(measured_data, comparator=rows, measurement=scans))
    assert "f2: its file is byte for byte that of f1" in problems
    assert "none of its 24 targets" not in problems


def test_single_targets_outside_the_scan_are_ordinary(measured_data: ReportData) -> None:
    rows = [*measured_data.comparator]
    rows[-1] = replace(rows[-1], status=Status.ABSENT, reason="Outside the scan.")
    assert judge(replace(measured_data, comparator=rows)).level == "good"


def test_when_opencv_differs_it_needs_attention_and_when_it_cannot_it_is_a_note(adjusted_data: ReportData) -> None:
    check = Check(verdict="differs", reason="k1 differs by 7 sigma.", cameras={})
    assert "k1 differs by 7 sigma." in describe(replace(adjusted_data, check=check))
    verdict = judge(replace(adjusted_data, check=replace(check, verdict="not possible", reason="One flat frame.")))
    assert verdict.level == "good"
    assert "OpenCV cannot check this calibration. One flat frame." in verdict.notes


def test_weights_that_the_adjustment_changed_are_noted(adjusted_data: ReportData) -> None:
    assert adjusted_data.adjustment is not None
    rows = [*adjusted_data.adjustment.residuals]
    rows[5] = replace(rows[5], weight=0.25)
    factors: dict[str, Any] = {"variance_factors": {"target": 4.0}, "variance_sigmas": {"target": 0.4}}
    notes = " ".join(judge(changed(adjusted_data, residuals=tuple(rows), **factors)).notes)
    assert "lowered the weight of 1 observation, most that of f1/6, to 0.25" in notes
    assert "the sigmas of the group target were multiplied by 2.00 ± 0.10" in notes


def test_an_adjustment_without_its_comparator_file_is_tested_all_the_same(adjusted_data: ReportData) -> None:
    verdict = judge(replace(adjusted_data, comparator=(), measurement=None))
    assert verdict.level == "good"
    assert verdict.sentence.startswith("Calibrated from 160 marks in 5 frames")


def test_nothing_measured_is_no_result() -> None:
    assert judge(ReportData("none")).level == "failed"


def test_even_fractions_pass_and_locked_ones_do_not() -> None:
    rng = np.random.default_rng(2)
    even = rng.uniform(0.0, 2000.0, 800)
    assert not fraction_test(even).is_locked
    pulled = np.round(even) + 0.6 * (even - np.round(even))
    assert fraction_test(pulled).is_locked
    assert fraction_test(even[:20]).probability is None
    assert fraction_test(even).counts.sum() == 800


def test_the_bias_of_locked_positions_is_measured() -> None:
    """0.03 px towards the pixel's centre, as interpolating methods have it."""
    rng = np.random.default_rng(4)
    true = rng.uniform(0.0, 4000.0, 20000)
    test = fraction_test(true - 0.03 * np.sin(2.0 * np.pi * true))
    assert test.is_locked
    assert test.bias_px == pytest.approx(0.03, abs=0.003)


def test_a_bias_that_harms_nobody_is_left_alone_however_many_marks_show_it() -> None:
    true = (np.arange(400000) + 0.5) / 1000.0
    test = fraction_test(true - 0.005 * np.sin(2.0 * np.pi * true))
    assert test.probability is not None
    assert test.probability < 1e-9
    assert not test.is_locked


def near_a_column(mark: MarkMeasurement, off_px: float) -> MarkMeasurement:
    """The mark so far off a whole column."""
    assert mark.center_px is not None
    return replace(mark, center_px=np.array([round(mark.center_px[0]) + off_px, mark.center_px[1]]))


def test_locked_positions_need_attention(measured_data: ReportData) -> None:
    assert measured_data.measurement is not None
    scans = {
        name: set_frame(scan, marks=tuple(near_a_column(mark, 0.02) for mark in scan.frame.marks))
        for name, scan in measured_data.measurement.items()
    }
    text = describe(replace(measured_data, measurement=scans))
    assert "The column positions of the marks prefer parts of a pixel" in text
    assert "The row positions" not in text


def test_marks_that_recur_in_one_place_are_no_pixel_locking(measured_data: ReportData) -> None:
    """A frame that lies in the same place of every scan: 4 marks, 38 times within 0.01 px of the same places."""
    assert measured_data.measurement is not None
    (name, scan), *_ = measured_data.measurement.items()
    rng = np.random.default_rng(6)

    def again() -> MeasuredScan:
        return set_frame(scan, marks=tuple(near_a_column(mark, rng.normal(0.0, 0.01)) for mark in scan.frame.marks[:4]))

    scans = {f"{name}-{k}": again() for k in range(38)}
    recurring = replace(measured_data, comparator=(), measurement=scans)
    shots = frames(recurring)
    assert sum(mark.status.is_observation for frame in shots for mark in frame.marks) == 4 * 38
    assert all(len(positions) <= 4 for positions in places_px(shots).values())
    assert judge(recurring).level == "good"


def test_a_lattice_that_lies_along_the_pixels_is_no_pixel_locking(measured_data: ReportData) -> None:
    """A reseau of 20 x 20 crosses, 120.04 px apart: 20 columns and 20 rows, each measured 20 times."""
    assert measured_data.measurement is not None
    (name, scan), *_ = measured_data.measurement.items()
    mark = scan.frame.marks[0]
    rng = np.random.default_rng(8)
    places = np.stack(np.meshgrid(*[100.7 + 120.04 * np.arange(20)] * 2), axis=-1).reshape(-1, 2)
    places += rng.normal(0.0, 0.01, places.shape)
    marks = tuple(replace(mark, point=str(index), center_px=place) for index, place in enumerate(places))
    lattice = replace(measured_data, comparator=(), measurement={name: set_frame(scan, marks=marks)})
    assert len(frames(lattice)[0].marks) == 400
    assert judge(lattice).level == "good"


def test_quantities_are_called_as_in_the_tables() -> None:
    names = ["IO.RC 20.c", "IO.RC 20.x0", "FID.RC 20.7.1.x", "EO.f1.Z0"]
    assert [spoken_name(name, ["RC 20"]) for name in names] == ["c", "x₀′", "x′ of fiducial 7.1", "Z0 of image f1"]
    assert spoken_name("IO.A.B.k3", ["A", "A.B"]) == "k3, A.B"

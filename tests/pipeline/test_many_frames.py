"""The report on thousands of frames: small, its numbers those that were made up, and a page of any frame."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kept_scans import keep_scans

from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, Pose
from pipeline.archive.checked_statuses import remember_written
from pipeline.archive.results_database import Store
from pipeline.cli import run
from pipeline.files.project_file import read_project
from pipeline.report import ReportData, Thumbnail, judge, render_report
from pipeline.report.frame_views import MOST_CARDS
from pipeline.report.load import report_data
from pipeline.report.many_frames import MOST_FRAMES, frame_counts, reduced
from pipeline.report.page import render_frame_page
from pipeline.results.comparator_file import ComparatorPoint, mark_rows, read_measurement_hash, write_comparator
from pipeline.results.measured_record import Failure, FailureCode, MeasuredScan
from pipeline.review.session import Filters, Session

FRAMES, MARKS = 2100, 8  # more of them are bad than a report shows
BAD, FAILED = range(0, FRAMES, 10), range(5, FRAMES, 100)
KNOWN = Covariance({Cause.NOISE: np.eye(2) * 4e-4})
SIGMA_UM = (3.0, 4.0)


def image(number: int) -> str:
    return f"box<b>{number % 3}/{number:04d}"


def scan(number: int) -> MeasuredScan:
    """Every tenth has lost a fiducial, every hundredth could not be read."""
    rng = np.random.default_rng(number)
    marks = []
    for i in range(MARKS):
        is_lost = number in FAILED or (number in BAD and i == 0)
        status = Status.ABSENT if is_lost else Status.MEASURED
        place = None if is_lost else rng.uniform(0, 12000, 2)
        why = Reason("it is faint", Code.COVERED) if is_lost else Reason()
        marks.append(MarkMeasurement(f"m{i}", "fiducial", place, None if is_lost else KNOWN, status, why))
    if number in FAILED:
        failure = Failure(FailureCode.UNREADABLE, f"scan {number} is damaged")
        frame = FrameMeasurement(image(number), tuple(marks), problems=(Reason(failure.sentence, Code.FAILED_SCAN),))
        return MeasuredScan.failed(f"{image(number)}.tif", frame, failure)
    frame = FrameMeasurement(image(number), tuple(marks), Pose("0", True, ("set.",)), np.eye(2, 3))
    ending = "jpg" if number % 2 else "tif"
    return MeasuredScan(f"{image(number)}.{ending}", 12000, 12000, (20.0, 20.0), frame)


def rows(scans: list[MeasuredScan]) -> Iterator[ComparatorPoint]:
    for each in scans:
        for mark in each.frame.marks:
            is_known = mark.center_px is not None
            xy, sigma = (np.zeros(2), 1e-3 * np.array(SIGMA_UM)) if is_known else (None, None)
            yield ComparatorPoint(each.frame.image, mark.point, "fiducial", xy, sigma, 0.0, mark.status, mark.reason)


@pytest.fixture(scope="module")
def many() -> ReportData:
    scans = [scan(number) for number in range(FRAMES)]
    return reduced(ReportData("Many", list(rows(scans))), iter(scans), lambda name: f"camera {name[6]}")


@pytest.fixture(scope="module")
def page(many: ReportData) -> str:
    return render_report(many)


def test_a_report_on_thousands_of_frames_is_small(page: str) -> None:
    assert len(page.encode()) < 2_000_000
    assert page.count('<details class="frame"') == MOST_FRAMES


def test_its_counts_are_those_of_the_frames(many: ReportData) -> None:
    assert many.totals is not None
    good = FRAMES - len(BAD) - len(FAILED)
    counts = sum(map(Counter, many.totals.verdicts.values()), Counter[str]())
    assert counts == {"good": good, "look": len(BAD), "failed": len(FAILED)}
    assert frame_counts(many, []) == counts  # of the terminal
    assert {camera for camera, _ in many.totals.verdicts} == {"camera 0", "camera 1", "camera 2"}
    assert {kind for _, kind in many.totals.verdicts} == {"tif", "jpg"}
    observed = FRAMES * MARKS - len(BAD) - MARKS * len(FAILED)
    assert judge(many).sentence.startswith(f"Measured: {observed} marks in {FRAMES} frames, but ")


def test_the_worst_frames_are_shown_and_alike_problems_stated_once(many: ReportData, page: str) -> None:
    shown = set(many.measurement or {})
    assert {image(number) for number in FAILED} <= shown
    assert shown <= {image(number) for number in (*BAD, *FAILED)}
    finding = [problem.what for problem in judge(many).problems]
    assert len(finding) == 2
    assert f"and {len(BAD) - 8} more: 1 fiducial mark not measured, 7 measured" in finding[0]
    assert f"and {len(FAILED) - 8} more: scan 5 is damaged" in finding[1]


def test_what_users_named_is_escaped(page: str) -> None:
    assert "box&lt;b&gt;" in page
    assert "<b>0/" not in page


def test_only_what_is_shown_is_kept(many: ReportData) -> None:
    assert len(many.measurement or {}) == MOST_FRAMES
    assert len(many.comparator) == MOST_FRAMES * MARKS


def test_pictures_of_all_that_is_shown_leave_it_small(many: ReportData) -> None:
    grey = np.random.default_rng(1).normal(2e4, 3e3, (81, 81))  # noise, which no format makes small
    page = render_report(replace(many, thumbnail=lambda *_: Thumbnail(grey, (0.0, 0.0))))
    assert page.count("data:image/png") == MOST_FRAMES * MARKS + MOST_CARDS + 1  # with the first problem's
    assert len(page.encode()) < 10_000_000


def test_good_frames_alone_need_no_attention() -> None:
    scans = [scan(number) for number in range(1, 400) if number not in BAD and number not in FAILED]
    data = reduced(ReportData("Good", list(rows(scans))), iter(scans), lambda _: "k")
    assert judge(data).level == "good"
    assert "No frame needs a look." in render_report(data)


def test_the_page_of_a_frame_has_all_its_marks() -> None:
    one = scan(0)
    targets = tuple(MarkMeasurement(f"t{i}", "target", np.ones(2), KNOWN, Status.MEASURED) for i in range(700))
    frame = FrameMeasurement(one.frame.image, (*one.frame.marks, *targets), one.frame.pose, np.eye(2, 3))
    whole = MeasuredScan(one.scan, 12000, 12000, (20.0, 20.0), frame)
    html = render_frame_page(ReportData("Many", [], {frame.image: whole}), frame.image)
    assert set(re.findall(r"<b>([mt]\d+)</b>", html)) == {mark.point for mark in frame.marks}
    assert 'href="../../report.html"' in html
    assert "<b>0/" not in html


def write_images(folder: Path, images: int) -> Path:
    """A project of coordinates that somebody has measured."""
    marks = {"1": (-100, -100), "2": (100, -100), "3": (100, 100), "4": (-100, 100)}
    fiducials = [f'[[fiducial]]\nid = "{id}"\nxy_mm = [{x}, {y}]\nsigma_mm = 0' for id, (x, y) in marks.items()]
    (folder / "camera.toml").write_text("\n".join(['name = "K"', *fiducials]), encoding="utf-8")
    (folder / "project.toml").write_text('camera = "camera.toml"\n', encoding="utf-8")
    lines = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    rng = np.random.default_rng(3)
    for number in range(images):
        for id, xy in marks.items():
            x, y = xy + rng.normal(0, 0.003, 2)
            lines.append(f"roll/{number:03d},{id},fiducial,{x:.5f},{y:.5f},0.003,0.003")
    (folder / "comparator.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "project.toml"


@pytest.mark.study
def test_pages_are_made_when_requested(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = write_images(tmp_path, MOST_FRAMES + 5)
    assert run(["adjust", str(project)]) in (0, 1)
    for _ in range(2):  # what was written may be written over
        assert run(["report", str(project)]) in (0, 1)
        assert run(["report", str(project), "--frames", "roll/007", "roll/008"]) == 0
    assert sorted(file.name for file in (tmp_path / "out" / "frames" / "roll").iterdir()) == ["007.html", "008.html"]
    page = (tmp_path / "out" / "frames" / "roll" / "007.html").read_text(encoding="utf-8")
    assert set(re.findall(r"<b>(\d)</b> fiducial", page)) == {"1", "2", "3", "4"}
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"{MOST_FRAMES + 5} of {MOST_FRAMES + 5} scans measured (" in report
    capsys.readouterr()
    assert run(["report", str(project), "--frames", "roll/7"]) == 2
    assert "has no image 'roll/7'" in capsys.readouterr().err
    assert run(["report", str(project), "roll/007"]) == 2


def test_few_frames_are_shown_one_by_one(tmp_path: Path) -> None:
    project = write_images(tmp_path, 3)
    assert run(["adjust", str(project)]) in (0, 1)
    assert run(["report", str(project)]) in (0, 1)
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "3 of 3 scans measured (3 good)." in report
    assert report.count('<details class="frame"') == 3


def stored(folder: Path) -> tuple[Path, list[MeasuredScan]]:
    """A project whose many scans were measured; of every tenth no target was seen."""
    project, scans = write_images(folder, 1), []
    project.write_text('camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = 20.0\n', encoding="utf-8")
    (folder / "scans").mkdir()
    for number in range(MOST_FRAMES + 11):
        file = folder / "scans" / f"{number:04d}.tif"
        file.write_bytes(f"scan {number}".encode())
        one = scan(number)
        view = (
            (Status.PREDICTED, Reason("it is faint", Code.COVERED)) if number % 10 == 3 else (Status.MEASURED, Reason())
        )
        targets = [MarkMeasurement(f"t{i}", "target", np.full(2, 7.0 * i), KNOWN, *view) for i in (1, 2)]
        marks = (*one.frame.marks, *(targets if number not in FAILED else ()))
        scans.append(replace(one, scan=str(file), frame=replace(one.frame, image=file.stem, marks=marks)))
    digest = keep_scans(folder / "out" / "measurement.db", scans)
    pitches = {each.frame.image: each.pitch_um for each in scans}
    write_comparator(folder / "comparator.csv", mark_rows([each.frame for each in scans]), pitches, digest)
    return project, scans


def test_natural_points_are_no_questions_to_a_reviewer(tmp_path: Path) -> None:
    project, (first, *_) = stored(tmp_path)
    doubtful = replace(first.frame.marks[1], status=Status.REJECTED, reason=Reason("it is faint", Code.COVERED))
    marks = (doubtful, replace(doubtful, point="tie1", kind="tie"), *first.frame.marks[2:-2])
    digest = keep_scans(tmp_path / "out" / "measurement.db", [replace(first, frame=replace(first.frame, marks=marks))])
    frames = {first.frame.image: first.pitch_um}
    write_comparator(tmp_path / "comparator.csv", mark_rows([replace(first.frame, marks=marks)]), frames, digest)
    asked = Session(read_project(project), "bob").page(Filters())["entries"]
    assert [(one["point"], one["kind"]) for one in asked] == [("m1", "fiducial")]


def as_written(folder: Path) -> None:
    """As `reseau measure` says it at its end."""
    with Store(folder / "out" / "measurement.db") as store:
        remember_written(store, read_measurement_hash(folder / "comparator.csv"), folder / "comparator.csv")


@pytest.mark.study
@pytest.mark.parametrize("is_written", [False, True])
def test_scans_come_from_the_store_one_after_the_other(tmp_path: Path, is_written: bool) -> None:
    project, scans = stored(tmp_path)
    if is_written:
        as_written(tmp_path)
    assert run(["report", str(project), "--frames", "0001", "0010"]) == 0
    assert "12000 × 12000 px" in (tmp_path / "out" / "frames" / "0010.html").read_text(encoding="utf-8")
    assert run(["report", str(project), "--frames", "1"]) == 2
    assert run(["report", str(project)]) == 1
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    bad, lost, blind = (sum(map(n, range(len(scans)))) for n in (BAD.__contains__, FAILED.__contains__, is_blind))
    counts = f"({len(scans) - bad - lost} good, {bad} to look at, {lost} failed)"
    assert f"{len(scans) - lost} of {len(scans)} scans measured {counts}." in report
    assert f"The {bad + lost + blind} that need a look most are shown below" in report
    assert report.count('<details class="frame"') == bad + lost + blind
    assert "scan 5 is damaged" in report


def is_blind(number: int) -> bool:
    return number % 10 == 3 and number not in BAD and number not in FAILED


def test_frames_that_need_no_attention_are_counted_as_if_each_were_read(tmp_path: Path, monkeypatch: Any) -> None:
    project = read_project(stored(tmp_path)[0])
    every = report_data(project, lambda path: path)
    as_written(tmp_path)
    monkeypatch.setattr("pipeline.report.load.read_comparator", None)  # nobody reads all of it
    few = report_data(project, lambda path: path)
    assert every.totals is not None
    assert few.totals is not None
    assert {n: +Counter(c) for n, c in few.totals.marks.items()} == {
        n: +Counter(c) for n, c in every.totals.marks.items()
    }
    assert +Counter(few.totals.of_targets) == +Counter(every.totals.of_targets)
    assert few.totals.verdicts == every.totals.verdicts
    assert few.totals.problems == every.totals.problems
    for axis in ("column", "row"):
        np.testing.assert_array_equal(few.totals.places_px[axis], every.totals.places_px[axis])
    assert set(few.measurement or {}) == set(every.measurement or {})


@pytest.mark.study
def test_marks_that_somebody_has_changed_are_read_from_the_file(tmp_path: Path) -> None:
    project = stored(tmp_path)[0]
    as_written(tmp_path)
    file = tmp_path / "comparator.csv"
    lines = file.read_text(encoding="utf-8").splitlines()
    place = next(number for number, line in enumerate(lines) if line.startswith("0001,m0,"))
    lines[place] = lines[place].replace(",measured,", ",rejected,it is a hair")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert run(["report", str(project)]) == 1
    assert "it is a hair" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")

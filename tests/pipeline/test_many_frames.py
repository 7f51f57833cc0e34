"""The report on thousands of frames, and the pictures of marks that it shows."""

import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import tifffile
from projects import command, comparator_points, fiducial_tables, keep_scans, present, write_project, write_tables

from measure import open_scan
from measure.flags import Cause, Code, Reason, Status
from measure.results import Covariance, FrameMeasurement, MarkMeasurement, ScanOrientation
from pipeline import read_project
from pipeline.archive.checked_results import read_measurement, stored_check_run
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.thumbnails import ThumbnailDatabase, Thumbnails
from pipeline.errors import InputError
from pipeline.files.project_file import read_undrawn
from pipeline.report import ReportData, Thumbnail, judge, load, render_report
from pipeline.report.load import MOST_FRAMES
from pipeline.report.page import render_frame_page
from pipeline.results.comparator_file import ComparatorPoint, read_measurement_hash, write_comparator
from pipeline.results.measured_record import Failure, FailureCode, MeasuredScan
from pipeline.results.thumbnail import cut
from pipeline.review.session import Filters, Session

SHOWN = 40  # of frames by a report here, in place of MOST_FRAMES
FRAMES, MARKS = 420, 8  # more of them are bad than a report shows
BAD, FAILED = range(0, FRAMES, 10), range(5, FRAMES, 40)
KNOWN = Covariance({Cause.NOISE: np.eye(2) * 4e-4})


def image(number: int) -> str:
    return f"box<b>{number % 3}/{number:04d}"


def scan(number: int) -> MeasuredScan:
    """Every tenth has lost a fiducial, every fortieth could not be read."""
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
    frame = FrameMeasurement(image(number), tuple(marks), ScanOrientation("0", True, ("set.",)), np.eye(2, 3))
    ending = "jpg" if number % 2 else "tif"
    return MeasuredScan(f"{image(number)}.{ending}", 12000, 12000, (20.0, 20.0), frame)


def rows(scans: list[MeasuredScan]) -> Iterator[ComparatorPoint]:
    for each in scans:
        for mark in each.frame.marks:
            is_known = mark.center_px is not None
            xy, sigma = (np.zeros(2), np.array([0.003, 0.004])) if is_known else (None, None)
            yield ComparatorPoint(each.frame.image, mark.point, "fiducial", xy, sigma, 0.0, mark.status, mark.reason)


@pytest.fixture(autouse=True, scope="module")
def fewer_frames_shown() -> Iterator[None]:
    with patch.object(load, "MOST_FRAMES", SHOWN):
        yield


@pytest.fixture(scope="module")
def many() -> ReportData:
    scans = [scan(number) for number in range(FRAMES)]
    return load.reduce_data(ReportData("Many", list(rows(scans))), iter(scans), lambda name: f"camera {name[6]}")


def test_a_report_on_thousands_of_frames_is_small_and_escaped(many: ReportData) -> None:
    page = render_report(many)
    assert len(page.encode()) < 2_000_000 * SHOWN / MOST_FRAMES
    assert page.count('<details class="frame"') == SHOWN
    assert "box&lt;b&gt;" in page
    assert "<b>0/" not in page
    grey = np.random.default_rng(1).normal(2e4, 3e3, (81, 81))  # noise, which no format makes small
    page = render_report(replace(many, thumbnail=lambda *_: Thumbnail(grey, (0.0, 0.0))))
    lost = SHOWN - len(FAILED)  # marks of the frames that could be read; and one of the first problem
    assert page.count("data:image/png") == SHOWN * MARKS + lost + 1
    assert len(page.encode()) < 4_000_000


def test_counts_are_those_of_all_frames_and_the_worst_are_shown(many: ReportData) -> None:
    verdicts = present(many.totals).verdicts
    good = FRAMES - len(BAD) - len(FAILED)
    counts = sum(map(Counter, verdicts.values()), Counter[str]())
    assert counts == {"good": good, "look": len(BAD), "failed": len(FAILED)}
    assert load.frame_counts(many, []) == counts  # of the terminal
    assert {camera for camera, _ in verdicts} == {"camera 0", "camera 1", "camera 2"}
    assert {kind for _, kind in verdicts} == {"tif", "jpg"}
    observed = FRAMES * MARKS - len(BAD) - MARKS * len(FAILED)
    assert judge(many).sentence.startswith(f"Measured: {observed} marks in {FRAMES - len(FAILED)} frames, but ")
    shown = set(many.measurement or {})
    assert {image(number) for number in FAILED} <= shown
    assert shown <= {image(number) for number in (*BAD, *FAILED)}
    finding = [problem.what for problem in judge(many).problems]
    assert len(finding) == 2
    assert f"and {len(BAD) - 8} more: 1 fiducial mark not measured, 7 measured" in finding[0]
    assert f"and {len(FAILED) - 8} more (numbers of {image(min(FAILED))}): scan 5 is damaged" in finding[1]


def test_the_page_of_a_frame_has_all_its_marks() -> None:
    one = scan(0)
    targets = tuple(MarkMeasurement(f"t{i}", "target", np.ones(2), KNOWN, Status.MEASURED) for i in range(700))
    frame = FrameMeasurement(one.frame.image, (*one.frame.marks, *targets), one.frame.pose, np.eye(2, 3))
    whole = MeasuredScan(one.scan, 12000, 12000, (20.0, 20.0), frame)
    html = render_frame_page(ReportData("Many", [], {frame.image: whole}), frame.image)
    assert set(re.findall(r"<b>([mt]\d+)</b>", html)) == {mark.point for mark in frame.marks}
    assert 'href="../../report.html"' in html
    assert "<b>0/" not in html
    scans = [scan(number) for number in range(1, 400) if number not in BAD and number not in FAILED]
    data = load.reduce_data(ReportData("Good", list(rows(scans))), iter(scans), lambda _: "k")
    assert judge(data).level == "good"
    assert "No frame needs a look." in render_report(data)


def write_images(folder: Path, images: int) -> Path:
    """A project of coordinates that somebody has measured."""
    marks = {"1": (-100, -100), "2": (100, -100), "3": (100, 100), "4": (-100, 100)}
    camera = 'name = "K"\n' + fiducial_tables(marks, "sigma_mm = 0\n")
    lines = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    rng = np.random.default_rng(3)
    for number in range(images):
        for id, xy in marks.items():
            x, y = xy + rng.normal(0, 0.003, 2)
            lines.append(f"roll/{number:03d},{id},fiducial,{x:.5f},{y:.5f},0.003,0.003")
    return write_tables(folder, 'camera = "camera.toml"', camera=camera, comparator=lines)


def stored(folder: Path) -> tuple[Path, list[MeasuredScan]]:
    """A project whose many scans were measured; of every tenth no target was seen."""
    project, scans = write_images(folder, 1), []
    project.write_text('camera = "camera.toml"\nscans = ["scans/*.tif"]\npitch_um = 20.0\n')
    (folder / "scans").mkdir()
    for number in range(SHOWN + 11):
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
    write_comparator(
        folder / "comparator.csv", comparator_points([each.frame for each in scans], pitches), pitches, digest
    )
    return project, scans


def test_natural_points_are_no_questions_to_a_reviewer(tmp_path: Path) -> None:
    project, (first, *_) = stored(tmp_path)
    doubtful = replace(first.frame.marks[1], status=Status.REJECTED, reason=Reason("it is faint", Code.COVERED))
    marks = (doubtful, replace(doubtful, point="tie1", kind="tie"), *first.frame.marks[2:-2])
    digest = keep_scans(tmp_path / "out" / "measurement.db", [replace(first, frame=replace(first.frame, marks=marks))])
    frames = {first.frame.image: first.pitch_um}
    points = comparator_points([replace(first.frame, marks=marks)], frames)
    write_comparator(tmp_path / "comparator.csv", points, frames, digest)
    entries = Session(read_project(project), "bob").page(Filters())["entries"]
    assert [(one["point"], one["kind"]) for one in entries] == [("m1", "fiducial")]


def test_marks_whose_camera_file_is_gone_are_no_questions(tmp_path: Path) -> None:
    project, scans = stored(tmp_path)
    keep_scans(tmp_path / "out" / "measurement.db", scans)
    camera = read_project(project).default_camera.path
    camera.unlink()
    with pytest.raises(InputError, match=f"{camera.name}: there is no such file, but its marks are in"):
        Session(read_undrawn(project), "bob")


@pytest.mark.parametrize("is_good", [True, False])
def test_a_weak_target_needs_an_answer_only_where_its_scan_needs_review(is_good: bool, tmp_path: Path) -> None:
    project, scans = stored(tmp_path)
    fiducial, *others, target = scans[1].frame.marks
    weak: dict[str, Any] = {"status": Status.WEAK, "reason": Reason("its contrast is low", Code.CONTRAST)}
    marks = (fiducial if is_good else replace(fiducial, **weak), *others, replace(target, **weak))
    frame = replace(scans[1].frame, marks=marks)
    digest = keep_scans(tmp_path / "out" / "measurement.db", [replace(scans[1], frame=frame)])
    pitches = {frame.image: scans[1].pitch_um}
    write_comparator(tmp_path / "comparator.csv", comparator_points([frame], pitches), pitches, digest)
    page = Session(read_project(project), "bob").page(Filters())
    assert {one["point"]: one["is_left"] for one in page["entries"]}[target.point] is not is_good
    assert (page["left"]["all"], page["optional"]) == ((0, 1) if is_good else (2, 0))


def test_frames_that_need_no_attention_are_counted_as_if_each_were_read(tmp_path: Path, monkeypatch: Any) -> None:
    project = read_project(stored(tmp_path)[0])
    every = load.report_data(project, lambda path: path)
    comparator = tmp_path / "comparator.csv"
    with stored_check_run(tmp_path / "out" / "measurement.db", read_measurement_hash(comparator)) as check_run:
        present(check_run).remember_written(comparator)  # as `reseau measure` says it at its end
    monkeypatch.setattr("pipeline.report.load.read_comparator", None)  # nobody reads all of it
    few = load.report_data(project, lambda path: path)
    of_few, of_every = present(few.totals), present(every.totals)
    marks = [{n: +Counter(c) for n, c in totals.marks.items()} for totals in (of_few, of_every)]
    assert marks[0] == marks[1]
    assert +Counter(of_few.of_targets) == +Counter(of_every.of_targets)
    assert (of_few.verdicts, of_few.problems) == (of_every.verdicts, of_every.problems)
    for axis in ("column", "row"):
        np.testing.assert_array_equal(of_few.places_px[axis], of_every.places_px[axis])
    assert set(few.measurement or {}) == set(every.measurement or {})


@pytest.fixture(scope="module")
def measured_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_project(tmp_path_factory.mktemp("thumbnails"), ["a", "b", "c"]).parent
    assert command("measure", folder / "project.toml") == 0
    return folder


@pytest.fixture
def folder(measured_folder: Path, tmp_path: Path) -> Path:
    shutil.copytree(measured_folder, tmp_path / "p")
    return tmp_path / "p"


def keys(folder: Path) -> dict[str, str]:
    digest = read_measurement_hash(folder / "comparator.csv")
    with stored_check_run(folder / "out" / "measurement.db", digest) as check_run:
        return present(check_run).fingerprints(("a", "b", "c", "none"))


def grey(pixels: np.ndarray) -> np.ndarray:
    """On one scale, whichever it had."""
    values = pixels.astype(float).ravel()
    return np.asarray((values - values.mean()) / values.std())


def test_every_mark_and_the_whole_scan_have_their_pictures(folder: Path) -> None:
    found = keys(folder)
    assert set(found) == {"a", "b", "c"}
    with ThumbnailDatabase(folder / "out" / "measurement.db") as database:
        for scan in read_measurement(folder / "out" / "measurement.db"):
            with open_scan(scan.scan) as opened:
                for mark in scan.frame.marks:
                    kept = present(database.get(found[scan.frame.image], mark.point, mark.kind))
                    own = present(cut(opened, mark))
                    assert (kept.origin_px, kept.step_px, kept.pixels.shape) == (
                        own.origin_px,
                        own.step_px,
                        own.pixels.shape,
                    )
                    assert grey(kept.pixels) @ grey(own.pixels) / own.pixels.size > 0.98
    with ThumbnailDatabase(folder / "out" / "measurement.db") as database:
        stored, key = database.get(keys(folder)["a"]), keys(folder)["a"]
        jpeg_bytes = database.first("select length(jpeg) from thumbnail where fingerprint = ? and kind = 'frame'", key)
    assert stored is not None
    pixels = tifffile.imread(folder / "a.tif").astype(float)
    step = round(stored.step_px)
    height, width = stored.pixels.shape
    assert abs(width * step - pixels.shape[1]) < 2 * step
    means = pixels[: height * step, : width * step].reshape(height, step, width, step).mean(axis=(1, 3))
    assert grey(means) @ grey(stored.pixels) / means.size > 0.95
    assert jpeg_bytes < 100_000


def test_a_report_and_a_frames_page_open_no_scan_unless_the_pictures_are_gone(folder: Path) -> None:
    page = folder / "out" / "frames" / "a.html"
    pictures = (folder / "out" / "thumbnails.db").rename(folder / "kept.db")
    assert command("report", folder / "project.toml", "--frames", "a") == 0
    assert page.read_text().count("data:image/png") == 4
    pictures.replace(folder / "out" / "thumbnails.db")
    for scan in folder.glob("*.tif"):  # the same size and time, and nothing in it
        stat = scan.stat()
        scan.write_bytes(bytes(stat.st_size))
        os.utime(scan, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    project = str(folder / "project.toml")
    assert command("report", project, "--frames", "a") == 0
    assert command("report", project) in (0, 1)
    assert page.read_text().count("data:image/png") == 4
    assert (folder / "out" / "report.html").read_text().count("data:image/png") == 12


def test_a_mark_that_was_measured_elsewhere_since_is_cut_anew(folder: Path) -> None:
    scans, path = read_measurement(folder / "out" / "measurement.db"), folder / "out" / "measurement.db"
    with Thumbnails(scans, None, path, keys(folder)) as kept:
        assert present(kept.get("a", "1", "fiducial")).pixels.dtype == np.uint8
    for mark in scans[0].frame.marks:
        np.add(center := present(mark.center_px), 60.0, out=center)
    with Thumbnails(scans, None, path, keys(folder)) as kept:
        assert present(kept.get("a", "1", "fiducial")).pixels.dtype == np.float32


def test_pictures_follow_results_that_are_moved_or_merged(folder: Path) -> None:
    project = str(folder / "project.toml")
    command("measure", project, "--moved", "--workers", "1")
    before = keys(folder)
    (folder / "a.tif").rename(folder / "aa.tif")
    command("measure", project, "--moved", "--workers", "1")
    with ResultsDatabase(folder / "out" / "measurement.db") as database:
        now = set(database.fingerprints()) - set(before.values())
    assert len(now) == 1
    with ThumbnailDatabase(folder / "out" / "measurement.db") as thumbnails:
        assert thumbnails.get(now.pop(), "1", "fiducial") is not None
        assert thumbnails.get(before["a"], "1", "fiducial") is None

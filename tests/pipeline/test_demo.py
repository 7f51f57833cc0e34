"""The whole chain on rendered film, against its truth: three frames of the demonstration, and by hand all of it."""

import json
import random
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from browser import browser_page, needs_browser
from demonstration import FRAMES
from playwright.sync_api import Browser, Page
from single_scans import measure_scan
from truth_comparison import compare_with_truth

from pipeline.cli import DONE, run
from pipeline.files.project_file import read_project
from pipeline.results.comparator_file import mark_rows, write_comparator


def assert_measured_right_and_calibrated_within_its_sigmas(folder: Path, frames: int) -> None:
    out = folder / "out"
    comparison = compare_with_truth(folder / "truth.json", out / "measurement.db", out / "adjustment.json")
    assert len(comparison.frames) == frames
    for frame in comparison.frames:
        assert frame.wrong == ()
        assert frame.pose == frame.true_pose
        assert frame.observed["fiducial"] == frame.visible["fiducial"] == 8
        assert frame.observed["target"] >= 0.98 * frame.visible["target"] - 1
    assert 0.85 < comparison.rms_error_over_sigma < 1.15
    assert comparison.worst_camera_sigmas < 3.0


def assert_agrees_with_opencv_and_reports(folder: Path, last: str) -> None:
    check = json.loads((folder / "out" / "check.json").read_text(encoding="utf-8"))
    assert check["verdict"] == "agrees"
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    HTMLParser().feed(page)
    assert last in page


def test_its_frames_are_measured_right_and_calibrated_within_their_sigmas(finished: tuple[Path, int]) -> None:
    folder, code = finished
    assert code == DONE
    assert_measured_right_and_calibrated_within_its_sigmas(folder, FRAMES)


def test_its_frames_agree_with_opencv_and_are_reported(finished: tuple[Path, int]) -> None:
    assert_agrees_with_opencv_and_reports(finished[0], f"frame{FRAMES}")


def assert_report_is_short(page: Page, folder: Path) -> None:
    """Without what is closed, at 1300 px: the limits that a reader has to get through."""
    page.goto((folder / "out" / "report.html").as_uri())
    assert page.evaluate("document.documentElement.scrollHeight") <= 6000
    assert len(page.inner_text("body").split()) <= 2500
    camera = page.locator("#camera").bounding_box()
    assert camera is not None
    assert camera["y"] < 300
    assert page.locator("#camera svg").count() == 2
    assert page.evaluate("document.documentElement.scrollWidth") <= 1300


@needs_browser
def test_its_report_is_short_and_begins_with_the_camera(browser: Browser, finished: tuple[Path, int]) -> None:
    with browser_page(browser) as page:
        assert_report_is_short(page, finished[0])
        page.goto((finished[0] / "out" / "report.html").as_uri() + "#frame-2")
        assert page.locator("#frame-2 .cards").is_visible()  # a link opens what it leads to


def test_its_summary_has_the_camera_first_and_at_most_40_lines(
    finished: tuple[Path, int], capsys: pytest.CaptureFixture[str]
) -> None:
    run(["report", str(finished[0] / "project.toml")])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    text = "\n".join(lines)
    assert lines[0].startswith("Calibrated from")
    assert 0 < text.index("c principal distance") < text.index("Frames, the worst first")


@pytest.mark.study
def test_the_order_of_points_csv_changes_no_digit(finished: tuple[Path, int], tmp_path: Path) -> None:
    shutil.copytree(finished[0], tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("out", "comparator.csv"))
    head, *rows = (tmp_path / "points.csv").read_text(encoding="utf-8").splitlines()
    random.Random(4).shuffle(rows)
    (tmp_path / "points.csv").write_text("\n".join([head, *rows]), encoding="utf-8")
    project = read_project(tmp_path / "project.toml")
    scan = measure_scan(project, "frame1")
    write_comparator(project.comparator, mark_rows([scan.frame]), {"frame1": scan.pitch_um})
    before = (finished[0] / "comparator.csv").read_text(encoding="utf-8").splitlines()
    shuffled = project.comparator.read_text(encoding="utf-8").splitlines()
    assert image_marks("frame1", shuffled) == image_marks("frame1", before)
    assert len(image_marks("frame1", before)) > 30


def image_marks(image: str, comparator: list[str]) -> list[str]:
    return [line for line in comparator if line.startswith(f"{image},")]


@pytest.mark.study
def test_the_demonstration_as_it_is_shown(browser: Browser, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All five frames, by the command that shows them."""
    assert run(["demo", str(tmp_path / "demo")]) == DONE
    assert_measured_right_and_calibrated_within_its_sigmas(tmp_path / "demo", 5)
    assert_agrees_with_opencv_and_reports(tmp_path / "demo", "frame5")
    assert len(capsys.readouterr().out.splitlines()) <= 40
    with browser_page(browser) as page:
        assert_report_is_short(page, tmp_path / "demo")

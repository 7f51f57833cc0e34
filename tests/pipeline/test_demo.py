"""The whole chain on rendered film, against its truth: three frames of the demonstration, and by hand all of it."""

import json
import random
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from demonstration import FRAMES
from single_scans import measure_scan

from pipeline.cli import DONE, run
from pipeline.files.project_file import read_project
from pipeline.rendered.against_truth import compare_with_truth
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
    assert marks_of("frame1", shuffled) == marks_of("frame1", before)
    assert len(marks_of("frame1", before)) > 40


def marks_of(image: str, comparator: list[str]) -> list[str]:
    return [line for line in comparator if line.startswith(f"{image},")]


@pytest.mark.study
def test_the_demonstration_as_it_is_shown(tmp_path: Path) -> None:
    """All five frames, by the command that shows them."""
    assert run(["demo", str(tmp_path / "demo")]) == DONE
    assert_measured_right_and_calibrated_within_its_sigmas(tmp_path / "demo", 5)
    assert_agrees_with_opencv_and_reports(tmp_path / "demo", "frame5")

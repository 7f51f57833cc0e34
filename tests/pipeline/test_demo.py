"""The whole chain on rendered film, against its truth."""

import json
from html.parser import HTMLParser
from pathlib import Path

import pytest

from pipeline.rendered.against_truth import compare_with_truth

pytestmark = pytest.mark.xdist_group("demonstration")  # one run of it serves all


def test_demo_is_measured_right_and_calibrated_within_its_sigmas(finished: tuple[Path, int]) -> None:
    folder, code = finished
    assert code == 0
    out = folder / "out"
    comparison = compare_with_truth(folder / "truth.json", out / "measurement.json", out / "adjustment.json")
    for frame in comparison.frames:
        assert frame.wrong == ()
        assert frame.pose == frame.true_pose
        assert frame.observed["fiducial"] == frame.visible["fiducial"] == 8
        assert frame.observed["target"] >= 0.98 * frame.visible["target"] - 1
    assert 0.85 < comparison.rms_error_over_sigma < 1.15
    assert comparison.worst_camera_sigmas < 3.0


def test_demo_agrees_with_opencv_and_reports(finished: tuple[Path, int]) -> None:
    folder, _ = finished
    check = json.loads((folder / "out" / "check.json").read_text(encoding="utf-8"))
    assert check["verdict"] == "agrees"
    page = (folder / "out" / "report.html").read_text(encoding="utf-8")
    HTMLParser().feed(page)
    assert "frame5" in page

"""A camera with a self-calibration set, from camera.toml to the report."""

import json
from pathlib import Path

import numpy as np
import pytest
from networks import LENSES, Truth, field_points, lens_network, simulated
from simulated_project import write_project
from studies import parametrize_with_studies

from pipeline.cli import DONE, LOOK, run

EBNER = {"b3": 0.02, "b5": -0.03, "b6": 0.015, "b7": 0.04, "b10": -0.02, "b11": 0.03}


@pytest.mark.study
def test_ebners_set_from_the_camera_file_to_the_report(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    free = {f"b{i}": np.inf for i in range(3, 13)}
    truth = Truth(family="ebner", distortion=dict.fromkeys(free, 0.0) | EBNER)
    network, _ = simulated(rng, truth, points=field_points(rng, 40), free=free)
    project = write_project(network, tmp_path)
    assert run(["run", str(project)]) in (DONE, LOOK)
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    distortion = result["cameras"]["K"]["distortion"]
    assert (distortion["family"], distortion["half_mm"]) == ("ebner", [114.0, 114.0])
    assert 0.8 < result["sigma0"] < 1.2
    for name, value in truth.distortion.items():
        assert abs(distortion[name]["value"] - value) < 4.0 * distortion[name]["sigma"], name
    check = json.loads((tmp_path / "out" / "check.json").read_text(encoding="utf-8"))
    assert check["verdict"] == "not possible"
    assert check["reason"] == "OpenCV has no counterpart of the distortion family ebner."
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Distortion vectors over the camera frame" in page
    assert "Distortion over the radius with its 95 % band" in page
    assert "effect in the frame (µm)" in page


@parametrize_with_studies("name", list(LENSES), quick=(2,))
def test_a_lens_from_the_camera_file_to_the_report(name: str, tmp_path: Path) -> None:
    """Noisy images, nothing known of the lens; what OpenCV can and cannot compare is said."""
    project = write_project(lens_network(name, np.random.default_rng(4)), tmp_path)
    assert run(["run", str(project)]) in (DONE, LOOK)
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    distortion = result["cameras"]["L"]["distortion"]
    assert (distortion["family"], distortion["r0_mm"]) == (name, 13.0)
    assert ("axes" in distortion) == name.startswith("opencv")
    assert 0.8 < result["sigma0"] < 1.2
    for each, value in LENSES[name][1].items():
        assert abs(distortion[each]["value"] - value) < 4.0 * distortion[each]["sigma"], each
    check = json.loads((tmp_path / "out" / "check.json").read_text(encoding="utf-8"))["cameras"]["L"]
    # A skew is none of cv2.calibrateCamera's models; cv2.fisheye has one.
    assert check["verdict"] == ("agrees" if name == "opencv_fisheye" else "not possible"), check["reason"]
    assert ("OpenCV's model cannot take this lens" in check["reason"]) == (name != "opencv_fisheye")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert ("refer to its axes, x right and y down" in page) == name.startswith("opencv")
    assert "Distortion over the radius with its 95 % band" in page

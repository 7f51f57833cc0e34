"""Data snooping, weight functions and variance components through files: keys, result, verdict, report."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import field_points, simulated
from reference_cases import CASES
from simulated_project import write_project as write_network
from studies import parametrize_with_studies
from test_cases import write_project

from adjust.problem.parameter import Parameter
from pipeline.cli import run
from pipeline.errors import InputError
from pipeline.files.project_file import read_project
from pipeline.results.covariance_file import read_own_covariance

CASE = "i_five_images_affine_reduced"
POINT = "7"


def spoilt_project(folder: Path, adjust: str) -> Path:
    """The reference network with one target wrong by 0.1 mm."""
    case: dict[str, Any] = json.loads((CASES / f"{CASE}.json").read_text(encoding="utf-8"))
    row = next(row for row in case["input"]["obs"] if str(row[1]) == POINT)
    row[2] += 0.1
    write_project(case, folder)
    file = folder / "project.toml"
    file.write_text(file.read_text(encoding="utf-8") + adjust + "\n", encoding="utf-8")
    return file


@parametrize_with_studies(
    ("adjust", "removed"),
    [("", False), ("snooping = true\nvariance_components = true", True), ('robust = "igg3"', True)],
)
def test_a_gross_error_is_named_in_file_and_report(adjust: str, removed: bool, tmp_path: Path) -> None:
    project = spoilt_project(tmp_path, adjust)
    assert run(["adjust", str(project)]) == 1
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    (suspect,) = result["suspects"]
    name = f"target {POINT} in image {suspect['owner']}"
    assert (suspect["name"], suspect["removed"]) == (name, removed)
    assert suspect["error"][0] == pytest.approx(0.1, abs=0.02)
    row = next(row for row in result["residuals"] if (row["image"], row["point"]) == (suspect["owner"], POINT))
    assert (row["weight"] < 1e-9) is removed
    assert row["smallest_error_x_um"] > 0.0
    outer = {each["parameter"]: each for each in result["reliability"]["outer"]}
    assert outer["IO.C.c"]["cause"]
    given = {each["name"]: each for each in result["reliability"]["given"]}
    assert given["given fiducial 3 x (camera C)"]["smallest_error"] > 0.0
    assert run(["report", str(project)]) == 1
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"{'Left out as gross errors' if removed else '1 gross error suspected'}: {name} (w = " in report
    assert "of an undetected error in" in report
    if "variance" in adjust:
        assert result["variance_sigmas"].keys() == {"target", "fiducial"}
        assert "Variance components: what the variances" in report


@pytest.mark.study
@pytest.mark.parametrize("adjust", ["", "snooping = true\n"])
def test_a_control_point_with_exchanged_coordinates_is_named(adjust: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    network, _ = simulated(rng, points=field_points(rng, 15), fiducial_sigma=0.01, point_sigma=0.05)
    project = write_network(network, tmp_path)
    project.write_text(project.read_text(encoding="utf-8") + adjust, encoding="utf-8")
    file = tmp_path / "points.csv"
    lines = file.read_text(encoding="utf-8").splitlines()
    name, x, y, *rest = lines[1].split(",")
    file.write_text("\n".join([lines[0], ",".join([name, y, x, *rest]), *lines[2:]]) + "\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == 1
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    left_out = {suspect["name"] for suspect in result["suspects"] if suspect["removed"]}
    if adjust:
        assert left_out == {f"control point {name} X", f"control point {name} Y"}
        assert result["sigma0"] < 1.2
    else:
        assert left_out == set()
        assert result["warnings"][0].startswith(f"Control point {name} is not where it is given")
        assert "X and Y look exchanged." in result["warnings"][0]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('robust = "tukey"', "possible are"),
        ('variance_components = ["targets"]', "names 'targets'; possible are target, tie, fiducial"),
        ("robust = true\nsnooping = true", "Set one of the two to false"),
    ],
)
def test_wrong_keys_are_reported(line: str, words: str, tmp_path: Path) -> None:
    project = spoilt_project(tmp_path, line)
    with pytest.raises(InputError, match=words):
        read_project(project)


@pytest.mark.study
def test_an_image_without_orientation_is_left_out_and_named(tmp_path: Path) -> None:
    """The targets of one of four frames have one another's numbers: the other three are adjusted."""
    network, _ = simulated(np.random.default_rng(1), points=field_points(np.random.default_rng(2), 15))
    observed = network.observations
    rows = [
        i
        for i, (image, kind) in enumerate(zip(observed.image, observed.kind, strict=True))
        if (image, kind) == ("f2", "target")
    ]
    points = list(observed.point)
    for row, other in zip(rows, np.random.default_rng(4).permutation(rows).tolist(), strict=True):
        points[row] = observed.point[other]
    project = write_network(replace(network, observations=replace(observed, point=tuple(points))), tmp_path)
    assert run(["adjust", str(project)]) == 1
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    assert result["converged"]
    assert sorted(result["images"]) == ["f0", "f1", "f3"]
    assert result["left_out"]["f2"].startswith("image f2 sees 15 known points, but no orientation")
    assert any(warning.startswith("Left out of the adjustment: image f2") for warning in result["warnings"])
    assert run(["check", str(project)]) in (0, 1)
    assert run(["report", str(project)]) == 1
    assert "Left out of the adjustment: image f2" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@parametrize_with_studies(("frame_mm", "level"), [(228.0, 0), (600.0, 1)])
def test_a_lens_known_in_the_middle_alone_needs_attention(frame_mm: float, level: int, tmp_path: Path) -> None:
    """Targets within some 110 mm of the principal point: most of a picture of 228 mm, a quarter of one of 600 mm."""
    free = {"k3": np.inf, "k5": np.inf}
    network, _ = simulated(np.random.default_rng(1), points=field_points(np.random.default_rng(2), 40), free=free)
    project = write_network(network, tmp_path)
    camera = tmp_path / "camera.toml"
    camera.write_text(camera.read_text(encoding="utf-8").replace("228.0", str(frame_mm)), encoding="utf-8")
    assert run(["adjust", str(project)]) == level
    known = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))["cameras"]["K"]["lens_known"]
    assert (known["share"] < 0.5) is bool(level)
    assert known["corner_sigma_um"] > known["sigma_um"] > 0.0
    # By dr = k3 r³ + k5 r⁵ and the covariance that stands in adjustment.npz.
    covariance = read_own_covariance(tmp_path / "out" / "adjustment.json")
    of_terms = covariance.select([Parameter.interior("K", each) for each in ("k3", "k5")])
    for radius, sigma in (("radius_mm", "sigma_um"), ("corner_mm", "corner_sigma_um")):
        by_terms = 1e3 * known[radius] ** np.array([3.0, 5.0])
        assert known[sigma] == pytest.approx(float(np.sqrt(by_terms @ of_terms @ by_terms)), rel=1e-6)
    assert run(["report", str(project)]) in (0, level)
    assert "of the way to the corner of the picture" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_points_that_no_image_shows_are_a_note_and_an_unknown_one_in_one_image_is_named(tmp_path: Path) -> None:
    """A pattern is often larger than what the images show; one ray does not locate a point."""
    network, _ = simulated(np.random.default_rng(1), points=field_points(np.random.default_rng(2), 40))
    project = write_network(network, tmp_path)
    points, marks = tmp_path / "points.csv", tmp_path / "comparator.csv"
    points.write_text(points.read_text(encoding="utf-8") + "u1,5,5,0,0,0,0\nu2,6,6,0,0,0,0\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == 0
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    assert [note for note in result["notes"] if "measured in no image: 2 points, u1, u2" in note]
    points.write_text(points.read_text(encoding="utf-8") + "single,,,,,,\n", encoding="utf-8")
    marks.write_text(marks.read_text(encoding="utf-8") + "f2,single,target,10,10,0.005,0.005\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == 1
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    (warning,) = [warning for warning in result["warnings"] if "single" in warning]
    assert "measured in one image only, and so left out: single (f2). Two images are needed" in warning
    assert not any("single" in note for note in result["notes"])

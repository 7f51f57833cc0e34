"""Frames of fiducial marks alone, the form of their fiducials; snooping, robust weights and components by files."""

import re
from pathlib import Path

import numpy as np
import pytest
from networks import field_points, simulated
from projects import Capture, Printed, command, fiducial_tables, result_file, write_tables
from projects import write_network_project as write_network
from reference_cases import load
from studies import parametrize_with_studies
from test_adjust_stage import write_project

from adjust import Parameter
from pipeline.results.adjustment_file import read_own_covariance

GIVEN = {"1": (-106.0, 106.0), "2": (106.0, 106.0), "3": (106.0, -106.0), "4": (-106.0, -106.0), "5": (0.0, 112.0)}
AFFINE = np.array([[1.001, 0.02], [-0.021, 0.999]])
SHIFT = np.array([-118.0, 121.0])
SIGMA_MM = 0.004


def comparator_mm(seed: int, count: int = 5) -> np.ndarray:
    camera = np.array(list(GIVEN.values()))[:count]
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_MM, camera.shape)
    return np.linalg.solve(AFFINE, (camera - SHIFT).T).T + noise


def write_fiducials_project(
    folder: Path, marks: dict[str, int], camera: str = "", extra: tuple[str, ...] = (), sigma_mm: float = 0.0
) -> Path:
    """Frames by name with so many fiducials each, of which the camera knows that much, and further marks' lines."""
    text = f'name = "K"\n{camera}\n' + fiducial_tables(GIVEN, f"sigma_mm = {sigma_mm}\n")
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm", *extra]
    for seed, (image, count) in enumerate(marks.items()):
        for id_, (x, y) in zip(GIVEN, comparator_mm(seed, count).tolist(), strict=False):
            rows.append(f"{image},{id_},fiducial,{x!r},{y!r},{SIGMA_MM},{SIGMA_MM}")
    return write_tables(folder, 'camera = "camera.toml"', camera=text, comparator=rows)


def test_film_transformations_without_an_object(tmp_path: Path, printed_line: Printed) -> None:
    """Against the linear least-squares fit, values and standard deviations; no orientation, no calibration."""
    project = write_fiducials_project(tmp_path, {"a": 5, "b": 5, "c": 3})
    text = printed_line("run", project)
    assert "Film transformations from 13 marks in 3 frames; no frame is oriented, and no camera calibrated" in text
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert report.count("No exterior orientation") == 3
    assert "Exterior orientation</caption>" not in report
    assert "Film report</p>" in report
    assert "Calibration report" not in report
    assert command("report", project) == 0  # and it may be written over
    result = result_file(tmp_path)
    assert result["converged"]
    assert (result["unknowns"], result["redundancy"]) == (18, 8)
    for seed, image in enumerate(("a", "b")):
        xy, camera = comparator_mm(seed), np.array(list(GIVEN.values()))
        design = np.column_stack([np.ones(5), xy])
        fitted = np.linalg.lstsq(design, camera)[0]
        cofactor = np.linalg.inv(design.T @ design) * (SIGMA_MM * result["sigma0"]) ** 2
        for axis, letter in enumerate("ab"):
            for k in range(3):
                found = result["images"][image]["transformation"][f"{letter}{k + 1}"]
                sigma = float(np.sqrt(cofactor[k, k]))
                assert found["value"] == pytest.approx(fitted[k, axis], abs=0.01 * sigma)
                assert found["sigma"] == pytest.approx(sigma, rel=0.01)
        assert {(one["value"], one["sigma"]) for one in result["images"][image]["exterior"].values()} == {(None, None)}
    camera = result["cameras"]["K"]
    assert camera["principal_distance_mm"] == {"value": None, "sigma": None}
    assert camera["principal_point_mm"]["x"]["sigma"] is None


def test_a_frame_without_enough_targets_keeps_its_film_transformation(tmp_path: Path) -> None:
    target = ("a,t1,target,100.0,90.0,0.004,0.004",)
    project = write_fiducials_project(tmp_path, {"a": 5, "b": 2}, "principal_distance_mm = 153.0", target)
    (tmp_path / "points.csv").write_text("point,X,Y,Z\nt1,0,0,0\n", encoding="utf-8")
    project.write_text('camera = "camera.toml"\n[object]\npoints = "points.csv"\n', encoding="utf-8")
    assert command("adjust", project) == 1
    result = result_file(tmp_path)
    assert list(result["images"]) == ["a"]
    assert {row["kind"] for row in result["residuals"]} == {"fiducial"}
    warnings = " ".join(result["warnings"])
    assert "Image 'a' is not oriented: it shows 1 targets and needs 3." in warnings
    assert "Image 'b' has no part in the adjustment" in warnings
    assert result["cameras"]["K"]["principal_distance_mm"]["value"] == 153.0
    assert result["cameras"]["K"]["principal_distance_mm"]["sigma"] is None


def test_the_film_transformation_can_be_chosen(tmp_path: Path, printed_line: Printed) -> None:
    """No lens to choose, but the kind of film: these marks have two scales that differ by 0.2 %."""
    assert "Selected: affine, no distortion" in printed_line(
        "choose", write_fiducials_project(tmp_path, {"a": 5, "b": 5})
    )


def test_the_form_of_the_fiducials_is_reported_where_they_are_estimated(tmp_path: Path, printed_line: Printed) -> None:
    """Marks with a datum of 1 mm: no figure of mm is left in the form, and the dashes are gone."""
    project = write_fiducials_project(tmp_path, {f"f{i}": 5 for i in range(60)}, sigma_mm=1.0)
    text = printed_line("run", project)
    assert re.search(r"K: Corrections to the certificate, after a common affine transformation: \d\.\d µm rms", text)
    assert "the worst first (8 of 60)" in text
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    form = report[report.index('<section id="fiducials">') : report.index('<section id="reliability">')]
    row = r"<td>\d</td>\s*<td[^>]*>[+−][\d.]+</td><td[^>]*>([\d.]+)</td><td[^>]*>[+−][\d.]+</td><td[^>]*>([\d.]+)</td>"
    sigmas_um = [float(text) for pair in re.findall(row, form) for text in pair]
    assert len(sigmas_um) == 10
    assert 0.05 < max(sigmas_um) < 1e3 * SIGMA_MM / np.sqrt(60)
    assert "Distances" not in form


def test_a_single_frame_with_a_mere_datum_has_a_priori_sigmas(tmp_path: Path, capsys: Capture) -> None:
    """sigma0 was 0.003 here, and multiplied the datum's 1 mm: now the shift is known to 1 mm over the root of 5."""
    project = write_fiducials_project(tmp_path, {"a": 5}, sigma_mm=1.0)
    command("adjust", project)
    printed = " ".join(capsys.readouterr().out.split())
    assert "standard deviations a priori" in printed
    result = result_file(tmp_path)
    assert result["sigma0_from"] == {"redundancy": 0.0, "a_priori": True, "left_out": []}
    design = np.column_stack([np.ones(5), comparator_mm(0)])
    sigma = np.sqrt(np.linalg.inv(design.T @ design)[0, 0] * (1.0 + SIGMA_MM**2))
    assert result["images"]["a"]["transformation"]["a1"]["sigma"] == pytest.approx(sigma, rel=1e-3)


def test_one_frame_within_its_certificate_needs_no_attention(tmp_path: Path) -> None:
    """Four calibrated fiducials of one frame, given to 10 µm and measured to 4 µm: nothing speaks against any."""
    project = write_fiducials_project(tmp_path, {"a": 4}, sigma_mm=0.01)
    assert command("run", project) == 0
    rows = (tmp_path / "comparator.csv").read_text(encoding="utf-8").splitlines()
    name, id_, kind, x, *rest = rows[1].split(",")
    wrong = ",".join((name, id_, kind, str(float(x) + 0.4), *rest))  # 0.2 mm and more at each mark of an affine fit
    (tmp_path / "comparator.csv").write_text("\n".join([rows[0], wrong, *rows[2:]]) + "\n", encoding="utf-8")
    assert command("run", project) == 1


POINT = "7"


def spoilt_project(folder: Path, adjust: str) -> Path:
    """The reference network with one target wrong by 0.1 mm."""
    case = load("i_five_images_affine_reduced")
    row = next(row for row in case["input"]["obs"] if str(row[1]) == POINT)
    row[2] += 0.1
    file = write_project(case, folder)
    file.write_text(file.read_text(encoding="utf-8") + adjust + "\n", encoding="utf-8")
    return file


@parametrize_with_studies(
    ("adjust", "removed"),
    [("", False), ("snooping = true\nvariance_components = true", True), ('robust = "igg3"', True)],
)
def test_a_gross_error_is_named_in_file_and_report(adjust: str, removed: bool, tmp_path: Path) -> None:
    project = spoilt_project(tmp_path, adjust)
    assert command("adjust", project) == 1
    result = result_file(tmp_path)
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
    assert command("report", project) == 1
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert f"{'Left out as gross errors' if removed else '1 gross error suspected'}: {name} (w = " in report
    assert "of an undetected error in" in report
    if "variance" in adjust:
        assert result["variance_sigmas"].keys() == {"target", "fiducial"}
        assert "Variance components: factors of the variances" in report


@parametrize_with_studies(("frame_mm", "level"), [(228.0, 0), (600.0, 1)])
def test_a_lens_known_in_the_middle_alone_needs_attention(frame_mm: float, level: int, tmp_path: Path) -> None:
    """Targets within some 110 mm of the principal point: most of a picture of 228 mm, a quarter of one of 600 mm."""
    free = {"k3": np.inf, "k5": np.inf}
    network, _ = simulated(np.random.default_rng(1), points=field_points(np.random.default_rng(2), 40), free=free)
    project = write_network(network, tmp_path, f"frame_mm = [{frame_mm}, {frame_mm}]")
    assert command("adjust", project) == level
    known = result_file(tmp_path)["cameras"]["K"]["lens_known"]
    assert (known["share"] < 0.5) is bool(level)
    assert known["corner_sigma_um"] > known["sigma_um"] > 0.0
    # By dr = k3 r³ + k5 r⁵ and the covariance that stands in adjustment.npz.
    covariance = read_own_covariance(tmp_path / "out" / "adjustment.json")
    of_terms = covariance.select([Parameter.interior("K", each) for each in ("k3", "k5")])
    for radius, sigma in (("radius_mm", "sigma_um"), ("corner_mm", "corner_sigma_um")):
        by_terms = 1e3 * known[radius] ** np.array([3.0, 5.0])
        assert known[sigma] == pytest.approx(float(np.sqrt(by_terms @ of_terms @ by_terms)), rel=1e-6)
    assert command("report", project) in (0, level)
    assert "of the way to the corner of the picture" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_points_that_no_image_shows_are_a_note_and_an_unknown_one_in_one_image_is_named(tmp_path: Path) -> None:
    """A pattern is often larger than what the images show; one ray does not locate a point."""
    network, _ = simulated(np.random.default_rng(1), points=field_points(np.random.default_rng(2), 40))
    project = write_network(network, tmp_path)
    points, marks = tmp_path / "points.csv", tmp_path / "comparator.csv"
    points.write_text(points.read_text(encoding="utf-8") + "u1,5,5,0,0,0,0\nu2,6,6,0,0,0,0\n", encoding="utf-8")
    assert command("adjust", project) == 0
    result = result_file(tmp_path)
    assert [note for note in result["notes"] if "measured in no image: 2 points, u1, u2" in note]
    points.write_text(points.read_text(encoding="utf-8") + "single,,,,,,\n", encoding="utf-8")
    marks.write_text(marks.read_text(encoding="utf-8") + "f2,single,target,10,10,0.005,0.005\n", encoding="utf-8")
    assert command("adjust", project) == 1
    result = result_file(tmp_path)
    (warning,) = [warning for warning in result["warnings"] if "single" in warning]
    assert "measured in one image only, and so left out: single (f2). Two images are needed" in warning
    assert not any("single" in note for note in result["notes"])

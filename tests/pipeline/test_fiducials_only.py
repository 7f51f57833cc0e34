"""Frames that show fiducial marks alone: their film transformations are adjusted, and nothing else is claimed."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.cli import run

GIVEN = {"1": (-106.0, 106.0), "2": (106.0, 106.0), "3": (106.0, -106.0), "4": (-106.0, -106.0), "5": (0.0, 112.0)}
AFFINE = np.array([[1.001, 0.02], [-0.021, 0.999]])
SHIFT = np.array([-118.0, 121.0])
SIGMA_MM = 0.004


def comparator_mm(seed: int, count: int = 5) -> np.ndarray:
    camera = np.array(list(GIVEN.values()))[:count]
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_MM, camera.shape)
    return np.linalg.solve(AFFINE, (camera - SHIFT).T).T + noise


def write_project(folder: Path, marks: dict[str, int], camera: str = "", extra: tuple[str, ...] = ()) -> Path:
    """Frames by name with so many fiducials each, and further lines of comparator.csv."""
    lines = ['name = "K"', camera]
    for id_, (x, y) in GIVEN.items():
        lines += ["[[fiducial]]", f'id = "{id_}"', f"xy_mm = [{x}, {y}]", "sigma_mm = 0"]
    (folder / "camera.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm", *extra]
    for seed, (image, count) in enumerate(marks.items()):
        for id_, (x, y) in zip(GIVEN, comparator_mm(seed, count).tolist(), strict=False):
            rows.append(f"{image},{id_},fiducial,{x!r},{y!r},{SIGMA_MM},{SIGMA_MM}")
    (folder / "comparator.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "project.toml").write_text('camera = "camera.toml"\n', encoding="utf-8")
    return folder / "project.toml"


def read_result(project: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((project.parent / "out" / "adjustment.json").read_text(encoding="utf-8"))
    return content


def test_film_transformations_without_an_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Against the linear least-squares fit, values and standard deviations; no orientation, no calibration."""
    project = write_project(tmp_path, {"a": 5, "b": 5, "c": 3})
    assert run(["run", str(project)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Film transformations from 13 marks in 3 frames; no frame is oriented, and no camera calibrated" in printed
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert report.count("No exterior orientation") == 3
    assert "Exterior orientation</caption>" not in report
    assert "Film report</p>" in report
    assert not any(
        word in report for word in ("OpenCV</h2>", "Calibration report", "Distortion</h2>", "Parameters</h2>")
    )
    assert run(["report", str(project)]) == 0  # and it may be written over
    result = read_result(project)
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
        assert {(each["value"], each["sigma"]) for each in result["images"][image]["exterior"].values()} == {
            (None, None)
        }
    camera = result["cameras"]["K"]
    assert camera["principal_distance_mm"] == {"value": None, "sigma": None}
    assert camera["principal_point_mm"]["x"]["sigma"] is None


def test_a_frame_without_enough_targets_keeps_its_film_transformation(tmp_path: Path) -> None:
    project = write_project(
        tmp_path,
        {"a": 5, "b": 2},
        "principal_distance_mm = 153.0",
        ("a,t1,target,100.0,90.0,0.004,0.004",),
    )
    (tmp_path / "points.csv").write_text("point,X,Y,Z\nt1,0,0,0\n", encoding="utf-8")
    project.write_text('camera = "camera.toml"\n[object]\npoints = "points.csv"\n', encoding="utf-8")
    assert run(["adjust", str(project)]) == 1
    result = read_result(project)
    assert list(result["images"]) == ["a"]
    assert {row["kind"] for row in result["residuals"]} == {"fiducial"}
    warnings = " ".join(result["warnings"])
    assert "Image 'a' is not oriented: it shows 1 targets and needs 3." in warnings
    assert "Image 'b' has no part in the adjustment" in warnings
    assert result["cameras"]["K"]["principal_distance_mm"]["value"] == 153.0
    assert result["cameras"]["K"]["principal_distance_mm"]["sigma"] is None


def test_too_few_fiducials_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["adjust", str(write_project(tmp_path, {"a": 2}))]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "'a' shows the most fiducials, 2, and its affine transformation needs 3" in message


def test_the_film_transformation_can_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No lens to choose, but the kind of film: these marks have two scales that differ by 0.2 %."""
    assert run(["choose", str(write_project(tmp_path, {"a": 5, "b": 5}))]) == 0
    assert "The data ask for affine, no distortion" in " ".join(capsys.readouterr().out.split())


def test_the_form_of_the_fiducials_is_reported_where_they_are_estimated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Marks with a datum of 1 mm: no figure of mm is left in the form, and the dashes are gone."""
    project = write_project(tmp_path, {f"f{i}": 5 for i in range(60)})
    camera = tmp_path / "camera.toml"
    camera.write_text(camera.read_text(encoding="utf-8").replace("sigma_mm = 0\n", "sigma_mm = 1\n"), encoding="utf-8")
    assert run(["run", str(project)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert re.search(r"K: Corrections to the certificate, after a common affine transformation: \d\.\d µm rms", printed)
    assert "the worst first (8 of 60)" in printed
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    form = report[report.index('<section id="fiducials">') : report.index('<section id="reliability">')]
    row = r"<td>\d</td>\s*<td[^>]*>[+−][\d.]+</td><td[^>]*>([\d.]+)</td><td[^>]*>[+−][\d.]+</td><td[^>]*>([\d.]+)</td>"
    sigmas_um = [float(text) for pair in re.findall(row, form) for text in pair]
    assert len(sigmas_um) == 10
    assert 0.05 < max(sigmas_um) < 1e3 * SIGMA_MM / np.sqrt(60)
    assert "Distances" not in form


@pytest.mark.parametrize(
    ("source", "given_by"),
    [
        ("", "the certificate"),
        ('[source]\ntext = "reports"\nreports = 3\n', "the library's typical coordinates"),
        ('[source]\ntext = "adjusted"\nframes = 3\n', "the camera file"),
    ],
)
def test_corrections_are_to_what_the_camera_file_rests_on(
    source: str, given_by: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = write_project(tmp_path, {"a": 5, "b": 5})
    camera = tmp_path / "camera.toml"
    text = camera.read_text(encoding="utf-8").replace("sigma_mm = 0\n", "sigma_mm = 0.01\n")
    camera.write_text(f"{text}{source}", encoding="utf-8")
    run(["run", str(project)])
    assert f"Corrections to {given_by}, after a common" in " ".join(capsys.readouterr().out.split())


def test_a_single_frame_with_a_mere_datum_has_a_priori_sigmas(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """sigma0 was 0.003 here, and multiplied the datum's 1 mm: now the shift is known to 1 mm over the root of 5."""
    project = write_project(tmp_path, {"a": 5})
    camera = tmp_path / "camera.toml"
    camera.write_text(camera.read_text(encoding="utf-8").replace("sigma_mm = 0\n", "sigma_mm = 1\n"), encoding="utf-8")
    run(["adjust", str(project)])
    printed = " ".join(capsys.readouterr().out.split())
    assert "standard deviations a priori" in printed
    result = read_result(project)
    assert result["sigma0_from"] == {"redundancy": 0.0, "a_priori": True, "left_out": []}
    design = np.column_stack([np.ones(5), comparator_mm(0)])
    sigma = np.sqrt(np.linalg.inv(design.T @ design)[0, 0] * (1.0 + SIGMA_MM**2))
    assert result["images"]["a"]["transformation"]["a1"]["sigma"] == pytest.approx(sigma, rel=1e-3)


def test_one_frame_within_its_certificate_needs_no_attention(tmp_path: Path) -> None:
    """Four calibrated fiducials of one frame, given to 10 µm and measured to 4 µm: nothing speaks against any."""
    project = write_project(tmp_path, {"a": 4})
    camera = tmp_path / "camera.toml"
    camera.write_text(camera.read_text(encoding="utf-8").replace("sigma_mm = 0", "sigma_mm = 0.01"), encoding="utf-8")
    assert run(["run", str(project)]) == 0
    rows = (tmp_path / "comparator.csv").read_text(encoding="utf-8").splitlines()
    name, id_, kind, x, *rest = rows[1].split(",")
    wrong = ",".join((name, id_, kind, str(float(x) + 0.4), *rest))  # 0.2 mm and more at each mark of an affine fit
    (tmp_path / "comparator.csv").write_text("\n".join([rows[0], wrong, *rows[2:]]) + "\n", encoding="utf-8")
    assert run(["run", str(project)]) == 1

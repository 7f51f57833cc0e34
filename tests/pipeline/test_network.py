"""The network that is adjusted, from the user's files; the choice of its model."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import BOARD_FRAME_MM, BOARD_TRUTH, Truth, board_network, field_points, film_parameters, simulated
from projects import Capture, Refusal, result_file, write_network_project, write_tables
from studies import parametrize_with_studies
from test_bent_boards import BENDS_MM, bent_board, make_network

from adjust import Adjustment, Distortion, Parameter, Prior
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.network import Transformation
from pipeline import InputError, build_network, read_comparator, read_project
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.cli import DONE, LOOK, run


@pytest.mark.parametrize("film_um", [0.0, 7.0])
def test_film_is_added_to_the_covariance_of_every_mark(film_um: float, tmp_path: Path) -> None:
    network, _ = simulated(np.random.default_rng(1))
    path = write_network_project(network, tmp_path)
    path.write_text(path.read_text(encoding="utf-8") + f"film_sigma_um = {film_um}\n", encoding="utf-8")
    project = read_project(path)
    built, left_out = build_network(project, read_comparator(project.comparator))
    assert not left_out
    expected = network.observations.covariance_mm2 + np.eye(2) * (film_um / 1000) ** 2
    np.testing.assert_allclose(built.observations.covariance_mm2, expected, rtol=1e-9)


def test_one_frame_with_too_few_fiducials_does_not_end_the_others(tmp_path: Path) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = read_project(write_network_project(network, tmp_path))
    marks = read_comparator(project.comparator)
    few = [mark for mark in marks if mark.kind != "fiducial" or mark.image != "f1" or mark.point in "12"]
    built, (left_out,) = build_network(project, few)
    assert left_out.startswith("Image 'f1' has no part in the adjustment: it shows 2 fiducial marks, and its affine ")
    assert [image.name for image in built.images] == ["f0", "f2", "f3"]
    assert set(built.observations.image) == {"f0", "f2", "f3"}
    assert build_network(project, [mark for mark in marks if mark.kind != "fiducial"])[1] == ()


DRAWN_MM = 0.005  # of a pixel, as the pictures were projected


def written(folder: Path, camera: str = "", project: str = "") -> Path:
    network = board_network(np.random.default_rng(2), 6, 1e-4)
    marks = network.observations
    pixels = marks.xy_mm / DRAWN_MM * [1.0, -1.0]
    lines = [
        f"{image},{point},{col:.5f},{row:.5f}"
        for image, point, (col, row) in zip(marks.image, marks.point, pixels, strict=True)
    ]
    given = [f"b{number},{25 * (number % 9)},{25 * (number // 9)},0,0,0,0" for number in range(54)]
    lens = '[distortion]\nfamily = "opencv"\n[distortion.sigma]\nk1 = "free"\nk2 = "free"'
    return write_tables(
        folder,
        f'camera = "camera.toml"\n{project}[object]\npoints = "points.csv"\nunit = "mm"',
        camera=f'name = "desk"\n{camera}{lens}',
        points=["point,X,Y,Z,sX,sY,sZ", *given],
        comparator=["image,point,col_px,row_px", *lines],
    )


def adjust_network(path: Path) -> Adjustment:
    project = read_project(path)
    return adjust_marks(project, read_comparator(project.comparator, project.list_pitch_um))


@pytest.mark.parametrize(("line", "pitch_mm"), [("", 0.005), ("pitch_um = 8.0\n", 0.008)])
def test_a_digital_camera_comes_from_pixels_alone(tmp_path: Path, line: str, pitch_mm: float) -> None:
    result = adjust_network(written(tmp_path, project=line))
    for name in ("c", "x0", "y0"):
        key = Parameter.interior("desk", name)
        assert abs(result.value(key) / pitch_mm - BOARD_TRUTH[name] / DRAWN_MM) < 4.0 * result.sigma(key) / pitch_mm
    assert any("5 µm are assumed" in note for note in result.unused) == (not line)


def test_a_camera_file_in_mm_needs_the_size_of_a_pixel(tmp_path: Path) -> None:
    path = written(tmp_path, camera=f"frame_mm = [{BOARD_FRAME_MM[0]}, {BOARD_FRAME_MM[1]}]\n")
    with pytest.raises(InputError, match="Set pitch_um in"):
        adjust_network(path)


def make_project(folder: Path, bend: str) -> Path:
    network = make_network(np.random.default_rng(5))
    given = {"principal_distance_mm": Prior(20.5, np.inf), "x0_mm": Prior(0.0, np.inf), "y0_mm": Prior(0.0, np.inf)}
    network = replace(network, cameras=(replace(network.cameras[0], **given),))  # type: ignore[arg-type]
    project = write_network_project(network, folder)
    text = project.read_text(encoding="utf-8").replace("[object]\n", f'[object]\nunit = "mm"\nboard_bend = {bend}\n')
    project.write_text(text, encoding="utf-8")
    return project


def test_a_bent_board_from_the_project_file_to_the_report(tmp_path: Path) -> None:
    """Its bends within four sigmas, its points where they are and not on the plane, OpenCV in agreement there."""
    assert run(["run", str(make_project(tmp_path, '"free"'))]) in (DONE, LOOK)
    result = result_file(tmp_path)
    board = result["boards"]["board"]
    assert board["points"] == 70
    for name, value in zip(("bend_x", "bend_y"), BENDS_MM, strict=True):
        assert abs(board[name]["value"] - value) < 4.0 * board[name]["sigma"]
        assert board[name]["p"] < 1e-6
    middle = result["points"]["p34"]["Z"]
    assert middle["sigma"] > 0.0
    assert abs(middle["value"] - bent_board()[34, 2]) < 4.0 * middle["sigma"]
    assert result["points"]["p0"]["Z"]["sigma"] == 0.0
    check = json.loads((tmp_path / "out" / "check.json").read_text(encoding="utf-8"))
    assert check["verdict"] == "agrees"
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "The board of 70 points is bent" in page


def test_points_that_are_no_board_are_reported(tmp_path: Path, refusal: Refusal) -> None:
    project = make_project(tmp_path, '"free"')
    points = (tmp_path / "points.csv").read_text(encoding="utf-8").splitlines()
    moved = [",".join([*(cells := line.split(","))[:3], "90.0", *cells[4:]]) for line in points[1:20]]
    (tmp_path / "points.csv").write_text("\n".join([points[0], *moved, *points[20:]]) + "\n", encoding="utf-8")
    assert "the object points are no board" in refusal(["adjust", str(project)])


SCANS = Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))


@parametrize_with_studies(
    "kind", ["congruent", "projective", "bilinear", "conformal(2)", "polynomial(2)"], quick=(0, 1)
)
def test_films_of_every_kind_are_adjusted_from_files(kind: Transformation, tmp_path: Path) -> None:
    points = field_points(np.random.default_rng(7), 16)
    network, _ = simulated(np.random.default_rng(4), SCANS, kind, points)
    write_network_project(network, tmp_path)
    assert run(["adjust", str(tmp_path / "project.toml")]) == (1 if kind == "polynomial(2)" else 0)  # too few marks
    result = result_file(tmp_path)
    assert result["converged"]
    for i in range(4):
        film = result["images"][f"f{i}"]["transformation"]
        assert film["kind"] == kind
        assert film["mirrored"] == (i == 1)
        for name, truth in zip(film_parameter_names(kind), film_parameters(SCANS, i, kind), strict=True):
            found, expected = (film["angle_deg"], np.degrees(truth)) if name == "angle" else (film[name], truth)
            off = (found["value"] - expected + 180.0) % 360.0 - 180.0 if name == "angle" else found["value"] - expected
            assert abs(off) <= 5.0 * found["sigma"]
    assert run(["check", str(tmp_path / "project.toml")]) in (0, 1)
    assert run(["report", str(tmp_path / "project.toml")]) in (0, 1)


@parametrize_with_studies("given", ["none", "torlegard"])
def test_the_project_is_reported_what_its_data_ask_for(given: str, tmp_path: Path, capsys: Capture) -> None:
    """A lens without distortion: right as given without any, and to be looked at where k3 is estimated."""
    points = field_points(np.random.default_rng(1), 15)
    network, _ = simulated(np.random.default_rng(8), Truth(distortion={}), "none", points=points)
    parameters = {"k3": Prior(0.0, np.inf)} if given == "torlegard" else {}
    camera = replace(network.cameras[0], distortion=Distortion(given, parameters), fiducials={})
    project = write_network_project(replace(network, cameras=(camera,)), tmp_path)
    assert run(["choose", str(project)]) == (DONE if given == "none" else LOOK)
    shown = " ".join(capsys.readouterr().out.split())
    assert "The data ask for no distortion." in shown
    assert ("That is the model as it is given." in shown) is (given == "none")
    result = json.loads((tmp_path / "out" / "choose.json").read_text(encoding="utf-8"))
    assert result["chosen"] == {"transformation": "none", "family": "none", "parameters": [], "bends": {}}
    names = [each["name"] for each in result["candidates"]]
    assert names[:3] == ["no distortion", "torlegard k3", "torlegard k3 k5"]
    assert {"ebner", "legendre(3)"} <= set(names)
    first = result["candidates"][0]
    assert first["cross_validation"]["rays"] == 60
    assert first["aic"] == pytest.approx(first["vpv"] + 2 * first["unknowns"])
    assert result["tests"][0] | {"F": 0, "p": 0} == {
        "simpler": "no distortion", "richer": "torlegard k3", "F": 0, "degrees": [1, first["redundancy"] - 1], "p": 0,
    }  # fmt: skip

"""The network that is adjusted, from the user's files; the choice of its model."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import BOARD_FRAME_MM, BOARD_TRUTH, Truth, board_network, field_points, film_parameters, simulated
from projects import replace_text, write_network_project
from studies import parametrize_with_studies
from test_bent_boards import BENDS_MM, bent_board, make_network

from adjust import Adjustment, Distortion, Parameter, Prior
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.network import Transformation
from pipeline import InputError, build_network, read_comparator, read_project
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.results.adjustment_record import LensReachRecord
from pipeline.results.record_json import plain_json
from pipeline.results.stage_files import read_choice


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
    (folder / "comparator.csv").write_text("\n".join(["image,point,col_px,row_px", *lines]))
    given = [f"b{number},{25 * (number % 9)},{25 * (number // 9)},0,0,0,0" for number in range(54)]
    (folder / "points.csv").write_text("\n".join(["point,X,Y,Z,sX,sY,sZ", *given]))
    lens = '[distortion]\nfamily = "opencv"\n[distortion.sigma]\nk1 = "free"\nk2 = "free"\n'
    (folder / "camera.toml").write_text(f'name = "desk"\n{camera}{lens}')
    path = folder / "project.toml"
    path.write_text(f'camera = "camera.toml"\n{project}[object]\npoints = "points.csv"\nunit = "mm"\n')
    return path


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
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
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


@pytest.mark.study
def test_a_prior_holds_the_bend(tmp_path: Path) -> None:
    assert run(["adjust", str(make_project(tmp_path, "0.001"))]) in (DONE, LOOK)
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    assert abs(result["boards"]["board"]["bend_x"]["value"]) < 0.2
    assert result["boards"]["board"]["significance"][0]["p"] < 1e-6  # the prior is contradicted


def test_points_that_are_no_board_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project = make_project(tmp_path, '"free"')
    points = (tmp_path / "points.csv").read_text(encoding="utf-8").splitlines()
    moved = [",".join([*(cells := line.split(","))[:3], "90.0", *cells[4:]]) for line in points[1:20]]
    (tmp_path / "points.csv").write_text("\n".join([points[0], *moved, *points[20:]]) + "\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == WRONG_INPUT
    assert "the object points are no board" in capsys.readouterr().err.replace("\n", " ")


SCANS = Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))


@parametrize_with_studies(
    "kind", ["congruent", "projective", "bilinear", "conformal(2)", "polynomial(2)"], quick=(0, 1)
)
def test_films_of_every_kind_are_adjusted_from_files(kind: Transformation, tmp_path: Path) -> None:
    points = field_points(np.random.default_rng(7), 16)
    network, _ = simulated(np.random.default_rng(4), SCANS, kind, points)
    write_network_project(network, tmp_path)
    assert run(["adjust", str(tmp_path / "project.toml")]) == (1 if kind == "polynomial(2)" else 0)  # too few marks
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
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


@pytest.mark.parametrize(
    ("spelling", "words"),
    [
        ("afine", ['no transformation "afine"', "possible are none, congruent, similarity, affine, projective"]),
        ("polynomial", ["lacks its order", 'as in "polynomial(2)"']),
        ("conformal(9)", ["order must be from 1 to 5"]),
    ],
)
def test_a_wrong_transformation_is_reported_with_its_line(spelling: str, words: list[str], tmp_path: Path) -> None:
    network, _ = simulated(np.random.default_rng(4), noise=False)
    project = write_network_project(network, tmp_path)
    replace_text(project, '"affine"', f'"{spelling}"')
    with pytest.raises(InputError) as caught:
        read_project(project)
    for word in ["project.toml, line 5: [adjust] transformation", *words]:
        assert word in str(caught.value)


Spoil = Callable[[list[str]], None]


def huge(column: int) -> Spoil:
    def spoil(cells: list[str]) -> None:
        cells[column] = "1e300"

    return spoil


def collapse(kind: str) -> Spoil:
    def spoil(cells: list[str]) -> None:
        if cells[2] == kind:
            cells[3:5] = ["30.0", "-30.0"]

    return spoil


def spoiled(path: Path, spoil: Spoil) -> None:
    head, *rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    for cells in rows:
        spoil(cells)
    path.write_text("\n".join(",".join(cells) for cells in (head, *rows)) + "\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("points.csv", huge(1), r"points.csv, line 2, column X: '1e300' is larger than anything"),
        ("comparator.csv", huge(3), r"comparator.csv, line 2, column x_mm: '1e300'"),
        ("comparator.csv", huge(5), r"comparator.csv, line 2, column sx_mm: '1e300'"),
        ("comparator.csv", collapse("target"), r"image f\d: all its \d+ targets are at one place, \(30, -30\) mm"),
        ("comparator.csv", collapse("fiducial"), r"image f\d: all its \d+ fiducials are at one place"),
    ],
)
def test_each_ends_with_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, spoil: Spoil, words: str
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_network_project(network, tmp_path)
    spoiled(tmp_path / name, spoil)
    assert run(["adjust", str(project)]) == WRONG_INPUT
    message = capsys.readouterr().err
    assert re.search(words, message)
    assert message.count("reseau: ") == 1


@pytest.mark.parametrize(
    ("status", "words"),
    [("measured", "is blank, but the status is 'measured'. Give x_mm and y_mm"), ("weak", "the status is 'weak'")],
)
def test_a_blank_place_of_an_observation_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], status: str, words: str
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_network_project(network, tmp_path)
    head, first, *rows = (tmp_path / "comparator.csv").read_text(encoding="utf-8").splitlines()
    cells = first.split(",")
    cells[3] = ""
    rows = [f"{','.join(cells)},{status}", *(f"{row},measured" for row in rows)]
    (tmp_path / "comparator.csv").write_text("\n".join([f"{head},status", *rows]) + "\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == WRONG_INPUT
    assert words in capsys.readouterr().err


def test_marks_that_were_all_refused_end_with_their_commonest_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_network_project(network, tmp_path)
    head, *rows = (tmp_path / "comparator.csv").read_text(encoding="utf-8").splitlines()
    assert not head.endswith("reason")
    rows = [f"{row},absent,{'one of 6 x 5 is' if number else 'covered'}" for number, row in enumerate(rows)]
    (tmp_path / "comparator.csv").write_text("\n".join([f"{head},status,reason", *rows]) + "\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == WRONG_INPUT
    assert f"Most have this reason ({len(rows) - 1} of {len(rows)}): one of 6 x 5 is." in capsys.readouterr().err


def test_sizes_have_no_exponent_and_what_nothing_shows_has_no_size() -> None:
    reach = LensReachRecord(1.5, 6.4, 1.1, 617.0, None, 0.24)
    assert "with a standard deviation of up to 1.1 µm" in reach.sentence("K")
    assert reach.sentence("K").endswith("there its standard deviation is 620 µm.")
    unknown = replace(reach, corner_sigma_um=2500.0)
    assert unknown.sentence("K").endswith("the lens shows nothing there.")


@pytest.mark.parametrize(("sigma", "is_wrong"), [("1e-12", True), ("0", False)])
def test_a_fiducial_is_not_known_to_a_millionth_of_a_nanometre(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sigma: str, is_wrong: bool
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_network_project(network, tmp_path)
    camera = tmp_path / "camera.toml"
    given = camera.read_text(encoding="utf-8")
    before, after = given.split("[[fiducial]]", 1)
    after = re.sub(r"sigma_mm = .*", f"sigma_mm = {sigma}", after, count=1)
    camera.write_text(f"{before}[[fiducial]]{after}", encoding="utf-8")
    code = run(["status", str(project)])
    message = capsys.readouterr().err
    assert (code == WRONG_INPUT and "nothing is known to 1e-12 mm" in message) == is_wrong


@parametrize_with_studies("given", ["none", "torlegard"])
def test_the_project_is_reported_what_its_data_ask_for(
    given: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    assert plain_json(read_choice(tmp_path / "out" / "choose.json")) == result
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


def test_a_project_without_coordinates_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["choose", str(tmp_path / "project.toml")]) == WRONG_INPUT
    assert "there is no such file" in capsys.readouterr().err

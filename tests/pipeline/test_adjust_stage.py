"""Networks adjusted through the user's files: reference cases, datum, other observations, choice of a model."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import networks as nets
import numpy as np
import projects
import pytest
from projects import write_network_project as write_network
from real_data import DATA, needs
from reference_cases import CASES, case_network, load
from studies import parametrize_with_studies
from test_condition_equations import BENDS_MM, bent_board, make_network

from adjust import Adjustment, Distortion, Network, Parameter, Prior, adjust
from adjust.functional_model.transformation import film_parameter_names
from adjust.problem.network import Transformation
from pipeline import InputError, build_network, read_adjustment, read_comparator, read_project, write_adjustment
from pipeline.adjusting import adjust_stage
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.cli import DONE, LOOK
from pipeline.exchange.block import read_block
from pipeline.opencv_check.check import check_against_opencv
from pipeline.report import ReportData
from pipeline.report.verdict import judge
from pipeline.results.adjustment_file import read_own_covariance
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.text.files import image_name

NAMES = sorted(path.stem for path in CASES.glob("*.json") if not path.stem.startswith("v_"))


@parametrize_with_studies("name", NAMES, quick=(5, 6))
def test_reference_case_through_files(name: str, tmp_path: Path) -> None:
    case = load(name)
    adjustment = adjust_network(write_project(case, tmp_path).parent)
    reference = case["result"]
    assert adjustment.converged
    assert (adjustment.unknowns, adjustment.redundancy) == (reference["unknowns"], reference["redundancy"])
    exact = reference["vpv"] < 1e-12
    if not exact:
        assert adjustment.vpv == pytest.approx(reference["vpv"], rel=1e-8)
    checked = 0
    for parameter, expected in reference["parameters"].items():
        value, sigma = adjustment.value(full_name(parameter)), adjustment.sigma(full_name(parameter))
        scale = expected["std_apriori" if exact else "std_aposteriori"]
        difference = value - expected["value"]
        if parameter.endswith(("omega", "phi", "kappa")):
            difference = float(np.angle(np.exp(1j * difference)))  # a whole turn is no difference
        assert abs(difference) <= 1e-6 * scale, parameter
        if not exact:
            assert sigma == pytest.approx(expected["std_aposteriori"], rel=1e-6), parameter
        checked += 1
    assert checked == reference["unknowns"]


def full_name(parameter: str) -> str:
    """The name that a parameter of a case has in the adjustment: EO2.X0 is EO.2.X0, FID3.x is FID.C.3.x."""
    owner, name = parameter.split(".")
    kind, id = projects.present(re.fullmatch(r"([A-Z]+)(.*)", owner)).groups()
    return ".".join([kind, *["C"] * (kind in ("IO", "FID")), *[id] * bool(id), name])


def write_project(case: dict[str, Any], folder: Path) -> Path:
    """The case as a user would write it."""
    network = case_network(case)
    camera = replace(network.cameras[0], name="C")
    return projects.write_network_project(replace(network, cameras=(camera,)), folder, frame_mm="")


def free_project(folder: Path, adjust: str = "", objects: str = "", scale: float = 1.0) -> dict[str, Any]:
    """The reference network with approximate points and nothing known of them; more lines for its tables."""
    case = load("iii_selfcal_all_unknown_datum_A")
    case["input"]["pts_obs"] = [[scale * x for x in row] for row in case["input"]["pts_obs"]]
    case["input"]["pts_sigma"] = [[None] * 3 for _ in case["input"]["pts_sigma"]]
    project = write_project(case, folder)
    projects.replace_text(project, "[object]\n", f"[object]\n{objects}\n")
    project.write_text(f"{project.read_text(encoding='utf-8')}\n{adjust}\n")
    return case


def adjust_network(folder: Path) -> Adjustment:
    project = read_project(folder / "project.toml")
    return adjust_marks(project, read_comparator(project.comparator))


def written_again(result: Adjustment, folder: Path) -> AdjustmentRecord:
    """The result by its file, in which the parts of the redundancy sum up to the whole."""
    write_adjustment(result, folder / "adjustment.json")
    record = read_adjustment(folder / "adjustment.json")
    assert sum(group.redundancy for group in record.groups.values()) == pytest.approx(record.redundancy)
    return record


def test_chosen_datum_coordinates(tmp_path: Path) -> None:
    """Other seven coordinates than the reference holds: its camera, and the seven where points.csv has them."""
    held = ["2.X", "2.Y", "2.Z", "9.X", "9.Y", "9.Z", "4.Z"]
    case = free_project(tmp_path, f'datum = "minimal"\ndatum_coordinates = {json.dumps(held)}')
    result = adjust_network(tmp_path)
    reference = case["result"]["parameters"]["IO.c"]
    assert result.value("IO.C.c") == pytest.approx(reference["value"], abs=1e-6 * reference["std_apriori"])
    assert result.sigma("IO.C.c") == pytest.approx(reference["std_aposteriori"], rel=1e-7)
    for name in held:
        point, axis = name.split(".")
        assert result.value(f"PT.{name}") == case["input"]["pts_obs"][int(point) - 1]["XYZ".index(axis)]


def test_distances_through_files(tmp_path: Path) -> None:
    """Two scale bars give a free network its size; the rows come out with residuals, and a wrong one is named. One to a
    point that no image shows is left out."""
    case = free_project(tmp_path, 'datum = "free"', 'distances = "bars.csv"')
    xyz = np.array(case["input"]["pts_obs"])
    rows = ["from,to,distance,sigma", "1,lost,3.0,0.1"]
    for a, b, scale in ((1, 2, 1.0), (3, 9, 1.0), (5, 7, 1.01)):
        rows.append(f"{a},{b},{scale * float(np.linalg.norm(xyz[b - 1] - xyz[a - 1]))!r},0.2")
    (tmp_path / "bars.csv").write_text("\n".join(rows) + "\n")
    with (tmp_path / "points.csv").open("a", encoding="utf-8") as points:
        points.write("lost,0.0,0.0,0.0,,,\n")
    result = adjust_network(tmp_path)
    assert any("1 to lost" in warning for warning in result.warnings)
    written = written_again(result, tmp_path)
    assert [(row.start, row.end) for row in written.distances] == [("1", "2"), ("3", "9"), ("5", "7")]
    assert written.groups["distance"].redundancy == pytest.approx(1.8, abs=0.2)
    verdict = judge(ReportData("t", adjustment=written))
    assert any("contradicted" in each.what and "5 to 7 (v = " in each.what for each in verdict.problems)
    assert written.redundancy == case["result"]["redundancy"] + 2


def test_refraction_and_curvature_through_files(tmp_path: Path) -> None:
    """The field ten times as large: in decimetres it bends its lines of sight as in metres."""
    results, bent = [], 'datum = "minimal"\nrefraction = true\nearth_curvature = true'
    for unit, scale in (("m", 10.0), ("dm", 100.0)):
        case = free_project(tmp_path, bent, f'unit = "{unit}"', scale)
        results.append(adjust_network(tmp_path))
    straight = case["result"]["parameters"]["IO.c"]
    first, second = results
    assert second.value("IO.C.c") == pytest.approx(first.value("IO.C.c"), abs=1e-6 * straight["std_apriori"])
    assert second.vpv == pytest.approx(first.vpv, rel=1e-7)
    assert abs(first.value("IO.C.c") - straight["value"]) > 1e-4
    written = written_again(first, tmp_path)
    assert (written.refraction, written.earth_curvature) == (True, True)
    assert check_against_opencv(first).cameras["C"].verdict == "not possible"


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Adjustment]:
    """The folder of a reference case, and its adjustment."""
    folder = tmp_path_factory.mktemp("earlier")
    write_project(load("iii_selfcal_mixed"), folder)
    first = adjust_network(folder)
    write_adjustment(first, folder / "adjustment.json")
    return folder, first


def once_more(earlier: Path, folder: Path, **changes: tuple[str, str]) -> Adjustment:
    """The same observations adjusted again, where files of these names say something else."""
    for file in ("project.toml", "camera.toml", "points.csv", "comparator.csv"):
        shutil.copy(earlier / file, folder)
    for name, change in changes.items():
        projects.replace_text(folder / f"{name}.toml", *change)
    return adjust_network(folder)


@pytest.mark.parametrize("marks", [True, False])
def test_an_earlier_calibration_through_files(earlier: tuple[Path, Adjustment], marks: bool, tmp_path: Path) -> None:
    """The same observations twice: the same values, and smaller sigmas. Its fiducials can be left out."""
    folder, first = earlier
    keys = f'[sigma]\ncalibration = "{(folder / "adjustment.json").as_posix()}"\n'
    keys += "" if marks else "calibration_fiducials = false\n"
    second = once_more(folder, tmp_path, camera=("[sigma]\n", keys))
    assert second.converged
    assert {row.name.split(".")[0] for row in second.further} == {"IO", *["FID"] * marks}
    for name in ("c", "x0", "y0", "k3"):
        sigma = first.sigma(f"IO.C.{name}")
        if marks:
            assert second.value(f"IO.C.{name}") == pytest.approx(first.value(f"IO.C.{name}"), abs=0.05 * sigma)
        assert second.sigma(f"IO.C.{name}") < 0.95 * sigma
    rows = {row.name: row for row in written_again(second, tmp_path).calibrations}
    assert rows["IO.C.c"].value == first.value("IO.C.c")
    assert rows["IO.C.c"].sigma == pytest.approx(first.sigma("IO.C.c"), rel=1e-9)  # a posteriori
    assert ({f"FID.C.{i}.{axis}" for i in range(1, 5) for axis in "xy"} <= set(rows)) is marks
    assert "IO.C.k7" not in rows  # fixed in both


SIX_DISTANCES = [("1", "2"), ("2", "3"), ("3", "4"), ("4", "1"), ("1", "3"), ("2", "4")]


def fiducial_project(folder: Path, **errors: float) -> Path:
    """Eight affine frames of the fiducials alone, whose coordinates are free, and their distances."""
    place = {"1": (-106.0, 106.0), "2": (106.0, 106.0), "3": (106.0, -106.0), "4": (-106.0, -106.0)}
    true = {id_: np.array(xy) + shift for (id_, xy), shift in zip(place.items(), [0.0, 0.03, -0.02, 0.05], strict=True)}
    lines = ['name = "K"', "frame_mm = [228.0, 228.0]", projects.fiducial_tables(place, 'sigma_mm = "free"\n')]
    for start, end in SIX_DISTANCES:
        length = float(np.linalg.norm(true[end] - true[start])) + errors.get(f"from{start}to{end}", 0.0)
        lines += ["[[fiducial_distance]]", f'from = "{start}"', f'to = "{end}"', f"mm = {length!r}", "sigma_mm = 0.005"]
    rows, rng = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"], np.random.default_rng(3)
    for image in "abcdefgh":
        film = np.eye(2) + 1e-3 * rng.standard_normal((2, 2))
        for id_, xy in true.items():
            x, y = (film @ xy + 3.0 + 0.003 * rng.standard_normal(2)).tolist()
            rows.append(f"{image},{id_},fiducial,{x!r},{y!r},0.003,0.003")
    return projects.write_tables(folder, 'camera = "camera.toml"', camera=lines, comparator=rows)


def test_distances_between_fiducials_through_files(tmp_path: Path, printed_line: projects.Printed) -> None:
    """Affine films tell no form; six distances of a certificate do, with one to spare, and their table is written."""
    project = fiducial_project(tmp_path)
    assert "1 to 3: 299.81" in printed_line("run", project)
    assert "The project names no scans." in printed_line("status", project)
    written = read_adjustment(tmp_path / "out" / "adjustment.json")
    assert [(row.start, row.end) for row in written.fiducial_distances] == SIX_DISTANCES
    redundancy = sum(row.redundancy for row in written.fiducial_distances)
    assert redundancy == pytest.approx(3.0, abs=0.3)  # affinity by them alone
    mm = {id_: np.array(mark.xy_mm) for id_, mark in written.cameras["K"].fiducials.items()}
    assert np.linalg.norm(mm["3"] - mm["1"]) == pytest.approx(212.0 * np.sqrt(2.0), abs=0.012)


def test_a_wrong_distance_of_a_certificate_is_named(tmp_path: Path) -> None:
    written = written_again(adjust_network(fiducial_project(tmp_path, from1to3=0.4).parent), tmp_path)
    verdict = judge(ReportData("t", adjustment=written))
    assert any("contradicted" in each.what and "1 to 3 of K" in each.what for each in verdict.problems)


@needs("film_numbers")
@pytest.mark.parametrize("kind", ["affine", "similarity"])
def test_interior_orientation_has_the_published_residuals(kind: str, tmp_path: Path) -> None:
    """A Wild RC30 pair, the calibrated fiducials held fixed; the readings' origin is at the lower left, y up."""
    with (DATA / "film_numbers" / "rc30_AR112_3574_3575" / "fiducials.csv").open(encoding="utf-8") as lines:
        marks = list(csv.DictReader(lines))
    rms_um = {"affine": ((5.7, 5.1), (5.7, 4.3)), "similarity": ((6.8, 6.2), (6.5, 5.3))}[kind]
    places = {m["id"]: (float(m["cal_x_mm"]), float(m["cal_y_mm"])) for m in marks}
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    for image in ("3574", "3575"):
        for m in marks:
            x, y = (0.016 * float(m[f"img{image}_{axis}_px"]) for axis in "xy")
            rows.append(f"{image},{m['id']},fiducial,{x},{y},0.005,0.005")
    camera = 'name = "RC30"\n' + projects.fiducial_tables(places, "sigma_mm = 0\n")
    project = f'camera = "camera.toml"\n[adjust]\ntransformation = "{kind}"'
    result = adjust_network(projects.write_tables(tmp_path, project, camera=camera, comparator=rows).parent)
    for image, expected in zip(("3574", "3575"), rms_um, strict=True):
        v_um = 1e3 * result.residuals.v_mm[np.array(result.network.observations.image) == image]
        assert np.sqrt((v_um**2).mean(axis=0)) == pytest.approx(expected, abs=0.06)
    assert result.redundancy == 2 * (16 - {"affine": 6, "similarity": 4}[kind])


def test_film_is_added_to_the_covariance_of_every_mark(tmp_path: Path) -> None:
    network, _ = nets.simulated(np.random.default_rng(1))
    path = projects.write_network_project(network, tmp_path)
    path.write_text(path.read_text() + "film_sigma_um = 7.0\n")
    project = read_project(path)
    built, left_out = build_network(project, read_comparator(project.comparator))
    assert not left_out
    expected = network.observations.covariance_mm2 + 0.007**2 * np.eye(2)
    np.testing.assert_allclose(built.observations.covariance_mm2, expected, rtol=1e-9)


def test_one_frame_with_too_few_fiducials_does_not_end_the_others(tmp_path: Path) -> None:
    network, _ = nets.simulated(np.random.default_rng(1))
    project = read_project(projects.write_network_project(network, tmp_path))
    marks = read_comparator(project.comparator)
    few = [mark for mark in marks if mark.kind != "fiducial" or mark.image != "f1" or mark.point in "12"]
    built, (left_out,) = build_network(project, few)
    assert left_out.startswith("Image 'f1' has no part in the adjustment: it shows 2 fiducial marks, and its affine ")
    assert [image.name for image in built.images] == ["f0", "f2", "f3"]
    assert set(built.observations.image) == {"f0", "f2", "f3"}
    assert build_network(project, [mark for mark in marks if mark.kind != "fiducial"])[1] == ()


DRAWN_MM = 0.005  # of a pixel, as the pictures were projected


def pixel_project(folder: Path, camera: str = "", project: str = "") -> Path:
    """Pictures of a board by a digital camera: a list of pixels, without fiducials and film."""
    marks = nets.board_network(np.random.default_rng(2), 6, 1e-4).observations
    rows = ["image,point,col_px,row_px"]
    for image, point, (x_mm, y_mm) in zip(marks.image, marks.point, marks.xy_mm.tolist(), strict=True):
        rows.append(f"{image},{point},{x_mm / DRAWN_MM:.5f},{-y_mm / DRAWN_MM:.5f}")
    given = [f"b{number},{25 * (number % 9)},{25 * (number // 9)},0,0,0,0" for number in range(54)]
    lens = '[distortion]\nfamily = "opencv"\n[distortion.sigma]\nk1 = "free"\nk2 = "free"'
    text = f'camera = "camera.toml"\n{project}[object]\npoints = "points.csv"\nunit = "mm"'
    points = ["point,X,Y,Z,sX,sY,sZ", *given]
    return projects.write_tables(folder, text, camera=f'name = "desk"\n{camera}{lens}', points=points, comparator=rows)


def adjust_pixels(path: Path) -> Adjustment:
    project = read_project(path)
    return adjust_marks(project, read_comparator(project.comparator, project.list_pitch_um))


@pytest.mark.parametrize(("line", "pitch_mm"), [("", 0.005), ("pitch_um = 8.0\n", 0.008)])
def test_a_digital_camera_comes_from_pixels_alone(tmp_path: Path, line: str, pitch_mm: float) -> None:
    result = adjust_pixels(pixel_project(tmp_path, project=line))
    for name in ("c", "x0", "y0"):
        key = Parameter.interior("desk", name)
        assert (
            abs(result.value(key) / pitch_mm - nets.BOARD_TRUTH[name] / DRAWN_MM) < 4.0 * result.sigma(key) / pitch_mm
        )
    assert any("5 µm are assumed" in note for note in result.unused) == (not line)
    frame = read_block(read_project(tmp_path / "project.toml")).frames[0]
    cells = (tmp_path / "comparator.csv").read_text().splitlines()[1].split(",")
    place = next(px for mark, px in zip(frame.marks, frame.pixels(frame.marks), strict=True) if mark.point == cells[1])
    np.testing.assert_allclose(place, [float(cells[2]), float(cells[3])])  # exported as it came


def test_a_camera_file_in_mm_needs_the_size_of_a_pixel(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Set pitch_um in"):
        adjust_pixels(pixel_project(tmp_path, camera=f"frame_mm = {[*nets.BOARD_FRAME_MM]}\n"))


def bent_project(folder: Path) -> Path:
    network = make_network(np.random.default_rng(5))
    free = {"principal_distance_mm": Prior(20.5, np.inf), "x0_mm": Prior(0.0, np.inf), "y0_mm": Prior(0.0, np.inf)}
    network = nets.set_camera(network, **free)
    project = projects.write_network_project(network, folder)
    projects.replace_text(project, "[object]\n", '[object]\nunit = "mm"\nboard_bend = "free"\n')
    return project


def test_eccentricities_are_corrected_where_a_round_leaves_out_an_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The result is that of the project without this image from the beginning."""
    simulated, _ = nets.simulated(np.random.default_rng(1), points=nets.field_points(np.random.default_rng(2), 30, 0.0))
    path = write_network(simulated, tmp_path)
    path.write_text(path.read_text() + '[targets]\nkind = "disk"\ndiameter_mm = 30000.0\n')
    project = read_project(path)
    marks = read_comparator(project.comparator)
    expected = adjust_marks(project, [mark for mark in marks if mark.image != "f3"])
    rounds = list[Network]()

    def without_f3(network: Network, **options: Any) -> Adjustment:
        rounds.append(network)
        rest = [row for row, image in enumerate(network.observations.image) if image != "f3"]
        images = tuple(image for image in network.images if image.name != "f3")
        left = replace(network, images=images, observations=network.observations.only(np.array(rest)))
        return adjust(network if len(rounds) == 1 else left, **options)

    monkeypatch.setattr(adjust_stage, "adjust", without_f3)
    found = adjust_marks(project, marks)
    assert len(rounds) > 1
    assert found.parameters == expected.parameters
    sigmas = np.array([expected.sigma(each) for each in expected.parameters])
    is_free = sigmas > 0.0
    assert (np.abs(found.values - expected.values)[is_free] < 1e-4 * sigmas[is_free]).all()


def test_a_bent_board_from_the_project_file_to_the_report(tmp_path: Path) -> None:
    """Its bends within four sigmas, its points where they are and not on the plane, OpenCV in agreement there."""
    assert projects.command("run", bent_project(tmp_path)) in (DONE, LOOK)
    result = projects.result_file(tmp_path)
    board = result["boards"]["board"]
    assert board["points"] == 70
    for name, value in zip(("bend_x", "bend_y"), BENDS_MM, strict=True):
        assert abs(board[name]["value"] - value) < 4.0 * board[name]["sigma"]
        assert board[name]["p"] < 1e-6
    middle = result["points"]["p34"]["Z"]
    assert middle["sigma"] > 0.0
    assert abs(middle["value"] - bent_board()[34, 2]) < 4.0 * middle["sigma"]
    assert result["points"]["p0"]["Z"]["sigma"] == 0.0
    check = json.loads((tmp_path / "out" / "check.json").read_text())
    assert check["verdict"] == "agrees"
    page = (tmp_path / "out" / "report.html").read_text()
    assert "The board of 70 points is bent" in page


def test_points_that_are_no_board_are_reported(tmp_path: Path, refusal: projects.Refusal) -> None:
    project = bent_project(tmp_path)
    points = (tmp_path / "points.csv").read_text().splitlines()
    moved = [",".join([*(cells := line.split(","))[:3], "90.0", *cells[4:]]) for line in points[1:20]]
    (tmp_path / "points.csv").write_text("\n".join([points[0], *moved, *points[20:]]) + "\n")
    assert "the object points are no board" in refusal("adjust", project)


SCANS = nets.Truth(middle_mm=(120.0, -115.0), mirrored=(False, True, False, False))


@parametrize_with_studies("kind", ["congruent", "projective", "bilinear", "conformal(2)", "polynomial(2)"], quick=(1,))
def test_films_of_every_kind_are_adjusted_from_files(kind: Transformation, tmp_path: Path) -> None:
    points = nets.field_points(np.random.default_rng(7), 16)
    network, _ = nets.simulated(np.random.default_rng(4), SCANS, kind, points)
    projects.write_network_project(network, tmp_path)
    assert projects.command("adjust", tmp_path / "project.toml") == (
        1 if kind == "polynomial(2)" else 0
    )  # too few marks
    result = projects.result_file(tmp_path)
    assert result["converged"]
    for i in range(4):
        film = result["images"][f"f{i}"]["transformation"]
        assert film["kind"] == kind
        assert film["mirrored"] == (i == 1)
        for name, truth in zip(film_parameter_names(kind), nets.film_parameters(SCANS, i, kind), strict=True):
            found, expected = (film["angle_deg"], np.degrees(truth)) if name == "angle" else (film[name], truth)
            off = (found["value"] - expected + 180.0) % 360.0 - 180.0 if name == "angle" else found["value"] - expected
            assert abs(off) <= 5.0 * found["sigma"]
    assert projects.command("check", tmp_path / "project.toml") in (0, 1)
    assert projects.command("report", tmp_path / "project.toml") in (0, 1)


@parametrize_with_studies("given", ["none", "torlegard"])
def test_the_project_is_reported_what_its_data_ask_for(given: str, tmp_path: Path, capsys: projects.Capture) -> None:
    """A lens without distortion: right as given without any, and to be looked at where k3 is estimated."""
    points = nets.field_points(np.random.default_rng(1), 15)
    network, _ = nets.simulated(np.random.default_rng(8), nets.Truth(distortion={}), "none", points=points)
    parameters = {"k3": Prior(0.0, np.inf)} if given == "torlegard" else {}
    camera = replace(network.cameras[0], distortion=Distortion(given, parameters), fiducials={})
    project = projects.write_network_project(replace(network, cameras=(camera,)), tmp_path)
    assert projects.command("choose", project) == (DONE if given == "none" else LOOK)
    shown = " ".join(capsys.readouterr().out.split())
    assert "Selected: no distortion" in shown
    assert ("the given model." in shown) is (given == "none")
    result = json.loads((tmp_path / "out" / "choose.json").read_text())
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
    text = f'name = "K"\n{camera}\n' + projects.fiducial_tables(GIVEN, f"sigma_mm = {sigma_mm}\n")
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm", *extra]
    for seed, (image, count) in enumerate(marks.items()):
        for id_, (x, y) in zip(GIVEN, comparator_mm(seed, count).tolist(), strict=False):
            rows.append(f"{image},{id_},fiducial,{x!r},{y!r},{SIGMA_MM},{SIGMA_MM}")
    return projects.write_tables(folder, 'camera = "camera.toml"', camera=text, comparator=rows)


def test_film_transformations_without_an_object(tmp_path: Path, printed_line: projects.Printed) -> None:
    """Against the linear least-squares fit, values and standard deviations; no orientation, no calibration."""
    project = write_fiducials_project(tmp_path, {"a": 5, "b": 5, "c": 3})
    text = printed_line("run", project)
    assert "Film transformations from 13 marks in 3 frames; no frame is oriented, and no camera calibrated" in text
    report = (tmp_path / "out" / "report.html").read_text()
    assert report.count("No exterior orientation") == 3
    assert "Exterior orientation</caption>" not in report
    assert "Film report</p>" in report
    assert "Calibration report" not in report
    assert projects.command("report", project) == 0  # and it may be written over
    result = projects.result_file(tmp_path)
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
    (tmp_path / "points.csv").write_text("point,X,Y,Z\nt1,0,0,0\n")
    project.write_text('camera = "camera.toml"\n[object]\npoints = "points.csv"\n')
    assert projects.command("adjust", project) == 1
    result = projects.result_file(tmp_path)
    assert list(result["images"]) == ["a"]
    assert {row["kind"] for row in result["residuals"]} == {"fiducial"}
    warnings = " ".join(result["warnings"])
    assert "Image 'a' is not oriented: it shows 1 target and needs 3." in warnings
    assert "Image 'b' has no part in the adjustment" in warnings
    assert result["cameras"]["K"]["principal_distance_mm"]["value"] == 153.0
    assert result["cameras"]["K"]["principal_distance_mm"]["sigma"] is None


def test_the_film_transformation_can_be_chosen(tmp_path: Path, printed_line: projects.Printed) -> None:
    """No lens to choose, but the kind of film: these marks have two scales that differ by 0.2 %."""
    assert "Selected: affine, no distortion" in printed_line(
        "choose", write_fiducials_project(tmp_path, {"a": 5, "b": 5})
    )


def test_the_form_of_the_fiducials_is_reported_where_they_are_estimated(
    tmp_path: Path, printed_line: projects.Printed
) -> None:
    """Marks with a datum of 1 mm: no figure of mm is left in the form, and the dashes are gone."""
    project = write_fiducials_project(tmp_path, {f"f{i}": 5 for i in range(60)}, sigma_mm=1.0)
    text = printed_line("run", project)
    assert re.search(r"K: Corrections to the certificate, after a common affine transformation: \d\.\d µm rms", text)
    assert "the worst first (8 of 60)" in text
    report = (tmp_path / "out" / "report.html").read_text()
    form = report[report.index('<section id="fiducials">') : report.index('<section id="reliability">')]
    row = r"<td>\d</td>\s*<td[^>]*>[+−][\d.]+</td><td[^>]*>([\d.]+)</td><td[^>]*>[+−][\d.]+</td><td[^>]*>([\d.]+)</td>"
    sigmas_um = [float(text) for pair in re.findall(row, form) for text in pair]
    assert len(sigmas_um) == 10
    assert 0.05 < max(sigmas_um) < 1e3 * SIGMA_MM / np.sqrt(60)
    assert "Distances" not in form


def test_a_single_frame_with_a_mere_datum_has_a_priori_sigmas(tmp_path: Path, capsys: projects.Capture) -> None:
    """sigma0 was 0.003 here, and multiplied the datum's 1 mm: now the shift is known to 1 mm over the root of 5."""
    project = write_fiducials_project(tmp_path, {"a": 5}, sigma_mm=1.0)
    projects.command("adjust", project)
    printed = " ".join(capsys.readouterr().out.split())
    assert "standard deviations a priori" in printed
    result = projects.result_file(tmp_path)
    assert result["sigma0_from"] == {"redundancy": 0.0, "a_priori": True, "left_out": []}
    design = np.column_stack([np.ones(5), comparator_mm(0)])
    sigma = np.sqrt(np.linalg.inv(design.T @ design)[0, 0] * (1.0 + SIGMA_MM**2))
    assert result["images"]["a"]["transformation"]["a1"]["sigma"] == pytest.approx(sigma, rel=1e-3)


def test_one_frame_within_its_certificate_needs_no_attention(tmp_path: Path) -> None:
    """Four calibrated fiducials of one frame, given to 10 µm and measured to 4 µm: nothing speaks against any."""
    project = write_fiducials_project(tmp_path, {"a": 4}, sigma_mm=0.01)
    assert projects.command("run", project) == 0
    rows = (tmp_path / "comparator.csv").read_text().splitlines()
    name, id_, kind, x, *rest = rows[1].split(",")
    wrong = ",".join((name, id_, kind, str(float(x) + 0.4), *rest))  # 0.2 mm and more at each mark of an affine fit
    (tmp_path / "comparator.csv").write_text("\n".join([rows[0], wrong, *rows[2:]]) + "\n")
    assert projects.command("run", project) == 1


POINT = "7"


def spoilt_project(folder: Path, adjust: str) -> Path:
    """The reference network with one target wrong by 0.1 mm."""
    case = load("i_five_images_affine_reduced")
    row = next(row for row in case["input"]["obs"] if str(row[1]) == POINT)
    row[2] += 0.1
    file = write_project(case, folder)
    file.write_text(file.read_text() + adjust + "\n")
    return file


@parametrize_with_studies(
    ("adjust", "removed"),
    [("", False), ("snooping = true\nvariance_components = true", True), ('robust = "igg3"', True)],
)
def test_a_gross_error_is_named_in_file_and_report(adjust: str, removed: bool, tmp_path: Path) -> None:
    project = spoilt_project(tmp_path, adjust)
    assert projects.command("adjust", project) == 1
    result = projects.result_file(tmp_path)
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
    assert projects.command("report", project) == 1
    report = (tmp_path / "out" / "report.html").read_text()
    assert f"{'Left out as gross errors' if removed else '1 gross error suspected'}: {name} (w = " in report
    assert "of an undetected error in" in report
    if "variance" in adjust:
        assert result["variance_sigmas"].keys() == {"target", "fiducial"}
        assert "Variance components: factors of the variances" in report


@parametrize_with_studies(("frame_mm", "level"), [(228.0, 0), (600.0, 1)])
def test_a_lens_known_in_the_middle_alone_needs_attention(frame_mm: float, level: int, tmp_path: Path) -> None:
    """Targets within some 110 mm of the principal point: most of a picture of 228 mm, a quarter of one of 600 mm."""
    free = {"k3": np.inf, "k5": np.inf}
    network, _ = nets.simulated(
        np.random.default_rng(1), points=nets.field_points(np.random.default_rng(2), 40), free=free
    )
    project = write_network(network, tmp_path, f"frame_mm = [{frame_mm}, {frame_mm}]")
    assert projects.command("adjust", project) == level
    known = projects.result_file(tmp_path)["cameras"]["K"]["lens_known"]
    assert (known["share"] < 0.5) is bool(level)
    assert known["corner_sigma_um"] > known["sigma_um"] > 0.0
    # By dr = k3 r³ + k5 r⁵ and the covariance that stands in adjustment.npz.
    covariance = read_own_covariance(tmp_path / "out" / "adjustment.json")
    of_terms = covariance.select([Parameter.interior("K", each) for each in ("k3", "k5")])
    for radius, sigma in (("radius_mm", "sigma_um"), ("corner_mm", "corner_sigma_um")):
        by_terms = 1e3 * known[radius] ** np.array([3.0, 5.0])
        assert known[sigma] == pytest.approx(float(np.sqrt(by_terms @ of_terms @ by_terms)), rel=1e-6)
    assert projects.command("report", project) in (0, level)
    assert "of the way to the corner of the picture" in (tmp_path / "out" / "report.html").read_text()


def test_points_that_no_image_shows_are_a_note_and_an_unknown_one_in_one_image_is_named(tmp_path: Path) -> None:
    """A pattern is often larger than what the images show; one ray does not locate a point."""
    network, _ = nets.simulated(np.random.default_rng(1), points=nets.field_points(np.random.default_rng(2), 40))
    project = write_network(network, tmp_path)
    points, marks = tmp_path / "points.csv", tmp_path / "comparator.csv"
    points.write_text(points.read_text() + "u1,5,5,0,0,0,0\nu2,6,6,0,0,0,0\n")
    assert projects.command("adjust", project) == 0
    result = projects.result_file(tmp_path)
    assert [note for note in result["notes"] if "measured in no image: 2 points, u1, u2" in note]
    points.write_text(points.read_text() + "single,,,,,,\n")
    marks.write_text(marks.read_text() + "f2,single,target,10,10,0.005,0.005\n")
    assert projects.command("adjust", project) == 1
    result = projects.result_file(tmp_path)
    (warning,) = [warning for warning in result["warnings"] if "single" in warning]
    assert "measured in one image only, and so left out: single (f2). Two images are needed" in warning
    assert not any("single" in note for note in result["notes"])


@parametrize_with_studies("other", ["F1.TIF", "f1.dng"])
def test_names_of_one_image_that_differ_by_case_and_ending_are_named(
    other: str, tmp_path: Path, printed_line: projects.Printed
) -> None:
    network, _ = nets.simulated(np.random.default_rng(1), points=nets.field_points(np.random.default_rng(2), 40))
    project, table = write_network(network, tmp_path), tmp_path / "comparator.csv"
    head, *rows = table.read_text().splitlines()
    own = [row.replace("f1,", f"{other},") for row in rows if row.startswith("f1,")]
    fiducials = [row for row in own if ",fiducial," in row]
    halved = [row for row in rows if not row.startswith("f1,") or ",fiducial," in row or int(row.split(",")[1]) % 2]
    targets = [row for row in own if ",target," in row and int(row.split(",")[1]) % 2 == 0]
    table.write_text("\n".join([head, *halved, *fiducials, *targets, ""]))
    names = sorted(["f1", image_name(other)])
    words = f"{names[0]} and {names[1]} differ only by case and ending, and count as two images"
    assert words in printed_line("adjust", project, code=LOOK)
    listed = "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg\n" + "".join(f"{name},,,,,,\n" for name in names)
    (tmp_path / "images.csv").write_text(listed)
    projects.replace_text(project, "[object]\n", '[object]\nimages = "images.csv"\n')
    assert words not in printed_line("adjust", project)

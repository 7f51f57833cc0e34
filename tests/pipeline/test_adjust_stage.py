"""Reference adjustments, published numbers, datum, distances and other observed quantities through the user's files."""

import csv
import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from projects import Capture, fiducial_tables, result_file, write_network_project, write_tables
from real_data import DATA, needs
from reference_cases import CASES, case_network
from studies import parametrize_with_studies

from adjust import Adjustment
from adjust.functional_model.rotation import rotation_from_angles
from adjust.problem.network import EXTERIOR_NAMES
from pipeline import InputError, read_adjustment, read_comparator, read_project, write_adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.cli import run
from pipeline.opencv_check.check import check_against_opencv
from pipeline.report import ReportData
from pipeline.report.verdict import judge

NAMES = sorted(path.stem for path in CASES.glob("*.json") if not path.stem.startswith("v_"))


@parametrize_with_studies("name", NAMES, quick=(5, 6))
def test_reference_case_through_files(name: str, tmp_path: Path) -> None:
    case = json.loads((CASES / f"{name}.json").read_text(encoding="utf-8"))
    write_project(case, tmp_path)
    project = read_project(tmp_path / "project.toml")
    adjustment = adjust_marks(project, read_comparator(project.comparator))
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
    kind, id = re.fullmatch(r"([A-Z]+)(.*)", owner).groups()  # type: ignore[union-attr]
    return ".".join([kind, *["C"] * (kind in ("IO", "FID")), *[id] * bool(id), name])


def write_project(case: dict[str, Any], folder: Path) -> None:
    """The case as a user would write it."""
    network = case_network(case)
    camera = replace(network.cameras[0], name="C")
    write_network_project(replace(network, cameras=(camera,)), folder, frame_mm="")


CASE = "iii_selfcal_all_unknown_datum_A"


def free_project(folder: Path, adjust: str = "", objects: str = "", scale: float = 1.0) -> dict[str, Any]:
    """The reference network with approximate points and nothing known of them; more lines for its tables."""
    case: dict[str, Any] = json.loads((CASES / f"{CASE}.json").read_text(encoding="utf-8"))
    case["input"]["pts_obs"] = [[scale * x for x in row] for row in case["input"]["pts_obs"]]
    case["input"]["pts_sigma"] = [[None] * 3 for _ in case["input"]["pts_sigma"]]
    write_project(case, folder)
    file = folder / "project.toml"
    text = file.read_text(encoding="utf-8").replace("[object]\n", f"[object]\n{objects}\n")
    file.write_text(f"{text}\n{adjust}\n", encoding="utf-8")
    return case


def adjust_network(folder: Path) -> Adjustment:
    project = read_project(folder / "project.toml")
    return adjust_marks(project, read_comparator(project.comparator))


def test_disks_larger_than_their_spacing_are_refused(tmp_path: Path) -> None:
    """As where coordinates are in m and said to be in mm: the iteration diverged."""
    free_project(tmp_path, '[targets]\nkind = "disk"\ndiameter_mm = 1e6\n')
    with pytest.raises(InputError, match="would cover one another"):
        adjust_network(tmp_path)


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
    """Two scale bars give a free network its size; the rows come out with residuals, and a wrong one is named."""
    objects = 'distances = "bars.csv"'
    case = free_project(tmp_path, 'datum = "free"', objects)
    xyz = np.array(case["input"]["pts_obs"])
    bars = [("1", "2", 1.0), ("3", "9", 1.0), ("5", "7", 1.01)]
    lengths = [scale * float(np.linalg.norm(xyz[int(b) - 1] - xyz[int(a) - 1])) for a, b, scale in bars]
    rows = [f"{a},{b},{length!r},0.2" for (a, b, _), length in zip(bars, lengths, strict=True)]
    (tmp_path / "bars.csv").write_text("\n".join(["from,to,distance,sigma", *rows]) + "\n", encoding="utf-8")
    result = adjust_network(tmp_path)
    write_adjustment(result, tmp_path / "adjustment.json")
    written = read_adjustment(tmp_path / "adjustment.json")
    assert [(row.start, row.end) for row in written.distances] == [("1", "2"), ("3", "9"), ("5", "7")]
    assert written.groups["distance"].redundancy == pytest.approx(1.8, abs=0.2)
    assert sum(group.redundancy for group in written.groups.values()) == pytest.approx(written.redundancy)
    verdict = judge(ReportData("t", adjustment=written))
    assert any("contradicted" in each.what and "5 to 7 (v = " in each.what for each in verdict.problems)
    assert written.redundancy == case["result"]["redundancy"] + 2


def test_a_distance_to_a_point_that_no_image_shows_is_left_out(tmp_path: Path) -> None:
    free_project(tmp_path, 'datum = "free"', 'distances = "bars.csv"')
    with (tmp_path / "points.csv").open("a", encoding="utf-8") as points:
        points.write("lost,0.0,0.0,0.0,,,\n")
    (tmp_path / "bars.csv").write_text("from,to,distance,sigma\n1,lost,3.0,0.1\n", encoding="utf-8")
    result = adjust_network(tmp_path)
    assert result.further == ()
    assert any("1 to lost" in warning for warning in result.warnings)


def test_refraction_and_curvature_through_files(tmp_path: Path) -> None:
    """The field ten times as large: in decimetres it bends its lines of sight as in metres."""
    results = []
    for unit, scale in (("m", 10.0), ("dm", 100.0)):
        folder = tmp_path / unit
        folder.mkdir()
        case = free_project(
            folder, 'datum = "minimal"\nrefraction = true\nearth_curvature = true', f'unit = "{unit}"', scale
        )
        results.append(adjust_network(folder))
    straight = case["result"]["parameters"]["IO.c"]
    first, second = results
    assert second.value("IO.C.c") == pytest.approx(first.value("IO.C.c"), abs=1e-6 * straight["std_apriori"])
    assert second.vpv == pytest.approx(first.vpv, rel=1e-7)
    assert abs(first.value("IO.C.c") - straight["value"]) > 1e-4
    write_adjustment(first, tmp_path / "adjustment.json")
    written = read_adjustment(tmp_path / "adjustment.json")
    assert (written.refraction, written.earth_curvature) == (True, True)
    assert check_against_opencv(first).cameras["C"].verdict == "not possible"


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Adjustment]:
    """The folder of a reference case, and its adjustment."""
    folder = tmp_path_factory.mktemp("earlier")
    write_project(json.loads((CASES / "iii_selfcal_mixed.json").read_text(encoding="utf-8")), folder)
    first = adjust_network(folder)
    write_adjustment(first, folder / "adjustment.json")
    return folder, first


def adjust_antennas(earlier: tuple[Path, Adjustment], folder: Path, sigma: str) -> Adjustment:
    """The reference case with antennas observed where its adjustment puts them, 2.5 units away from the lenses."""
    source, first = earlier
    offset = (0.5, -1.0, 2.2)
    rows = ["image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,sX0,sY0,sZ0"]
    for image in first.network.images:
        place = [first.value(f"EO.{image.name}.{name}") for name in EXTERIOR_NAMES]
        antenna = np.array(place[:3]) + rotation_from_angles(np.array(place[3:])).T @ offset
        rows.append(
            ",".join([image.name, *map(repr, [*antenna.tolist(), *np.degrees(place[3:]).tolist()]), *[sigma] * 3])
        )
    (folder / "images.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    for file in ("camera.toml", "points.csv", "comparator.csv"):
        (folder / file).write_bytes((source / file).read_bytes())
    text = (source / "project.toml").read_text(encoding="utf-8")
    keys = f'[object]\nimages = "images.csv"\nantenna_offset = {list(offset)}\n'
    (folder / "project.toml").write_text(text.replace("[object]\n", keys), encoding="utf-8")
    return adjust_network(folder)


def test_observed_antennas_through_files(earlier: tuple[Path, Adjustment], tmp_path: Path) -> None:
    """They are where the adjustment puts them, so that nothing moves but every station becomes more certain."""
    _, first = earlier
    result = adjust_antennas(earlier, tmp_path, "0.05")
    for image in first.network.images:
        name = f"EO.{image.name}.Z0"
        assert result.value(name) == pytest.approx(first.value(name), abs=1e-3 * first.sigma(name))
        assert result.sigma(name) < first.sigma(name)
    write_adjustment(result, tmp_path / "adjustment.json")
    written = read_adjustment(tmp_path / "adjustment.json")
    assert len(written.antennas) == 3 * len(first.network.images)
    assert written.groups["antenna"].redundancy > 0.0
    assert sum(group.redundancy for group in written.groups.values()) == pytest.approx(written.redundancy)
    with pytest.raises(InputError, match="column sX0: is 0, but an antenna can be observed only"):
        adjust_antennas(earlier, tmp_path, "0")


def once_more(earlier: Path, folder: Path, change: Callable[[str], str] = str) -> Adjustment:
    """The same observations adjusted again, with that result as the earlier calibration of a changed camera."""
    for file in ("project.toml", "points.csv", "comparator.csv"):
        (folder / file).write_bytes((earlier / file).read_bytes())
    text = (earlier / "camera.toml").read_text(encoding="utf-8")
    key = f'calibration = "{(earlier / "adjustment.json").as_posix()}"'
    (folder / "camera.toml").write_text(change(text.replace("[sigma]\n", f"[sigma]\n{key}\n", 1)), encoding="utf-8")
    return adjust_network(folder)


def test_an_earlier_calibration_through_files(earlier: tuple[Path, Adjustment], tmp_path: Path) -> None:
    """The same observations twice: the same values, and smaller sigmas."""
    folder, first = earlier
    second = once_more(folder, tmp_path)
    assert second.converged
    for name in ("c", "x0", "y0", "k3"):
        sigma = first.sigma(f"IO.C.{name}")
        assert second.value(f"IO.C.{name}") == pytest.approx(first.value(f"IO.C.{name}"), abs=0.05 * sigma)
        assert second.sigma(f"IO.C.{name}") < 0.95 * sigma
    write_adjustment(second, tmp_path / "second.json")
    written = read_adjustment(tmp_path / "second.json")
    rows = {row.name: row for row in written.calibrations}
    assert rows["IO.C.c"].value == first.value("IO.C.c")
    assert rows["IO.C.c"].sigma == pytest.approx(first.sigma("IO.C.c"), rel=1e-9)  # a posteriori
    assert {f"FID.C.{i}.{axis}" for i in range(1, 5) for axis in "xy"} <= set(rows)
    assert "IO.C.k7" not in rows  # fixed in both
    assert sum(group.redundancy for group in written.groups.values()) == pytest.approx(written.redundancy)


def test_fiducials_of_an_earlier_calibration_can_be_left_out(earlier: tuple[Path, Adjustment], tmp_path: Path) -> None:
    keys = "[sigma]\ncalibration_fiducials = false"
    second = once_more(earlier[0], tmp_path, lambda text: text.replace("[sigma]", keys, 1))
    assert {row.name.split(".")[0] for row in second.further} == {"IO"}


def fiducial_project(folder: Path, distances: list[tuple[str, str, float]]) -> Path:
    """Eight affine frames of the fiducials alone, whose coordinates are free, and distances between them."""
    place = {"1": (-106.0, 106.0), "2": (106.0, 106.0), "3": (106.0, -106.0), "4": (-106.0, -106.0)}
    true = {id_: np.array(xy) + shift for (id_, xy), shift in zip(place.items(), [0.0, 0.03, -0.02, 0.05], strict=True)}
    lines = ['name = "K"', "frame_mm = [228.0, 228.0]", fiducial_tables(place, 'sigma_mm = "free"\n')]
    for start, end, error in distances:
        length = float(np.linalg.norm(true[end] - true[start])) + error if end in true and start in true else 100.0
        lines += ["[[fiducial_distance]]", f'from = "{start}"', f'to = "{end}"', f"mm = {length!r}", "sigma_mm = 0.005"]
    rows, rng = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"], np.random.default_rng(3)
    for image in "abcdefgh":
        film = np.eye(2) + 1e-3 * rng.standard_normal((2, 2))
        for id_, xy in true.items():
            x, y = (film @ xy + 3.0 + 0.003 * rng.standard_normal(2)).tolist()
            rows.append(f"{image},{id_},fiducial,{x!r},{y!r},0.003,0.003")
    return write_tables(folder, 'camera = "camera.toml"', camera=lines, comparator=rows)


ALL_SIX = [("1", "2", 0.0), ("2", "3", 0.0), ("3", "4", 0.0), ("4", "1", 0.0), ("1", "3", 0.0), ("2", "4", 0.0)]


def test_distances_between_fiducials_through_files(tmp_path: Path, capsys: Capture) -> None:
    """Affine films tell no form; six distances of a certificate do, with one to spare, and their table is written."""
    project = fiducial_project(tmp_path, ALL_SIX)
    assert run(["run", str(project)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "1 to 3: 299.81" in printed
    written = read_adjustment(tmp_path / "out" / "adjustment.json")
    assert [(row.camera, row.start, row.end) for row in written.fiducial_distances] == [("K", *p[:2]) for p in ALL_SIX]
    assert sum(row.redundancy for row in written.fiducial_distances) == pytest.approx(
        3.0, abs=0.3
    )  # affinity by them alone
    mm = {id_: np.array(mark.xy_mm) for id_, mark in written.cameras["K"].fiducials.items()}
    assert np.linalg.norm(mm["3"] - mm["1"]) == pytest.approx(212.0 * np.sqrt(2.0), abs=0.012)


def test_a_wrong_distance_of_a_certificate_is_named(tmp_path: Path) -> None:
    project = fiducial_project(tmp_path, [*ALL_SIX[:4], ("1", "3", 0.4), ("2", "4", 0.0)])
    result = adjust_network(project.parent)
    write_adjustment(result, tmp_path / "adjustment.json")
    verdict = judge(ReportData("t", adjustment=read_adjustment(tmp_path / "adjustment.json")))
    assert any("contradicted" in each.what and "1 to 3 of K" in each.what for each in verdict.problems)


FILM = DATA / "film_numbers"


def adjusted_result(
    folder: Path, camera: str, project: str, rows: Iterable[Sequence[object]], points: str = ""
) -> dict[str, Any]:
    """The result of `reseau adjust` on files; rows of comparator.csv in its own order."""
    given = '[object]\npoints = "points.csv"\n' if points else ""
    lines = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm", *(",".join(map(str, row)) for row in rows)]
    text, points = f'camera = "camera.toml"\n{given}{project}', f"point,X,Y,Z,sX,sY,sZ\n{points}"
    assert run(["adjust", str(write_tables(folder, text, camera=camera, points=points, comparator=lines))]) in (0, 1)
    result = result_file(folder)
    assert result["converged"]
    return result


def table(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def fiducials(rows: list[dict[str, str]], sigma: float) -> str:
    return "".join(
        f'[[fiducial]]\nid = "{row["id"]}"\nxy_mm = [{float(row["cal_x_mm"])}, {float(row["cal_y_mm"])}]\n'
        f"sigma_mm = {sigma}\n"
        for row in rows
    )


@needs("film_numbers")
def test_interior_orientation_of_eight_fiducials(tmp_path: Path) -> None:
    """An affine transformation published with its rms, all errors in the given coordinates: they are given 1 mm."""
    pitch_mm = 0.042
    marks = table(FILM / "sju_8fid" / "fiducials.csv")
    rows = [
        ("left", m["id"], "fiducial", float(m["x_px"]) * pitch_mm, -float(m["y_px"]) * pitch_mm, 1e-4, 1e-4)
        for m in marks
    ]
    result = adjusted_result(tmp_path, 'name = "SJU"\n' + fiducials(marks, 1.0), "", rows)
    found = {key: part["value"] for key, part in result["images"]["left"]["transformation"].items() if key[0] in "ab"}
    per_px = [pitch_mm * found["a2"], -pitch_mm * found["a3"], pitch_mm * found["b2"], -pitch_mm * found["b3"]]
    assert per_px == pytest.approx([0.041989, 0.000144, 0.000147, -0.041985], abs=6e-7)
    assert (found["a1"], found["b1"]) == pytest.approx(
        (-120.259262, 116.872551), abs=1e-5
    )  # computed in single precision
    datum = result["groups"]["datum"]
    assert (datum["rms_x_um"], datum["rms_y_um"]) == pytest.approx((18.612, 10.329), abs=1e-3)
    assert result["redundancy"] == 10


@needs("film_numbers")
@pytest.mark.parametrize(
    ("kind", "rms_um"), [("affine", ((5.7, 5.1), (5.7, 4.3))), ("similarity", ((6.8, 6.2), (6.5, 5.3)))]
)
def test_fiducials_of_a_film_pair(kind: str, rms_um: Sequence[tuple[float, float]], tmp_path: Path) -> None:
    """A Wild RC30 pair, the calibrated fiducials held fixed."""
    result = adjusted_result(tmp_path, *rc30(kind))
    for image, expected in zip(("3574", "3575"), rms_um, strict=True):
        v = [(row["vx_um"], row["vy_um"]) for row in result["residuals"] if row["image"] == image]
        assert np.sqrt((np.array(v) ** 2).mean(axis=0)) == pytest.approx(expected, abs=0.06)
    assert result["redundancy"] == 2 * (16 - {"affine": 6, "similarity": 4}[kind])


def rc30(kind: str) -> tuple[str, str, list[tuple[object, ...]]]:
    """Camera, project and fiducial rows of the pair: the readings' origin is at the lower left, y up."""
    marks = table(FILM / "rc30_AR112_3574_3575" / "fiducials.csv")
    rows: list[tuple[object, ...]] = [
        (image, m["id"], "fiducial", *(0.016 * float(m[f"img{image}_{axis}_px"]) for axis in "xy"), 0.005, 0.005)
        for image in ("3574", "3575")
        for m in marks
    ]
    camera = (
        'name = "RC30"\nprincipal_distance_mm = 153.324\nprincipal_point_mm = [-0.002, 0.004]\n'
        "[sigma]\nprincipal_distance_mm = 0\nprincipal_point_mm = 0\n"
    )
    return camera + fiducials(marks, 0.0), f'[adjust]\ntransformation = "{kind}"\n', rows

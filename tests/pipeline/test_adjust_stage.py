"""The reference adjustments, datum, distances and other observed quantities through the user's files."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from projects import write_network_project
from reference_cases import CASES, CAUSES, DROPPED, case_network
from studies import parametrize_with_studies

from adjust import Adjustment, AdjustmentError
from adjust.functional_model.rotation import rotation_from_angles
from adjust.problem.network import EXTERIOR_NAMES
from pipeline import InputError, read_adjustment, read_comparator, read_project, write_adjustment
from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.cli import run
from pipeline.opencv_check.check import check_against_opencv
from pipeline.report import ReportData
from pipeline.report.verdict import judge
from pipeline.results.adjustment_content import adjustment_record
from pipeline.results.record_json import plain_json

USUAL = ("F5-F9", "F7-F9")  # what is not left to the studies
NAMES = sorted(path.stem for path in CASES.glob("*.json") if not path.stem.startswith("v_"))


@parametrize_with_studies("name", NAMES, quick=(5, 6))
def test_reference_case_through_files(name: str, tmp_path: Path) -> None:
    case = json.loads((CASES / f"{name}.json").read_text(encoding="utf-8"))
    write_project(case, tmp_path)
    project = read_project(tmp_path / "project.toml")
    adjustment = adjust_marks(project, read_comparator(project.comparator))
    result, reference = plain_json(adjustment_record(adjustment)), case["result"]
    assert result["converged"]
    assert (result["unknowns"], result["redundancy"]) == (reference["unknowns"], reference["redundancy"])
    exact = reference["vpv"] < 1e-12
    if not exact:
        assert adjustment.vpv == pytest.approx(reference["vpv"], rel=1e-8)
    checked = 0
    for parameter, expected in reference["parameters"].items():
        value, sigma = quantity(result, parameter)
        scale = expected["std_apriori" if exact else "std_aposteriori"]
        difference = value - expected["value"]
        if parameter.endswith(("omega", "phi", "kappa")):
            difference = float(np.angle(np.exp(1j * difference)))  # a whole turn is no difference
        assert abs(difference) <= 1e-6 * scale, parameter
        if not exact:
            assert sigma == pytest.approx(expected["std_aposteriori"], rel=1e-6), parameter
        checked += 1
    assert checked == reference["unknowns"]


@pytest.mark.parametrize(
    "priors", [each if each in USUAL else pytest.param(each, marks=pytest.mark.study) for each in DROPPED]
)
@parametrize_with_studies("name", sorted(path.stem for path in CASES.glob("v_*.json")), quick=(0, 2))
def test_singular_case_through_files(name: str, priors: str, tmp_path: Path) -> None:
    """The number and the kinds of the null directions, from the case's own orientations as approximations."""
    case = json.loads((CASES / f"{name}.json").read_text(encoding="utf-8"))
    expected = case["expected_defects_by_dropped_pseudo_observations"][priors]
    sigmas = {number: None if number in DROPPED[priors] else 1.0 for number in range(5, 10)}
    case["input"]["fid_sigma"] = [[sigmas[5], sigmas[6]]] * len(case["input"]["fid_obs"])
    case["input"]["io_sigma"][:3] = [sigmas[7], sigmas[8], sigmas[9]]
    write_project(case, tmp_path)
    write_images(case, tmp_path)
    code = run(["adjust", str(tmp_path / "project.toml")])
    result = json.loads((tmp_path / "out" / "adjustment.json").read_text(encoding="utf-8"))
    assert len(result["singular"]) == expected["total_defect"]
    assert result["converged"] == (expected["total_defect"] == 0)
    assert code == (1 if result["singular"] or result["warnings"] else 0)
    datum, camera = np.split(np.array(result["singular"], dtype=object), [expected["object_datum_defect"]])
    assert all("object space" in direction["cause"] and direction["remedy"] for direction in datum)
    assert len(camera) == len(expected["directions"])
    for direction, row in zip(camera, expected["directions"], strict=True):
        assert CAUSES[row["lead"]] in direction["cause"]
        assert direction["parameters"]
        assert direction["remedy"]


def write_images(case: dict[str, Any], folder: Path) -> None:
    """images.csv with the orientations of the case's state, angles in degrees."""
    state = case["state"]
    rows = ["image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg"]
    for image in sorted({row[0] for row in case["input"]["obs"]}):
        angles = [np.rad2deg(state[f"EO{image}.{angle}"]) for angle in ("omega", "phi", "kappa")]
        rows.append(",".join(map(str, [image, *(state[f"EO{image}.{axis}"] for axis in ("X0", "Y0", "Z0")), *angles])))
    (folder / "images.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    project = folder / "project.toml"
    text = project.read_text(encoding="utf-8")
    project.write_text(text.replace("[object]", '[object]\nimages = "images.csv"'), encoding="utf-8")


def quantity(result: dict[str, Any], parameter: str) -> tuple[float, float]:
    """Value and sigma of a parameter by its name in the case, angles in rad."""
    owner, name = parameter.split(".")
    camera = result["cameras"]["C"]
    image = result["images"].get(owner.removeprefix("EO").removeprefix("T"), {})
    if owner.startswith("EO"):
        key = f"{name}_deg" if name in ("omega", "phi", "kappa") else name
        found, factor = image["exterior"][key], np.pi / 180.0 if key.endswith("deg") else 1.0
    elif owner.startswith("T"):
        found, factor = image["transformation"][name], 1.0
    elif owner.startswith("FID"):
        found, factor = camera["fiducials"][owner.removeprefix("FID")][f"{name}_mm"], 1.0
    elif owner.startswith("PT"):
        found, factor = result["points"][owner.removeprefix("PT")][name], 1.0
    elif name == "c":
        found, factor = camera["principal_distance_mm"], 1.0
    elif name in ("x0", "y0"):
        found, factor = camera["principal_point_mm"][name[0]], 1.0
    else:
        found, factor = camera["distortion"][name], 1.0
    return factor * found["value"], factor * found["sigma"]


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


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("1,77,3.0,0.1", ["line 2, column to", "'77' is no object point"]),
        ("1,1,3.0,0.1", ["both ends"]),
        ("1,2,-3.0,0.1", ["column distance", "positive length"]),
        ("1,2,3.0,0", ["column sigma", "exact distance is not offered"]),
        ("1,2,3.0,", ["column sigma", "blank"]),
        ("1,2,3.0,-1", ["column sigma", "negative"]),
        ("", ["holds no distance"]),
    ],
)
def test_a_mistake_in_the_distances_gets_a_message(row: str, words: list[str], tmp_path: Path) -> None:
    free_project(tmp_path, objects='distances = "bars.csv"')
    (tmp_path / "bars.csv").write_text(f"from,to,distance,sigma\n{row}\n", encoding="utf-8")
    with pytest.raises(InputError) as error:
        adjust_network(tmp_path)
    for word in ["bars.csv", *words]:
        assert word in str(error.value)


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


def test_an_antenna_cannot_be_fixed(earlier: tuple[Path, Adjustment], tmp_path: Path) -> None:
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


def test_the_fiducials_of_an_earlier_calibration_can_be_left_out(
    earlier: tuple[Path, Adjustment], tmp_path: Path
) -> None:
    keys = "[sigma]\ncalibration_fiducials = false"
    second = once_more(earlier[0], tmp_path, lambda text: text.replace("[sigma]", keys, 1))
    assert {row.name.split(".")[0] for row in second.further} == {"IO"}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("adjustment.json", "no.json", ["no.json", "no such file"]),
        ("[distortion]", '[distortion]\nfamily = "brown"\n[unused]', ["family = 'torlegard'", "'brown'"]),
        ('decentering = "paper"', 'decentering = "reduced"', ["decentering = 'paper'"]),
        ("r0_mm = 0.0", "r0_mm = 50.0", ["r0_mm = 0.0"]),
        ("\nk7 = 0.0\n", "\nk7 = 1e-20\n", ["held k7 of camera C fixed at 0", "standard deviation of 0"]),
    ],
)
def test_a_calibration_of_another_lens_is_refused(
    old: str, new: str, words: list[str], earlier: tuple[Path, Adjustment], tmp_path: Path
) -> None:
    def changed(text: str) -> str:
        assert old in text
        return re.sub(r"\[unused\].*?(?=\[\[fiducial)", "", text.replace(old, new, 1), flags=re.DOTALL)

    with pytest.raises(InputError) as error:
        once_more(earlier[0], tmp_path, changed)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('datum = "free"\ndatum_coordinates = ["1.X"]', ["line 9", "datum_coordinates", '"minimal"']),
        ('datum_points = ["1"]', ["datum_points", '"free"', '"control"']),
        ('datum = "free"\ndatum_points = []', ["empty list"]),
        ('datum = "free"\ndatum_points = ["1", "1"]', ["'1' twice"]),
        ('datum = "free"\ndatum_points = ["1", "2", "P3"]', ["Point P3", "not among the object points"]),
        ('datum = "minimal"\ndatum_coordinates = ["1X"]', ["1X", "a dot and X, Y or Z"]),
    ],
)
def test_a_mistake_in_the_datum_gets_a_message(
    lines: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At once: it is sought in no observation."""
    monkeypatch.setattr("adjust.solution.adjustment.blunder_sentence", lambda *_: pytest.fail("sought a slip"))
    free_project(tmp_path, lines)
    with pytest.raises((InputError, AdjustmentError)) as error:
        adjust_network(tmp_path)
    for word in words:
        assert word in str(error.value)


def fiducial_project(folder: Path, distances: list[tuple[str, str, float]], extra: str = "") -> Path:
    """Eight affine frames of the fiducials alone, whose coordinates are free, and distances between them."""
    place = {"1": (-106.0, 106.0), "2": (106.0, 106.0), "3": (106.0, -106.0), "4": (-106.0, -106.0)}
    true = {id_: np.array(xy) + shift for (id_, xy), shift in zip(place.items(), [0.0, 0.03, -0.02, 0.05], strict=True)}
    lines = ['name = "K"', "frame_mm = [228.0, 228.0]"]
    for id_, (x, y) in place.items():
        lines += ["[[fiducial]]", f'id = "{id_}"', f"xy_mm = [{x}, {y}]", 'sigma_mm = "free"']
    for start, end, error in distances:
        length = float(np.linalg.norm(true[end] - true[start])) + error if end in true and start in true else 100.0
        lines += ["[[fiducial_distance]]", f'from = "{start}"', f'to = "{end}"', f"mm = {length!r}", "sigma_mm = 0.005"]
    (folder / "camera.toml").write_text("\n".join([*lines, extra]) + "\n", encoding="utf-8")
    rows, rng = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"], np.random.default_rng(3)
    for image in "abcdefgh":
        film = np.eye(2) + 1e-3 * rng.standard_normal((2, 2))
        for id_, xy in true.items():
            x, y = (film @ xy + 3.0 + 0.003 * rng.standard_normal(2)).tolist()
            rows.append(f"{image},{id_},fiducial,{x!r},{y!r},0.003,0.003")
    (folder / "comparator.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "project.toml").write_text('camera = "camera.toml"\n', encoding="utf-8")
    return folder / "project.toml"


ALL_SIX = [("1", "2", 0.0), ("2", "3", 0.0), ("3", "4", 0.0), ("4", "1", 0.0), ("1", "3", 0.0), ("2", "4", 0.0)]


def test_distances_between_fiducials_through_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


@pytest.mark.parametrize(
    ("distance", "extra", "words"),
    [
        (("1", "9", 0.0), "", r"fiducial_distance.* to: there is no fiducial '9'"),
        (("1", "1", 10.0), "", "a distance has two ends"),
        (("1", "2", -300.0), "", "mm: must be greater than 0"),
        (("1", "2", 0.0), "weight = 2", "weight"),
    ],
)
def test_what_is_no_distance_between_fiducials_is_refused(
    tmp_path: Path, distance: tuple[str, str, float], extra: str, words: str
) -> None:
    project = fiducial_project(tmp_path, [distance], extra)
    with pytest.raises(InputError, match=words):
        read_project(project)

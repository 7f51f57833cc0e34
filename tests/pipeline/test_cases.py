"""The reference adjustments through the user's files: comparator.csv and TOML in, adjustment.json out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference_cases import CASES, CAUSES, DROPPED
from studies import parametrize_with_studies

from pipeline.adjusting.adjust_stage import adjust_marks
from pipeline.cli import run
from pipeline.files.project_file import read_project
from pipeline.results.adjustment_content import adjustment_record
from pipeline.results.comparator_file import read_comparator
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
    given = case["input"]
    interior = dict(zip(case["io_names"], zip(given["io_obs"], given["io_sigma"], strict=True), strict=True))
    distortion = {name: pair for name, pair in interior.items() if name not in ("x0", "y0", "c")}
    lines = [
        'name = "C"',
        f"principal_distance_mm = {interior['c'][0]!r}",
        f"principal_point_mm = [{interior['x0'][0]!r}, {interior['y0'][0]!r}]",
        "[sigma]",
        f"principal_distance_mm = {sigma(interior['c'][1])}",
        f"principal_point_mm = [{sigma(interior['x0'][1])}, {sigma(interior['y0'][1])}]",
        "[distortion]",
        f'family = "{case["distortion"]}"',
        f"r0_dm = {case['r0']!r}" if case["distortion"] == "juhl" else f"r0_mm = {case['r0']!r}",
        'decentering = "paper"' if case["decentering_mode"] == "paper" else "",
        "[distortion.value]",
        *(f"{name} = {value!r}" for name, (value, _) in distortion.items()),
        "[distortion.sigma]",
        *(f"{name} = {sigma(s)}" for name, (_, s) in distortion.items()),
    ]
    for i, ((x, y), (sx, sy)) in enumerate(zip(given["fid_obs"], given["fid_sigma"], strict=True), 1):
        lines += ["[[fiducial]]", f'id = "{i}"', f"xy_mm = [{x!r}, {y!r}]", f"sigma_mm = [{sigma(sx)}, {sigma(sy)}]"]
    (folder / "camera.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = ["point,X,Y,Z,sX,sY,sZ"]
    for i, (xyz, sigmas) in enumerate(zip(given["pts_obs"], given["pts_sigma"], strict=True), 1):
        rows.append(",".join([str(i), *map(repr, xyz), *("" if s is None else repr(s) for s in sigmas)]))
    (folder / "points.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    rows = ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    for kind, key in (("target", "obs"), ("fiducial", "fobs")):
        rows += [",".join([str(i), str(p), kind, *map(repr, rest)]) for i, p, *rest in given[key]]
    (folder / "comparator.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "project.toml").write_text(
        f'camera = "camera.toml"\n[object]\npoints = "points.csv"\n[adjust]\ntransformation = "{case["transform"]}"\n',
        encoding="utf-8",
    )


def sigma(value: float | None) -> str:
    return '"free"' if value is None else repr(value)

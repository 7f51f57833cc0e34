"""Lenses converted, compared, and written as certificates."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from networks import lens_network, set_camera, set_observations, simulated
from projects import Printed, Refusal, command, present, result_file, write_network_project

from adjust import adjust
from adjust.functional_model.families import FAMILY_NAMES, parameter_names
from adjust.functional_model.lens import Distortion, Lens
from adjust.problem.parameter import Parameter
from pipeline import InputError, read_adjustment, read_camera, write_adjustment
from pipeline.adjusting.compare_stage import run_compare
from pipeline.cli import DONE, LOOK
from pipeline.commands.exchanging import FAMILIES
from pipeline.exchange.saved_cameras import save_cameras
from pipeline.files.project_file import read_project
from pipeline.provenance import hash_file
from pipeline.report.lens import ANGLES_DEG, certificate
from pipeline.results.adjustment_file import read_covariance
from pipeline.text.files import FORMS, check_replaceable

CAMERA = """\
name = "C"
frame_mm = [36.0, 24.0]
principal_distance_mm = 28.8
principal_point_mm = [0.02, 0.05]
sigma = {principal_distance_mm = 0.0, principal_point_mm = 0.0}
[distortion]
family = "aicon"
r0_mm = 13.488
value = {a1 = -1.1e-4, a2 = 1.5e-7}
sigma = {a1 = 3e-7, a2 = "free"}
"""


def test_the_help_lists_all_families() -> None:
    assert ", ".join(FAMILY_NAMES) == FAMILIES


def test_a_camera_file_becomes_opencvs(tmp_path: Path, printed: Printed) -> None:
    (tmp_path / "camera.toml").write_text(CAMERA)
    assert "opencv mean the same here" in printed("convert", tmp_path / "camera.toml", "opencv", tmp_path / "out")
    camera = read_camera(tmp_path / "out" / "camera.toml")
    s = 1.0 + 1.1e-4 * 13.488**2 - 1.5e-7 * 13.488**4
    assert camera.principal_distance_mm == pytest.approx(28.8 * s, rel=1e-12)
    assert camera.distortion.parameters["k1"].value == pytest.approx(-1.1e-4 * 28.8**2 / s, rel=1e-9)
    assert set(camera.distortion.parameters) == {"k1", "k2"}
    assert all(np.isinf(prior.sigma) for prior in camera.distortion.parameters.values())


def test_an_adjustment_keeps_its_covariance(tmp_path: Path, printed: Printed) -> None:
    """The converted file compares with its source as no drift, and comes back to it when converted back."""
    project = write_network_project(lens_network("australis", np.random.default_rng(7)), tmp_path)
    command("adjust", project)
    first = tmp_path / "out" / "adjustment.json"
    there, back = tmp_path / "brown", tmp_path / "back"
    assert f'calibration = "{there / "adjustment.json"}" under [sigma] in the camera file' in printed(
        "convert", first, "brown", there
    )
    assert command("convert", there / "adjustment.json", "australis", back) == DONE
    before, after = (read_adjustment(path).cameras["L"] for path in (first, back / "adjustment.json"))
    for name in ("k1", "k2", "p1", "p2", "b1", "b2"):
        for key in ("value", "sigma"):
            found, given = (getattr(each.distortion.parameters[name], key) for each in (after, before))
            assert found == pytest.approx(given, rel=1e-6)
    names = ["IO.L.c", "IO.L.k1", "EO.i0.omega", "EO.i3.X0"]
    one, other = (read_covariance(path).select(names) for path in (first, back / "adjustment.json"))
    np.testing.assert_allclose(other, one, rtol=1e-5)
    converted = read_adjustment(there / "adjustment.json").cameras["L"]
    assert present(converted.converted).same
    k1, given = (each.distortion.parameters["k1"].value for each in (converted, before))
    assert k1 == pytest.approx(-given, rel=1e-9)
    assert command("compare", first, there / "adjustment.json") == DONE
    (there / "adjustment.npz").write_bytes(first.with_suffix(".npz").read_bytes())
    assert command("convert", there / "adjustment.json", "australis", tmp_path / "mixed") == 2
    assert not (tmp_path / "mixed").exists()


def test_the_larger_covariance_is_converted_saved_and_used(tmp_path: Path, printed: Printed) -> None:
    """Images of unlike distortion: by leaving them out the camera is less precise than by the model."""
    network = lens_network("australis", np.random.default_rng(7))
    xy_mm, images = network.observations.xy_mm, [int(image[1:]) for image in network.observations.image]
    unlike = 1e-5 * np.random.default_rng(8).normal(size=len(network.images))[images, None]
    observed = replace(network.observations, xy_mm=xy_mm * (1.0 + unlike * (xy_mm**2).sum(axis=1, keepdims=True)))
    some = np.flatnonzero([int(point[1:]) % 2 for point in observed.point])  # half of the points are enough
    observed = observed.only(some)
    project = write_network_project(replace(network, observations=observed), tmp_path, "frame_mm = [40.0, 27.0]")
    project.write_text(project.read_text() + 'unmodelled = "estimate"\n')
    command("adjust", project)
    first, out = tmp_path / "out" / "adjustment.json", tmp_path / "brown"
    known, names = read_covariance(first), ("c", "x0", "y0", "k1", "k2", "p1", "p2", "b1", "b2")
    keys = [Parameter.interior("L", name) for name in names]
    sigmas = np.sqrt(np.diag(known.select_larger(keys)))
    assert sigmas[3] > 2.0 * np.sqrt(known.select(keys[3:4])[0, 0])
    written = json.loads(first.read_text())["cameras"]["L"]
    quantities = written["principal_distance_mm"], *written["principal_point_mm"].values(), written["distortion"]["k1"]
    clusters = np.sqrt(np.diag(present(known.clusters).select(keys[:4])))
    assert [each["sigma_clusters"] for each in quantities] == pytest.approx(clusters)
    assert "over 40 x 27 mm is rounding" in " ".join(printed("convert", first, "brown", out).split())
    values = json.loads(printed("convert", first, "brown", out, "--json"))["values"]
    assert [values[name]["sigma"] for name in names] == pytest.approx(sigmas, rel=1e-6)
    converted = read_covariance(out / "adjustment.json")
    np.testing.assert_allclose(np.sqrt(np.diag(converted.select_larger(keys))), sigmas, rtol=1e-6)
    (saved,) = save_cameras([read_project(project)], tmp_path / "saved")
    text = (tmp_path / "camera.toml").read_text()
    (tmp_path / "later.toml").write_text(text.replace("[sigma]\n", '[sigma]\ncalibration = "out/adjustment.json"\n'))
    for path in (saved.path, tmp_path / "later.toml"):
        calibration = present(read_camera(path).calibration)
        rows = [calibration.parameters.index(key) for key in keys]
        assert np.sqrt(np.diag(calibration.covariance))[rows] == pytest.approx(sigmas, rel=1e-6)


def test_what_does_not_fit_is_reported(tmp_path: Path, printed: Printed, refusal: Refusal) -> None:
    camera = tmp_path / "camera.toml"
    camera.write_text(CAMERA)
    output = json.loads(printed("convert", camera, "brown", tmp_path / "out", "--json", code=LOOK))
    assert not output["same"]
    assert 0.5 < output["largest_um"] < 10.0
    for arguments, words in (
        (["opencf", "out"], "did you mean"),
        (["juhl", "out"], "needs a radius r0"),
        (["juhl", "out", "--r0-mm", "1e-300"], "needs a radius r0"),
        (["brown", "out", "--parameters", "k1,a2"], "brown has no parameter a2"),
    ):
        assert words in refusal(
            "convert", camera, arguments[0], tmp_path / arguments[1], *arguments[2:]
        ).lower().replace("\n", " ")
    camera.write_text(CAMERA.replace("frame_mm = [36.0, 24.0]\n", ""))
    assert "has no frame_mm" in refusal("convert", camera, "opencv", tmp_path / "out")
    wide = CAMERA.split("[distortion]")[0].replace("28.8", "15.0")
    lens = '[distortion]\nfamily = "opencv_fisheye"\nvalue = {k1 = 0.03, k2 = -0.01, k3 = 0.002}\n'
    (tmp_path / "wide.toml").write_text(wide + lens)
    assert "folds the image over" in refusal("convert", tmp_path / "wide.toml", "opencv", tmp_path / "wide")
    assert not (tmp_path / "wide").exists()
    project = tmp_path / "project.toml"
    project.write_text('camera = "camera.toml"\n')
    (tmp_path / "comparator.csv").write_text("image,point,kind,x_mm,y_mm\na,1,target,1.0,1.0\n")
    message = refusal("convert", project, "opencv", tmp_path / "out")
    assert "is a project" in message
    assert str(camera) in message


SVG = "{http://www.w3.org/2000/svg}"


def shift_parameter(project: Path, name: str, change_mm: float) -> Path:
    """A copy of the project's calibration whose principal distance is another."""
    copy = project.parent / name / "adjustment.json"
    copy.parent.mkdir()
    content = result_file(project)
    (camera,) = content["cameras"].values()
    camera["principal_distance_mm"]["value"] += change_mm
    copy.write_text(json.dumps(content))
    with np.load(project / "out" / "adjustment.npz") as arrays:
        whole = dict(arrays)
    whole["fingerprint"] = np.array(hash_file(copy))
    whole["values"] = whole["values"] + change_mm * np.char.endswith(whole["names"], ".c")
    np.savez(copy.with_suffix(".npz"), **whole)
    return copy


def test_an_unchanged_camera_and_a_changed_one(
    project: Path, printed: Printed, printed_line: Printed, refusal: Refusal
) -> None:
    first = project / "out" / "adjustment.json"
    output = printed_line("compare", first, shift_parameter(project, "same", 0.0))
    assert output.startswith("no drift ")
    assert "same less out" in output
    assert "were adjusted from the same measured marks: they are not independent" in output
    assert "they agree better than independent calibrations can" in output
    out = project / "compared"
    output = printed("compare", first, shift_parameter(project, "later", 0.5), "--out", out, code=1)
    assert output.startswith("drift\n")
    assert "better than independent" not in output
    (largest,) = re.findall(r"Fiducial marks after a similarity: at most ([\d.]+) µm", output)
    assert float(largest) < 0.2  # of their 0.3 um: c and the marks are hardly tied
    for name in ("compare.json", "compare.svg"):  # its own files may be replaced, others not
        check_replaceable(out / name, FORMS[Path(name).suffix], "")
        (project / name).write_text("mine")
        assert f"{name}: a result is to be written there, but" in refusal("compare", first, first, "--out", project)
        (project / name).unlink()
    drawn = ElementTree.parse(out / "compare.svg").getroot()
    assert len(drawn.findall(f".//{SVG}ellipse")) == 49  # one a place of the field
    content = json.loads((out / "compare.json").read_text())
    (difference,) = content["differences"]
    corner = np.array(difference["field_um"])[np.abs(content["places_mm"]).sum(axis=1).argmax()]
    assert content["verdict"] == "drift"
    # A ray at 25 mm of 60 moves by 0.5 / 60 of that, less what a change of the point or the lens would not take up.
    assert np.hypot(*corner) == pytest.approx(np.hypot(25.0, 25.0) * 0.5 / 60.3 * 1e3, rel=0.1)


def test_calibrations_are_compared_where_all_have_observations(tmp_path: Path) -> None:
    """A digital camera counts from its first pixel, so that the area is no rectangle about 0; apart there is none."""
    network, _ = simulated(np.random.default_rng(1), kind="none")
    (camera,) = network.cameras
    paths, off_mm = [tmp_path / f"{name}.json" for name in "ab"], np.array([120.0, -115.0])
    x0, y0 = (
        replace(given, value=given.value + off)
        for given, off in zip((present(camera.x0_mm), present(camera.y0_mm)), off_mm, strict=True)
    )
    xy_mm = network.observations.xy_mm + off_mm
    network = set_observations(set_camera(network, x0_mm=x0, y0_mm=y0), xy_mm=xy_mm)
    adjustment = adjust(network)
    for path in paths:
        write_adjustment(adjustment, path)
    found, record = run_compare(paths, None, None, "space", 0.01, None)
    np.testing.assert_allclose(found.places_mm.min(axis=0), xy_mm.min(axis=0), atol=1e-9)
    np.testing.assert_allclose(found.places_mm.max(axis=0), xy_mm.max(axis=0), atol=1e-9)
    assert record.verdict == "no drift"
    content = json.loads(paths[1].read_text())
    for row in content["residuals"]:
        row["camera_x_mm"] += 1000.0
    paths[1].write_text(json.dumps(content))
    with np.load(paths[0].with_suffix(".npz")) as arrays:
        np.savez(paths[1].with_suffix(".npz"), **{**arrays, "fingerprint": np.array(hash_file(paths[1]))})
    with pytest.raises(InputError, match="no part of the image was observed in all of them"):
        run_compare(paths, None, None, "space", 0.01, None)


def test_a_series_has_a_trend(project: Path, printed: Printed) -> None:
    paths = [str(shift_parameter(project, f"y{year}", 0.02 * (year - 1950))) for year in (1952, 1958, 1961, 1970)]
    content = json.loads(printed("compare", *paths, "--times", "1952,1958,1961,1970", "--json", code=1))
    assert content["trend"]["probability"] < 1e-6
    assert content["probability"] <= 2 * content["trend"]["probability"]
    corner = np.array(content["trend_um"])[np.abs(content["places_mm"]).sum(axis=1).argmax()]
    assert np.hypot(*corner) == pytest.approx(np.hypot(25.0, 25.0) * 0.36 / 60.3 * 1e3, rel=0.1)  # over 18 years
    assert [each["time"] for each in content["calibrations"]] == [1952.0, 1958.0, 1961.0, 1970.0]


@pytest.mark.parametrize(
    ("other", "arguments", "words"),
    [
        ("same", ["--camera", "metric 6 x 7"], "holds no camera 'metric 6 x 7'"),
        ("same", ["--times", "1952;1958"], "are not numbers with commas"),
        ("same", ["--times", "1958,1952"], "in rising order"),
        ("mixed", [], "is of another adjustment than"),
        ("out", [], "is named twice"),
    ],
)
def test_what_it_refuses(other: str, arguments: list[str], words: str, project: Path, refusal: Refusal) -> None:
    first = project / "out" / "adjustment.json"
    second = first if other == "out" else shift_parameter(project, other, 0.1)
    if other == "mixed":
        second.with_suffix(".npz").write_bytes(first.with_suffix(".npz").read_bytes())
    assert words in refusal("compare", first, second, *arguments)


C, K3, K5 = 153.02, 2.0e-8, -1.5e-12
NAMES = parameter_names("torlegard")
SIGMAS = {"c": 0.01, "k3": 4e-9, "k5": 3e-13}
LENS = Lens(
    Distortion("torlegard"),
    np.array([C, 0.1, -0.2]),
    np.array([{"k3": K3, "k5": K5, "p1": 3e-7}.get(name, 0.0) for name in NAMES]),
    np.diag([SIGMAS.get(name, 0.0) ** 2 for name in ("c", "x0", "y0", *NAMES)]),
)
REACH_MM = 140.0


def distortion_um(c: float, angle_deg: Any, lens: tuple[float, float, float] = (C, K3, K5)) -> Any:
    """By fixed-point iteration, of the lens at angles against c."""
    equivalent, k3, k5 = lens
    tangent = np.tan(np.radians(angle_deg))
    r = equivalent * tangent
    for _ in range(20):
        r = equivalent * tangent + k3 * r**3 + k5 * r**5
    return 1000.0 * (r - c * tangent)


def balanced(lens: tuple[float, float, float]) -> float:
    """By bisection over a dense table."""
    largest = REACH_MM - lens[1] * REACH_MM**3 - lens[2] * REACH_MM**5
    angles = np.degrees(np.arctan(np.linspace(0.0, largest / lens[0], 800)))
    own = distortion_um(0.0, angles, lens)
    low, high = lens[0] - 1.0, lens[0] + 1.0
    for _ in range(60):
        middle = (low + high) / 2.0
        off = own - 1000.0 * middle * np.tan(np.radians(angles))
        low, high = (middle, high) if off.max() + off.min() > 0.0 else (low, middle)
    return (low + high) / 2.0


def test_the_printed_table_is_that_of_the_lens_with_its_standard_deviations() -> None:
    view = certificate(LENS, REACH_MM)
    calibrated = balanced((C, K3, K5))
    assert view.calibrated[0] == pytest.approx(calibrated, abs=2e-5)
    assert view.equivalent[0] == pytest.approx(C, abs=2e-5)
    assert view.equivalent[1] == pytest.approx(SIGMAS["c"], rel=0.05)
    assert [row.angle_deg for row in view.rows] == list(ANGLES_DEG)
    for row in view.rows:
        there = distortion_um(calibrated, row.angle_deg)
        assert row.radial[0] == pytest.approx(there, abs=0.01)
    rng = np.random.default_rng(2)
    drawn = [rng.normal((C, K3, K5), list(SIGMAS.values())) for _ in range(300)]
    distances = [balanced((float(c), float(k3), float(k5))) for c, k3, k5 in drawn]
    assert view.calibrated[1] == pytest.approx(np.std(distances), rel=0.15)
    for row in view.rows[1:]:
        angle = row.angle_deg
        values = [
            distortion_um(own, angle, (float(c), float(k3), float(k5)))
            for own, (c, k3, k5) in zip(distances, drawn, strict=True)
        ]
        assert row.radial[1] == pytest.approx(np.std(values), rel=0.2)
    view = certificate(replace(LENS, interior=np.array([600.0, 0.0, 0.0])), 140.0)
    angles = [row.angle_deg for row in view.rows]
    assert len(angles) == 6
    assert angles[-1] == pytest.approx(np.degrees(np.arctan(140.0 / 600.0)), abs=0.1)

"""A scanner through files: [adjust] scanner, the column of images.csv, adjustment.json, the report, the messages."""

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from networks import bent_films
from simulated_project import write_project
from small_scene import OBLIQUE, SCANNER, scene
from truth_comparison import Comparison, bend_quantities

from adjust.functional_model.lens import Prior
from adjust.initial_values.approximations import approximate
from adjust.problem.network import Network, Scanner
from adjust.solution.adjustment import adjust
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.rendered.scene_file import read_scene
from pipeline.rendered.scene_project import write_project as write_rendered
from pipeline.report.camera_views import bend_field
from pipeline.results.adjustment_file import read_adjustment
from pipeline.results.covariance_file import read_covariance
from synthetic_images.film import frame_geometry, scanner_bend
from synthetic_images.frame import frame_truth

TRUTH = {"a20": 0.02, "b11": -0.015, "b02": 0.01}
QUARTERS = [0.0, 90.0, 180.0, 270.0] * 2


def project(folder: Path, network: Network, setting: str) -> Path:
    path = write_project(network, folder)
    text = path.read_text(encoding="utf-8").replace('points = "points.csv"\n', 'images = "images.csv"\n')
    path.write_text(f"{text}scanner = {setting}\n", encoding="utf-8")
    names = [image.name for image in network.images]
    rows = [f"{name},{'' if i < len(names) // 2 else 'other'}" for i, name in enumerate(names)]
    (folder / "images.csv").write_text("image,scanner\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def stored(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "out" / "adjustment.json").read_text(encoding="utf-8")))


def test_two_scanners_of_images_csv_are_adjusted_and_shown(tmp_path: Path) -> None:
    network = bent_films(QUARTERS, TRUTH, {}, np.random.default_rng(1))
    path = project(tmp_path, network, '["a20", "b11", "b02"]\nscanner_sigma_um = 50.0')
    assert run(["run", str(path)]) == DONE
    scanners = stored(tmp_path)["scanners"]
    assert set(scanners) == {"1", "other"}
    assert [image["scanner"] for image in stored(tmp_path)["images"].values()] == ["1"] * 4 + ["other"] * 4
    for scanner in scanners.values():
        assert set(scanner["terms"]) == set(TRUTH)
        term = scanner["terms"]["a20"]
        assert term["value"] == pytest.approx(0.02, rel=0.2)
        assert term["given"] == {"value": 0.0, "sigma": 0.05}
        assert 0.0 < term["sigma"] < 0.005
        assert term["p"] < 0.001
        assert scanner["significance"][0]["parameters"] == list(TRUTH)
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    section = report[report.index('id="scanners"') : report.index('id="notes"')]
    assert section.count("<svg") == 2
    assert section.count('class="ellipse"') >= 2 * 72
    assert "other (4 scans)" in section
    assert "significant (" in section


def test_the_field_of_the_report_has_the_band_of_its_terms(tmp_path: Path) -> None:
    """At the corner of the extent a Legendre polynomial is 1: the field there is the sum of the terms."""
    network = bent_films(QUARTERS, TRUTH, {}, np.random.default_rng(1))
    assert run(["adjust", str(project(tmp_path, network, '["a20", "a02"]'))]) == LOOK  # b11 is missing, sigma0 says
    path = tmp_path / "out" / "adjustment.json"
    scanner, covariance = read_adjustment(path).scanners["1"], read_covariance(path)
    corner = np.array([scanner.center_mm]) + scanner.half_mm
    value_um, covariance_um2 = bend_field("1", scanner, covariance, corner)
    terms = scanner.terms
    assert value_um[0, 0] == pytest.approx(1e3 * (terms["a20"].value + terms["a02"].value))
    matrix = covariance.select(["SC.1.a20", "SC.1.a02"])
    assert covariance_um2[0, 0, 0] == pytest.approx(1e6 * matrix.sum())
    assert covariance_um2[0, 1, 1] == pytest.approx(0.0)


def test_without_the_key_there_is_no_scanner(tmp_path: Path) -> None:
    network = bent_films(QUARTERS, {}, {}, np.random.default_rng(1))
    path = project(tmp_path, network, '"none"')
    assert run(["run", str(path)]) == DONE
    assert stored(tmp_path)["scanners"] == {}
    assert 'id="scanners"' not in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_frames_that_lie_alike_end_in_a_question(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network = bent_films([0.0] * 4, TRUTH, {}, np.random.default_rng(1))
    assert run(["adjust", str(project(tmp_path, network, '"auto"'))]) == LOOK
    assert "all frames lie alike in the scanner" in " ".join(capsys.readouterr().out.split())
    assert not any(scanner["terms"] for scanner in stored(tmp_path)["scanners"].values())


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ('"wobble"', "possible are 'none', 'auto', 'bend'"),
        ('["a10"]', "names 'a10'; a bend has the terms a20"),
        ('["a20", "a20"]', "names a term twice"),
        ('["stretch"]', "'stretch', which the affine transformation of the films takes"),
        ('"bend"\nscanner_sigma_um = 0.0', "would fix every term at 0"),
    ],
)
def test_what_is_wrong_is_stated(tmp_path: Path, capsys: pytest.CaptureFixture[str], setting: str, words: str) -> None:
    assert run(["adjust", str(project(tmp_path, bent_films([0.0], {}, {}), setting))]) == WRONG_INPUT
    assert words in capsys.readouterr().err


def test_a_digital_camera_has_no_scanner(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = project(tmp_path, bent_films([0.0], {}, {}), '"bend"')
    text = path.read_text(encoding="utf-8").replace('transformation = "affine"', 'transformation = "none"')
    path.write_text(text, encoding="utf-8")
    assert run(["adjust", str(path)]) == WRONG_INPUT
    assert "a digital camera no scanner" in capsys.readouterr().err


def test_a_rendered_scanner_is_the_one_that_is_adjusted() -> None:
    """Where the renderer puts the marks of frames in four poses, one of them mirrored: its bend to a nanometre."""
    bend_um = {"a20": 20.0, "b11": -15.0, "a02": 8.0, "b30": 5.0, "a04": -3.0}
    poses = ("0", "90", "180", "270m")
    images = tuple(replace(OBLIQUE, name=f"f{pose}", pose=pose) for pose in poses)
    made = scene(images=images, scanner=replace(SCANNER, bend_um=bend_um))
    geometries = [frame_geometry(made, i) for i in range(len(poses))]
    marks_mm = {f"{i}{j}": (-5.0 + 2.0 * i, -5.0 + 2.0 * j) for i in range(6) for j in range(6)}
    pixels = np.concatenate([geometry.pixel_from_camera(np.array(list(marks_mm.values()))) for geometry in geometries])
    bend = scanner_bend(made)
    scanner = Scanner("S", dict.fromkeys(bend_um, Prior(0.0, np.inf)), bend.center_mm, (bend.size_mm / 2,) * 2)
    network = replace(
        bent_films([0.0] * len(poses), {}, {}, marks_mm=marks_mm, sigma_given_mm=0.0),
        scanners=(scanner,),
    )
    network = replace(network, observations=replace(network.observations, xy_mm=pixels * [0.04, -0.04]))
    result = adjust(network, approximate(network))
    assert result.converged
    for name, value in bend_um.items():
        assert result.value(f"SC.S.{name}") == pytest.approx(value / 1000.0, abs=1e-6)


def test_a_rendered_project_of_a_bent_scanner_appears_for_it(tmp_path: Path) -> None:
    text = (files("pipeline") / "templates" / "scene.toml").read_text(encoding="utf-8")
    bent = text.replace("# bend_um = {a20 = 20.0, b11 = -15.0}", "bend_um = {a20 = 20.0, b11 = -15.0}")
    assert bent != text
    (tmp_path / "scene.toml").write_text(bent, encoding="utf-8")
    scene_file = read_scene(tmp_path / "scene.toml")
    assert scene_file.scene.scanner.bend_um == {"a20": 20.0, "b11": -15.0}
    write_rendered(scene_file, tmp_path)
    assert 'scanner = "auto"' in (tmp_path / "project.toml").read_text(encoding="utf-8")


def test_a_design_says_what_cannot_be_known_of_the_scanner(tmp_path: Path) -> None:
    """The template's second frame turned by 180 degrees against the first, and laid like it, which tells less."""
    text = (files("pipeline") / "templates" / "scene.toml").read_text(encoding="utf-8")
    text = text.replace('scanner = "none"  ', 'scanner = ["a20"]  ').replace(
        "alternatives = true", "alternatives = false"
    )
    turned, alike = (text.replace('pose = "90m"', f'pose = "{pose}"') for pose in ("180", "0"))
    sigmas = {}
    for name, content in (("two", turned), ("alike", alike)):
        (tmp_path / f"{name}.toml").write_text(content, encoding="utf-8")
        run(["design", str(tmp_path / f"{name}.toml"), str(tmp_path / name)])
        found = json.loads((tmp_path / name / "design.json").read_text(encoding="utf-8"))
        sigmas[name] = found["scanners"]["1"]["a20"]["sigma"]
    assert 0.0 < sigmas["two"] < 0.99 * sigmas["alike"]


def test_a_design_tries_scans_turned_by_180_degrees(tmp_path: Path) -> None:
    text = (files("pipeline") / "templates" / "scene.toml").read_text(encoding="utf-8")
    text = text.replace('scanner = "none"  ', 'scanner = ["a20", "b11"]  ').replace('pose = "90m"', 'pose = "0"')
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    run(["design", str(tmp_path / "scene.toml"), str(tmp_path / "out")])
    found = json.loads((tmp_path / "out" / "design.json").read_text(encoding="utf-8"))
    (turned,) = [one for one in found["what_would_help"] if one["change"] == "every second scan turned by 180 degrees"]
    rms_um = 1e3 * np.sqrt(np.mean([term["sigma"] ** 2 for term in found["scanners"]["1"].values()]))
    assert turned["sigmas"]["scanner"] < 0.99 * rms_um
    assert turned["gain_percent"]["scanner"] == pytest.approx(100.0 * (1.0 - turned["sigmas"]["scanner"] / rms_um))


def test_two_photographs_of_a_rendered_scene_give_its_scanner_back(tmp_path: Path) -> None:
    """Marks where the renderer puts them, to 1.5 um: most of the terms that are tried are not told by two frames."""
    text = (files("pipeline") / "templates" / "scene.toml").read_text(encoding="utf-8")
    text = text.replace("# bend_um = {a20 = 20.0, b11 = -15.0}", "bend_um = {a20 = 20.0, b11 = -15.0}")
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    scene_file = read_scene(tmp_path / "scene.toml")
    write_rendered(scene_file, tmp_path)
    project_text = (tmp_path / "project.toml").read_text(encoding="utf-8")
    kept = [
        line for line in project_text.splitlines() if not line.startswith(("scans", "[targets]", "kind", "diameter"))
    ]
    (tmp_path / "project.toml").write_text("\n".join(kept) + "\n", encoding="utf-8")
    rng, rows = np.random.default_rng(1), ["image,point,kind,x_mm,y_mm,sx_mm,sy_mm"]
    for i, image in enumerate(scene_file.scene.images):
        truth = frame_truth(scene_file.scene, i)
        for kind, marks in (("fiducial", truth.fiducials), ("target", truth.targets)):
            for id, position in marks.items():
                x, y = position.center_px * [0.045, -0.045] + rng.normal(0.0, 0.0015, 2)
                if not position.hidden:
                    rows.append(f"{image.name},{id},{kind},{x:.6f},{y:.6f},0.0015,0.0015")
    (tmp_path / "comparator.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    assert run(["adjust", str(tmp_path / "project.toml")]) == DONE
    (found,) = stored(tmp_path)["scanners"].values()
    assert set(found["terms"]) == {"a20", "b11"}
    bed_mm = max(scene_file.scene.camera.frame_mm) / 2 + scene_file.scene.scanner.margin_mm
    (half_x, half_y), terms = found["half_mm"], found["terms"]
    for name, true in (("a20", 0.020 * (half_x / bed_mm) ** 2), ("b11", -0.015 * half_x * half_y / bed_mm**2)):
        assert abs(terms[name]["value"] - true) < 4.0 * terms[name]["sigma"]


def test_a_scenes_bend_is_compared_over_the_extent_that_was_adjusted() -> None:
    """u = r t + s takes P2(u) to r^2 P2(t), and P3(u) to r^3 P3(t) + 5 r^2 s P2(t), and what films take."""
    truth = {
        "center_mm": [60.0, -60.0],
        "half_mm": [60.0, 60.0],
        "terms": {"a30": {"value": 0.02}, "b02": {"value": 0.01}},
    }
    terms = {name: {"value": 0.0, "sigma": 0.001} for name in ("a20", "a30", "b02", "b11", "stretch")}
    found = dict(bend_quantities({"center_mm": [66.0, -54.0], "half_mm": [48.0, 30.0], "terms": terms}, truth))
    r, s = 0.8, 0.1
    expected = {"a20": 5 * r**2 * s * 0.02, "a30": r**3 * 0.02, "b02": 0.5**2 * 0.01, "b11": 0.0}
    assert {name: quantity[2] for name, quantity in found.items()} == pytest.approx(expected, abs=1e-12)
    assert Comparison((), {}, found).worst_scanner_sigmas == pytest.approx(1e3 * r**3 * 0.02)

"""`reseau convert`, from camera files and from adjustments with their covariance."""

import json
from pathlib import Path

import numpy as np
import pytest
from networks import lens_network
from simulated_project import write_project

from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.files.camera_file import read_camera
from pipeline.results.adjustment_file import read_adjustment
from pipeline.results.covariance_file import read_covariance

CAMERA = """\
name = "C"
frame_mm = [36.0, 24.0]
principal_distance_mm = 28.8
principal_point_mm = [0.02, 0.05]
[sigma]
principal_distance_mm = 0.0
principal_point_mm = 0.0
[distortion]
family = "aicon"
r0_mm = 13.488
[distortion.value]
a1 = -1.1e-4
a2 = 1.5e-7
[distortion.sigma]
a1 = 3e-7
a2 = "free"
"""


def test_a_camera_file_becomes_opencvs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "camera.toml").write_text(CAMERA, encoding="utf-8")
    assert run(["convert", str(tmp_path / "camera.toml"), "opencv", str(tmp_path / "out")]) == DONE
    assert "aicon and opencv mean the same here" in capsys.readouterr().out
    camera = read_camera(tmp_path / "out" / "camera.toml")
    s = 1.0 + 1.1e-4 * 13.488**2 - 1.5e-7 * 13.488**4
    assert camera.principal_distance_mm == pytest.approx(28.8 * s, rel=1e-12)
    assert camera.distortion.parameters["k1"].value == pytest.approx(-1.1e-4 * 28.8**2 / s, rel=1e-9)
    assert set(camera.distortion.parameters) == {"k1", "k2"}
    assert all(np.isinf(prior.sigma) for prior in camera.distortion.parameters.values())


def test_an_adjustment_keeps_its_covariance(tmp_path: Path) -> None:
    """The converted file compares with its source as no drift, and comes back to it when converted back."""
    project = write_project(lens_network("australis", np.random.default_rng(7)), tmp_path)
    run(["adjust", str(project)])
    first = tmp_path / "out" / "adjustment.json"
    there, back = tmp_path / "brown", tmp_path / "back"
    assert run(["convert", str(first), "brown", str(there)]) == DONE
    assert run(["convert", str(there / "adjustment.json"), "australis", str(back)]) == DONE
    before, after = (read_adjustment(path).cameras["L"] for path in (first, back / "adjustment.json"))
    for name in ("k1", "k2", "p1", "p2", "b1", "b2"):
        for key in ("value", "sigma"):
            found, given = (getattr(each.distortion.parameters[name], key) for each in (after, before))
            assert found == pytest.approx(given, rel=1e-6)
    names = ["IO.L.c", "IO.L.k1", "EO.i0.omega", "EO.i3.X0"]
    one, other = (read_covariance(path).select(names) for path in (first, back / "adjustment.json"))
    np.testing.assert_allclose(other, one, rtol=1e-5)
    converted = read_adjustment(there / "adjustment.json").cameras["L"]
    assert converted.converted is not None
    assert converted.converted.same
    k1, given = (each.distortion.parameters["k1"].value for each in (converted, before))
    assert k1 == pytest.approx(-given, rel=1e-9)
    assert run(["compare", str(first), str(there / "adjustment.json")]) == DONE
    (there / "adjustment.npz").write_bytes(first.with_suffix(".npz").read_bytes())
    assert run(["convert", str(there / "adjustment.json"), "australis", str(tmp_path / "mixed")]) == 2
    assert not (tmp_path / "mixed").exists()


@pytest.mark.study
def test_a_converted_calibration_is_taken_in(tmp_path: Path) -> None:
    project = write_project(lens_network("australis", np.random.default_rng(7)), tmp_path)
    run(["adjust", str(project)])
    assert run(["convert", str(tmp_path / "out" / "adjustment.json"), "brown", str(tmp_path / "brown")]) == DONE
    text = (tmp_path / "camera.toml").read_text(encoding="utf-8").replace('"australis"', '"brown"')
    text = text.replace("r0_mm = 13.0\n", "").replace("[sigma]\n", '[sigma]\ncalibration = "brown/adjustment.json"\n')
    (tmp_path / "camera.toml").write_text(text, encoding="utf-8")
    assert run(["adjust", str(project)]) in (DONE, LOOK)
    assert len(read_adjustment(tmp_path / "out" / "adjustment.json").calibrations) == 9


def test_what_does_not_fit_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    camera = tmp_path / "camera.toml"
    camera.write_text(CAMERA, encoding="utf-8")
    assert run(["convert", str(camera), "brown", str(tmp_path / "out"), "--json"]) == LOOK
    output = json.loads(capsys.readouterr().out)
    assert not output["same"]
    assert 0.5 < output["largest_um"] < 10.0
    for arguments, words in (
        (["opencf", "out"], "did you mean"),
        (["juhl", "out"], "needs a radius r0"),
        (["brown", "out", "--parameters", "k1,a2"], "brown has no parameter a2"),
    ):
        assert run(["convert", str(camera), arguments[0], str(tmp_path / arguments[1]), *arguments[2:]]) == WRONG_INPUT
        assert words in capsys.readouterr().err.lower().replace("\n", " ")
    camera.write_text(CAMERA.replace("frame_mm = [36.0, 24.0]\n", ""), encoding="utf-8")
    assert run(["convert", str(camera), "opencv", str(tmp_path / "out")]) == WRONG_INPUT
    assert "has no frame_mm" in capsys.readouterr().err

"""`reseau choose` from a project's files to its exit code and choose.json."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import Truth, field_points, simulated
from simulated_project import write_project
from studies import parametrize_with_studies

from adjust.functional_model.lens import Distortion, Prior
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run
from pipeline.results.choice_file import read_choice
from pipeline.results.record_json import plain_json


@parametrize_with_studies("given", ["none", "torlegard"])
def test_the_project_is_reported_what_its_data_ask_for(
    given: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A lens without distortion: right as given without any, and to be looked at where k3 is estimated."""
    points = field_points(np.random.default_rng(1), 15)
    network, _ = simulated(np.random.default_rng(8), Truth(distortion={}), "none", points=points)
    parameters = {"k3": Prior(0.0, np.inf)} if given == "torlegard" else {}
    camera = replace(network.cameras[0], distortion=Distortion(given, parameters), fiducials={})
    project = write_project(replace(network, cameras=(camera,)), tmp_path)
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

"""`board_bend` in a project file, from there to the report."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_project import write_project
from test_bent_boards import BENDS_MM, bent_board, make_network

from adjust.functional_model.lens import Prior
from pipeline.cli import DONE, LOOK, WRONG_INPUT, run


def make_project(folder: Path, bend: str) -> Path:
    network = make_network(np.random.default_rng(5))
    given = {"principal_distance_mm": Prior(20.5, np.inf), "x0_mm": Prior(0.0, np.inf), "y0_mm": Prior(0.0, np.inf)}
    network = replace(network, cameras=(replace(network.cameras[0], **given),))  # type: ignore[arg-type]
    project = write_project(network, folder)
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

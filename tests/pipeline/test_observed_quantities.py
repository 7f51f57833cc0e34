"""Datum, distances and other observed quantities through the user's files."""

import json
from pathlib import Path
from typing import Any

import pytest
from test_cases import CASES, write_project

from adjust.errors import AdjustmentError
from adjust.result import Adjustment
from pipeline.adjust_stage import adjust_marks
from pipeline.comparator_file import read_comparator
from pipeline.errors import InputError
from pipeline.project_file import read_project

pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="the reference cases are not here")

CASE = "iii_selfcal_all_unknown_datum_A"


def free_project(folder: Path, adjust: str = "", objects: str = "") -> dict[str, Any]:
    """The reference network with approximate points and nothing known of them; more lines for its tables."""
    case: dict[str, Any] = json.loads((CASES / f"{CASE}.json").read_text(encoding="utf-8"))
    case["input"]["pts_sigma"] = [[None] * 3 for _ in case["input"]["pts_sigma"]]
    write_project(case, folder)
    file = folder / "project.toml"
    text = file.read_text(encoding="utf-8").replace("[object]\n", f"[object]\n{objects}\n")
    file.write_text(f"{text}\n{adjust}\n", encoding="utf-8")
    return case


def adjusted(folder: Path) -> Adjustment:
    project = read_project(folder / "project.toml")
    return adjust_marks(project, read_comparator(project.comparator))


def test_chosen_datum_coordinates(tmp_path: Path) -> None:
    """Other seven coordinates than the reference holds: its camera, and the seven where points.csv has them."""
    held = ["2.X", "2.Y", "2.Z", "9.X", "9.Y", "9.Z", "4.Z"]
    case = free_project(tmp_path, f'datum = "minimal"\ndatum_coordinates = {json.dumps(held)}')
    result = adjusted(tmp_path)
    reference = case["result"]["parameters"]["IO.c"]
    assert result.value("IO.C.c") == pytest.approx(reference["value"], abs=1e-6 * reference["std_apriori"])
    assert result.sigma("IO.C.c") == pytest.approx(reference["std_aposteriori"], rel=1e-7)
    for name in held:
        point, axis = name.split(".")
        assert result.value(f"PT.{name}") == case["input"]["pts_obs"][int(point) - 1]["XYZ".index(axis)]


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
def test_a_mistake_in_the_datum_gets_a_message(lines: str, words: list[str], tmp_path: Path) -> None:
    free_project(tmp_path, lines)
    with pytest.raises((InputError, AdjustmentError)) as error:
        adjusted(tmp_path)
    for word in words:
        assert word in str(error.value)

"""Numbers that nothing measured can have: one message that names the place, and no arithmetic with them."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from networks import simulated
from simulated_project import write_project

from pipeline.cli import WRONG_INPUT, run

Spoil = Callable[[list[str]], None]


def huge(column: int) -> Spoil:
    def spoil(cells: list[str]) -> None:
        cells[column] = "1e300"

    return spoil


def collapse(kind: str) -> Spoil:
    def spoil(cells: list[str]) -> None:
        if cells[2] == kind:
            cells[3:5] = ["30.0", "-30.0"]

    return spoil


def spoiled(path: Path, spoil: Spoil) -> None:
    head, *rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    for cells in rows:
        spoil(cells)
    path.write_text("\n".join(",".join(cells) for cells in (head, *rows)) + "\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("points.csv", huge(1), r"points.csv, line 2, column X: '1e300' is larger than anything"),
        ("comparator.csv", huge(3), r"comparator.csv, line 2, column x_mm: '1e300'"),
        ("comparator.csv", huge(5), r"comparator.csv, line 2, column sx_mm: '1e300'"),
        ("comparator.csv", collapse("target"), r"image f\d: all its \d+ targets are at one place, \(30, -30\) mm"),
        ("comparator.csv", collapse("fiducial"), r"image f\d: all its \d+ fiducials are at one place"),
    ],
)
def test_each_ends_with_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, spoil: Spoil, words: str
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_project(network, tmp_path)
    spoiled(tmp_path / name, spoil)
    assert run(["adjust", str(project)]) == WRONG_INPUT
    message = capsys.readouterr().err
    assert re.search(words, message)
    assert message.count("reseau: ") == 1


@pytest.mark.parametrize(("sigma", "is_wrong"), [("1e-12", True), ("0", False)])
def test_a_fiducial_is_not_known_to_a_millionth_of_a_nanometre(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sigma: str, is_wrong: bool
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_project(network, tmp_path)
    camera = tmp_path / "camera.toml"
    given = camera.read_text(encoding="utf-8")
    before, after = given.split("[[fiducial]]", 1)
    after = re.sub(r"sigma_mm = .*", f"sigma_mm = {sigma}", after, count=1)
    camera.write_text(f"{before}[[fiducial]]{after}", encoding="utf-8")
    code = run(["status", str(project)])
    message = capsys.readouterr().err
    assert (code == WRONG_INPUT and "nothing is known to 1e-12 mm" in message) == is_wrong

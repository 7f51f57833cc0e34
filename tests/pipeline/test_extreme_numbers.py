"""Numbers that nothing measured can have: one message that names the place, and no arithmetic with them."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from networks import simulated
from simulated_project import write_project

from pipeline.cli import WRONG_INPUT, run
from pipeline.results.adjustment_record import LensReachRecord

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


@pytest.mark.parametrize(
    ("status", "words"),
    [("measured", "is blank, but the status is 'measured'. Give x_mm and y_mm"), ("weak", "the status is 'weak'")],
)
def test_a_blank_place_of_an_observation_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], status: str, words: str
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_project(network, tmp_path)
    head, first, *rows = (tmp_path / "comparator.csv").read_text(encoding="utf-8").splitlines()
    cells = first.split(",")
    cells[3] = ""
    rows = [f"{','.join(cells)},{status}", *(f"{row},measured" for row in rows)]
    (tmp_path / "comparator.csv").write_text("\n".join([f"{head},status", *rows]) + "\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == WRONG_INPUT
    assert words in capsys.readouterr().err


def test_marks_that_were_all_refused_end_with_their_commonest_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network, _ = simulated(np.random.default_rng(1))
    project = write_project(network, tmp_path)
    head, *rows = (tmp_path / "comparator.csv").read_text(encoding="utf-8").splitlines()
    assert not head.endswith("reason")
    rows = [f"{row},absent,{'one of 6 x 5 is' if number else 'covered'}" for number, row in enumerate(rows)]
    (tmp_path / "comparator.csv").write_text("\n".join([f"{head},status,reason", *rows]) + "\n", encoding="utf-8")
    assert run(["adjust", str(project)]) == WRONG_INPUT
    assert f"Most have this reason ({len(rows) - 1} of {len(rows)}): one of 6 x 5 is." in capsys.readouterr().err


def test_sizes_have_no_exponent_and_what_nothing_shows_has_no_size() -> None:
    reach = LensReachRecord(1.5, 6.4, 1.1, 617.0, None, 0.24)
    assert "with a standard deviation of up to 1.1 µm" in reach.sentence("K")
    assert reach.sentence("K").endswith("there its standard deviation is 620 µm.")
    unknown = replace(reach, corner_sigma_um=2500.0)
    assert unknown.sentence("K").endswith("the lens shows nothing there.")


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

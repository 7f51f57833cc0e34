"""The pages: their commands exist with their options, those of the README and of the start run, their tables hold."""

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import cv2
import pytest
import real_data
import typer
from every_command import chessboard
from test_tutorial import block

from pipeline.cli import DONE, LOOK, app, run
from pipeline.files.library import read_library
from pipeline.results.adjustment_file import read_adjustment
from pipeline.review import server

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
BOARD_PICTURES = 7


def commands(page: Path) -> Iterator[str]:
    """The lines of indented or fenced blocks that are commands of the program."""
    text = page.read_text(encoding="utf-8")
    lines = re.findall(r"^    (.*)$", text, flags=re.MULTILINE)
    lines += [
        line
        for block in re.findall(r"^```\w*\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
        for line in block.splitlines()
    ]
    for line in lines:
        if found := re.match(r"(?:\.venv/bin/|env/bin/)?reseau( .*)?$", line.strip()):
            yield f"reseau{(found[1] or '').partition(' #')[0].rstrip()}"


def split_words(command: str) -> list[str]:
    return shlex.split(command, comments=True)[1:]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_exists_with_its_options(page: Path) -> None:
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    general = {"--version", "--help", "--install-completion"}
    for command in commands(page):
        name, *others = split_words(command.split(">")[0])
        if name in general:
            continue
        options = {option for parameter in known[name].params for option in parameter.opts}
        assert {word for word in others if word.startswith("--")} <= options | general, f"{page}: {command}"


def test_the_readme_and_the_start_have_commands() -> None:
    counts = {str(page.relative_to(ROOT)): len(list(commands(page))) for page in PAGES}
    assert counts["README.md"] >= 5
    start = {name: counts[f"docs/start/{name}.md"] for name in ("install", "board", "film-scan", "archive")}
    assert start["install"] >= 1
    assert start["board"] >= 1
    assert start["film-scan"] >= 2
    assert start["archive"] >= 4
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


@pytest.fixture
def desk(finished: tuple[Path, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which a reader stands: scans of the demonstration, and pictures of a board."""
    folder = tmp_path / "desk"
    shutil.copytree(finished[0], folder)
    (folder / "pictures").mkdir()
    for number in range(BOARD_PICTURES):
        cv2.imwrite(str(folder / "pictures" / f"{number}.png"), chessboard(number, 9, 6))
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def small_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two cameras of fifty."""
    cameras = dict(list(read_library().items())[:2])
    for module in ("files.library", "archive.new_project"):
        monkeypatch.setattr(f"pipeline.{module}.read_library", lambda: cameras)


def run_all(page: Path, skip: Callable[[str], bool] = lambda _: False) -> dict[str, int]:
    """The exit code of each command of a page, run in the current folder."""
    done = dict.fromkeys(command for command in commands(page) if not skip(command))
    return {command: run(split_words(command)) for command in done}


@pytest.mark.study
@pytest.mark.usefixtures("desk", "small_library")
def test_the_commands_of_the_readme_run() -> None:
    codes = run_all(ROOT / "README.md")
    assert len(codes) == 4
    assert set(codes.values()) <= {DONE, LOOK}
    assert Path("demo/out/report.html").exists()
    assert Path("calibration/camera.yaml").exists()
    assert Path("archive/project.toml").exists()


@pytest.mark.usefixtures("small_library")
def test_the_quick_commands_of_the_readme_run(desk: Path) -> None:
    """The project, which is measured already; neither demonstration, board nor folder."""
    codes = run_all(ROOT / "README.md", lambda command: "project.toml" not in command)
    assert list(codes.values()) == [DONE]
    assert (desk / "out" / "report.html").exists()


@pytest.mark.study
@pytest.mark.usefixtures("desk")
def test_the_commands_of_the_page_of_boards_run(capsys: pytest.CaptureFixture[str]) -> None:
    codes = run_all(ROOT / "docs" / "start" / "board.md")
    assert set(codes.values()) <= {DONE, LOOK}
    assert Path("calibration/camera.yaml").exists()
    assert "Next: open calibration/out/report.html" in capsys.readouterr().out


@pytest.mark.study
def test_the_commands_of_the_tutorial_run(desk: Path) -> None:
    page = ROOT / "docs" / "start" / "film-scan.md"
    desk.rename(desk.with_name("demo"))
    folder = desk.parent
    copying = re.findall(r"^    ((?:mkdir|cp) .*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert len(copying) == 2
    subprocess.run("\n".join(copying), shell=True, cwd=folder, check=True)
    (folder / "mine" / "project.toml").write_text(block("toml"), encoding="utf-8")
    with pytest.MonkeyPatch.context() as there:
        there.chdir(folder)
        codes = run_all(page, lambda command: "mine/" not in command)
    assert list(codes.values()) == [DONE, DONE]
    assert (folder / "mine" / "out" / "report.html").exists()


@pytest.mark.study
@pytest.mark.usefixtures("small_library")
def test_the_commands_of_the_page_of_archives_run(desk: Path) -> None:
    """The camera is none of the library: its file is drawn, as the page says."""
    for name in ("project.toml", "images.csv", "comparator.csv"):
        (desk / name).unlink(missing_ok=True)
    shutil.rmtree(desk / "out")
    page = ROOT / "docs" / "start" / "archive.md"
    with patch.object(server, "serve", lambda *_: None):
        codes = run_all(page, lambda command: "project.toml" in command or "--scan" in command)
        project = desk / "project.toml"
        text = project.read_text(encoding="utf-8")
        assert run(["review", str(project)]) == DONE
        project.write_text(text.replace('# camera = "camera.toml"', 'camera = "camera.toml"'), encoding="utf-8")
        codes |= run_all(page, lambda command: "project.toml" not in command)
    assert set(codes.values()) <= {DONE, LOOK}, codes
    assert (desk / "out" / "report.html").exists()


@pytest.mark.study
def test_the_figures_of_the_demonstration_on_the_pages(tmp_path: Path) -> None:
    """Those of the tutorial, and the table of the page of models."""
    assert run(["demo", str(tmp_path)]) == DONE
    adjustment = read_adjustment(tmp_path / "out" / "adjustment.json")
    (camera,) = adjustment.cameras.values()
    c = camera.principal_distance_mm
    tutorial = (ROOT / "docs" / "start" / "film-scan.md").read_text(encoding="utf-8")
    assert f"c = {c.value:.3f} mm, with a standard deviation of {c.sigma:.3f}" in tutorial
    assert f"Here it is {adjustment.sigma0:.2f}" in tutorial
    assert run(["choose", str(tmp_path / "project.toml")]) == DONE
    candidates = {
        each["name"]: each for each in json.loads((tmp_path / "out" / "choose.json").read_text())["candidates"]
    }
    rows = table((ROOT / "docs" / "how-to" / "choose-a-model.md"), "model")
    assert len(rows) == 6
    for name, unknowns, redundancy, sigma0, *_ in rows:
        found = candidates[name.strip("*")]
        assert (int(unknowns), int(redundancy)) == (found["unknowns"], found["redundancy"])
        assert float(sigma0) == pytest.approx(found["sigma0"], abs=0.006)


@real_data.needs("chessboards", "opencv")
@pytest.mark.study
def test_the_table_of_the_page_of_boards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures = sorted((real_data.DATA / "chessboards" / "opencv").glob("left[0-9]*.jpg"))
    run(
        [
            "calibrate",
            *map(str, pictures),
            "--board",
            "9x6",
            "--square",
            "25mm",
            "--json",
            "--out",
            str(tmp_path / "out"),
        ]
    )
    (camera,) = json.loads(capsys.readouterr().out)["cameras"]
    page = ROOT / "docs" / "start" / "board.md"
    rows = table(page, "parameter")
    assert len(rows) >= 6
    for name, value, sigma in rows:
        word = name.removesuffix(", px")
        found = camera["distortion"][word] if word not in ("fx", "fy", "cx", "cy") else camera[f"{word}_px"]
        decimals = len(value.partition(".")[2])
        assert float(value.replace("−", "-")) == pytest.approx(found["value"], abs=0.51 * 10**-decimals)
        assert float(sigma) == pytest.approx(found["sigma"], abs=0.51 * 10**-decimals)
    assert f"rms {camera['rms_px']:.3f} px a point" in page.read_text(encoding="utf-8")
    assert f"rms {camera['lens_rms_px']['opencv4']:.3f} px in pictures left out" in page.read_text(encoding="utf-8")


def table(page: Path, first: str) -> list[list[str]]:
    """The cells of the table whose first column has this heading."""
    lines = page.read_text(encoding="utf-8").split(f"| {first} |")[1].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]

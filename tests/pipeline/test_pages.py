"""The demonstration against its truth, and the pages of documentation: their commands and examples run."""

import json
import re
import shlex
import shutil
import textwrap
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import matplotlib as mpl
import numpy as np
import pytest
import real_data
import typer
from browser import browser_page, needs_browser
from every_command import chessboard
from playwright.sync_api import Browser, Page
from projects import FRAMES, Capture, Printed, command, present
from truth_comparison import camera_errors, compare_frames

import measure
import pipeline
from pipeline.cli import DONE, LOOK, app, run
from pipeline.files.library import read_library
from pipeline.files.project_file import read_project
from pipeline.results.adjustment_file import read_adjustment
from pipeline.review import server


def assert_demonstrated(folder: Path, frames: int) -> None:
    """Measured right, calibrated within its sigmas, in agreement with OpenCV, and reported."""
    found = compare_frames(folder)
    assert len(found) == frames
    for frame in found:
        assert frame.wrong == []
        assert frame.pose == frame.truth["pose"]
        assert frame.observed["fiducial"] == frame.visible("fiducial") == 8
        assert frame.observed["target"] >= 0.98 * frame.visible("target") - 1
    assert 0.85 < np.sqrt(np.mean(np.square([error for frame in found for error in frame.normalised]))) < 1.15
    assert np.abs(camera_errors(folder)).max() < 3.0
    assert json.loads((folder / "out" / "check.json").read_text())["verdict"] == "agrees"
    page = (folder / "out" / "report.html").read_text()
    HTMLParser().feed(page)
    assert f"frame{frames}" in page


def test_the_demonstration_is_measured_right_agrees_with_opencv_and_is_reported(finished: tuple[Path, int]) -> None:
    folder, code = finished
    assert code == DONE
    assert_demonstrated(folder, FRAMES)


def assert_report_is_short(page: Page, folder: Path) -> None:
    """Without what is closed, at 1300 px: the limits that a reader has to get through."""
    page.goto((folder / "out" / "report.html").as_uri())
    assert page.evaluate("document.documentElement.scrollHeight") <= 6000
    assert len(page.inner_text("body").split()) <= 2500
    camera = present(page.locator("#camera").bounding_box())
    assert camera["y"] < 300
    assert page.locator("#camera svg").count() == 2
    assert page.evaluate("document.documentElement.scrollWidth") <= 1300


@needs_browser
def test_its_report_is_short_and_begins_with_the_camera(browser: Browser, finished: tuple[Path, int]) -> None:
    with browser_page(browser) as page:
        assert_report_is_short(page, finished[0])
        page.goto((finished[0] / "out" / "report.html").as_uri() + "#frame-2")
        assert page.locator("#frame-2 .cards").is_visible()  # a link opens what it leads to


def test_its_summary_has_the_camera_first_and_at_most_40_lines(finished: tuple[Path, int], capsys: Capture) -> None:
    command("report", finished[0] / "project.toml")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40
    text = "\n".join(lines)
    assert lines[0].startswith("Calibrated from")
    assert 0 < text.index("c principal distance") < text.index("Frames, the worst first")


PAGE = (Path(__file__).parents[2] / "docs" / "start" / "film-scan.md").read_text()


def block(language: str) -> str:
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    return str(text)


def test_the_tutorial_is_right(project: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    mine = project / "tutorial.toml"
    mine.write_text(block("toml"))
    read = read_project(mine)
    assert sorted(read.scans) == [path.stem for path in sorted((project / "scans").glob("*.tif"))]
    assert read.targets is not None
    assert len(read.object_points) > 10
    mpl.use("Agg")
    project.rename(project.with_name("demo"))
    monkeypatch.chdir(project.parent)
    exec(compile(block("python"), "tutorial.md", "exec"), {})
    assert re.search(r"^\d+ marks, median standard deviation 0\.0\d+ px$", capsys.readouterr().out, flags=re.MULTILINE)
    assert (project.parent / "w.png").stat().st_size > 3000


@pytest.mark.study
def test_the_example_measures_adjusts_and_plots(project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the names that it gives."""
    mpl.use("Agg")
    project.rename(project.with_name("demo"))
    monkeypatch.chdir(project.parent)
    page = (ROOT / "docs" / "how-to" / "python.md").read_text()
    _, code = re.findall(r"^```python\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)
    made: dict[str, Any] = {}
    exec(compile(code, "python.md", "exec"), made)
    frame, result = made["frame"], made["result"]
    truth = pipeline.read_adjustment(tmp_path / "demo" / "out" / "adjustment.json").cameras["metric 6 x 6"]
    assert sum(mark.status is measure.Status.MEASURED for mark in frame.marks) >= 6
    assert result.converged
    assert result.value("IO.metric 6 x 6.c") == pytest.approx(truth.principal_distance_mm.value, abs=0.05)
    assert (tmp_path / "residuals.png").stat().st_size > 5000
    shown = (frame, frame.marks[0], result, made["network"], result.network.observations, result.residuals)
    for each in (*shown, result.reliability):
        assert "\n" not in repr(each)
        assert len(repr(each)) < 200
    assert result._repr_html_().count("<tr>") == sum(name.startswith("IO.") for name in result.names) + 1
    assert frame._repr_html_().count("<tr>") == len(frame.marks) + 1


ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))


def commands(page: Path) -> Iterator[str]:
    """The lines of indented or fenced blocks that are commands of the program."""
    text = page.read_text()
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    for line in [*re.findall(r"^    (.*)$", text, flags=re.MULTILINE), *"".join(blocks).splitlines()]:
        if found := re.match(r"(?:\.venv/bin/|env/bin/)?reseau( .*)?$", line.strip()):
            yield f"reseau{(found[1] or '').partition(' #')[0].rstrip()}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_exists_with_its_options(page: Path) -> None:
    known = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    general = {"--version", "--help", "--install-completion"}
    for line in commands(page):
        name, *others = shlex.split(line.split(">")[0], comments=True)[1:]
        if name in general:
            continue
        options = {option for parameter in known[name].params for option in parameter.opts}
        assert {word for word in others if word.startswith("--")} <= options | general, f"{page}: {line}"


@pytest.fixture
def desk(finished: tuple[Path, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which a reader stands: scans of the demonstration, and pictures of a board."""
    folder = tmp_path / "desk"
    shutil.copytree(finished[0], folder)
    (folder / "pictures").mkdir()
    for number in range(7):
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
    done = dict.fromkeys(command for command in commands(page) if ">" not in command and not skip(command))
    return {command: run(shlex.split(command, comments=True)[1:]) for command in done}


@pytest.mark.study
@pytest.mark.parametrize(("page", "count"), [("README.md", 4), ("docs/start/board.md", 1)])
@pytest.mark.usefixtures("desk", "small_library")
def test_the_commands_of_a_page_run(page: str, count: int, capsys: Capture) -> None:
    codes = run_all(ROOT / page)
    assert len(codes) >= count
    assert set(codes.values()) <= {DONE, LOOK}
    assert Path("calibration/camera.yaml").exists()
    assert "Next: open calibration/out/report.html" in capsys.readouterr().out


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
        text = project.read_text()
        assert command("review", project) == DONE
        project.write_text(text.replace('# camera = "camera.toml"', 'camera = "camera.toml"'))
        codes |= run_all(page, lambda command: "project.toml" not in command)
    assert set(codes.values()) <= {DONE, LOOK}, codes
    assert (desk / "out" / "report.html").exists()


@pytest.mark.study
def test_the_figures_of_the_demonstration_on_the_pages(tmp_path: Path) -> None:
    """Those of the tutorial, and the table of the page of models."""
    assert command("demo", tmp_path) == DONE
    assert_demonstrated(tmp_path, 5)
    mine = tmp_path / "mine"
    shutil.copytree(tmp_path / "scans", mine / "scans")
    for name in ("camera.toml", "points.csv"):
        shutil.copy(tmp_path / name, mine)
    (mine / "project.toml").write_text(block("toml"))
    assert command("run", mine / "project.toml") == DONE
    stored = json.loads((ROOT / "docs" / "demo.json").read_text(encoding="utf-8"))
    assert read_adjustment(tmp_path / "out" / "adjustment.json").sigma0 == pytest.approx(stored["sigma0"], abs=1e-3)
    adjustment = read_adjustment(mine / "out" / "adjustment.json")
    (camera,) = adjustment.cameras.values()
    c = camera.principal_distance_mm
    assert f"c = {c.value:.3f} mm, with a standard deviation of {c.sigma:.3f}" in PAGE
    assert f"Here it is {adjustment.sigma0:.2f}" in PAGE
    assert command("choose", tmp_path / "project.toml") == DONE
    candidates = {one["name"]: one for one in json.loads((tmp_path / "out" / "choose.json").read_text())["candidates"]}
    rows = table((ROOT / "docs" / "how-to" / "choose-a-model.md"), "model")
    assert len(rows) == 6
    for name, unknowns, redundancy, sigma0, *_ in rows:
        found = candidates[name.strip("*")]
        assert (int(unknowns), int(redundancy)) == (found["unknowns"], found["redundancy"])
        assert float(sigma0) == pytest.approx(found["sigma0"], abs=0.006)


@real_data.needs("film_scans", "aerial")
@pytest.mark.study
def test_the_example_of_the_page_of_archives(tmp_path: Path, printed: Printed) -> None:
    page = (ROOT / "docs" / "start" / "archive.md").read_text()
    drawn = printed("template", "camera", "--marks", "ring-cross", "--square", "212", "--c", "153").split("[mark")[0]
    mark = present(re.search(r"^    \[mark.corner\]\n(?:    .*\n)+", page, flags=re.MULTILINE))
    (tmp_path / "camera.toml").write_text(drawn + textwrap.dedent(mark[0]))
    scan = real_data.DATA / "film_scans" / "aerial" / "0b50b18e.jpeg"
    project = f'camera = "camera.toml"\nscans = ["{scan}"]\n[measure]\ntone = "linear"\nwriting = "none"\n'
    (tmp_path / "project.toml").write_text(project)
    assert command("measure", tmp_path / "project.toml") == LOOK
    rows = (tmp_path / "comparator.csv").read_text().splitlines()
    shown = re.findall(r"^    (0b50b18e,.*)$", page, flags=re.MULTILINE)
    assert len(shown) == 2
    assert set(shown) <= set(rows)


@real_data.needs("chessboards", "opencv")
@pytest.mark.study
def test_the_table_of_the_page_of_boards(tmp_path: Path, capsys: Capture) -> None:
    pictures = sorted((real_data.DATA / "chessboards" / "opencv").glob("left[0-9]*.jpg"))
    options = ("--board", "9x6", "--square", "25mm", "--json", "--out", str(tmp_path / "out"))
    command("calibrate", *pictures, *options)
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
    assert f"rms {camera['rms_px']:.3f} px a point" in page.read_text()
    assert f"rms {camera['lens_rms_px']['opencv4']:.3f} px in pictures left out" in page.read_text()


def table(page: Path, first: str) -> list[list[str]]:
    """The cells of the table whose first column has this heading."""
    lines = page.read_text().split(f"| {first} |")[1].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]

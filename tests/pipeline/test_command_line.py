"""The command line on right and wrong input, what it suggests next, and the time that it expects."""

import io
import itertools
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from projects import (
    Capture,
    Printed,
    Refusal,
    Spoil,
    change_camera,
    change_project,
    command,
    replace_text,
    result_file,
    scan_content,
)
from rich.console import Console
from studies import parametrize_with_studies

from pipeline.archive.verdicts import Verdict
from pipeline.cli import app
from pipeline.commands.shared import command_step, print_next, summary_steps
from pipeline.errors import InputError
from pipeline.exchange.exchange_stage import check_folder
from pipeline.report.verdict import ReportVerdict
from pipeline.summary import Summary
from pipeline.terminal import PlainConsole, Reporter, time_left, uncut_table
from pipeline.text.wording import count_sentence


def rewritten_scans(folder: Path, pattern: str) -> None:
    path = folder / "project.toml"
    text = re.sub(r"^scans = .*$", f'scans = ["{pattern}"]', path.read_text(), flags=re.MULTILINE)
    path.write_text(text)


def results(folder: Path) -> dict[str, bytes]:
    """Everything that a run writes."""
    files = [folder / "comparator.csv", *sorted((folder / "out").iterdir())]
    return {file.name: scan_content(file) for file in files if not file.name.endswith(("-wal", "-shm"))}


def remove(*names: str) -> Spoil:
    def spoil(folder: Path) -> None:
        for file in [file for name in names for file in folder.glob(name)]:
            file.unlink()

    return spoil


def write(name: str, text: str) -> Spoil:
    return lambda folder: (folder / name).write_text(text)


def misspelt_key_and_no_file(folder: Path) -> None:
    replace_text(folder / "project.toml", "comparator =", "comparater =")
    (folder / "points.csv").unlink()


def name_in_another_encoding(folder: Path) -> None:
    scans = os.fsencode(folder / "scans")
    os.rename(scans + b"/frame1.tif", scans + b"/fl\xfcg.tif")
    rewritten_scans(folder, "scans/*.tif")


def nothing_to_measure(folder: Path) -> None:
    camera = (folder / "camera.toml").read_text()
    write("camera.toml", re.sub(r"^mark = .*$", 'mark = "none"', camera, flags=re.MULTILINE))(folder)
    write("project.toml", 'camera = "camera.toml"\nscans = ["scans/*.tif"]\n')(folder)


def one_fiducial(folder: Path) -> None:
    camera = (folder / "camera.toml").read_text()
    head, first, *_ = camera.split("[[fiducial]]")
    write("camera.toml", f"{head}[[fiducial]]{first}{camera[camera.index('[mark.') :]}")(folder)


MARKS_FILE = 'comparator = "comparator.csv"'
NO_COORDINATES = "point,X,Y,Z,sX,sY,sZ\n101,1.0,2.0,0.5,,,\n102,,,,,,\n"


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (remove("project.toml"), ["project.toml", "no such file"]),
        (remove("scans/*"), ["scans/frame1.tif", "finds no file", "It holds no files"]),
        (misspelt_key_and_no_file, ["project.toml, line 4", "comparater", "Did you mean 'comparator'?"]),
        (
            remove("camera.toml", "points.csv"),
            ["line 2: camera: ", "camera.toml: there is no such", "line 12: [object] points: "],
        ),
        (change_project('output = "out"', 'output = "points.csv/out"'), ["cannot be written"]),
        (lambda folder: rewritten_scans(folder, "scans"), ["line 3: scans: 'scans' is a folder", "'scans/*.tif'"]),
        (name_in_another_encoding, ["line 3: scans:", "is not text in UTF-8", "Rename it"]),
        (
            change_project("output =", "pitch_um = 0.045\noutput ="),
            ["line 5: pitch_um: 0.045 µm is finer than any scanner"],
        ),
        (
            change_camera('id = "1"', 'id = "1 "'),
            ["camera.toml, line", "text on one line without blanks at its ends, not '1 '"],
        ),
        (change_project("output =", "pitch_um = 0\noutput ="), ["line 5: pitch_um: must be positive, not 0."]),
        (change_project('"camera.toml"', '"camera.tml"'), ["Did you mean 'camera.toml'? `reseau template camera`"]),
        (nothing_to_measure, ["nothing to measure", 'have mark = "none"', "Draw the marks"]),
        (
            change_project(MARKS_FILE, 'comparator = "scans/../scans/frame2.tif"'),
            ["line 4: comparator:", "written over the scan frame2"],
        ),
        (change_project(MARKS_FILE, 'comparator = "out"'), ["line 4: comparator:", "is a folder"]),
        (write("camera.toml", 'name = "bare"\n'), ["transformation is 'affine'", "has no fiducials for it"]),
        (
            change_project('points = "points.csv"', ""),
            ["kind 'disk' is named by the targets' coordinates", "there is no [object] points"],
        ),
        (write("points.csv", NO_COORDINATES), ["[object] points: 1 points with X, Y and Z name no targets; give 4"]),
        (one_fiducial, ["camera.toml has one fiducial mark", "two or more"]),
    ],
)
def test_wrong_input_leaves_earlier_results(project: Path, refusal: Refusal, spoil: Spoil, words: list[str]) -> None:
    before = results(project)
    spoil(project)
    message = refusal("run", project / "project.toml")
    for word in words:
        assert word in message
    assert "Traceback" not in message
    assert results(project) == before


def test_a_folder_in_place_of_a_project_is_answered_by_what_it_holds(tmp_path: Path, refusal: Refusal) -> None:
    words = "is a folder; a TOML file is needed here. It holds no project.toml; `reseau template`"
    assert words in refusal("adjust", tmp_path)
    for name in ("project.toml", "camera.toml"):
        (tmp_path / name).touch()
    assert "It holds no scene.toml; `reseau template`" in refusal("design", tmp_path)
    for name in ("1952.toml", "1958.toml"):
        (tmp_path / name).touch()
    assert f"Name one that it holds: {tmp_path}/project.toml." in refusal("adjust", tmp_path)
    words = f"Name one that it holds: {tmp_path}/1952.toml, {tmp_path}/1958.toml."
    assert words in refusal("design", tmp_path)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("measure", "p.toml", "--workers", "0"), "'--workers': must be at least 1, not 0."),
        (("compare", "a.json", "--level", "2"), "'--level': must be at most 0.5, not 2."),
        (("cameras", "--pitch", "abc"), "'--pitch': must be a number, not 'abc'."),
        (("review", "p.toml", "--port", "1.5"), "'--port': must be a whole number, not '1.5'."),
    ],
)
def test_a_wrong_value_of_an_option_is_refused_as_in_a_table(
    arguments: tuple[str, ...], words: str, refusal: Refusal
) -> None:
    assert words in refusal(*arguments)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("left.JPG", ["is a scan; a TOML file is needed", "`reseau run {folder}`"]),
        ("points.csv", ["is a CSV table; a TOML file is needed", "`reseau template`"]),
        ("lens.yaml", ["is a YAML file; a TOML file is needed"]),
    ],
)
def test_a_file_of_another_kind_in_place_of_a_project(
    name: str, words: list[str], tmp_path: Path, refusal: Refusal
) -> None:
    (tmp_path / name).write_bytes(b"\xff\xd8\xff")
    message = refusal("run", tmp_path / name)
    for word in words:
        assert word.format(folder=tmp_path) in message


def test_a_file_in_place_of_a_folder_is_named(tmp_path: Path, refusal: Refusal) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(resources.files("pipeline").joinpath("templates", "scene.toml").read_text("utf-8"), "utf-8")
    words = f"{scene} is a file, and a folder is needed there"
    assert words in refusal("render", scene, scene)
    assert words in refusal("render", scene, scene / "below")
    assert words in refusal("demo", scene)
    with pytest.raises(InputError, match="is a file, and a folder is needed there"):
        check_folder(scene)  # of an export or import


def pixels_for_mm(rows: list[str]) -> list[str]:
    cells = [row.split(",") for row in rows]
    return [",".join([*row[:3], row[8], row[9], *row[5:]]) for row in cells if row[8]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows, ["in 3 frames"]),
        (lambda rows: [row for row in rows if not row.startswith("frame2")], ["in 2 frames"]),
        (lambda rows: [*rows, "frame1,1O1,target,1,2,0.001,0.001,0,,,measured,"], ["'1O1'", "Did you mean", "line"]),
        (pixels_for_mm, ["comparator.csv, line 2: the fiducials of image 'frame1' stand 22.4 times as far apart"]),
    ],
)
def test_marks(project: Path, capsys: Capture, change: Callable[[list[str]], list[str]], words: list[str]) -> None:
    """A point that nobody measured is a note: of a large pattern a part is used."""
    replace_text(project / "project.toml", "scans = [", "# scans = [")
    with (project / "points.csv").open("a", encoding="utf-8") as file:
        file.write("999,1,2,3,0,0,0,0,0,1\n")
    lines = (project / "comparator.csv").read_text().splitlines()
    head = next(line for line in lines if line.startswith("image,"))
    rows = change([line for line in lines if line.startswith("frame")])
    (project / "comparator.csv").write_text("\n".join([head, *rows]) + "\n")
    capsys.readouterr()
    code = command("adjust", project / "project.toml", "--json")
    out, err = capsys.readouterr()
    assert [word for word in words if word not in out + err] == []
    assert code == (0 if "frames" in words[0] else 2)
    assert code or any("999" in note for note in result_file(project)["notes"])


def test_singular_network_is_named_in_words(project: Path, printed: Printed) -> None:
    path = project / "camera.toml"
    text = path.read_text().replace("sigma_mm = [0.005, 0.005]", 'sigma_mm = "free"')
    path.write_text(re.sub(r"(?m)^(principal_\w+) = (1.0|\[1.0, 1.0\])$", r'\1 = "free"', text))
    problems = json.loads(printed("adjust", project / "project.toml", "--json", code=1))["problems"]
    what = " ".join(problem["what"] for problem in problems)
    assert [word for word in ("Shift x", "Shift y", "Rotation", "Scale") if word not in what] == []


def test_unknown_command_and_option_have_code_2_and_the_help_is_whole(printed: Printed, refusal: Refusal) -> None:
    assert command("mesure") == 2
    assert command("run", "--jason", "p.toml") == 2
    assert "Traceback" not in refusal("template", "cameras")
    assert refusal("calibrate", "pictures") == (
        "reseau: Missing option '--board'. `reseau calibrate --help` shows what it takes."
    )
    text = printed("--help")
    titles = re.findall(r"^(\w+):$", text, flags=re.MULTILINE)
    assert titles == ["Options", "Measure", "Calibrate", "Archive", "Exchange", "Plan", "Tools"]
    assert "..." not in text.split("Measure:")[1]
    assert len(re.findall(r"^  [a-z]+  +\S", text, flags=re.MULTILINE)) == 22


@pytest.mark.study
def test_the_help_does_not_wait_for_what_commands_need() -> None:
    heavy = ("numpy", "scipy", "cv2", "pipeline.stages", "pipeline.files.project_file")
    program = f"import sys, pipeline.cli; print(*set(sys.modules) & set({heavy}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"
    naming = "pipeline.measuring.camera_trials, pipeline.files.library as library; library.read_library()"
    for needed, spared in (("pipeline.stages", "pipeline.measuring.scan_measurement"), (naming, "adjust.solution")):
        program = f"import sys, {needed}; sys.exit({spared!r} in sys.modules)"
        assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0, needed


@parametrize_with_studies(("arguments", "code"), [(["template", "scene"], 0), (["template", "nothing"], 2)], quick=(1,))
def test_a_reader_that_stops_reading_does_not_change_the_exit_code(arguments: list[str], code: int) -> None:
    """As `head` does. 1 would say that something needs a look."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-c", "from pipeline.main import main; main()", *arguments]
    done = subprocess.run(command, stdout=writing, stderr=writing, check=False)
    os.close(writing)
    assert done.returncode == code


PROJECT = Path("my project.toml")
ROOT = Path(__file__).parents[2]


def summary(*files: str, adjustment: Any = None, parts: int = 0, frames: Any = None, **verdicts: int) -> Any:
    """One that has what the steps depend on."""
    counts = {Verdict[name]: count for name, count in verdicts.items()}
    paths, shown = {word: Path("out", word) for word in files}, frames or {"a": {"measured": 4}}
    return Summary(ReportVerdict("look", "", (), ()), shown, {}, adjustment, None, paths, verdicts=counts, parts=parts)


def adjustment(is_calibrated: bool) -> Any:
    return SimpleNamespace(converged=True, cameras={"a": SimpleNamespace(is_calibrated=is_calibrated)})


@pytest.mark.parametrize(
    ("given", "steps"),
    [
        (summary("measurement"), ["reseau run 'my project.toml'"]),
        (summary("measurement", FAILED=2), ["reseau measure 'my project.toml' --retry", "reseau run"]),
        (summary("measurement", OLD=1, WAITING=2), ["reseau measure 'my project.toml'  # 3 scans", "reseau run"]),
        (summary("adjustment", "covariance", adjustment=adjustment(True)), ["reseau check", "reseau report"]),
        (
            summary("report", adjustment=adjustment(True), GOOD=4),
            ["open out/report", "reseau export 'my project.toml' opencv"],
        ),
        (summary("report", adjustment=adjustment(True)), ["open out/report", "reseau export 'my project.toml' csv"]),
        (summary("report", adjustment=adjustment(False), LOOK=1, POOR=1), ["open", "reseau review", "reseau resample"]),
        (summary("measurement", frames={"a": {"absent": 4}}, POOR=1), ["reseau cameras --scan SCAN", "reseau review"]),
        (summary("part 1 of 8", parts=8), ["reseau merge 'my project.toml' out/measurement.*-of-8.db"]),
    ],
)
def test_a_summary_calls_for_what_mends_it_then_for_the_next_stage(given: Any, steps: list[str]) -> None:
    found = list(summary_steps(PROJECT, given))
    assert len(found) == len(steps)
    for step, begins in zip(found, steps, strict=True):
        assert step.startswith(begins)


def test_commands_that_messages_name_exist() -> None:
    commands, named = vars(typer.main.get_command(app))["commands"], 0
    for source in (file for package in ("adjust", "measure", "pipeline") for file in (ROOT / package).rglob("*.py")):
        for name, options in re.findall(r"`reseau ([a-z]+)((?: --[a-z-]+)*)", source.read_text()):
            assert name in commands, source
            taken = {option for parameter in commands[name].params for option in parameter.opts}
            assert taken.issuperset(options.split()), source
            named += 1
    assert named > 50


def test_steps_counts_and_times_are_printed_in_one_form(capsys: Capture) -> None:
    print_next(False, "a", "a", "b", command_step("run", PROJECT, why="c"), "d")
    assert capsys.readouterr().out == "Next: a\nNext: b\nNext: reseau run 'my project.toml'  # c\n"
    print_next(True, "a")
    assert capsys.readouterr().out == ""
    rest = {"without a camera": 3, "broken": 0}
    assert count_sentence("can be measured", 15, 18, rest) == "15 of 18 scans can be measured (3 without a camera)"
    assert count_sentence("measured", 1, 1, {}) == "1 of 1 scan measured"
    left = [time_left(seconds).removeprefix("about ") for seconds in (0.2, 110.0, 3000.0, 9000.0)]
    assert left == ["a minute left", "2 minutes left", "50 minutes left", "2.5 hours left"]


def test_no_figure_of_a_table_is_cut_where_the_terminal_is_narrow() -> None:
    text = io.StringIO()
    table = uncut_table([f"figure {k}" for k in range(9)], "Candidates")
    table.add_row(*["123456789.5"] * 9)
    PlainConsole(file=text, width=80).print(table)
    assert "…" not in text.getvalue()
    assert sum(letter in "123456789.5" for letter in text.getvalue().split("┡")[1]) == 9 * 11


def lines(quiet: bool = False, terminal: bool = False) -> list[str]:
    text = io.StringIO()
    console = PlainConsole(file=text, width=200, force_terminal=terminal, quiet=quiet)
    with Reporter(console).stage("scans measured:") as count:
        for done in range(1, 31):
            count("2 of 5 groups", done, 30, left_s=200.0)
    return text.getvalue().splitlines()


def test_the_time_left_is_estimated_from_the_second_item_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty seconds an item; the first also loads what all need."""
    text, seconds = io.StringIO(), itertools.count(0.0, 30.0)
    monkeypatch.setattr("pipeline.terminal.time.monotonic", lambda: next(seconds))
    with Reporter(PlainConsole(file=text, width=200)).stage("reading scan") as count:
        for done, name in enumerate(("a", "b"), 1):
            count(name, done, 6)
    first, second = text.getvalue().splitlines()
    assert (first, second) == ("reading scan 1 of 6, a", "reading scan 2 of 6, b, about 2 minutes left")


def test_progress_is_two_lines_without_a_terminal_and_none_for_who_is_quiet() -> None:
    """The first and the last: between them lines come at intervals only."""
    assert lines() == [
        "scans measured: 1 of 30, 2 of 5 groups, about 3 minutes left",
        "scans measured: 30 of 30, 2 of 5 groups",
    ]
    assert any("scans measured: 30 of 30, 2 of 5 groups" in line for line in lines(terminal=True))
    assert lines(quiet=True) == lines(quiet=True, terminal=True) == []
    assert Reporter(quiet=True)._console.quiet
    assert isinstance(Reporter()._console, Console)

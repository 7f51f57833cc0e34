"""Results say what they were made from, take their places together whatever ends a command, never that of a file."""

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from in_process import Loses, wait_until
from projects import (
    Capture,
    Printed,
    Refusal,
    Spoil,
    change_camera,
    change_project,
    command,
    comparator_points,
    keep_scans,
    replace_text,
    scan_content,
)
from test_command_line import results, rewritten_scans

from adjust import Prior
from measure import MarkMeasurement, Status
from measure.flags import Code, Reason
from measure.results import Covariance, FrameMeasurement
from pipeline import read_measurement, read_project, stages
from pipeline.adjusting import second_pass
from pipeline.archive.made_from import changed_scans, measured_from
from pipeline.provenance import fingerprint, parts_hash
from pipeline.report.load import adjusted_data
from pipeline.resampling.resample_stage import resample_tasks
from pipeline.results.comparator_file import write_comparator
from pipeline.results.measured_record import MeasuredScan
from pipeline.summary import summarise


def load_summary(folder: Path) -> tuple[int, dict[str, Any]]:
    """Exit code and summary that `reseau report` has of what stands in the folder."""
    own = summarise(adjusted_data(read_project(folder / "project.toml"), lambda path: path), {})
    return own.verdict.exit_code, own.as_json()


def summary(folder: Path, capsys: Capture, name: str) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    code = command(name, folder / "project.toml", "--json")
    return code, json.loads(capsys.readouterr().out)


def join_problems(told: dict[str, Any]) -> str:
    return " ".join(problem["what"] for problem in told["problems"])


def one_scan_more(folder: Path) -> MeasuredScan:
    """A fourth scan of the project, and what measuring it gives."""
    (folder / "scans" / "frame4.tif").write_bytes((folder / "scans" / "frame1.tif").read_bytes() + b"\0")
    rewritten_scans(folder, "scans/frame*.tif")
    first = read_measurement(folder / "out" / "measurement.db")[0]
    return replace(first, scan=str(folder / "scans" / "frame4.tif"), frame=replace(first.frame, image="frame4"))


def test_a_finished_project_is_current(finished: tuple[Path, int]) -> None:
    project, code = finished
    after, own_summary = load_summary(project)
    assert after == code
    assert None not in (own_summary["adjustment"], own_summary["check"])
    assert not [name for name in os.listdir(project / "out") if name.startswith(".")]


def test_measuring_again_says_whether_the_adjustment_is_of_the_marks(project: Path, printed_line: Printed) -> None:
    def of_measure() -> str:
        return printed_line("measure", project / "project.toml")

    text = of_measure()
    assert "adjustment.json is of these marks and of the present settings." in text
    assert "Next: reseau report" in text
    robust(project)
    text = of_measure()
    assert "adjustment.json is of other settings than there are now: `reseau run` adjusts again" in text
    assert "Next: reseau run" in text
    path = project / "out" / "adjustment.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "iterations": "many"}))
    assert "iterations is 'many'; it should be a whole number" in of_measure()  # and the marks are written nevertheless
    path.unlink()
    assert "These marks are not adjusted yet: run `reseau run`." in of_measure()


def test_an_adjustment_of_one_scan_less_is_not_shown(project: Path, capsys: Capture) -> None:
    """As `reseau measure` leaves the files."""
    path = project / "out" / "measurement.db"
    scans = (*read_measurement(path), one_scan_more(project))
    digest = keep_scans(path, scans, measured_from(read_project(project / "project.toml")))
    pitch_um = {scan.frame.image: scan.pitch_um for scan in scans}
    write_comparator(
        project / "comparator.csv", comparator_points([scan.frame for scan in scans], pitch_um), pitch_um, digest
    )
    code, own_summary = summary(project, capsys, "report")
    assert code == 1
    assert own_summary["sentence"].startswith("Measured: ")
    assert own_summary["adjustment"] is own_summary["check"] is None
    assert not any("not adjusted yet" in note for note in own_summary["notes"])
    assert "adjustment.json is of other marks than there are now: it is not shown." in join_problems(own_summary)
    assert "Calibrated" not in (project / "out" / "report.html").read_text()


def test_a_scan_that_is_not_measured_yet_is_named(project: Path, capsys: Capture) -> None:
    one_scan_more(project)
    for code, own_summary in (load_summary(project), summary(project, capsys, "adjust")):
        assert code == 1
        assert own_summary["adjustment"] is not None  # it is of these marks
        assert "Not measured yet: frame4." in join_problems(own_summary)
        assert "other settings" not in join_problems(own_summary)


def another_scan(folder: Path) -> None:
    file = folder / "scans" / "frame2.tif"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)


def scan_gone(folder: Path) -> None:
    (folder / "scans" / "frame2.tif").unlink()
    rewritten_scans(folder, "scans/frame*.tif")


another_mark = change_camera("[[fiducial]]", '[[fiducial]]\nid = "99"\nxy_mm = [1.0, 2.0]\n\n[[fiducial]]')
surer_camera = change_camera("principal_distance_mm = 1.0", "principal_distance_mm = 1.1")
robust = change_project("[adjust]", "[adjust]\nrobust = true")


def old(name: str) -> Spoil:
    """A result of before the last adjustment."""

    def change(folder: Path) -> None:
        data = (folder / "out" / name).read_bytes()
        surer_camera(folder)
        assert command("adjust", folder / "project.toml") in (0, 1)
        (folder / "out" / name).write_bytes(data)

    return change


def old_measurement(folder: Path) -> None:
    scans = read_measurement(folder / "out" / "measurement.db")
    (folder / "out" / "measurement.db").unlink()
    keep_scans(folder / "out" / "measurement.db", scans[:2])


def drop_provenance(folder: Path) -> None:
    path = folder / "out" / "adjustment.json"
    content = json.loads(path.read_text())
    del content["made_from"]
    path.write_text(json.dumps(content))


def shift_column(name: str, is_moved: Callable[[str], bool], column: int) -> Spoil:
    """A table of which one number, in the first of such rows, is another one."""

    def change(folder: Path) -> None:
        line = next(filter(is_moved, (folder / name).read_text().splitlines()))
        cells = line.split(",")
        cells[column] = f"{float(cells[column]) + 0.01:.7f}"
        replace_text(folder / name, line, ",".join(cells))

    return change


moved_mark = shift_column("comparator.csv", lambda line: ",target," in line and ",measured," in line, 3)
moved_point = shift_column("points.csv", lambda line: not line.startswith("point"), 1)


@pytest.mark.parametrize(
    ("change", "words", "kept"),
    [
        (another_scan, "Changed since it was measured: frame2.", {"adjustment", "check"}),
        (scan_gone, "Measured, but no scan of the project any more: frame2.", {"adjustment", "check"}),
        (another_mark, "The marks were measured with other settings than there are now of camera ", set()),
        (moved_mark, "adjustment.json is of other marks than there are now", set()),
        (moved_point, "adjustment.json is of other points than there are now", set()),
        (robust, "adjustment.json is of other settings than there are now", set()),
        (surer_camera, "adjustment.json is of other cameras than there are now", set()),
        (old("check.json"), "check.json is of another adjustment: it is not shown.", {"adjustment"}),
        (old("adjustment.npz"), "adjustment.npz goes with another adjustment.json: both are not shown.", set()),
        (drop_provenance, "adjustment.json is of what it does not say: it is not shown.", set()),
        (old_measurement, "measurement.db is of other marks than comparator.csv", {"adjustment", "check"}),
    ],
)  # fmt: skip
def test_stale_results_are_listed_and_not_shown(project: Path, change: Spoil, words: str, kept: set[str]) -> None:
    change(project)
    code, own_summary = load_summary(project)
    assert code == 1
    assert words in join_problems(own_summary)
    assert {name for name in ("adjustment", "check") if own_summary[name] is not None} == kept


def test_marks_of_replaced_scans_and_earlier_decisions_are_not_exported(
    project: Path, tmp_path: Path, refusal: Refusal
) -> None:
    """A rectified frame would show a new picture as the earlier one lay."""
    file, first = project / "project.toml", project / "scans" / "frame1.tif"
    shutil.copy(project / "scans" / "frame2.tif", first)
    words = "is of other scans than there are now: frame1. Run `reseau measure`"
    assert words in refusal("export", file, "csv", tmp_path / "csv")
    tasks, failed = resample_tasks(read_project(file), tmp_path, None, False, 3)
    assert ([task.image for task in tasks], [one.image for one in failed]) == (["frame2", "frame3"], ["frame1"])
    assert "not the one measured: run `reseau measure`" in failed[0].problem
    replace_text(file, "scans = [", 'exclude = ["scans/frame1.tif"]\nscans = [')
    assert words in refusal("export", file, "csv", tmp_path / "csv")
    replace_text(file, 'exclude = ["scans/frame1.tif"]\n', "")
    first.unlink()
    first.symlink_to(tmp_path / "offline.tif")  # the marks may be of it
    assert changed_scans(read_project(file)) == []
    line = {"image": "frame2", "point": "1", "kind": "fiducial", "decision": "reject", "who": "ann", "fingerprint": "0"}
    (project / "decisions.jsonl").write_text(json.dumps({**line, "when": "2026-01-31T12:00:00+00:00"}) + "\n")
    for arguments in (("export", file, "csv", tmp_path / "csv"), ("resample", file, tmp_path / "frames")):
        assert "of other decisions than there are now" in refusal(*arguments)


def test_a_check_writes_nothing_but_its_own_file(project: Path, refusal: Refusal) -> None:
    def states() -> dict[str, tuple[int, int]]:
        paths = [path for path in project.rglob("*") if path.is_file() and path.name != "check.json"]
        return {str(path): ((state := path.stat()).st_mtime_ns, state.st_ino) for path in paths}

    before = states()
    (project / "out" / "check.json").unlink()
    assert command("check", project / "project.toml") == 0
    assert states() == before
    assert json.loads((project / "out" / "check.json").read_text())["verdict"] == "agrees"
    surer_camera(project)
    assert "other cameras than there are now. Run `reseau adjust` first." in refusal("check", project / "project.toml")
    (project / "out" / "adjustment.json").unlink()
    assert "Run `reseau adjust` first." in refusal("check", project / "project.toml")


def test_files_that_say_the_same_in_other_letters_are_the_same(project: Path, tmp_path: Path) -> None:
    """Moved, saved by an editor with other line ends, lines exchanged and commented: nothing is new."""
    code, _ = load_summary(project)
    moved = tmp_path / "elsewhere"
    shutil.move(project, moved)
    for name in ("points.csv", "camera.toml", "project.toml", "comparator.csv"):
        path = moved / name
        lines = path.read_text().splitlines()
        if name == "points.csv":
            lines[1:] = reversed(lines[1:])
        path.write_bytes("\r\n".join([*lines, "# saved"]).encode())
    os.utime(moved / "scans" / "frame1.tif", (1, 1))
    after, own_summary = load_summary(moved)
    assert after == code
    assert own_summary["adjustment"] is not None
    assert own_summary["check"] is not None
    assert own_summary["poses"]


def test_an_interrupt_leaves_all_as_it_was(project: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    before = results(project)
    monkeypatch.setattr(stages, "adjust_marks", Mock(side_effect=KeyboardInterrupt))
    assert command("run", project / "project.toml") == 130
    assert "interrupted; files that were complete stay" in capsys.readouterr().err
    assert results(project) == before


@pytest.mark.study
def test_an_ended_second_pass_costs_no_other(project: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The visits are shared among processes as the first ones are: one of them is ended over frame2."""

    def is_deadly(_: object, args: tuple[Any, ...]) -> bool:
        requests.append(args[0])
        return isinstance(args[0], second_pass.RepeatedSearch) and args[0].image == "frame2"

    requests = list[Any]()
    monkeypatch.setattr("pipeline.archive.measure_archive.worker_pool", lambda *_: nullcontext(Loses(is_deadly)))
    predicted = second_pass._missed_targets  # given no marks, it returns all targets
    monkeypatch.setattr(
        second_pass, "_missed_targets", lambda field, scan, *given: predicted(field, scan.changed(()), *given)
    )
    (project / "comparator.csv").unlink()  # what is shown is new
    code, own_summary = summary(project, capsys, "run")
    assert code == 1
    assert own_summary["adjustment"] is not None
    problems = [one for one in own_summary["problems"] if "second pass failed" in one["what"]]
    assert [one["what"].split(":")[0] for one in problems] == ["frame2"]
    assert "its process was ended" in problems[0]["what"]
    assert {visit.image for visit in requests if isinstance(visit, second_pass.RepeatedSearch)} > {"frame1", "frame2"}


def test_targets_of_a_second_pass_answer_why_none_had_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(second_pass, "adjusted_image", Mock())
    monkeypatch.setattr(second_pass, "checked_places", lambda marks, *_: marks)
    problems = (Reason("No target has a name: no pattern.", Code.UNNAMED), Reason("It is blurred.", Code.SMALL))
    found, other = (
        MarkMeasurement(id, "target", np.full(2, col), Covariance.from_noise(np.eye(2)), Status.MEASURED)
        for id, col in (("1", 9.0), ("2", 50.0))
    )
    for marks, left in (((), problems[1:]), ((other,), problems)):
        scan = MeasuredScan("a.tif", 100, 100, (20.0, 20.0), FrameMeasurement("a", marks, problems=problems))
        again = second_pass._add_targets(scan, [found], Mock(), Mock())
        assert again.frame.problems == left
        assert found in again.frame.marks


def test_a_place_that_is_held_is_named(project: Path, refusal: Refusal, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = os.replace

    def refuse(source: Path, target: Path) -> None:
        if target == project / "out" / "adjustment.npz":
            raise PermissionError(errno.EACCES, "held by another program")
        whole(source, target)

    monkeypatch.setattr("pipeline.publishing.os.replace", refuse)
    message = refusal("adjust", project / "project.toml")
    assert "adjustment.npz: cannot be written (held by another program)" in message
    assert "New are: adjustment.json." in message
    assert ".unfinished" not in message


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("notes.csv", "# my comparator notes\na,b\n", "was not written by reseau"),
        ("null.csv", "", "is no regular file"),
        ("out/report.html", "<!DOCTYPE html><title>A letter</title>", "was not written by reseau"),
        ("out/adjustment.json", '{"name": "reseau"}', "was not written by reseau"),
    ],
)
def test_what_is_no_result_is_left_alone(project: Path, refusal: Refusal, name: str, content: str, words: str) -> None:
    if name.endswith(".csv"):
        replace_text(project / "project.toml", 'comparator = "comparator.csv"', f'comparator = "{name}"')
    if content:
        (project / name).write_text(content)
    else:
        (project / name).symlink_to("/dev/null")
    assert words in refusal("run", project / "project.toml")
    assert (project / name).read_text() == content


def test_a_refused_command_leaves_no_output_folder(project: Path, refusal: Refusal) -> None:
    shutil.rmtree(project / "out")
    with (project / "comparator.csv").open("a", encoding="utf-8") as file:
        file.write("a,b\n")
    assert "comparator.csv, line" in refusal("adjust", project / "project.toml")
    assert "is no results database" in refusal("merge", project / "project.toml", project / "camera.toml")
    assert not (project / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('output = "out"', 'output = "earlier"', "line 5: output: adjustment.json would be written over the earlier"),
        ('comparator = "comparator.csv"', 'comparator = "earlier/adjustment.npz"', "over the covariance of"),
        ('comparator = "comparator.csv"', 'comparator = "out/adjustment.json"', "over another result"),
        ('comparator = "comparator.csv"', 'comparator = "camera.toml"', "over the camera of"),
    ],
)
def test_inputs_are_never_outputs(project: Path, refusal: Refusal, old: str, new: str, words: str) -> None:
    shutil.copytree(project / "out", project / "earlier")
    change_camera("[sigma]", '[sigma]\ncalibration = "earlier/adjustment.json"')(project)
    replace_text(project / "project.toml", old, new)
    assert words in refusal("run", project / "project.toml")


def test_a_folder_outside_the_projects_is_named(project: Path, tmp_path: Path, capsys: Capture) -> None:
    change_project('output = "out"', 'output = "../elsewhere"')(project)
    _, own_summary = summary(project, capsys, "adjust")
    assert any(
        f"outside the project's folder: to {tmp_path.resolve() / 'elsewhere'}" in note for note in own_summary["notes"]
    )


def test_what_an_ended_process_left_is_cleared(project: Path) -> None:
    host = os.uname().nodename
    left = project / "out" / f".unfinished.{host}.999999999"
    left.mkdir()
    (left / "adjustment.json").write_text("half")
    (project / f".comparator.unfinished.{host}.999999999.csv").touch()
    mine = project / "out" / f".unfinished.{host}.{os.getppid()}"
    mine.mkdir()
    assert command("adjust", project / "project.toml") in (0, 1)
    assert not left.exists()
    assert not list(project.glob(".comparator*"))
    assert mine.exists()


def test_values_that_differ_have_fingerprints_that_differ() -> None:
    values: list[object] = [
        1, 1.0, "1", None, True, [1, [2]], [[1], 2], [[1, 2]], [], {}, "", {"a": 1}, {"a": 2}, {"b": 1}, ["a", 1],
        np.array([1.0, 2.0]), np.array([1.0, 2.5]), np.array([[1.0, 2.0]]), np.array([1, 2]), np.array(["a", "b"]),
        Prior(1.0, 0.0), Prior(1.0, 0.5), Path("a.csv"), Path("b.csv"), Status.WEAK, Status.MEASURED,
    ]  # fmt: skip
    assert len({fingerprint(value) for value in values}) == len(values)
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint(Path("here/a.csv")) == fingerprint(Path("there/a.csv"))
    with pytest.raises(TypeError):
        fingerprint(object())


def test_a_scan_counts_as_another_wherever_a_piece_of_it_changes(tmp_path: Path) -> None:
    """The pieces lie from the first byte to the last, and small files are read whole."""
    for size in (0, 1, 1000, 200_000, 5_000_000):
        file = tmp_path / "scan.tif"
        data = bytearray(np.random.default_rng(size).bytes(size))
        file.write_bytes(data)
        found = {parts_hash(file)}
        places = range(0, size, max(size // 7, 1)) if size <= 200_000 else (0, 30_000, 2_130_000, size - 1)
        for at in list(places)[:8]:
            changed = data.copy()
            changed[at] ^= 1
            file.write_bytes(changed)
            found.add(parts_hash(file))
        assert len(found) == 1 + len(list(places)[:8]), size
    assert parts_hash(tmp_path / "none.tif") == ""


END_S = 5.0  # within which every process is to be gone
LONGEST_S = 300.0
State = dict[str, bytes]


def state(folder: Path) -> State:
    """The results in a project's folder; what begins with a point has not taken its place."""
    files = [folder / "comparator.csv", *sorted((folder / "out").rglob("*"))]
    names = {str(file.relative_to(folder)): file for file in files if file.is_file()}
    left = {name: file for name, file in names.items() if "/." not in name and not name.endswith(("-wal", "-shm"))}
    return {name: result for name, file in left.items() if (result := scan_content(file))}


def started(folder: Path, command: str) -> subprocess.Popen[bytes]:
    # What is started in the background of a shell inherits that it hears no interrupt.
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{heard}; from pipeline.main import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", program, command, str(folder / "project.toml")],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def ended(source: Path, folder: Path, command: str, sign: signal.Signals, after_s: float) -> tuple[bool, State, str]:
    """Whether a command, begun in a copy of a project, ended before it was ended after so many seconds; what stands
    there then; and what is wrong beside it: processes that run on, or that it took its time."""
    shutil.copytree(source, folder)
    parent = started(folder, command)
    is_early = wait_until(lambda: parent.poll() is not None, after_s)
    begun = time.monotonic()
    if not is_early:
        parent.send_signal(sign)
    parent.wait(LONGEST_S)
    wrong = "" if is_early or time.monotonic() - begun < END_S else "not ended in time"
    wait_until(lambda: not _session(parent.pid), END_S)
    for pid in _session(parent.pid):
        os.kill(pid, signal.SIGKILL)
        wrong = "processes left"
    found = state(folder)
    shutil.rmtree(folder)
    return is_early, found, wrong


def _session(leader: int) -> list[int]:
    """The processes of a session that are no zombies."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            text = (entry / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if text[0] != "Z" and int(text[3]) == leader:
            found.append(int(entry.name))
    return found


@pytest.mark.study
def test_two_hundred_kills(rendered_demo: Path, tmp_path: Path) -> None:
    """Of a project whose results are of other input than it has now."""
    old, rng = tmp_path / "old", random.Random(2)
    shutil.copytree(rendered_demo, old)
    project = old / "project.toml"
    replace_text(project, ', "scans/frame3.tif"', "")
    assert command("run", project) in (0, 1)
    replace_text(old / "camera.toml", "principal_distance_mm = 1.0", "principal_distance_mm = 0.5")
    project.write_text(f"pitch_um = 45.001\n{project.read_text(encoding='utf-8')}")  # other places
    earlier, start = state(old), time.monotonic()
    _, complete, _ = ended(old, tmp_path / "trial", "run", signal.SIGKILL, LONGEST_S)
    seconds = time.monotonic() - start
    assert complete.keys() >= earlier.keys() - {"out/check.json", "out/report.html"}
    assert all(complete[name] != earlier[name] for name in ("out/adjustment.json", "out/adjustment.npz"))
    faults = []
    for number in range(200):
        sign = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)[number % 3]
        after_s = rng.uniform(0.0, 1.1 * seconds)
        _, found, wrong = ended(old, tmp_path / "trial", "run", sign, after_s)
        if wrong or found not in (earlier, complete):
            names = [name for name in complete if found.get(name) != complete[name]]
            faults.append(f"{sign.name} after {after_s:.1f} s: {wrong or f'earlier {names}'}")
    assert not faults, "\n".join(faults)

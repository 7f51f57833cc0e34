"""A project's scans are measured once: what changed is measured again, and nothing else."""

import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import projects
import pytest
import tifffile
from drawn import lay_out
from projects import Refusal, present
from studies import parametrize_with_studies

from measure import Code, MarkShape, Reason, ScanOrientation, Status, polygon
from measure.fiducials.options import BelievedFilm
from pipeline import read_measurement, read_project
from pipeline.archive.checked_results import latest
from pipeline.archive.made_from import differing, measured_from
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.schema import MEASUREMENTS, Schema, open_database
from pipeline.archive.status import archive_status
from pipeline.archive.verdicts import NEXT_STEP, Verdict, scan_doubt
from pipeline.files.camera_file import CameraFile
from pipeline.measuring.roll import check_scans
from pipeline.measuring.scan_measurement import MeasuredFile, measure_file
from pipeline.measuring.scan_task import Measure, ScanTask
from pipeline.results.measured_record import FailureCode, MeasuredScan
from pipeline.review.session import Session

measured: list[str] = []  # the images that were measured, in their order


def counted_scan(task: ScanTask) -> MeasuredFile:
    measured.append(task.name)
    return measure_file(task)


@pytest.fixture(autouse=True)
def counts(monkeypatch: pytest.MonkeyPatch) -> None:
    measured.clear()
    monkeypatch.setattr("pipeline.archive.work.measure_file", counted_scan)


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of three scans, not measured yet."""
    return projects.write_project(tmp_path_factory.mktemp("three"), ["a", "b", "c"]).parent


@pytest.fixture(scope="module")
def done(three: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, measured."""
    folder = tmp_path_factory.mktemp("done") / "p"
    shutil.copytree(three, folder)
    assert measure(folder) == 0
    return folder


@pytest.fixture
def folder(done: Path, tmp_path: Path) -> Path:
    """The same, in a folder of its own, as old as it was."""
    shutil.copytree(done, tmp_path / "p")
    return tmp_path / "p"


def measure(folder: Path, *options: str) -> int:
    return projects.command("measure", folder / "project.toml", *options)


def marks(folder: Path) -> bytes:
    return (folder / "comparator.csv").read_bytes()


def verdicts(folder: Path) -> dict[str, str]:
    return {scan.image: str(scan.verdict) for scan in archive_status(read_project(folder / "project.toml")).scans}


def one_more(folder: Path) -> None:
    pixels = tifffile.imread(folder / "b.tif")
    tifffile.imwrite(folder / "d.tif", pixels + 1)


CHANGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "nothing": (lambda p: None, ""),
    "touched": (lambda p: os.utime(p / "b.tif", ns=(1, 1)), ""),
    "one pixel changed": (lambda p: change_pixel(p / "b.tif"), "b"),
    "renamed": (lambda p: (p / "b.tif").rename(p / "e.tif"), "e"),
    "one more": (one_more, "d"),
    "one less": (lambda p: (p / "b.tif").unlink(), ""),
    "excluded": (projects.change_project("[measure]", 'exclude = ["b.tif"]\n[measure]'), ""),
    "an option": (projects.change_project('tone = "linear"', "tone = 1.01"), "abc"),
    "a mark drawn otherwise": (projects.change_camera("line_mm = 0.1\n", "line_mm = 0.11\n"), "abc"),
    "an option of the adjustment": (projects.change_project("[measure]", "[adjust]\nrobust = true\n[measure]"), ""),
    "the camera's name": (projects.change_camera('name = "K"', 'name = "L"'), ""),
    "a pose decided": (
        lambda p: (p / "decisions.jsonl").write_text('{"image": "b", "decision": "pose", "pose": "90"}\n'), "b"),
    "the marks' file deleted": (lambda p: (p / "comparator.csv").unlink(), ""),
}  # fmt: skip


@parametrize_with_studies("change", CHANGES, quick=(1, 2, 5, 6, 9, 10, 12))
def test_exactly_what_changed_is_measured_again(folder: Path, change: str) -> None:
    act, again = CHANGES[change]
    act(folder)
    statuses = verdicts(folder)  # what is to be measured is known before
    assert "".join(sorted(name for name in statuses if statuses[name] in ("old", "waiting"))) == again
    assert measure(folder) in (0, 1)
    assert "".join(sorted(measured)) == again
    assert not {"old", "waiting"} & set(verdicts(folder).values())
    after = marks(folder)
    measured.clear()
    assert measure(folder) in (0, 1)
    assert not measured
    assert marks(folder) == after


def test_decisions_stay_with_results_of_touched_files(folder: Path) -> None:
    """Touched, touched again, and as old as at first; what a decision names is found in the review, too."""
    with ResultsDatabase(folder / "out" / "measurement.db") as database:
        key = database.first("select fingerprint from result join scan on scan.id = scan where name = 'b'")
    point = next(line.split(",")[1] for line in marks(folder).decode().splitlines() if line.startswith("b,"))
    line = {"image": "b", "decision": "reject", "point": point, "fingerprint": key}
    (folder / "decisions.jsonl").write_text(json.dumps(line) + "\n")
    first_ns = (folder / "b.tif").stat().st_mtime_ns
    for time_ns in (first_ns, 1, 2, first_ns):
        os.utime(folder / "b.tif", ns=(time_ns, time_ns))
        assert measure(folder) in (0, 1)
        assert not measured
        (row,) = (row for row in marks(folder).decode().splitlines() if row.startswith(f"b,{point},"))
        assert ",rejected," in row
        project = read_project(folder / "project.toml")
        with ResultsDatabase(project.measurement_path) as database:
            now = database.first("select fingerprint from result join scan on scan.id = scan where name = 'b'")
        assert (now == key) is (time_ns == first_ns)
        assert Session(project, "me")._names_result(project.decisions[0], now)


def test_measure_keeps_a_second_pass_until_the_adjustment_has_other_settings(folder: Path) -> None:
    before, path = marks(folder), folder / "out" / "measurement.db"
    with ResultsDatabase(path) as database:
        check_run = present(latest(database))
        scans = [
            scan.changed([replace(mark, point=f"{mark.point}'") for mark in scan.frame.marks])
            for scan in check_run.scans()
        ]
        for _ in range(2):  # of a second pass another one
            check_run = check_run.store_second_pass(scans, read_project(folder / "project.toml").adjust)
    for _ in range(2):
        assert measure(folder) in (0, 1)
        assert marks(folder).count(b"',") == len(scans[0].frame.marks) * 3
    projects.change_project("[measure]", "[adjust]\nrobust = true\n[measure]")(folder)
    assert measure(folder) in (0, 1)
    assert marks(folder).splitlines()[1:] == before.splitlines()[1:]


def test_film_settings_of_the_adjustment_are_settings_of_the_measurement(folder: Path) -> None:
    made = measured_from(read_project(folder / "project.toml"))
    for line, names in (("robust = true", []), ("robust = true\nfilm_sigma_um = 7.0", ["settings"])):
        projects.change_project("[measure]", f"[adjust]\n{line}\n[measure]")(folder)
        assert differing(made, measured_from(read_project(folder / "project.toml"))) == names
        projects.change_project(f"[adjust]\n{line}\n[measure]", "[measure]")(folder)


def test_a_second_measure_waits_for_no_other(folder: Path, refusal: Refusal) -> None:
    """In another process; a killed one leaves nothing behind."""
    database = folder / "out" / "measurement.db"
    code = (
        "import pathlib, time\n"
        "from pipeline.archive.schema import single_writer\n"
        f"with single_writer(pathlib.Path({str(database)!r})):\n"
        "    print('has it', flush=True)\n"
        "    time.sleep(100)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert present(other.stdout).readline() == b"has it\n"
        try:
            for command in ("measure", "run"):
                sentence = refusal(command, folder / "project.toml")
                assert "another `reseau measure` or `reseau run` is running on this project" in sentence
            with ResultsDatabase(database) as reader:
                assert latest(reader) is not None
        finally:
            other.kill()
    assert measure(folder) in (0, 1)
    assert not list(database.parent.glob(".*"))


def test_results_come_back_by_options_and_move_with_their_project(folder: Path, tmp_path: Path) -> None:
    before = marks(folder)
    for old, new in (('tone = "linear"', "tone = 1.01"), ("tone = 1.01", 'tone = "linear"')):
        projects.replace_text(folder / "project.toml", old, new)
        measure(folder)
        assert len(measured) == 3
    assert marks(folder) == before
    folder.rename(tmp_path / "elsewhere")
    assert measure(tmp_path / "elsewhere") == 0
    assert len(measured) == 3
    assert marks(tmp_path / "elsewhere") == before


def test_other_programs_read_the_marks(folder: Path) -> None:
    with sqlite3.connect(folder / "out" / "measurement.db") as db:
        rows = db.execute("select image, point, x_mm, y_mm, status from mark_view").fetchall()
    lines = [line.split(",") for line in marks(folder).decode().splitlines() if line.startswith(("a,", "b,", "c,"))]
    assert [(row[0], row[1], f"{row[2]:.7f}", f"{row[3]:.7f}", row[4]) for row in rows] == [
        (line[0], line[1], line[3], line[4], line[10]) for line in lines
    ]


def change_pixel(path: Path) -> None:
    pixels = tifffile.imread(path)
    pixels[5, 5] ^= 1
    tifffile.imwrite(path, pixels)


def test_moved_files_are_known_by_content_where_requested(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def asks_first(tasks: Sequence[ScanTask], measure: Measure, _: Any) -> Any:
        """A step that has scans measured before all others, as that which reads a roll's first frames."""
        return tasks, {scan.frame.image: scan for scan in measure(tasks)}

    monkeypatch.setattr("pipeline.archive.measure_archive.add_known_lines", asks_first)
    measure(folder, "--moved")  # hashes whole files
    assert not measured
    os.utime(folder / "a.tif", ns=(1, 1))
    (folder / "b.tif").rename(folder / "e.tif")
    change_pixel(folder / "c.tif")
    measure(folder, "--moved")
    assert measured == ["c"]
    assert set(verdicts(folder)) == {"a", "c", "e"}
    measure(folder)
    assert measured == ["c"]


def test_bad_scans_have_a_verdict_and_the_others_are_measured(folder: Path, capsys: projects.Capture) -> None:
    """Beside one good scan: a truncated, a foreign and a black one, and one that is no picture."""
    good = [line for line in marks(folder).decode().splitlines() if line.startswith("a,")]
    (folder / "b.tif").write_bytes((folder / "b.tif").read_bytes()[:100_000])
    (folder / "c.tif").write_bytes(b"II*\0 and nothing that is right")
    (folder / "foreign.tif").write_text("a letter")
    tifffile.imwrite(folder / "black.tif", np.zeros_like(tifffile.imread(folder / "a.tif")))
    assert measure(folder) == 1
    found = {"a": "good", "b": "failed", "c": "failed", "black": "poor", "foreign": "failed"}
    assert verdicts(folder) == found
    rows = marks(folder).decode().splitlines()
    assert [row for row in rows if row.startswith("a,")] == good
    assert sum(",absent," in row and "the scan could not be measured" in row for row in rows) == 3 * 4
    measured.clear()
    capsys.readouterr()
    assert measure(folder) == 1  # and no second time
    assert not measured
    assert measure(folder, "--retry") == 1
    assert sorted(measured) == ["b", "c", "foreign"]
    assert projects.command("status", folder / "project.toml", "--verdict", "failed") == 1
    out, err = capsys.readouterr()
    assert "foreign" in out
    assert "Repair or replace" in out.replace("\n", " ")
    assert "Traceback" not in err


@pytest.mark.study
def test_copies_count_once(folder: Path) -> None:
    shutil.copyfile(folder / "a.tif", folder / "z.tif")
    near = tifffile.imread(folder / "a.tif")
    near[2, 2] ^= 1
    tifffile.imwrite(folder / "y.tif", near)
    assert measure(folder) == 1
    rows = [line.split(",") for line in marks(folder).decode().splitlines() if line.startswith(("y,", "z,"))]
    assert {(row[0], row[10]) for row in rows} == {("y", "measured"), ("z", "rejected")}
    assert all("copy of that of a" in row[11] for row in rows if row[0] == "z")
    assert verdicts(folder)["z"] in ("look", "poor")


def test_a_full_disk_costs_no_result(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: projects.Capture) -> None:
    before = marks(folder)
    one_more(folder)

    def full(path: Path, schema: Schema = MEASUREMENTS) -> sqlite3.Connection:
        database = open_database(path, schema)
        database.execute("pragma max_page_count = 1")  # no page more than there are
        return database

    with monkeypatch.context() as patched:
        patched.setattr("pipeline.archive.schema.open_database", full)
        assert measure(folder) == 2
    message = capsys.readouterr().err
    assert "is full). Make room there" in message
    assert "Traceback" not in message
    assert marks(folder) == before
    measured.clear()
    assert measure(folder) in (0, 1)
    assert measured == ["d"]


def test_shards_joined_are_the_same_as_one_machine(
    folder: Path, three: Path, tmp_path: Path, capsys: projects.Capture
) -> None:
    parts = tmp_path / "parts"
    shutil.copytree(three, parts)
    project = parts / "project.toml"
    assert measure(parts, "--shard", "1/5") == 0
    assert not (parts / "comparator.csv").exists()
    database = parts / "out" / "measurement.{}-of-5.db"
    assert projects.command("merge", project, str(database).format(1)) == 1  # the others are waiting
    assert "waiting" in capsys.readouterr().out
    assert measure(parts, "--shard", "2/5") == 0
    assert sorted(measured) == ["a", "b", "c"]
    assert projects.command("merge", project, *(str(database).format(k) for k in (1, 2))) == 0
    assert len(measured) == 3
    assert marks(parts) == marks(folder)
    assert measure(parts) == 0
    assert len(measured) == 3


@pytest.mark.parametrize("shard", ["3", "0/2", "3/2", "a/b", "1/2/3"])
def test_a_shard_that_is_none_is_refused(folder: Path, shard: str, capsys: projects.Capture) -> None:
    assert measure(folder, "--shard", shard) == 2
    assert "is not K/N" in capsys.readouterr().err


def test_a_new_scan_has_its_own_lot_checked_again_and_no_other(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lots = list[set[str]]()

    def note_lot(camera: CameraFile, scans: Sequence[MeasuredScan], film: BelievedFilm) -> tuple[MeasuredScan, ...]:
        lots.append({scan.frame.image for scan in scans})
        return check_scans(camera, scans, film)

    monkeypatch.setattr("pipeline.archive.cross_scan_checks.check_scans", note_lot)
    # lots as of an archive of 2000 times as many scans
    monkeypatch.setattr("pipeline.archive.cross_scan_checks._TOGETHER", 1)
    measure(folder, "--retry")
    assert lots == [{"a", "b", "c"}]  # by a hash of their names
    one_more(folder)
    measure(folder)
    assert lots[1:] == [{"d"}]
    assert set(verdicts(folder)) == {"a", "b", "c", "d"}


def test_status_tells_what_changed_outside(folder: Path, printed: projects.Printed) -> None:
    project = str(folder / "project.toml")
    assert projects.command("status", project) == 0
    one_more(folder)
    change_pixel(folder / "a.tif")
    os.utime(folder / "b.tif", ns=(1, 1))  # as in a copy
    (folder / "c.tif").unlink()
    assert verdicts(folder) == {"a": "old", "b": "good", "d": "waiting"}
    output = json.loads(printed("status", project, "--json", code=1))
    assert {name: one["verdict"] for name, one in output["images"].items()} == {"a": "old", "d": "waiting"}
    assert output["verdicts"]["good"]["scans"] == 1
    assert printed("status", project, "--csv", "--verdict", "waiting", code=1).splitlines()[1].startswith("d,waiting,")
    assert "No scan has this verdict." in printed("status", project, "--verdict", "failed", code=1)
    assert projects.command("status", project, "--verdict", "dreadful") == 2


def test_status_says_why_a_scan_needs_attention(folder: Path) -> None:
    scan, *_ = read_measurement(folder / "out" / "measurement.db")
    assumed = replace(scan, frame=replace(scan.frame, pose=ScanOrientation("90", decided=False)))
    doubted = scan.change_status("fiducial", Status.WEAK, Reason("it is dusty", Code.DUST))
    assert scan_doubt(scan) == ""
    assert scan_doubt(assumed) == "scan orientation 90 is assumed"
    assert scan_doubt(assumed.changed(problems=[Reason("it is bent", Code.PITCH)])) == "it is bent"
    assert scan_doubt(doubted) == f"{scan.frame.marks[0].point}: it is dusty"


def test_the_pages_of_results_and_scans_have_the_tables_of_verdicts_and_failures() -> None:
    results, scans = (
        (Path(__file__).parents[2] / "docs" / "reference" / name).read_text() for name in ("results.md", "scans.md")
    )
    assert all(f"| `{verdict}` | {verdict.meaning} | {NEXT_STEP[verdict]} |" in results for verdict in Verdict)
    assert all(f"| `{code}` | {code.meaning} |" in scans for code in FailureCode)


TIP_MM = ((0.0, 0.0), (0.8, -1.0), (0.8, 1.0))  # of a wedge, whose sides lean on the tone curve


@pytest.mark.study
def test_the_tone_of_a_scanner_stays_when_scans_come_and_go(tmp_path: Path, capsys: projects.Capture) -> None:
    folder = tmp_path / "p"
    unknown = projects.PROJECT.replace('tone = "linear"\n', "")
    projects.write_project(folder, ["a", "b"], unknown, lay_out([MarkShape(polygon(TIP_MM))] * 4))
    mark = f'[mark.m]\nkind = "polygon"\nvertices_mm = {[*map(list, TIP_MM)]}\n'
    (folder / "camera.toml").write_text(projects.CAMERA.split("[mark.m]")[0] + mark)
    measure(folder)
    assert "tone curve from scan 2 of 2" in capsys.readouterr().err
    measured.clear()
    measure(folder)
    assert not measured
    assert "2 of 2 scans measured (2 stored already)" in capsys.readouterr().err
    one_more(folder)
    (folder / "a.tif").unlink()
    measure(folder)
    assert measured == ["d"]


def test_scans_that_fail_alike_are_reported_once_and_all_scans_are_counted(
    tmp_path: Path, refusal: projects.Refusal
) -> None:
    """No pitch in project and files: one sentence with the number and the names, not one a scan."""
    for number in range(6):
        pixels = np.full((40, 40), 90 + number, np.uint8)
        tifffile.imwrite(tmp_path / f"s{number}.tif", pixels, metadata=None)
    disks = '[targets]\nkind = "disk"\ndiameter_mm = 1.0\n[adjust]\ntransformation = "none"'
    project = f'camera = "camera.toml"\nscans = ["*.tif"]\n[object]\npoints = "points.csv"\n{disks}'
    points = ["point,X,Y,Z", "1,0,0,0", "2,9,0,0", "3,0,9,0", "4,9,9,1"]
    projects.write_tables(tmp_path, project, camera='name = "c"\nprincipal_distance_mm = 10.0', points=points)
    message = refusal("measure", tmp_path / "project.toml")
    assert "reseau: 6 scans (s0, s1, s2, s3, s4, s5): pitch_um is missing in the project, and the file" in message
    assert message.count("reseau: ") == 1
    assert message.count("pitch_um is missing") == 2  # at the first that fails, and at the end
    assert re.findall(r"measured: (\d) of 6", message)[-1] == "6"
    assert "measured: 1 of 1" not in message

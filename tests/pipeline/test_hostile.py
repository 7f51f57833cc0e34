"""Results, requests, decisions, imports, names and addresses damaged at random: each read rightly or refused."""

import json
import os
import random
import shutil
import sqlite3
import string
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
from hostile import MESSAGE, RESULT, change_bytes, change_json, command_ending, counted
from networks import simulated
from projects import POINTS, TRUTH, Capture, adjusted_project, command, make_project, write_project
from review_server import GOOD, Served, get_cookie, mark_px, measured_faults, request, served
from studies import parametrize_with_studies

from adjust import AdjustmentError
from measure import MeasurementError
from measure.scans.remote import Address
from pipeline import InputError, read_project
from pipeline.archive.checked_results import latest, measured_scans
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.status import archive_status
from pipeline.exchange.exchange_stage import run_export, run_import
from pipeline.exchange.formats import ExportOptions
from pipeline.exchange.incoming import ImportOptions
from pipeline.files.decisions_file import Decision, DecisionKind, append_decisions, read_decisions
from pipeline.results.measured_record import FailureCode, mark_row, scan_detail
from pipeline.review.session import build_queue
from pipeline.text.files import names_below

FORMATS = ("csv", "opencv", "colmap", "micmac", "mmvii", "metashape", "asp", "bingo", "geojson")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    network, _ = simulated(np.random.default_rng(1), TRUTH, points=POINTS, free={"k3": np.inf})
    project = make_project(network, folder, "EPSG:25832")
    camera = folder / "camera.toml"
    camera.write_text(camera.read_text().replace("[[fiducial]]\n", '[[fiducial]]\nmark = "none"\n'))
    assert command("check", project) in (0, 1)
    shutil.copytree(folder / "out", folder / "earlier")
    return folder


def commands(folder: Path) -> dict[str, list[list[str]]]:
    """By result file those that read it."""
    project, out = str(folder / "project.toml"), folder / "out"
    adjusted, earlier = str(out / "adjustment.json"), str(folder / "earlier" / "adjustment.json")
    return {
        "out/adjustment.json": [
            ["status", project],
            ["report", project],
            ["check", project],
            ["compare", earlier, adjusted, "--out", str(folder / "compared")],
            ["convert", adjusted, "brown", str(folder / "converted.toml")],
            ["resample", project, str(folder / "resampled"), "--pitch-um", "5000", "--lens"],
            *(["export", project, name, str(folder / "exported" / name)] for name in FORMATS),
        ],
        "out/check.json": [["report", project], ["status", project]],
    }


@pytest.mark.study
def test_all_changed_results(sound: Path, capsys: Capture) -> None:
    """Each trial changes one value of a file and runs one command that reads it."""

    def trial(rng: random.Random) -> str:
        name, calls = rng.choice(sorted(commands(sound).items()))
        path, call = sound / name, rng.choice(calls)
        whole = path.read_text()
        text, what = change_json(whole, rng)
        path.write_text(text)
        try:
            return command_ending(call, capsys, f"{call[:3:2]} with {name}: {what}")
        finally:
            path.write_text(whole)

    found = counted(3000, 2, trial)
    assert set(found) == {MESSAGE, RESULT}, "\n".join(found)


DECISION = {"image": GOOD, "point": "1", "kind": "fiducial", "decision": "place", "col_px": 100.0, "row_px": 90.5}
CLICKS = {point: mark_px(GOOD, point).tolist() for point in "123"}
DRAWING = {
    "image": GOOD, "point": "1", "name": "drawn", "pose": "0", "pitch_um": 20.0, "principal_distance_mm": 60.0,
    "mark": {"kind": "ring-cross", "ring_mm": 0.8, "ring_line_mm": 0.1, "arm_mm": 1.2, "line_mm": 0.1, "gap_mm": 0.0},
    "marks": [{"id": point, "px": px, "xy_mm": [None, None]} for point, px in CLICKS.items()],
    "frame_mm": [60.0, 60.0], "corners_px": [[1.0, 2.0], [300.0, 310.0]], "sigma_mm": 0.01,
}  # fmt: skip
BODIES: dict[str, Any] = {
    "decide": {"decisions": [DECISION | {"window": [1, 2, 3, 4], "note": "n", "fingerprint": "f"}], "key": ""},
    "measure": {"image": GOOD, "clicks": [{"point": p, "col_px": c, "row_px": r} for p, (c, r) in CLICKS.items()]},
    "learn": {"image": GOOD, "of": GOOD, "px": CLICKS},
    "draw": {"drawing": DRAWING, "step": {"fit": True}},
    "save-camera": {"drawing": DRAWING, "file": "drawn.toml"},
    "save-learned": {"image": GOOD, "px": CLICKS, "file": "learned.toml"},
}
QUERIES: dict[str, dict[str, Any]] = {
    "queue": {"start": 0},
    "mark": {"image": GOOD, "point": "1", "kind": "fiducial"},
    "frame": {"image": GOOD},
    "camera": {"key": "k"},
    "scan": {"image": GOOD},
    "window.png": {"image": GOOD, "col": 10, "row": 10, "size": 64},
    "residual.png": {"image": GOOD, "point": "1", "kind": "fiducial"},
    "pose.png": {"image": GOOD, "pose": "90"},
    "drawing.png": {"drawing": json.dumps(DRAWING), "half": 20, "of": "drawing"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return measured_faults(tmp_path_factory.mktemp("requests") / "faults")


def answers(folder: Path, server: Served, trials: int, seed: int) -> Counter[str]:
    """What was answered with a fault, or spoilt the decisions or what lies about the folder; and how many otherwise."""
    headers = {"Cookie": get_cookie(server), "Origin": server.origin, "Content-Type": "application/json"}
    around = sorted(folder.parent.iterdir())

    def trial(rng: random.Random) -> str:
        is_body = rng.random() < 0.7
        name, content = rng.choice(sorted((BODIES if is_body else QUERIES).items()))
        text, what = change_json(json.dumps(content), rng)
        if is_body:
            status, _, answer = request(server, f"/api/{name}", headers, "POST", text)
        else:
            status, _, answer = request(server, f"/api/{name}?{urlencode(json.loads(text))}", headers)
        read_decisions(folder / "decisions.jsonl")
        is_plain = status in (200, 400, 404) and sorted(folder.parent.iterdir()) == around
        return str(status) if is_plain else f"{name}: {what}: {status} {answer[:200]!r}"

    return counted(trials, seed, trial)


@parametrize_with_studies(("trials", "seed"), [(25, 1), (3000, 2)])
def test_changed_requests(trials: int, seed: int, folder: Path) -> None:
    with served(folder / "project.toml") as server:
        found = answers(folder, server, trials, seed)
    assert set(found) <= {"200", "400", "404"}, "\n".join(found)


REFUSED = (InputError, MeasurementError, AdjustmentError)
RIGHT, WRONG = "right or refused", "wrong as right"


@pytest.fixture(scope="module")
def measured_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile") / "p"
    project = write_project(folder, ["a", "b", "c"])
    assert command("measure", project) == 0
    append_decisions(folder / "decisions.jsonl", [Decision("b", DecisionKind.REJECT, "1", "fiducial", who="ann")])
    command("measure", project)
    with sqlite3.connect(folder / "out" / "measurement.db") as db:
        db.execute("pragma wal_checkpoint(truncate)")
    return folder


def readings(folder: Path) -> dict[str, Any]:
    """What every reader makes of a project's store; of what it refuses, nothing."""
    project = read_project(folder / "project.toml")
    path, result = project.measurement_path, dict[str, Any]()

    def scans() -> Any:
        scans = measured_scans(path)
        kept = [scan for scan in scans if scan.failure is None or scan.failure.code is not FailureCode.DAMAGED]
        return {s.frame.image: [scan_detail(s, Path(s.scan).name), *map(mark_row, s.frame.marks)] for s in kept}

    def questions() -> Any:
        with ResultsDatabase(path) as database:
            check_run = latest(database)
            queue = build_queue(project, database.connection, check_run.row) if check_run is not None else ()
        return [entry for entry in queue if entry.fingerprints != ("",)]

    def statuses() -> Any:
        scans = archive_status(project).scans
        return {scan.image: scan for scan in scans if scan.verdict not in ("failed", "waiting", "old")}

    for name, reading in (("scans", scans), ("questions", questions), ("status", statuses)):
        try:
            result[name] = reading()
        except REFUSED:
            result[name] = None
    return result


def is_right(found: Any, right: Any) -> bool:
    """Whether all that is told is right: what is left out was refused."""
    if found is None:
        return True
    if isinstance(right, dict):
        return all(name in right and right[name] == value for name, value in found.items())
    return all(one in right for one in found)


Damage = Callable[[random.Random, Path], None]


def spoil_file(rng: random.Random, path: Path) -> None:
    path.write_bytes(change_bytes(path.read_bytes(), rng))


TABLES = ("scan", "result", "mark", "judging", "judged_frame", "judged", "kept", "options", "program", "judged_lot")


def change_values(rng: random.Random, path: Path) -> None:
    words = ["", "x", "../../x", "[]", "{}", "null", b"\xff\x00", "a", "good", "measured"]
    values = [None, 0, 1, -1, 2.5, 1e300, *words, 2**62]
    with sqlite3.connect(path, isolation_level=None) as db:
        db.execute("pragma foreign_keys = off")
        table = rng.choice(TABLES)
        columns = [row[1] for row in db.execute(f"pragma table_info({table})")]
        column = rng.choice(columns)
        rows = db.execute(f"select {', '.join(columns)} from {table}").fetchall()
        if not rows:
            return
        row = rng.choice(rows)
        now = row[columns.index(column)]
        other = rng.choice(rows)[columns.index(column)]
        value = rng.choice([*values, now + 5.0 if isinstance(now, int | float) else f"{now}x", other])
        where = " and ".join(f"{name} is ?" for name in columns)
        try:
            if rng.random() < 0.1:
                db.execute(f"delete from {table} where {where}", row)
            else:
                db.execute(f"update {table} set {column} = ? where {where}", (value, *row))
        except sqlite3.Error:  # not null, unique
            pass
        db.execute("pragma wal_checkpoint(truncate)")


def test_a_changed_digest_is_never_taken_for_no_judging(measured_folder: Path, tmp_path: Path) -> None:
    right, place = readings(measured_folder), tmp_path / "p"
    shutil.copytree(measured_folder, place)
    path = place / "out" / "measurement.db"
    with sqlite3.connect(path) as db:
        (digest,) = db.execute("select digest from judging order by id desc").fetchone()
    data = path.read_bytes()
    places = [at for at in range(len(data)) if data.startswith(digest.encode(), at)]
    assert len(places) >= 2
    for at in places:
        path.write_bytes(data[:at] + b"g" + data[at + 1 :])
        found = readings(place)
        assert all(is_right(found[name], right[name]) for name in right), at


def test_a_damaged_view_of_the_checked_marks_is_not_used(measured_folder: Path, tmp_path: Path) -> None:
    """SQLite ends the text of a view at a byte 0: then marks that a person rejected were measured."""
    place = tmp_path / "p"
    right, path = readings(measured_folder), place / "out" / "measurement.db"
    shutil.copytree(measured_folder, place)
    data = path.read_bytes()
    assert data.count(b"where not f.own_marks") == 1
    path.write_bytes(data.replace(b"where not f.own_marks", b"\0here not f.own_marks"))
    assert readings(place) == right


@pytest.mark.parametrize("words", [b"set in the project", b'"evidence"', b'"roll"', b"a.tif", b"measured"])
def test_damaged_words_of_a_result_are_refused(words: bytes, measured_folder: Path, tmp_path: Path) -> None:
    """A text that is no UTF-8, or lacks a key, is not read, wherever it stands."""
    right, place = readings(measured_folder), tmp_path / "p"
    shutil.copytree(measured_folder, place)
    path = place / "out" / "measurement.db"
    data = path.read_bytes()
    places = [at for at in range(len(data)) if data.startswith(words, at)]
    assert places
    for at, byte in product(places, (b"\xff", b"x")):
        path.write_bytes(data[: at + 2] + byte + data[at + 3 :])
        found = readings(place)
        assert all(is_right(found[name], right[name]) for name in right), at


@parametrize_with_studies(("trials", "seed"), [(4, 1), (600, 36)])
@pytest.mark.parametrize("damage", [spoil_file, change_values])
def test_damaged_databases(trials: int, seed: int, damage: Damage, measured_folder: Path, tmp_path: Path) -> None:
    right, folder = readings(measured_folder), tmp_path / "p"

    def trial(rng: random.Random) -> str:
        shutil.copytree(measured_folder, folder)
        damage(rng, folder / "out" / "measurement.db")
        try:
            found = readings(folder)
            return RIGHT if all(is_right(found[name], right[name]) for name in right) else WRONG
        except Exception:
            return traceback.format_exc()
        finally:
            shutil.rmtree(folder)

    assert counted(trials, seed, trial) == {RIGHT: trials}


def test_trap_two_blas_threads_a_worker() -> None:
    """The command sets one BLAS thread before numpy is loaded, and the workers inherit it."""
    program = (
        "import os, sys, types\n"
        "from pipeline.main import main\n"
        "def run():\n"
        "    assert 'numpy' not in sys.modules\n"
        "    print(os.environ['OPENBLAS_NUM_THREADS'])\n"
        "sys.modules['pipeline.cli'] = types.SimpleNamespace(run=run)\n"
        "main()\n"
    )
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    text = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert text.stdout.split() == ["1"]


SECRETS = ("hunter2", "s3cr3t-signature", "AKIAEXAMPLE")
OUTSIDE = "outside"
Trial = Callable[[random.Random, Path, Path], str]


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return adjusted_project(tmp_path_factory.mktemp("adjusted"))


def decisions_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    """A file of good lines, one of them spoiled: all good ones are read, or the bad one is named; and appending writes
    all of a batch or nothing."""
    path = folder / "decisions.jsonl"
    choices = (DecisionKind.ACCEPT, DecisionKind.REJECT, DecisionKind.ABSENT, DecisionKind.UNDO)
    lines = [Decision(rng.choice("abz"), rng.choice(choices), rng.choice("129"), "fiducial") for _ in range(8)]
    append_decisions(path, lines)
    if is_mostly_damaged := rng.random() < 0.7:
        path.write_bytes(change_bytes(path.read_bytes(), rng))
    read = read_decisions(path)
    if not is_mostly_damaged and read != tuple(lines):
        return WRONG
    bad = Decision("a", DecisionKind.PLACE, "1", "fiducial", col_px=rng.choice([float("nan"), 1e300]), row_px=1.0)
    before = path.read_bytes()
    try:
        append_decisions(path, [lines[0], bad])
    except InputError:
        return RIGHT if path.read_bytes() == before else WRONG
    return WRONG


def word(rng: random.Random) -> str:
    pieces = ["..", "/", "\\", ".", "x", "~", "C:", "\0", "\n", "%2e%2e", "σ", " ", "a" * 300, "$(x)", "<b>", '"', "'"]
    return "".join(rng.choice(pieces) for _ in range(rng.randrange(1, 6)))


def xml(text: str) -> str:
    return "".join(f"&#{ord(letter)};" if letter in '<>&"' else letter for letter in text)


def written(write: Callable[[Path], object], folder: Path) -> str:
    """Whether writing into a folder of the given one left its surroundings alone."""
    around, out = folder.parent, folder / "o" / "out"
    before = set(around.rglob("*"))
    with suppress(*REFUSED):
        write(out)
    news = {path for path in set(around.rglob("*")) - before if path.is_file()}
    return RIGHT if all(path.is_relative_to(out) for path in news) else OUTSIDE


def imports_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    place = rng.choice(["1 2", "nan 1", "1e999 0", "x", "1"])
    mark = f"<OneMesureAF1I><NamePt>{xml(word(rng))}</NamePt><PtIm>{place}</PtIm></OneMesureAF1I>"
    one = f"<MesureAppuiFlottant1Im><NameIm>{xml(word(rng))}</NameIm>{mark * rng.randrange(3)}</MesureAppuiFlottant1Im>"
    text = bytearray(one.encode())
    if rng.random() < 0.3:
        text[rng.randrange(len(text))] = rng.randrange(256)
    source = folder / rng.choice(["MeasuresIm-a.xml", "MeasuresCamera.xml", "MesIm-a.xml", "a.xml"])
    source.write_bytes(text)
    format = rng.choice(["micmac", "mmvii", "metashape", "opencv", "certificate", "bingo"])
    options = ImportOptions(pitch_um=10.0, sigma_px=0.1)
    return written(lambda out: run_import(format, [source], out, options), folder)


def names_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    name = word(rng)
    for file in ("project.toml", "camera.toml", "points.csv"):
        if (adjusted.parent / file).exists():
            shutil.copy(adjusted.parent / file, folder / file)
    project = folder / "project.toml"
    project.write_text(project.read_text().replace('scans = ["scans/*.tif"]\n', ""))
    cell = '"' + name.replace('"', '""') + '"'
    lines = adjusted.with_name("comparator.csv").read_text().splitlines()
    (folder / "comparator.csv").write_text(
        "\n".join(cell + line[2:] if line.startswith("f1,") else line for line in lines)
    )
    format = rng.choice(["csv", "mmvii", "micmac"])
    read = read_project(project)
    return written(lambda out: run_export(read, format, out, ExportOptions()), folder)


def addresses_trial(rng: random.Random, folder: Path, adjusted: Path) -> str:
    """No secret is told, and another signature is the same scan."""
    signed = [
        "X-Amz-Signature={0}&X-Amz-Credential={1}&X-Amz-Date={2}",
        "AWSAccessKeyId={1}&Signature={0}&Expires={2}",
        "sv={2}&se={2}&sr=b&sig={0}",
        "token={0}",
        "Policy={2}&Signature={0}&Key-Pair-Id={1}",
        "X-Goog-Signature={0}&X-Goog-Date={2}",
    ]
    form, user = rng.choice(signed), rng.choice(["", "ann:hunter2@", "hunter2@", "ann%40x:hunter2@"])
    host, path = rng.choice(["h.org", "h.org:8080", "[::1]"]), rng.choice(["0001.tif", "a/b/0001.tif", "a b/0001.tif"])
    base = f"{rng.choice(['https', 'http', 'HTTPS'])}://{user}{host}/{path}"

    def query() -> str:
        when = "".join(rng.choices(string.digits, k=8))
        return form.format(f"s3cr3t-signature{rng.choice('/+=%')}{rng.random()}", f"AKIAEXAMPLE{when}", when)

    one, two = Address(f"{base}?{query()}"), Address(f"{base}?{query()}")
    result = [str(one), repr(one), one.name, *names_below([one, one.with_name("b.tif")]), f"{one}", str([one])]
    if str(one) != str(two) or any(secret in text for secret in SECRETS for text in result):
        return WRONG
    return RIGHT if names_below([one]) == ["0001"] else WRONG


@parametrize_with_studies(("trials", "seed"), [(4, 1), (600, 36)])
@pytest.mark.parametrize("trial", [decisions_trial, imports_trial, names_trial, addresses_trial])
def test_hostile_inputs(trial: Trial, trials: int, seed: int, adjusted: Path, tmp_path: Path) -> None:
    def ending(rng: random.Random) -> str:
        folder = tmp_path / "around" / "p"
        folder.mkdir(parents=True)
        try:
            return trial(rng, folder, adjusted)
        except REFUSED:
            return RIGHT
        except Exception:
            return traceback.format_exc()
        finally:
            shutil.rmtree(folder.parent)

    assert counted(trials, seed, ending) == {RIGHT: trials}

"""Hostile inputs, seeded; and traps seen in comparable programs, each by its name."""

import os
import random
import shutil
import sqlite3
import string
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from projects import adjusted_project, write_project

from adjust import AdjustmentError
from measure import MeasurementError
from measure.scans.remote import Address
from pipeline import InputError, read_comparator, read_project
from pipeline.archive.checked_results import latest, measured_scans
from pipeline.archive.results_database import Store
from pipeline.archive.status import archive_status
from pipeline.cli import run
from pipeline.exchange.exchange_stage import run_export, run_import
from pipeline.exchange.formats import ExportOptions
from pipeline.exchange.incoming import ImportOptions
from pipeline.files.decisions_file import Choice, Decision, append_decisions, read_decisions
from pipeline.results.measured_record import FailureCode, mark_row, scan_detail
from pipeline.review.session import build_queue
from pipeline.text.files import names_below

REFUSED = (InputError, MeasurementError, AdjustmentError)
SECRETS = ("hunter2", "s3cr3t-signature", "AKIAEXAMPLE")
GOOD, WRONG, TRACEBACK, OUTSIDE = "right or refused", "wrong as right", "traceback", "outside"


@pytest.fixture(scope="module")
def measured_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile") / "p"
    project = write_project(folder, ["a", "b", "c"])
    assert run(["measure", str(project)]) == 0
    append_decisions(folder / "decisions.jsonl", [Decision("b", Choice.REJECT, "1", "fiducial", who="ann")])
    run(["measure", str(project)])
    with sqlite3.connect(folder / "out" / "measurement.db") as db:
        db.execute("pragma wal_checkpoint(truncate)")
    return folder


@pytest.fixture(scope="module")
def adjusted_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return adjusted_project(tmp_path_factory.mktemp("adjusted"))


def outcome(trial: Callable[[], str]) -> str:
    try:
        return trial()
    except REFUSED:
        return GOOD
    except Exception:
        import traceback

        traceback.print_exc()
        return TRACEBACK


# --- the results database


def readings(folder: Path) -> dict[str, Any]:
    """What every reader makes of a project's store; of what it refuses, nothing."""
    project = read_project(folder / "project.toml")
    path, result = project.measurement_path, dict[str, Any]()

    def scans() -> Any:
        scans = measured_scans(path)
        kept = [scan for scan in scans if scan.failure is None or scan.failure.code is not FailureCode.DAMAGED]
        return {
            s.frame.image: [scan_detail(s, os.path.relpath(s.scan, folder)), *map(mark_row, s.frame.marks)]
            for s in kept
        }

    def questions() -> Any:
        with Store(path) as store:
            judging = latest(store)
            queue = build_queue(project, store.connection, judging.row) if judging is not None else ()
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


def database_trial(
    rng: random.Random, measured_folder: Path, folder: Path, damage: Callable[[random.Random, Path], None]
) -> str:
    right = readings(measured_folder)
    shutil.copytree(measured_folder, folder)
    for name in ("a", "b", "c"):
        shutil.copystat(measured_folder / f"{name}.tif", folder / f"{name}.tif")
    damage(rng, folder / "out" / "measurement.db")

    def trial() -> str:
        found = readings(folder)
        return GOOD if all(is_right(found[name], right[name]) for name in right) else WRONG

    return outcome(trial)


def change_bytes(rng: random.Random, path: Path) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 1, 2, 8, 64])):
        at = rng.randrange(len(data))
        data[at] = rng.choice([0, 255, data[at] ^ (1 << rng.randrange(8)), rng.randrange(256)])
    if rng.random() < 0.1:
        del data[rng.randrange(len(data)) :]
    path.write_bytes(data)


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


# --- decisions


def decisions_trial(rng: random.Random, folder: Path) -> str:
    """A file of good lines, one of them spoiled: all good ones are read, or the bad one is named; and appending writes
    all of a batch or nothing."""
    folder.mkdir(parents=True)
    path = folder / "decisions.jsonl"
    choices = (Choice.ACCEPT, Choice.REJECT, Choice.ABSENT, Choice.UNDO)
    lines = [Decision(rng.choice("abz"), rng.choice(choices), rng.choice("129"), "fiducial") for _ in range(8)]
    append_decisions(path, lines)
    if is_spoilt := rng.random() < 0.7:
        change_bytes(rng, path)

    def trial() -> str:
        read = read_decisions(path)
        if not is_spoilt and read != tuple(lines):
            return WRONG
        bad = Decision("a", Choice.PLACE, "1", "fiducial", col_px=rng.choice([float("nan"), 1e300]), row_px=1.0)
        before = path.read_bytes()
        try:
            append_decisions(path, [lines[0], bad])
        except InputError:
            return GOOD if path.read_bytes() == before else WRONG
        return WRONG

    return outcome(trial)


# --- imports, names


def word(rng: random.Random) -> str:
    pieces = ["..", "/", "\\", ".", "x", "~", "C:", "\0", "\n", "%2e%2e", "σ", " ", "a" * 300, "$(x)", "<b>", '"', "'"]
    return "".join(rng.choice(pieces) for _ in range(rng.randrange(1, 6)))


def xml(text: str) -> str:
    return "".join(f"&#{ord(letter)};" if letter in '<>&"' else letter for letter in text)


def writing(write: Callable[[Path], object], out: Path, around: Path) -> str:
    """How writing into a folder ended, and whether a file came to be elsewhere around it."""
    before = files(around)
    ended = outcome(lambda: (write(out), GOOD)[1])
    return OUTSIDE if any(not path.is_relative_to(out) for path in files(around) - before) else ended


def imports_trial(rng: random.Random, folder: Path) -> str:
    folder.mkdir(parents=True)
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
    return writing(lambda out: run_import(format, [source], out, options), folder / "out", folder.parent)


def names_trial(rng: random.Random, adjusted_folder: Path, folder: Path) -> str:
    folder.mkdir(parents=True)
    name = word(rng)
    for file in ("project.toml", "camera.toml", "points.csv"):
        if (adjusted_folder.parent / file).exists():
            shutil.copy(adjusted_folder.parent / file, folder / file)
    project = folder / "project.toml"
    project.write_text(project.read_text().replace('scans = ["scans/*.tif"]\n', ""))
    cell = '"' + name.replace('"', '""') + '"'
    lines = adjusted_folder.with_name("comparator.csv").read_text().splitlines()
    (folder / "comparator.csv").write_text(
        "\n".join(cell + line[2:] if line.startswith("f1,") else line for line in lines)
    )
    format = rng.choice(["csv", "mmvii", "micmac"])
    return writing(
        lambda out: run_export(read_project(project), format, out, ExportOptions()), folder / "o" / "out", folder.parent
    )


def files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


# --- addresses


def addresses_trial(rng: random.Random) -> str:
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

    def trial() -> str:
        one, two = Address(f"{base}?{query()}"), Address(f"{base}?{query()}")
        result = [str(one), repr(one), one.name, *names_below([one, one.with_name("b.tif")]), f"{one}", str([one])]
        if str(one) != str(two) or any(secret in text for secret in SECRETS for text in result):
            return WRONG
        return GOOD if "?" not in names_below([one])[0] and names_below([one]) == ["0001"] else WRONG

    return outcome(trial)


KINDS = ("bytes", "values", "decisions", "imports", "names", "addresses")


def study(kind: str, count: int, seed: int, measured_folder: Path, adjusted_folder: Path, folder: Path) -> Counter[str]:
    counts = Counter[str]()
    for number in range(count):
        rng, place = random.Random(f"{kind} {seed} {number}"), folder / f"{kind}{number}"
        trials: dict[str, Callable[[], str]] = {
            "bytes": partial(database_trial, rng, measured_folder, place, change_bytes),
            "values": partial(database_trial, rng, measured_folder, place, change_values),
            "decisions": partial(decisions_trial, rng, place),
            "imports": partial(imports_trial, rng, place / "p"),
            "names": partial(names_trial, rng, adjusted_folder, place / "p"),
            "addresses": partial(addresses_trial, rng),
        }
        own_outcome = trials[kind]()
        if own_outcome != GOOD:
            print(kind, seed, number, own_outcome)
        counts[own_outcome] += 1
        shutil.rmtree(place, ignore_errors=True)
    return counts


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


@pytest.mark.parametrize("kind", KINDS)
def test_hostile_inputs(kind: str, measured_folder: Path, adjusted_folder: Path, tmp_path: Path) -> None:
    assert study(kind, 4, 1, measured_folder, adjusted_folder, tmp_path) == {GOOD: 4}


@pytest.mark.study
@pytest.mark.parametrize("kind", KINDS)
def test_thousands_of_hostile_inputs(kind: str, measured_folder: Path, adjusted_folder: Path, tmp_path: Path) -> None:
    assert study(kind, 600, 36, measured_folder, adjusted_folder, tmp_path) == {GOOD: 600}


def test_trap_a_failed_scan_is_dropped_from_the_table(finished: tuple[Path, int]) -> None:
    """Every mark of every scan has its row, found or not, with a reason unless it was measured."""
    folder, _ = finished
    points = read_comparator(folder / "comparator.csv")
    assert {point.image for point in points} == {path.stem for path in (folder / "scans").iterdir()}
    for image in {point.image for point in points}:
        assert sum(point.image == image and point.kind == "fiducial" for point in points) == 8
    assert all(point.reason for point in points if point.status != "measured")


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

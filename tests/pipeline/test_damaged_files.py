"""Damaged and hostile tables and calibrations: a message or a result, never a traceback, a wait, or a full memory."""

import errno
import io
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from projects import FILES, copied, damaged, make_table_project

from pipeline.cli import run
from pipeline.text.csv_table import csv_line, read_csv

SAID = pytest.CaptureFixture[str]
MESSAGE, RESULT = "message", "result"
LONGEST_S, LONGEST_MESSAGE, MOST_KB = 20.0, 4000, 1_000_000


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sound")
    make_table_project(folder)
    return folder


def outcomes(sound: Path, folder: Path, trials: int, seed: int, capsys: SAID) -> Counter[str]:
    """How so many trials ended, each with one file damaged. What is neither message nor result has its own key."""
    counted: Counter[str] = Counter()
    for trial in range(trials):
        rng = random.Random(f"{seed} {trial}")
        name = rng.choice(FILES)
        project = copied(sound, folder / "trial")
        file = project.parent / name
        file.write_bytes(damaged(file.read_bytes(), name, rng))
        start = time.process_time()
        code = run(["adjust", str(project), "--json"])
        captured = capsys.readouterr()
        if time.process_time() - start > LONGEST_S:
            counted[f"longer than {LONGEST_S:g} s: trial {trial}, {name}"] += 1
        elif code not in (0, 1, 2) or "Traceback" in captured.err or (code == 2) != ("reseau: " in captured.err):
            counted[f"code {code}: trial {trial}, {name}: {captured.err[-2000:]}"] += 1
        elif len(captured.err) > LONGEST_MESSAGE:
            counted[f"a message of {len(captured.err)} letters: trial {trial}, {name}: {captured.err[:500]}"] += 1
        elif "\x1b" in captured.out + captured.err:
            counted[f"an escape sequence: trial {trial}, {name}"] += 1
        else:
            counted[MESSAGE if code == 2 else RESULT] += 1
        shutil.rmtree(project.parent)
    return counted


def test_a_share_of_the_damaged_tables_and_calibrations(sound: Path, tmp_path: Path, capsys: SAID) -> None:
    found = outcomes(sound, tmp_path, 5, 1, capsys)
    assert set(found) == {MESSAGE, RESULT}, "\n".join(found)


@pytest.mark.study
def test_all_damaged_tables_and_calibrations(sound: Path, tmp_path: Path, capsys: SAID) -> None:
    found = outcomes(sound, tmp_path, 1200, 2, capsys)
    wrong = found.total() - found[MESSAGE] - found[RESULT]
    with capsys.disabled():
        print(f"\n{found[MESSAGE]} messages, {found[RESULT]} results, {wrong} others")
    assert set(found) == {MESSAGE, RESULT}, "\n".join(found)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < MOST_KB


def whole(number: str) -> str:
    return f'[targets]\nkind = "circle-grid"\ncolumns = {number}\n'


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("project.toml", whole("9" * 5000), "not valid TOML: Exceeds the limit"),
        ("project.toml", whole("0x1" + "0" * 5000), "columns: must be a whole number of 1 to 500, not a number of"),
        ("project.toml", "pitch_um = 1" + "0" * 400, "pitch_um: must be a number, not 1000"),
        ("project.toml", "a = " + "[" * 5000, "stand in one another too deep"),
        ("project.toml", "a = 1\n" + "b." * 200_000 + "c = 1", "line 3: joins more names by points than any table"),
        ("project.toml", 'output = "a\\u0000b"', r"output: 'a\x00b' can be no file's name"),
        ("project.toml", f'output = "{"o" * 300}"', "can be no file's name: too long"),
        ("project.toml", f'scans = ["{"s/" * 3000}*.tif"]', "scans: 's/s/s/"),
        pytest.param(
            "project.toml",
            "".join(f"[t{i}]\n" for i in range(100_000)),
            "99992 more keys are not known",
            marks=pytest.mark.study,
        ),
        ("project.toml", "".join(f"[t{i}]\n" for i in range(10_000)), "9992 more keys are not known"),
        ("project.toml", "#" * 5_000_000, "has more than 4 MB"),
        ("points.csv", "point,X,Y,Z\n" + "x" * 200_000 + ",1,2,3\n", "line 2: is no line of CSV (field larger than"),
        ("points.csv", "point,X,Y,Z\n\x1b[31mred,1,2,3\n", r"line 2, column point: '\x1b[31mred' can be no name"),
        ("earlier/adjustment.json", "[" * 100_000, "is not valid JSON (maximum recursion depth"),
        ("earlier/adjustment.json", '{"sigma0": NaN}', "is not valid JSON (NaN is no number of JSON)"),
        ("earlier/adjustment.json", '{"sigma0": ' + "9" * 5000 + "}", "is not valid JSON (Exceeds the limit"),
    ],
    ids=lambda value: value[:50],  # megabytes of names cost more than what they are the names of
)  # fmt: skip
def test_what_no_table_holds_gets_its_message(
    sound: Path, tmp_path: Path, capsys: SAID, name: str, content: str, words: str
) -> None:
    project = copied(sound, tmp_path / "project")
    text = f'camera = "camera.toml"\n{content}\n' if name == "project.toml" else content
    (project.parent / name).write_text(text, encoding="utf-8")
    start = time.process_time()
    assert run(["adjust", str(project)]) == 2
    assert time.process_time() - start < LONGEST_S / 2
    message = capsys.readouterr().err
    assert words in message
    assert len(message) < LONGEST_MESSAGE


def damaged_covariance(how: str, data: bytes) -> bytes:
    """adjustment.npz otherwise than it was written."""
    with np.load(io.BytesIO(data)) as arrays:
        content = dict(arrays)
    names, matrix = content["names"], content["matrix"]
    c, x0 = (int(np.flatnonzero(names == f"IO.K.{name}")[0]) for name in ("c", "x0"))
    packed = io.BytesIO()
    if how == "plain":
        np.save(packed, matrix)
        return packed.getvalue()
    if how == "zlib":
        at = data.index(b"matrix.npy") + 200
        return data[:at] + b"\xff" * 50 + data[at + 50 :]
    if how in ("complex", "text"):
        content["matrix"] = matrix.astype({"complex": complex, "text": str}[how])
    elif how == "infinite":
        matrix[c, x0] = matrix[x0, c] = np.inf
    elif how == "asymmetric":
        matrix[c, x0] *= 1.01
    elif how == "impossible":
        matrix[c, x0] = matrix[x0, c] = 2.0 * np.sqrt(matrix[c, c] * matrix[x0, x0])
    elif how == "misnamed":
        names[c] = "IO.K.d"
    elif how == "another value":
        content["values"][c] += 0.001
    elif how == "another sigma":
        matrix[c, c] *= 1.01
    elif how == "twice":
        names[c] = "IO.K.x0"
    np.savez_compressed(packed, **content)
    return packed.getvalue()


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("plain", "is not a covariance file"),
        ("zlib", "is not a covariance file (matrix: "),
        ("complex", "text and real numbers, not <U"),
        ("text", "text and real numbers, not <U"),
        ("infinite", "the covariance of c of camera K and x0 of camera K is no finite number"),
        ("asymmetric", "the covariance of c of camera K and x0 of camera K is not that of the exchanged pair"),
        ("impossible", "the covariance of c of camera K and x0 of camera K is larger than"),
        ("misnamed", "adjustment.json holds c of camera K, and adjustment.npz does not"),
        ("another value", "gives c of camera K the value 153.7"),
        ("another sigma", "gives c of camera K the standard deviation 0.4"),
        ("twice", "'IO.K.x0' is named twice"),
    ],
)
def test_an_earlier_calibration_whose_files_contradict_each_other_is_refused(
    sound: Path, tmp_path: Path, capsys: SAID, how: str, words: str
) -> None:
    project = copied(sound, tmp_path / "project")
    file = project.parent / "earlier" / "adjustment.npz"
    file.write_bytes(damaged_covariance(how, file.read_bytes()))
    assert run(["adjust", str(project)]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("name", ["project.toml", "camera.toml", "points.csv", "images.csv", "comparator.csv"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_only_regular_files_are_read(sound: Path, tmp_path: Path, capsys: SAID, name: str, kind: str) -> None:
    project = copied(sound, tmp_path / "project")
    file = project.parent / name
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to("/dev/zero")
    assert run(["adjust", str(project)]) == 2
    assert f"{name}: is a {kind}; a regular file is needed here" in capsys.readouterr().err


@pytest.mark.study
@pytest.mark.parametrize(("encoding", "json_wanted"), [("ascii", False), ("latin-1", True)])
def test_a_terminal_of_few_letters(sound: Path, encoding: str, json_wanted: bool) -> None:
    main = "from pipeline.main import main; main()"
    command = [sys.executable, "-c", main, "adjust", str(sound / "project.toml"), *["--json"] * json_wanted]
    done = subprocess.run(command, capture_output=True, env=os.environ | {"PYTHONIOENCODING": encoding}, check=False)
    assert done.returncode in (0, 1), done.stderr
    output = done.stdout.decode(encoding)
    assert json.loads(output)["adjustment"]["sigma0"] if json_wanted else "c principal distance" in output
    assert b"Traceback" not in done.stderr


def test_escape_sequences_in_names_do_not_reach_the_terminal(sound: Path, tmp_path: Path, capsys: SAID) -> None:
    project = copied(sound, tmp_path / "\x1b]0;owned\x07 project")
    camera = project.parent / "camera.toml"
    camera.write_text(
        camera.read_text(encoding="utf-8").replace('name = "K"', 'name = "K\\u001B[31m"'), encoding="utf-8"
    )
    assert run(["adjust", str(project)]) in (0, 1)
    assert run(["adjust", str(project.parent / "none.toml")]) == 2
    captured = capsys.readouterr()
    assert r"K\x1b[31m" in captured.out
    assert r"\x1b]0;owned\x07" in captured.err
    assert not set("\x1b\x07") & set(captured.out + captured.err)


@pytest.mark.parametrize(
    ("error", "words"),
    [(errno.EMFILE, "open files"), (errno.ENOSPC, "Make room"), (errno.EACCES, "permission"), (errno.EIO, "the drive")],
)
def test_what_the_machine_refuses_has_its_own_advice(
    sound: Path, capsys: SAID, monkeypatch: pytest.MonkeyPatch, error: int, words: str
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(error, os.strerror(error), "here")

    monkeypatch.setattr("pipeline.stages.run_adjust", refuse)
    assert run(["adjust", str(sound / "project.toml")]) == 2
    message = capsys.readouterr().err
    assert words in message
    assert ("Make room" in message) == (error == errno.ENOSPC)


@pytest.mark.parametrize(
    ("cell", "written"),
    [
        ("=1+1", "'=1+1"), ("+A1", "'+A1"), ("@SUM(1)", "'@SUM(1)"), ("-2+3", "'-2+3"), ("'=x", "''=x"),
        ("-12", "-12"), ("+3.5e-7", "+3.5e-7"), ("-", "-"), ("12-3", "12-3"), ("a=b", "a=b"), ("'tis", "'tis"),
        ("#1", '"#1"'), ('=HYPERLINK("a,b")', "\"'=HYPERLINK(\"\"a,b\"\")\""),
    ],
)  # fmt: skip
def test_what_a_spreadsheet_would_run_is_written_as_text_and_read_as_it_was(
    cell: str, written: str, tmp_path: Path
) -> None:
    assert csv_line([cell, "1"]) == f"{written},1"
    path = tmp_path / "table.csv"
    path.write_text(f"name,value\n{csv_line([cell, '1'])}\n", encoding="utf-8")
    assert next(read_csv(path, ("name", "value"))).name("name") == cell

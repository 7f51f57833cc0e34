"""Mistakes in tables, damaged and hostile files: a message or a result, never a traceback, a wait, or a full memory."""

import errno
import io
import json
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import time
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from projects import (
    FILES,
    LONGEST_MESSAGE,
    MESSAGE,
    RESULT,
    Capture,
    Refusal,
    command_ending,
    copied,
    damaged,
    make_table_project,
)

from pipeline.cli import WRONG_INPUT, run
from pipeline.text.csv_table import csv_line, read_csv

LONGEST_S, MOST_KB = 20.0, 1_000_000


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sound")
    make_table_project(folder)
    return folder


def outcomes(sound: Path, folder: Path, trials: int, seed: int, capsys: Capture) -> Counter[str]:
    """How so many trials ended, each with one file damaged. What is neither message nor result has its own key."""
    counted: Counter[str] = Counter()
    for trial in range(trials):
        rng = random.Random(f"{seed} {trial}")
        name = rng.choice(FILES)
        project = copied(sound, folder / "trial")
        file = project.parent / name
        file.write_bytes(damaged(file.read_bytes(), name, rng))
        start = time.process_time()
        ending = command_ending(["adjust", str(project), "--json"], capsys, f"trial {trial}, {name}")
        if time.process_time() - start > LONGEST_S:
            ending = f"longer than {LONGEST_S:g} s: trial {trial}, {name}"
        counted[ending] += 1
        shutil.rmtree(project.parent)
    return counted


def test_a_share_of_the_damaged_tables_and_calibrations(sound: Path, tmp_path: Path, capsys: Capture) -> None:
    found = outcomes(sound, tmp_path, 5, 1, capsys)
    assert set(found) == {MESSAGE, RESULT}, "\n".join(found)


@pytest.mark.study
def test_all_damaged_tables_and_calibrations(sound: Path, tmp_path: Path, capsys: Capture) -> None:
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
        ("project.toml", "pitch_um = 1" + "0" * 400, "pitch_um: must be a number, not 1000"),
        ("project.toml", "a = 1\n" + "b." * 200_000 + "c = 1", "line 3: joins more names by points than any table"),
        ("project.toml", 'output = "a\\u0000b"', r"output: 'a\x00b' can be no file's name"),
        ("project.toml", f'scans = ["{"s/" * 3000}*.tif"]', "scans: 's/s/s/"),
        ("project.toml", "".join(f"[t{i}]\n" for i in range(10_000)), "9992 more keys are not known"),
        ("project.toml", "#" * 5_000_000, "has more than 4 MB"),
        ("points.csv", "point,X,Y,Z\n" + "x" * 200_000 + ",1,2,3\n", "line 2: is no line of CSV (field larger than"),
        ("points.csv", "point,X,Y,Z\n\x1b[31mred,1,2,3\n", r"line 2, column point: '\x1b[31mred' can be no name"),
        ("earlier/adjustment.json", "[" * 100_000, "is not valid JSON (maximum recursion depth"),
        ("earlier/adjustment.json", '{"sigma0": NaN}', "is not valid JSON (NaN is no number of JSON)"),
    ],
    ids=lambda value: value[:50],  # megabytes of names cost more than what they are the names of
)  # fmt: skip
def test_what_no_table_holds_is_refused(
    sound: Path, tmp_path: Path, capsys: Capture, name: str, content: str, words: str
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


def bomb() -> bytes:
    """An array of a gigabyte and more of zeros, in a megabyte; its header claims still more."""
    packed, head = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)})
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("matrix.npy", "w") as member:
        member.write(head.getvalue())
        for _ in range(300):
            member.write(bytes(1_000_000))
    return packed.getvalue()


def damaged_covariance(how: str, data: bytes) -> bytes:
    """adjustment.npz otherwise than it was written."""
    with np.load(io.BytesIO(data)) as arrays:
        content = dict(arrays)
    if how == "bomb":
        return bomb()
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
        pytest.param("bomb", "is not a covariance file", marks=pytest.mark.study),
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
def test_contradicting_files_are_refused(sound: Path, tmp_path: Path, refusal: Refusal, how: str, words: str) -> None:
    project = copied(sound, tmp_path / "project")
    file = project.parent / "earlier" / "adjustment.npz"
    file.write_bytes(damaged_covariance(how, file.read_bytes()))
    assert words in refusal(["adjust", str(project)])


@pytest.mark.parametrize("name", ["project.toml", "camera.toml", "points.csv", "images.csv", "comparator.csv"])
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_only_regular_files_are_read(sound: Path, tmp_path: Path, refusal: Refusal, name: str, kind: str) -> None:
    project = copied(sound, tmp_path / "project")
    file = project.parent / name
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to("/dev/zero")
    assert f"{name}: is a {kind}; a regular file is needed here" in refusal(["adjust", str(project)])


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


def test_escape_sequences_in_names_do_not_reach_the_terminal(sound: Path, tmp_path: Path, capsys: Capture) -> None:
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
def test_what_the_machine_refuses_has_advice(
    sound: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch, error: int, words: str
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
def test_what_a_spreadsheet_would_run_is_written_as_text(cell: str, written: str, tmp_path: Path) -> None:
    assert csv_line([cell, "1"]) == f"{written},1"
    path = tmp_path / "table.csv"
    path.write_text(f"name,value\n{csv_line([cell, '1'])}\n", encoding="utf-8")
    assert next(read_csv(path, ("name", "value"))).name("name") == cell


ADJUST, OBJECT, END = r"\[adjust\]\n", r"\[object\]\n", r"\Z"
DISTANCES = "from,to,distance,sigma\n"
PARTS = "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,part_of\n"
WHOLE = r"(?s)\A.+"
Changes = dict[str, str]  # what takes the place of every match of a pattern


def setting(lines: str) -> Changes:
    return {ADJUST: f"[adjust]\n{lines}\n"}


def distance(row: str) -> Changes:
    return {WHOLE: f"{DISTANCES}{row}\n"}


def fiducial_distance(start: str, end: str, mm: float, more: str = "") -> Changes:
    table = f'[[fiducial_distance]]\nfrom = "{start}"\nto = "{end}"\nmm = {mm}\nsigma_mm = 0.005\n{more}\n'
    return {END: table}


def one_place(kind: str) -> Changes:
    return {rf"(?m)^(f\d,\w+,{kind}),[^,]+,[^,]+": r"\1,30.0,-30.0"}


def set_status(first: str, others: str, columns: str) -> Changes:
    """The marks with further columns; of the first the place is blank."""
    return {
        r"(?m)^(f.*)$": rf"\1,{others}",
        r"sy_mm": f"sy_mm,{columns}",
        rf"\n(f0,1,fiducial),[^,]+,(.*),{others}\n": rf"\n\1,,\2,{first}\n",
    }


@pytest.mark.parametrize(
    ("file", "changes", "words"),
    [
        # distances between points
        ("distances.csv", distance("1,77,3.0,0.1"), ["distances.csv", "line 2, column to", "'77' is no object point"]),
        ("distances.csv", distance("1,1,3.0,0.1"), ["both ends"]),
        ("distances.csv", distance("1,2,-3.0,0.1"), ["column distance", "positive length"]),
        ("distances.csv", distance("1,2,3.0,0"), ["column sigma", "exact distance is not offered"]),
        ("distances.csv", distance("1,2,3.0,"), ["column sigma", "blank"]),
        ("distances.csv", distance("1,2,3.0,-1"), ["column sigma", "negative"]),
        ("distances.csv", {WHOLE: DISTANCES}, ["holds no distance"]),
        # distances between fiducials
        ("camera.toml", fiducial_distance("1", "9", 100.0), ["fiducial_distance", "to: there is no fiducial '9'"]),
        ("camera.toml", fiducial_distance("1", "1", 10.0), ["a distance has two ends"]),
        ("camera.toml", fiducial_distance("1", "2", -88.0), ["mm: must be greater than 0"]),
        ("camera.toml", fiducial_distance("1", "2", 212.0, "weight = 2"), ["weight"]),
        # the datum
        ("project.toml", setting('datum = "free"\ndatum_coordinates = ["1.X"]'), ["datum_coordinates", '"minimal"']),
        ("project.toml", setting('datum_points = ["1"]'), ["datum_points", '"free"', '"control"']),
        ("project.toml", setting('datum = "free"\ndatum_points = []'), ["empty list"]),
        ("project.toml", setting('datum = "free"\ndatum_points = ["1", "1"]'), ["'1' twice"]),
        ("project.toml", setting('datum = "free"\ndatum_points = ["1", "P3"]'), ["P3", "not among the object points"]),
        ("project.toml", setting('datum = "minimal"\ndatum_coordinates = ["1X"]'), ["1X", "a dot and X, Y or Z"]),
        # film, weights, scanner, ties
        (
            "project.toml",
            {'"affine"': '"afine"'},
            [
                "line 7: [adjust] transformation",
                'no transformation "afine"',
                "possible are none, congruent, similarity",
            ],
        ),
        ("project.toml", {'"affine"': '"polynomial"'}, ["lacks its order", 'as in "polynomial(2)"']),
        ("project.toml", {'"affine"': '"conformal(9)"'}, ["order must be from 1 to 5"]),
        ("project.toml", setting('robust = "tukey"'), ["possible are"]),
        ("project.toml", setting('variance_components = ["targets"]'), ["names 'targets'; possible are target, tie"]),
        ("project.toml", setting("robust = true\nsnooping = true"), ["Set one of the two to false"]),
        ("project.toml", setting('scanner = "wobble"'), ["possible are 'none', 'auto', 'bend'"]),
        ("project.toml", setting('scanner = ["a10"]'), ["names 'a10'; a bend has the terms a20"]),
        ("project.toml", setting('scanner = ["a20", "a20"]'), ["names a term twice"]),
        ("project.toml", setting('scanner = ["stretch"]'), ["'stretch', which the affine transformation of the films"]),
        ("project.toml", setting('scanner = "bend"\nscanner_sigma_um = 0.0'), ["would fix every term at 0"]),
        ("project.toml", {'"affine"': '"none"\nscanner = "bend"'}, ["a digital camera no scanner"]),
        ("project.toml", {OBJECT: "[ties]\nimages = 2\n[object]\n"}, ["two prove nothing"]),
        ("project.toml", {OBJECT: "[ties]\nwanted = 0\n[object]\n"}, ["at least 1"]),
        ("project.toml", {OBJECT: "[ties]\nheight = 3.0\n[object]\n"}, ["height_sigma"]),
        ("project.toml", {OBJECT: "[ties]\nhight = 3.0\n[object]\n"}, ["hight"]),
        # images
        ("images.csv", {WHOLE: f"{PARTS}f0,,,,,,,f\n"}, ["'f0' is the only part of 'f'"]),
        ("images.csv", {WHOLE: f"{PARTS}a,,,,,,,f\nf,,,,,,,f\nb,,,,,,,b\nc,,,,,,,b\n"}, ["'b' is an image itself"]),
        ("images.csv", {WHOLE: f"{PARTS}a,0,0,9,0,0,0,f\nb,1,0,9,0,0,0,f\n"}, ["have different orientations"]),
        # places and standard deviations that cannot be
        ("points.csv", {r"(?m)^0,[^,]+": "0,1e300"}, ["line 2, column X: '1e300' is larger than anything"]),
        ("comparator.csv", {r"\nf0,1,fiducial,[^,]+": "\nf0,1,fiducial,1e300"}, ["line 2, column x_mm: '1e300'"]),
        ("comparator.csv", {r"\n(f0,1,fiducial,[^,]+,[^,]+),[^,]+": r"\n\1,1e300"}, ["line 2, column sx_mm: '1e300'"]),
        ("comparator.csv", one_place("target"), ["image f", "targets are at one place, (30, -30) mm"]),
        ("comparator.csv", one_place("fiducial"), ["image f", "fiducials are at one place"]),
        (
            "comparator.csv",
            set_status("measured", "measured", "status"),
            ["is blank, but the status is 'measured'. Give x_"],
        ),
        ("comparator.csv", set_status("weak", "measured", "status"), ["the status is 'weak'"]),
        (
            "comparator.csv",
            set_status("absent,covered", "absent,one of 6 x 5 is", "status,reason"),
            ["Most have this reason (", "): one of 6 x 5 is."],
        ),
        (
            "camera.toml",
            {r"(?s)\A(.*?\]\]\nid = \"1\".*?)sigma_mm[^\n]+": r"\1sigma_mm = 1e-12"},
            ["known to 1e-12 mm"],
        ),
        # an earlier calibration of another lens
        ("camera.toml", {"earlier/adjustment": "earlier/no"}, ["no.json", "no such file"]),
        (
            "camera.toml",
            {r"(?s)\[distortion\].*?(?=\[\[)": '[distortion]\nfamily = "brown"\n'},
            ["family = 'torlegard'", "'brown'"],
        ),
        ("camera.toml", {"r0_mm = 0.0": 'r0_mm = 0.0\ndecentering = "paper"'}, ["decentering = 'reduced'"]),
        ("camera.toml", {"r0_mm = 0.0": "r0_mm = 50.0"}, ["r0_mm = 0.0"]),
        ("camera.toml", {"k5 = -4e-12": "k5 = -4e-12\nk7 = 1e-20"}, ["held k7 of camera K fixed at 0"]),
    ],
)
def test_a_mistake_gets_one_message_at_once(
    file: str,
    changes: Changes,
    words: list[str],
    sound: Path,
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At once: it is sought in no observation."""
    monkeypatch.setattr("adjust.solution.adjustment.blunder_sentence", lambda *_: pytest.fail("sought a blunder"))
    project = copied(sound, tmp_path / "project")
    text = (project.parent / file).read_text(encoding="utf-8")
    for pattern, instead in changes.items():
        text, count = re.subn(pattern, instead, text)
        assert count, pattern
    (project.parent / file).write_text(text, encoding="utf-8")
    assert run(["adjust", str(project)]) == WRONG_INPUT
    message = " ".join(capsys.readouterr().err.split())
    assert [word for word in words if word not in message] == [], message
    assert message.count("reseau: ") == 1

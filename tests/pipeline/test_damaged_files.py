"""Mistakes in tables, damaged and hostile files: a message or a result, never a traceback, a wait, or a full memory."""

import errno
import io
import math
import os
import random
import re
import resource
import shutil
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hostile import LONGEST_MESSAGE, MESSAGE, RESULT, command_ending, counted, damaged
from networks import Truth, simulated
from projects import Capture, Refusal, command, copied, replace_text, write_network_project
from studies import parametrize_with_studies

from pipeline.text.csv_table import csv_line, read_csv
from pipeline.text.files import split_lines

FILES = ("project.toml", "camera.toml", "points.csv", "images.csv", "distances.csv", "comparator.csv",
         "earlier/adjustment.json", "earlier/adjustment.npz")  # fmt: skip
LONGEST_S, MOST_KB = 20.0, 1_500_000


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project that names every kind of table, adjusted once, with that as the camera's earlier calibration."""
    folder, truth = tmp_path_factory.mktemp("sound"), Truth()
    network, _ = simulated(np.random.default_rng(5), truth, free={"k3": np.inf, "p1": np.inf})
    project = write_network_project(network, folder)
    assert command("adjust", project) in (0, 1)
    (folder / "out").rename(folder / "earlier")
    replace_text(folder / "camera.toml", "[sigma]\n", '[sigma]\ncalibration = "earlier/adjustment.json"\n')
    replace_text(project, "[object]\n", '[object]\nimages = "images.csv"\ndistances = "distances.csv"\n')
    rows = ["image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg"]
    for i, (station, angles) in enumerate(zip(truth.stations, truth.attitudes, strict=True)):
        rows.append(",".join([f"f{i}", *(f"{value:.1f}" for value in (*station, *np.degrees(angles)))]))
    (folder / "images.csv").write_text("\n".join(rows) + "\n")
    one, other = ([getattr(network.point_by_id[id], axis).value for axis in "XYZ"] for id in "01")
    (folder / "distances.csv").write_text(f"from,to,distance,sigma\n0,1,{math.dist(one, other):.3f},0.01\n")
    return folder


@parametrize_with_studies(("trials", "seed"), [(5, 1), (1200, 2)])
def test_damaged_tables_and_calibrations(trials: int, seed: int, sound: Path, tmp_path: Path, capsys: Capture) -> None:
    """Each trial in one file."""

    def trial(rng: random.Random) -> str:
        name = rng.choice(FILES)
        project = copied(sound, tmp_path / "trial")
        file = project.parent / name
        file.write_bytes(damaged(file.read_bytes(), name, rng))
        start = time.process_time()
        ending = command_ending(["adjust", str(project), "--json"], capsys, name)
        shutil.rmtree(project.parent)
        return ending if time.process_time() - start < LONGEST_S else f"longer than {LONGEST_S:g} s: {name}"

    found = counted(trials, seed, trial)
    assert set(found) == {MESSAGE, RESULT}, "\n".join(found)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < MOST_KB


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("project.toml", "pitch_um = " + "9" * 5000, "not valid TOML: Exceeds the limit"),
        ("project.toml", "pitch_um = 1" + "0" * 400, "pitch_um: must be a number, not 1000"),
        ("project.toml", "a = 1\n" + "b." * 200_000 + "c = 1", "line 3: joins more names by points than any table"),
        ("project.toml", 'output = "a\\u0000b"', r"output: 'a\x00b' can be no file's name"),
        ("project.toml", f'scans = ["{"s/" * 3000}*.tif"]', "scans: 's/s/s/"),
        ("project.toml", "".join(f"[t{i}]\n" for i in range(10_000)), "is a file of another kind"),
        ("project.toml", "#" * 5_000_000, "has more than 4 MB"),
        ("points.csv", "point,X,Y,Z\n" + "x" * 200_000 + ",1,2,3\n", "line 2: is no line of CSV (field larger than"),
        ("points.csv", "point,X,Y,Z\n\x1b[31mred,1,2,3\n", r"line 2, column point: '\x1b[31mred' is not a valid name"),
        ("earlier/adjustment.json", "[" * 100_000, "is not valid JSON (maximum recursion depth"),
        ("earlier/adjustment.json", '{"sigma0": NaN}', "is not valid JSON (NaN is no number of JSON)"),
    ],
    ids=lambda value: value[:50],  # megabytes of names cost more than what they are the names of
)  # fmt: skip
def test_no_table_holds_it(sound: Path, tmp_path: Path, capsys: Capture, name: str, content: str, words: str) -> None:
    project = copied(sound, tmp_path / "project")
    text = f'camera = "camera.toml"\n{content}\n' if name == "project.toml" else content
    (project.parent / name).write_text(text)
    start = time.process_time()
    assert command("adjust", project) == 2
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
    if how == "bomb":
        return bomb()
    if how == "zlib":
        at = data.index(b"matrix.npy") + 200
        return data[:at] + b"\xff" * 50 + data[at + 50 :]
    with np.load(io.BytesIO(data)) as arrays:
        content = dict(arrays)
    names, matrix = content["names"], content["matrix"]
    c, x0 = (int(np.flatnonzero(names == f"IO.K.{name}")[0]) for name in ("c", "x0"))
    if how == "text":
        content["matrix"] = matrix.astype(str)
    elif how == "infinite":
        matrix[c, x0] = matrix[x0, c] = np.inf
    elif how == "asymmetric":
        matrix[c, x0] *= 1.01
    elif how == "impossible":
        matrix[c, x0] = matrix[x0, c] = 2.0 * np.sqrt(matrix[c, c] * matrix[x0, x0])
    elif how == "another value":
        content["values"][c] += 0.001
    elif how == "another sigma":
        matrix[c, c] *= 1.01
    else:
        names[c] = how
    packed = io.BytesIO()
    np.savez_compressed(packed, **content)
    return packed.getvalue()


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("zlib", "is not a covariance file (matrix: "),
        pytest.param("bomb", "is not a covariance file", marks=pytest.mark.study),
        ("text", "text and real numbers, not <U"),
        ("infinite", "the covariance of c of camera K and x0 of camera K is no finite number"),
        ("asymmetric", "the covariance of c of camera K and x0 of camera K is not that of the exchanged pair"),
        ("impossible", "the covariance of c of camera K and x0 of camera K is larger than"),
        ("IO.K.d", "adjustment.json holds c of camera K, and adjustment.npz does not"),
        ("another value", "gives c of camera K the value 153.7"),
        ("another sigma", "gives c of camera K the standard deviation 0.4"),
        ("IO.K.x0", "'IO.K.x0' is named twice"),
    ],
)
def test_contradicting_files_are_refused(sound: Path, tmp_path: Path, refusal: Refusal, how: str, words: str) -> None:
    project = copied(sound, tmp_path / "project")
    file = project.parent / "earlier" / "adjustment.npz"
    file.write_bytes(damaged_covariance(how, file.read_bytes()))
    assert words in refusal("adjust", project)


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
    assert f"{name}: is a {kind}; a regular file is needed here" in refusal("adjust", project)


def test_escape_sequences_in_names_do_not_reach_the_terminal(sound: Path, tmp_path: Path, capsys: Capture) -> None:
    project = copied(sound, tmp_path / "\x1b]0;owned\x07 project")
    camera = project.parent / "camera.toml"
    camera.write_text(camera.read_text().replace('name = "K"', 'name = "K\\u001B[31m"'))
    assert command("adjust", project) in (0, 1)
    assert command("adjust", project.parent / "none.toml") == 2
    captured = capsys.readouterr()
    assert r"K\x1b[31m" in captured.out
    assert r"\x1b]0;owned\x07" in captured.err
    assert not set("\x1b\x07") & set(captured.out + captured.err)


@pytest.mark.parametrize(
    ("error", "words"),
    [(errno.EMFILE, "open files"), (errno.ENOSPC, "Make room"), (errno.EACCES, "permission"), (errno.EIO, "the drive")],
)
def test_advice(sound: Path, refusal: Refusal, monkeypatch: pytest.MonkeyPatch, error: int, words: str) -> None:
    def refuse(*_: object) -> None:
        raise OSError(error, os.strerror(error), "here")

    monkeypatch.setattr("pipeline.stages.run_adjust", refuse)
    message = refusal("adjust", sound / "project.toml")
    assert words in message
    assert ("Make room" in message) == (error == errno.ENOSPC)


def test_lines_end_where_editors_end_them_alone() -> None:
    assert split_lines("a\r\nb\n\nc\u2028d\re") == ["a\r\n", "b\n", "\n", "c\u2028d\r", "e"]
    assert split_lines("") == []
    assert csv_line(["a\rb", "1"]) == '"a\rb",1'


@pytest.mark.parametrize(
    ("cell", "written"),
    [
        ("=1+1", "'=1+1"), ("+A1", "'+A1"), ("@SUM(1)", "'@SUM(1)"), ("-2+3", "'-2+3"), ("'=x", "''=x"),
        ("-12", "-12"), ("+3.5e-7", "+3.5e-7"), ("-", "-"), ("12-3", "12-3"), ("a=b", "a=b"), ("'tis", "'tis"),
        ("a\u2028b", "a\u2028b"), ("#1", '"#1"'), ('=HYPERLINK("a,b")', "\"'=HYPERLINK(\"\"a,b\"\")\""),
    ],
)  # fmt: skip
def test_what_a_spreadsheet_would_run_is_written_as_text(cell: str, written: str, tmp_path: Path) -> None:
    assert csv_line([cell, "1"]) == f"{written},1"
    path = tmp_path / "table.csv"
    path.write_text(f"name,value\r\n{csv_line([cell, '1'])}\r\n", encoding="utf-8", newline="")
    assert next(read_csv(path, ("name", "value"))).name("name") == cell


ADJUST, OBJECT, END = r"\[adjust\]\n", r"\[object\]\n", r"\Z"
DISTANCES = "from,to,distance,sigma\n"
PARTS = "image,X0,Y0,Z0,omega_deg,phi_deg,kappa_deg,part_of\n"
WHOLE, BROWN = r"(?s)\A.+", '[distortion]\nfamily = "brown"\n'
CODED = 'kind = "coded-ring"\ndiameter_mm = 200.0\n[targets.codes]\n8 = 23\n11 = 347\n'
Changes = dict[str, str]  # what takes the place of every match of a pattern


def setting(lines: str) -> Changes:
    return {ADJUST: f"[adjust]\n{lines}\n"}


def distance(row: str) -> Changes:
    return {WHOLE: f"{DISTANCES}{row}\n"}


def fiducial_distance(start: str, end: str, mm: float, more: str = "") -> Changes:
    table = f'[[fiducial_distance]]\nfrom = "{start}"\nto = "{end}"\nmm = {mm}\nsigma_mm = 0.005\n{more}\n'
    return {END: table}


def targets(lines: str) -> Changes:
    return {OBJECT: f"[targets]\n{lines}\n[object]\n"}


def lens(name: str) -> Changes:
    return {r"\A": "pitch_um = 30.0\n", OBJECT: f'[scanner]\nlens = "{name}"\n[object]\n'}


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
        ("project.toml", {'"affine"': "[5]"}, ["line 7: [adjust] transformation", "must be text in quotes, not [5]."]),
        ("project.toml", {'"affine"': '"afine"'}, ["line 7: [adjust] transformation", "Did you mean 'affine'?"]),
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
        ("project.toml", {OBJECT: "[ties]\nimages = 2\n[object]\n"}, ["images: must be", "at least 3, not 2"]),
        (
            "project.toml",
            {OBJECT: '[measure]\npose = "0"\nscan_orientation = "0"\n[object]\n'},
            ["pose: and scan_orientation are one key"],
        ),
        ("project.toml", {OBJECT: "[ties]\nwanted = 0\n[object]\n"}, ["wanted: must be", "at least 1, not 0"]),
        ("project.toml", {OBJECT: "[ties]\nheight = 3.0\n[object]\n"}, ["height_sigma"]),
        ("project.toml", {OBJECT: "[ties]\nhight = 3.0\n[object]\n"}, ["hight"]),
        # targets, a camera that takes the scans
        ("project.toml", targets('kind = "disk"\ndiameter_mm = 1e6'), ["would cover one another"]),
        ("project.toml", targets('kind = "cross"\narm_mm = 5.0\nline_mm = 6.0'), ["6 mm is no line for arms of 5 mm"]),
        ("project.toml", targets('kind = "cross"\nline_mm = 6.0'), ["arm_mm"]),
        ("project.toml", targets(f"{CODED}3 = 4095"), ["is no number of 12 bits"]),
        ("project.toml", targets(f"{CODED}3 = 46"), ["is, turned, the code of 8 too"]),
        ("project.toml", targets(f"{CODED}[targets.more]"), ["is no key of this table"]),
        ("project.toml", {OBJECT: '[scanner]\nlens = "a.yaml"\n[object]\n'}, ["goes with pitch_um, one number"]),
        ("project.toml", lens("nothing.yaml"), ["there is no such file"]),
        ("project.toml", lens("."), ["is a folder. Name the camera's file in it"]),
        ("project.toml", {**lens("a.yaml"), '"affine"': '"none"'}, ["there is no film"]),
        ("project.toml", {OBJECT: '[scanner]\nlense = "a.yaml"\n[object]\n'}, ["lense", "'lens'"]),
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
        ("comparator.csv", set_status("measured", "measured", "status"), ["is blank, but the status is 'measured'."]),
        ("comparator.csv", set_status("weak", "measured", "status"), ["the status is 'weak'"]),
        (
            "comparator.csv",
            set_status("absent,covered", "absent,one of 6 x 5 is", "status,reason"),
            ["Most have this reason (", "): one of 6 x 5 is."],
        ),
        ("camera.toml", {r"(?s)(id = \"1\".*?)sigma_mm[^\n]+": r"\1sigma_mm = 1e-12"}, ["known to 1e-12 mm"]),
        # an earlier calibration of another lens
        ("camera.toml", {"earlier/adjustment": "earlier/no"}, ["no.json", "no such file"]),
        ("camera.toml", {r"(?s)\[distortion\].*?(?=\[\[)": BROWN}, ["family = 'torlegard'", "'brown'"]),
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
    refusal: Refusal,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At once: it is sought in no observation."""
    monkeypatch.setattr("adjust.solution.adjustment.blunder_sentence", lambda *_: pytest.fail("sought a blunder"))
    project = copied(sound, tmp_path / "project")
    text = (project.parent / file).read_text()
    for pattern, instead in changes.items():
        text, count = re.subn(pattern, instead, text)
        assert count, pattern
    (project.parent / file).write_text(text)
    message = refusal("adjust", project)
    assert [word for word in words if word not in message] == [], message
    assert message.count("reseau: ") == 1

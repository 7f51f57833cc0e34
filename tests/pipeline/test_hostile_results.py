"""Result files and requests of which a value is of another type, not there, or beyond all numbers."""

import http.client
import json
import random
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np
import pytest
from networks import simulated
from projects import MESSAGE, POINTS, RESULT, TRUTH, Capture, command_ending, make_project
from review_server import GOOD, Served, mark_px, served, write_faults

from pipeline.cli import run
from pipeline.files.decisions_file import read_decisions

VALUES: tuple[Any, ...] = ("text", "9", -1, 1e300, 2.5, True, None, [], {}, [[1.0]], {"a": 1})
MISSING = "missing"
FORMATS = ("csv", "opencv", "colmap", "micmac", "mmvii", "metashape", "asp", "bingo", "geojson")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    network, _ = simulated(np.random.default_rng(1), TRUTH, points=POINTS, free={"k3": np.inf})
    project = make_project(network, folder, "EPSG:25832")
    camera = folder / "camera.toml"
    camera.write_text(camera.read_text().replace("[[fiducial]]\n", '[[fiducial]]\nmark = "none"\n'))
    assert run(["check", str(project)]) in (0, 1)
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


def places(content: Any, form: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """Every value: its place, the same for all entries of a list or of a table from names, what holds it, its key."""
    if isinstance(content, dict | list) and content:
        keys = list(content) if isinstance(content, dict) else range(len(content))
        for key in keys:
            inner = (*form, key if isinstance(key, str) and not _is_name(form) else "*")
            yield inner, content, key
            yield from places(content[key], inner)


def _is_name(form: tuple[str, ...]) -> bool:
    return form != () and form[-1] in ("cameras", "images", "points", "fiducials", "made_from", "groups")


def changed(text: str, rng: random.Random, place: tuple[str, ...] | None = None) -> tuple[str, str]:
    """A JSON file with one value changed, the place drawn first, that many entries share, and what was done."""
    content = json.loads(text)
    found = defaultdict[tuple[str, ...], list[tuple[Any, Any]]](list)
    for form, holder, key in places(content):
        found[form].append((holder, key))
    form = place or rng.choice(sorted(found))
    holder, key = rng.choice(found[form])
    new = rng.choice((*VALUES, MISSING))
    if new == MISSING:
        del holder[key]
    else:
        holder[key] = new
    return json.dumps(content), f"{'.'.join(form)} = {new!r}"


def wrong_ends(sound: Path, trials: int, seed: int, capsys: Capture) -> Counter[str]:
    """What ended otherwise than with a result or one message, and how often there was each of these. A trial changes
    one value of a file and runs one command that reads it."""
    counted = Counter[str]()
    for trial in range(trials):
        rng = random.Random(f"{seed} {trial}")
        name, calls = rng.choice(sorted(commands(sound).items()))
        path = sound / name
        whole = path.read_text(encoding="utf-8")
        text, what = changed(whole, rng)
        call = rng.choice(calls)
        path.write_text(text, encoding="utf-8")
        try:
            counted[command_ending(call, capsys, f"{call[:3:2]} with {name}: {what}")] += 1
        finally:
            path.write_text(whole, encoding="utf-8")
    return counted


@pytest.mark.study
def test_all_changed_results(sound: Path, capsys: Capture) -> None:
    found = wrong_ends(sound, 3000, 2, capsys)
    with capsys.disabled():
        print(f"\n{found[MESSAGE]} messages, {found[RESULT]} results")
    assert set(found) == {MESSAGE, RESULT}, "\n".join(found)


DECISION = {"image": GOOD, "point": "1", "kind": "fiducial", "decision": "place", "col_px": 100.0, "row_px": 90.5}
CLICKS = {point: mark_px(GOOD, point).tolist() for point in "123"}
DRAWING = {
    "image": GOOD,
    "mark": {"kind": "ring-cross", "ring_mm": 0.8, "ring_line_mm": 0.1, "arm_mm": 1.2, "line_mm": 0.1, "gap_mm": 0.0},
    "marks": [{"id": point, "px": px, "xy_mm": [None, None]} for point, px in CLICKS.items()],
    "point": "1",
    "name": "drawn",
    "pose": "0",
    "pitch_um": 20.0,
    "principal_distance_mm": 60.0,
    "frame_mm": [60.0, 60.0],
    "corners_px": [[1.0, 2.0], [300.0, 310.0]],
    "sigma_mm": 0.01,
}
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
    project = write_faults(tmp_path_factory.mktemp("requests") / "faults")
    assert run(["measure", str(project)]) == 1
    return project.parent


def answers(folder: Path, server: Served, trials: int, seed: int) -> Counter[str]:
    """What was answered with a fault, or spoilt the decisions or what lies about the folder; and how many otherwise."""
    where = urlsplit(server.address)
    connection = http.client.HTTPConnection(where.hostname or "", where.port, timeout=60)

    def ask(method: str, path: str, body: str = "") -> tuple[int, bytes]:
        try:
            connection.request(method, path, body or None, headers)
            answer = connection.getresponse()
            return answer.status, answer.read()
        except http.client.HTTPException as error:  # as after a fault of the program
            connection.close()
            return 500, repr(error).encode()

    connection.request("GET", f"/?{where.query}")
    welcome = connection.getresponse()
    welcome.read()
    cookie = welcome.headers["set-cookie"].split(";")[0]
    headers = {"Cookie": cookie, "Origin": server.origin, "Content-Type": "application/json"}
    counted, around = Counter[str](), sorted(folder.parent.iterdir())
    for trial in range(trials):
        rng = random.Random(f"{seed} {trial}")
        if rng.random() < 0.7:
            name, body = rng.choice(sorted(BODIES.items()))
            text, what = changed(json.dumps(body), rng)
            status, answer = ask("POST", f"/api/{name}", text)
        else:
            name, query = rng.choice(sorted(QUERIES.items()))
            text, what = changed(json.dumps(query), rng)
            status, answer = ask("GET", f"/api/{name}?{urlencode(json.loads(text))}")
        read_decisions(folder / "decisions.jsonl")
        is_plain = status in (200, 400, 404) and sorted(folder.parent.iterdir()) == around
        counted[str(status) if is_plain else f"{name}: {what}: {status} {answer[:200]!r}"] += 1
    connection.close()
    return counted


def test_a_share_of_changed_requests(folder: Path) -> None:
    with served(folder / "project.toml") as server:
        found = answers(folder, server, 40, 1)
    assert set(found) <= {"200", "400", "404"}, "\n".join(found)


@pytest.mark.study
def test_all_changed_requests(folder: Path, capsys: Capture) -> None:
    with served(folder / "project.toml") as server:
        found = answers(folder, server, 3000, 2)
    with capsys.disabled():
        print(f"\n{dict(found)}")
    assert set(found) == {"200", "400", "404"}, "\n".join(found)

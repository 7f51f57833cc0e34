"""Requests to the review page of which a value is of another type, not there, or beyond all numbers: an answer or one
sentence, never a fault of the program; and decisions.jsonl can still be read."""

import http.client
import json
import random
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import pytest
from review_server import GOOD, Served, mark_px, served, write_faults
from test_hostile_results import changed

from pipeline.cli import run
from pipeline.files.decisions_file import read_decisions

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
            status, said = ask("POST", f"/api/{name}", text)
        else:
            name, query = rng.choice(sorted(QUERIES.items()))
            text, what = changed(json.dumps(query), rng)
            status, said = ask("GET", f"/api/{name}?{urlencode(json.loads(text))}")
        read_decisions(folder / "decisions.jsonl")
        is_plain = status in (200, 400, 404) and sorted(folder.parent.iterdir()) == around
        counted[str(status) if is_plain else f"{name}: {what}: {status} {said[:200]!r}"] += 1
    connection.close()
    return counted


def test_a_share_of_changed_requests(folder: Path) -> None:
    with served(folder / "project.toml") as server:
        found = answers(folder, server, 40, 1)
    assert set(found) <= {"200", "400", "404"}, "\n".join(found)


@pytest.mark.study
def test_all_changed_requests(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with served(folder / "project.toml") as server:
        found = answers(folder, server, 3000, 2)
    with capsys.disabled():
        print(f"\n{dict(found)}")
    assert set(found) == {"200", "400", "404"}, "\n".join(found)

"""Result files of which a value is of another type, not there, or beyond all numbers: one message from every command
that reads them, never a traceback."""

import json
import random
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported_project import POINTS, TRUTH, make_project
from networks import simulated

from pipeline.cli import run

SAID = pytest.CaptureFixture[str]
VALUES: tuple[Any, ...] = ("text", "9", -1, 1e300, 2.5, True, None, [], {}, [[1.0]], {"a": 1})
MISSING = "missing"
FORMATS = ("csv", "opencv", "colmap", "micmac", "mmvii", "metashape", "asp", "bingo", "geojson")
LONGEST_MESSAGE = 2000


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


def wrong_ends(sound: Path, trials: int, seed: int, capsys: SAID) -> Counter[str]:
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
            code = run(call)
        finally:
            path.write_text(whole, encoding="utf-8")
        error = capsys.readouterr().err
        if code not in (0, 1, 2) or "Traceback" in error or (code == 2) != (error.count("reseau: ") == 1):
            counted[f"{call[:3:2]} with {name}: {what}: code {code}, {error[-1500:]}"] += 1
        elif code == 2 and (len(error) > LONGEST_MESSAGE):
            counted[f"{call[:3:2]} with {name}: {what}: a message of {len(error)} letters"] += 1
        else:
            counted["message" if code == 2 else "result"] += 1
    return counted


@pytest.mark.study
def test_a_share_of_changed_results(sound: Path, capsys: SAID) -> None:
    found = wrong_ends(sound, 8, 1, capsys)
    assert set(found) <= {"message", "result"}, "\n".join(found)


@pytest.mark.study
def test_all_changed_results(sound: Path, capsys: SAID) -> None:
    found = wrong_ends(sound, 3000, 2, capsys)
    with capsys.disabled():
        print(f"\n{found['message']} messages, {found['result']} results")
    assert set(found) == {"message", "result"}, "\n".join(found)

"""Camera that `reseau cameras --scan` identifies in real scans, and time and memory of the command.

Default scans: the aerial and réseau frames of the data outside the project.
"""

import json
from collections.abc import Iterator
from pathlib import Path

from benchmarks.harness import DATA, Row, reseau

COLUMNS = {"scan": "", "cpu_seconds": ".1f", "mib": ".0f", "answer": ""}


def cells(scans: tuple[Path, ...] = ()) -> Iterator[Row]:
    films = DATA / "film_scans"
    paths = scans or (*sorted(films.glob("aerial/*.jpeg")), *sorted(films.glob("reseau/*.jpg")))
    yield from ({"path": path} for path in paths)


def case(path: Path, pitch_um: float | None = None) -> Row:
    pitch = () if pitch_um is None else ("--pitch", pitch_um)
    used = reseau("cameras", "--json", "--scan", path, *pitch)
    sentence = json.loads(used.out)["sentence"]
    return {"scan": path.stem, **used.figures, "answer": sentence.removeprefix(f"{path.name}: ")}

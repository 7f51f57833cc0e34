"""Whether the tests notice: forty lines of core logic broken on purpose, one at a time, then the tests of it run.

`broken_lines.toml` has the lines. Each is broken in a copy of the project, so nothing here is touched. Tests that fail
without it, too, have caught nothing.
"""

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.harness import ROOT, Row

COPIED = (
    "reseau", "measure", "adjust", "pipeline", "synthetic_images", "benchmarks", "tests", "docs", "pyproject.toml",
    "CHANGELOG.md", "CITATION.cff",
)  # fmt: skip
LONGEST_S = 900
COLUMNS = {"file": "", "words": "", "outcome": ""}


def cells(word: str = "") -> Iterator[Row]:
    """Only lines whose file's path holds the word."""
    lines = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["line"]
    yield from (line for line in lines if word in line["file"])


def case(file: str, words: str, instead: str, tests: str) -> Row:
    """Raises ValueError where the line is not there any more."""
    text = (ROOT / file).read_text(encoding="utf-8")
    if words not in text:
        raise ValueError(f"{file} has no line with {words!r}: bring broken_lines.toml up to date")
    outcome = "FAILS ANYWAY" if exit_code(tests) else "NOT CAUGHT"
    if outcome == "NOT CAUGHT" and exit_code(tests, file, text.replace(words, instead, 1)) == 1:
        outcome = "caught"
    return {"words": f"`{' '.join(words.split())[:60]}`", "outcome": outcome}


def report(rows: list[Row]) -> Iterator[str]:
    yield f"{sum(row['outcome'] == 'caught' for row in rows)} of {len(rows)} caught"


@cache
def exit_code(tests: str, file: str = "", text: str = "") -> int:
    """Pytest's, in a copy of the project in which a file may have another text."""
    with TemporaryDirectory() as place:
        copy = Path(place)
        for part in COPIED:
            source = ROOT / part
            (shutil.copytree if source.is_dir() else shutil.copy2)(source, copy / part)
        if file:
            (copy / file).write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", f"tests/{tests}"]
        environment = {**os.environ, "PYTHONPATH": place, "PYTHONDONTWRITEBYTECODE": "1"}
        return subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, timeout=LONGEST_S, check=False
        ).returncode

"""Mutation test: forty lines of core logic are broken, one at a time, and the tests concerned are run.

The lines are in `broken_lines.toml`. Each is broken in a copy of the project. Tests that also fail without it do not
count as having caught it.
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
    """Yield the lines whose file's path contains the word."""
    lines = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["line"]
    yield from (line for line in lines if word in line["file"])


def case(file: str, words: str, instead: str, tests: str) -> Row:
    """Break one line and run its tests. Raises ValueError if the line no longer exists."""
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
    """Exit code of pytest in a copy of the project, with the text of a file replaced if given."""
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

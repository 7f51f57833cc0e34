"""Number of scans measured again after various changes: six small frames, counted by the results in the database."""

import os
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import tifffile
from projects import write_project

from benchmarks.archive_real import results
from benchmarks.harness import Row
from pipeline.cli import run

NAMES = [f"f{number}" for number in range(1, 7)]


def rewritten(name: str, old: str, new: str) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new), encoding="utf-8")

    return act


def pixel(folder: Path, name: str = "f2.tif", out: str = "f2.tif") -> None:
    pixels = tifffile.imread(folder / name)
    pixels[3, 3] ^= 1
    tifffile.imwrite(folder / out, pixels)


def move_files(folder: Path) -> None:
    (folder / "box").mkdir()
    (folder / "f2.tif").rename(folder / "box" / "f2.tif")
    rewritten("project.toml", 'scans = ["*.tif"]', 'scans = ["**/*.tif"]')(folder)


CHANGES: dict[str, Callable[[Path], object]] = {
    "nothing": lambda folder: None,
    "one file touched": lambda folder: os.utime(folder / "f2.tif", ns=(1, 1)),
    "one file moved to another folder": move_files,
    "one file renamed": lambda folder: (folder / "f2.tif").rename(folder / "g.tif"),
    "one pixel of one file changed": pixel,
    "one setting of [measure]": rewritten("project.toml", 'tone = "linear"', 'tone = "auto"'),
    "one mark drawn otherwise": rewritten("camera.toml", "line_mm = 0.1\n", "line_mm = 0.11\n"),
    "a setting of [adjust]": rewritten("project.toml", "[measure]", "[adjust]\nrobust = true\n[measure]"),
    "one scan more": lambda folder: pixel(folder, "f2.tif", "g.tif"),
    "one scan less": lambda folder: (folder / "f2.tif").unlink(),
    "one scan in exclude": rewritten("project.toml", "[measure]", 'exclude = ["f2.tif"]\n[measure]'),
}


COLUMNS = {"change": "", "measured again": "d", "and once more": "d"}


def cells() -> Iterator[Row]:
    yield from ({"change": change} for change in CHANGES)


def case(change: str) -> Row:
    """Measure all, apply a change, and measure twice again."""
    with TemporaryDirectory() as place:
        folder = write_project(Path(place), NAMES).parent
        count_measured(folder)
        CHANGES[change](folder)
        return {"measured again": count_measured(folder), "and once more": count_measured(folder)}


def count_measured(folder: Path) -> int:
    """Number of results that a run of `reseau measure` adds."""
    before = results(folder)
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        assert run(["measure", str(folder / "project.toml")]) in (0, 1)
    return results(folder) - before

"""docs/start/film-scan.md: its project file is read, and its example runs as it stands beside the demonstration."""

import re
from pathlib import Path

import matplotlib as mpl
import pytest

from pipeline.files.project_file import read_project

PAGE = (Path(__file__).parents[2] / "docs" / "start" / "film-scan.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    return str(text)


def test_its_project_file_names_the_scans_the_camera_and_the_points(project: Path) -> None:
    mine = project / "tutorial.toml"
    mine.write_text(block("toml"), encoding="utf-8")
    read = read_project(mine)
    assert sorted(read.scans) == [path.stem for path in sorted((project / "scans").glob("*.tif"))]
    assert read.targets is not None
    assert len(read.object_points) > 10


def test_its_example_reads_what_the_demonstration_gave(
    project: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mpl.use("Agg")
    project.rename(project.with_name("demo"))
    monkeypatch.chdir(project.parent)
    exec(compile(block("python"), "tutorial.md", "exec"), {})
    assert re.search(r"^\d+ marks, median standard deviation 0\.0\d+ px$", capsys.readouterr().out, flags=re.MULTILINE)
    assert (project.parent / "w.png").stat().st_size > 3000

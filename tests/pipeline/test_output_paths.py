"""Names that are no paths: whatever a table or another program's file calls an image, files stand where they belong."""

from pathlib import Path

import pytest
from exported_project import adjusted_project

from pipeline.cli import WRONG_INPUT, run
from pipeline.errors import InputError
from pipeline.exchange.formats import FORMATS
from pipeline.text.names import file_word, path_below

ELSEWHERE = (
    "../../x",
    "..",
    ".",
    "/tmp/x",
    "a/../../x",
    "a//x",
    "",
    "a/",
    "..\\x",
    "C:x",
    "a\nb",
    "\0",
    " .. ",
    "a/./b",
)


@pytest.mark.parametrize("name", ELSEWHERE)
def test_a_name_that_leads_elsewhere_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be that of a file below"):
        path_below(tmp_path, name, ".tif")


@pytest.mark.parametrize("name", ["f0", "box 1/0001", "..hidden", "a..b", "1952-06-01T12:30", "ü/σ"])
def test_a_name_is_a_path_below_its_folder(name: str, tmp_path: Path) -> None:
    assert path_below(tmp_path, name, ".tif") == tmp_path / f"{name}.tif"


@pytest.mark.parametrize(("name", "word"), [("RC8 17/3", "RC8-17-3"), ("..", "-"), ("", "-"), ("a.b_c-d", "a.b_c-d")])
def test_a_word_is_no_path(name: str, word: str) -> None:
    assert file_word(name) == word


@pytest.fixture(scope="module")
def strange(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project whose images.csv, points and marks are sound, and of which one image is named as a path elsewhere."""
    folder = tmp_path_factory.mktemp("deep") / "a" / "b"
    folder.mkdir(parents=True)
    project = adjusted_project(folder)
    text = project.read_text(encoding="utf-8").replace('scans = ["scans/*.tif"]\n', "")
    project.write_text(text, encoding="utf-8")
    for name in ("comparator.csv", "images.csv"):
        table = folder / name
        if table.exists():
            table.write_text(table.read_text(encoding="utf-8").replace("f1", "../../x"), encoding="utf-8")
    run(["adjust", str(project)])
    return project


@pytest.mark.parametrize("format", sorted(FORMATS))
def test_an_export_writes_nothing_outside_its_folder(
    format: str, strange: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _files(strange.parents[2])
    code = run(["export", str(strange), format, str(strange.parent / "deep" / "out")])
    assert "Traceback" not in capsys.readouterr().err
    new = _files(strange.parents[2]) - before
    assert all(path.is_relative_to(strange.parent / "deep" / "out") for path in new)
    if format in ("opencv", "mmvii"):  # whose files are named after the images
        assert code == WRONG_INPUT
        assert not new


def test_the_page_of_an_image_stands_in_the_output(strange: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["report", str(strange), "--frames", "../../x"]) == WRONG_INPUT
    assert "cannot be that of a file" in capsys.readouterr().err


def _files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}

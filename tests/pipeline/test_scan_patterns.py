"""Patterns of scans: what Python's own glob finds, and each real file once where links lead around."""

import glob
import os
from pathlib import Path

import pytest

from pipeline.archive.scan_groups import catalogue
from pipeline.files.scan_files import find_scans, found_names
from pipeline.text.tables import Table

FILES = ("1.tif", "a/2.tif", "a/b/3.tif", ".hidden/4.tif", ".5.tif")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in FILES:
        path = tmp_path / "scans" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path


def find_scans_case(folder: Path, *patterns: str, exclude: tuple[str, ...] = ()) -> list[str]:
    files = find_scans(Table({}, folder / "project.toml", ""), patterns, exclude).files.values()
    return sorted(os.path.relpath(file, folder) for file in files)


@pytest.mark.parametrize(
    "pattern",
    ["scans/**", "scans/**/*.tif", "**/*.tif", "**/a/**/*.tif", "scans/**/b/*", "scans/**/", "./scans/**/3.tif"],
)
def test_any_number_of_folders_is_as_in_glob(folder: Path, pattern: str) -> None:
    def files(names: set[str]) -> set[str]:
        return {os.path.normpath(name) for name in names if (folder / name).is_file()}

    assert files(found_names(pattern, folder)) == files(set(glob.glob(pattern, root_dir=folder, recursive=True)))


def test_links_to_parents_bring_nothing_twice(folder: Path) -> None:
    """Two links up make glob follow 2^40 paths; here the folder beside the scans is not theirs either."""
    (folder / "others").mkdir()
    (folder / "others" / "6.tif").touch()
    for name, target in {"up": "..", "a/again": "../a", "a/b/top": str(folder / "scans")}.items():
        (folder / "scans" / name).symlink_to(target)
    assert find_scans_case(folder, "scans/**/*.tif") == ["scans/1.tif", "scans/a/2.tif", "scans/a/b/3.tif"]


def test_a_file_is_one_scan_however_many_links_lead_to_it(folder: Path) -> None:
    (folder / "others").mkdir()
    (folder / "others" / "6.tif").touch()
    scans = folder / "scans"
    (scans / "elsewhere").symlink_to(folder / "others")
    (scans / "0.tif").symlink_to("1.tif")
    (scans / "twin").symlink_to("a")
    there = ["scans/1.tif", "scans/a/2.tif", "scans/a/b/3.tif", "scans/elsewhere/6.tif"]
    assert find_scans_case(folder, "scans/**/*.tif", "scans/twin/*.tif", "scans/*.tif") == there
    assert find_scans_case(folder, "scans/**/*.tif", exclude=("scans/twin/2.tif",)) == [there[0], *there[2:]]
    assert find_scans_case(folder, "scans/0.tif") == ["scans/0.tif"]  # named as it is


def test_a_link_that_leads_nowhere_is_a_scan_that_cannot_be_read(folder: Path) -> None:
    (folder / "scans" / "7.tif").symlink_to("nowhere.tif")
    assert "scans/7.tif" in find_scans_case(folder, "scans/**/*.tif")


def test_init_reads_each_folder_once(folder: Path) -> None:
    (folder / "scans" / "up").symlink_to("..")
    files = catalogue([folder / "scans"], lambda *_: None).broken
    assert len(files) == 3  # empty files, which no scan is

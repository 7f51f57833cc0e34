"""The demonstration's scans, rendered and run once for all tests that look at them."""

import shutil
from importlib import resources
from pathlib import Path

import pytest

from pipeline.cli import run
from pipeline.rendered.scene_file import render_project


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demonstration's project, not yet run. Tests copy it before they change anything."""
    folder = tmp_path_factory.mktemp("demo")
    with resources.as_file(resources.files("synthetic_images").joinpath("scenes", "demo.toml")) as scene:
        render_project(scene, folder)
    return folder


@pytest.fixture(scope="session")
def finished(rendered: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The demonstration's project after `reseau run`, and the exit code of that."""
    folder = tmp_path_factory.mktemp("finished") / "demo"
    shutil.copytree(rendered, folder)
    return folder, run(["run", str(folder / "project.toml")])


@pytest.fixture
def project(finished: tuple[Path, int], tmp_path: Path) -> Path:
    """A finished project of its own for a test, to spoil."""
    folder = tmp_path / "project"
    shutil.copytree(finished[0], folder)
    return folder

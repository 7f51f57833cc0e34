"""Demonstration: render a small folder of scans with known truth, and run all stages on it."""

from importlib import resources
from pathlib import Path

from pipeline.errors import InputError
from pipeline.files.project_file import read_project
from pipeline.progress import Reporter
from pipeline.rendered.scene_file import TRUTH, render_project
from pipeline.stages import run_all
from pipeline.summary import Summary
from pipeline.text.files import make_folder

SCENE = ("scenes", "demo.toml")


def run_demo(folder: Path, reporter: Reporter) -> Summary:
    """Render the demonstration into a folder and run it. Raises InputError for a folder with other content, which is
    never overwritten."""
    make_folder(folder)
    if any(folder.iterdir()) and not (folder / TRUTH).exists():
        raise InputError(f"{folder}: holds something that is no demonstration. Name another folder: reseau demo DIR")
    scene = resources.as_file(resources.files("synthetic_images").joinpath(*SCENE))
    with scene as path, reporter.stage("rendering strip") as count:
        render_project(path, folder, count)
    return run_all(read_project(folder / "project.toml"), reporter)

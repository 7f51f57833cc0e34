"""Arguments and options common to several commands, and output of their results.

Each command imports its modules when it runs: importing numpy and its dependants takes longer than printing the help.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.terminal import PlainConsole, plain
from pipeline.text.text_file import FINEST_PITCH_UM

if TYPE_CHECKING:
    from pipeline.files.project_file import Project
    from pipeline.progress import Reporter
    from pipeline.summary import Summary

DONE, LOOK, WRONG_INPUT, INTERNAL_ERROR, INTERRUPTED = 0, 1, 2, 3, 130

ProjectFile = Annotated[Path, typer.Argument(metavar="PROJECT.toml", help="The project file.", show_default=False)]
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE.toml", help="The scene file.", show_default=False)]
OutDir = Annotated[Path, typer.Argument(metavar="OUT_DIR", help="Where the results go.", show_default=False)]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Show no progress.")]
MaxPixels = Annotated[
    int | None,
    typer.Option("--max-pixels", metavar="N", min=1, help="Read scans of up to N pixels, whatever their file's size."),
]
OfCamera = Annotated[
    str | None, typer.Option("--camera", metavar="NAME", help="Which one, where a file holds several.")
]


def pitch_option(help: str, *names: str) -> Any:
    """Option for a pixel size in µm; its meaning and default depend on the command."""
    return typer.Option(*(names or ("--pitch-um",)), metavar="UM", min=FINEST_PITCH_UM, help=help)


def read(path: Path, max_pixels: int | None = None) -> "Project":
    """Read a project. Raises InputError for errors in it."""
    from pipeline.files.project_file import read_project

    return replace(read_project(path), max_pixels=max_pixels)


def run_stage(
    path: Path,
    stage: "Callable[[Project, Reporter], Summary]",
    as_json: bool,
    max_pixels: int | None = None,
    quiet: bool = False,
) -> int:
    """Run a stage on a project and print its summary. Returns the exit code."""
    from pipeline.progress import Reporter

    return finish(stage(read(path, max_pixels), Reporter(quiet=quiet)), as_json, path)


def finish(summary: "Summary", as_json: bool, project: Path | None) -> int:
    """Print a summary, and the next steps if the project file is given. Returns the exit code."""
    from pipeline.commands.next_steps import print_next, summary_steps
    from pipeline.summary import print_summary

    show(as_json, summary.as_json, lambda console: print_summary(summary, console))
    if project is not None:
        print_next(as_json, *summary_steps(project, summary))
    return summary.verdict.exit_code


def show(as_json: bool, content: Callable[[], Any], printed: Callable[[PlainConsole], None]) -> None:
    """Print a result on stdout, as JSON or as text."""
    if not as_json:
        printed(PlainConsole())
        return
    letters = (sys.stdout.encoding or "").lower().startswith("utf")  # otherwise escape them
    from pipeline.results.record_json import json_text

    typer.echo("".join(json_text(content(), ensure_ascii=not letters)), nl=False)


def say(*lines: str) -> None:
    """Print lines on stdout, with control characters escaped and credentials removed."""
    for line in lines:
        typer.echo(plain(line))


def choices_help(words: Mapping[str, Any] | tuple[str, ...]) -> str:
    """Help of an argument that is one of several words."""
    return f"One of {', '.join(words)}."

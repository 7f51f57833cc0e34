"""Arguments and options common to several commands, output of their results, and the suggested next steps.

Each command imports its modules when it runs: importing numpy and its dependants takes longer than printing the help.
"""

import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.archive.verdicts import Verdict
from pipeline.terminal import PlainConsole, plain
from pipeline.text.files import FINEST_PITCH_UM
from pipeline.text.wording import counted

if TYPE_CHECKING:
    from pipeline.archive.new_project import NewProject
    from pipeline.files.project_file import Project
    from pipeline.summary import Summary
    from pipeline.terminal import Reporter

DONE, LOOK, WRONG_INPUT, INTERNAL_ERROR, INTERRUPTED = 0, 1, 2, 3, 130
MOST = 3  # suggested next steps: the most urgent first
_ALL_STAGES = "adjusts, checks and writes the report"

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
    str | None, typer.Option("--camera", metavar="NAME", help="Name of the camera, where a file holds several.")
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
    from pipeline.terminal import Reporter

    return finish(stage(read(path, max_pixels), Reporter(quiet=quiet)), as_json, path)


def finish(summary: "Summary", as_json: bool, project: Path | None) -> int:
    """Print a summary, and the next steps if the project file is given. Returns the exit code."""
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


def print_next(as_json: bool, *steps: str) -> None:
    """Print the first steps on stdout, without duplicates; none with JSON output."""
    for step in [] if as_json else list(dict.fromkeys(steps))[:MOST]:
        typer.echo(plain(f"Next: {step}"))


def command_step(words: str, *arguments: Path | str, why: str = "") -> str:
    """Format `reseau WORDS ARGUMENTS`, quoted for the shell, with the reason as a comment."""
    line = " ".join(("reseau", words, *(shlex.quote(str(argument)) for argument in arguments)))
    return f"{line}  # {why}" if why else line


def page_step(path: Path) -> str:
    """Format the step that opens a page."""
    return f"open {shlex.quote(str(path))}"


def report_step(project: Path, report: Path) -> str:
    """Suggest to open a report, or the command that writes it."""
    return page_step(report) if report.exists() else command_step("run", project, why=_ALL_STAGES)


def summary_steps(project: Path, summary: "Summary") -> Iterator[str]:
    """Suggest steps after a stage, from its summary. project: the project file."""
    files, adjustment = summary.files, summary.adjustment
    if summary.parts:
        databases = shlex.quote(str(next(iter(files.values())).parent))
        words = f"merge {shlex.quote(str(project))} {databases}/measurement.*-of-{summary.parts}.db"
        yield command_step(words, why="when all parts are measured")
        return
    if "report" in files:
        yield page_step(files["report"])
    if summary.finds_no_frame:
        yield command_step("cameras", "--scan", "SCAN", why="names the camera of a scan, if it is another one")
        yield from verdict_steps(project, summary.verdicts)
        return
    yield from verdict_steps(project, summary.verdicts)
    if "covariance" in files:
        yield command_step("check", project, why="compares the adjustment with OpenCV's calibration")
        yield command_step("report", project)
    elif "check" in files or summary.is_adjusted:
        yield command_step("report", project)
    elif "report" not in files:
        yield command_step("run", project, why=_ALL_STAGES)
    elif adjustment is not None and adjustment.converged:
        if not summary.verdicts:  # whose sizes in pixels other programs need
            yield command_step("export", project, "csv", "DIR", why="or parquet, bingo; others need the scans")
        elif any(camera.is_calibrated for camera in adjustment.cameras.values()):
            yield command_step("export", project, "opencv", "DIR", why="or colmap, metashape, micmac, ...")
        else:
            yield command_step("resample", project, "DIR", why="rectifies the scans")


def init_steps(new: "NewProject") -> Iterator[str]:
    """Suggest steps for scans that a new project cannot measure yet."""
    from pipeline.archive.new_project import TEMPLATE_COMMAND

    if new.unknown:
        scans = counted(sum(len(group.paths) for group in new.unknown), "scan")
        if new.named:
            images, project = (shlex.quote(str(new.folder / name)) for name in ("images.csv", "project.toml"))
            what = f"{scans} without a camera: add them with one, and take them out of exclude in {project}"
            yield f"edit {images}  # {what}"
        else:
            yield f"{TEMPLATE_COMMAND}  # {scans} without a camera: draw it, then name it in project.toml"
    for group in sorted(new.digital, key=lambda group: -len(group.paths))[:1]:
        yield f"{group.calibrate_command}  # {counted(len(group.paths), 'picture')}, {group.digital}"


def verdict_steps(project: Path, counts: Mapping[Verdict, int]) -> Iterator[str]:
    """Suggest steps from the numbers of scans by verdict."""
    failed, stale = counts.get(Verdict.FAILED, 0), counts.get(Verdict.WAITING, 0) + counts.get(Verdict.OLD, 0)
    doubtful = counts.get(Verdict.LOOK, 0) + counts.get(Verdict.POOR, 0)
    if failed:
        why = f"{counted(failed, 'scan')} could not be measured: repair or replace the files first"
        yield command_step("measure", project, "--retry", why=why)
    if stale:
        yield command_step("measure", project, why=f"{counted(stale, 'scan')} not measured yet, or stale")
    if doubtful:
        yield command_step("review", project, why=f"settle the doubtful marks of {counted(doubtful, 'scan')}")

"""Suggested next steps, printed at the end of a command: at most three, the most urgent first.

A step is a command line that can be copied, with a comment on its purpose.
"""

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pipeline.archive.verdicts import Verdict
from pipeline.terminal import plain
from pipeline.text.wording import counted

if TYPE_CHECKING:
    from pipeline.archive.new_project import NewProject
    from pipeline.summary import Summary

MOST = 3
_ALL_STAGES = "adjusts, checks and writes the report"


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
        stores = shlex.quote(str(next(iter(files.values())).parent))
        words = f"merge {shlex.quote(str(project))} {stores}/measurement.*-of-{summary.parts}.db"
        yield command_step(words, why="when all parts are measured")
        return
    if "report" in files:
        yield page_step(files["report"])
    yield from verdict_steps(project, summary.verdicts)
    if "covariance" in files:
        yield command_step("check", project, why="compares the adjustment with OpenCV's calibration")
        yield command_step("report", project)
    elif "check" in files:
        yield command_step("report", project)
    elif "report" not in files:
        yield command_step("run", project, why=_ALL_STAGES)
    elif adjustment is not None and adjustment.converged:
        if any(camera.is_calibrated for camera in adjustment.cameras.values()):
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

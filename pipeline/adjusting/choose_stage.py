"""`reseau choose`: select film deformation and distortion model from the observations of a project; writes
choose.json."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from adjust.model_selection.candidates import Candidate
from adjust.model_selection.model_choice import Choice, choose
from pipeline.adjusting.adjust_stage import adjust_marks, adjustment_options, name_scanners
from pipeline.archive.made_from import adjusted_from
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.publishing import unpublished
from pipeline.results.choice_file import ChoiceRecord, choice_record
from pipeline.results.comparator_file import read_comparator
from pipeline.results.record_json import write_record


def run_choose(project: Project, reporter: Reporter) -> tuple[Choice, ChoiceRecord]:
    """Compare models on the observations of the project's own adjustment, with disks corrected for eccentricity; write
    and return the result.

    Raises InputError or AdjustmentError where the project cannot be adjusted.
    """
    with unpublished(project) as new:
        with reporter.stage("comparing") as count:
            marks = read_comparator(project.comparator, project.list_pitch_um)
            sizes = {camera.name: camera.frame_mm for camera in project.cameras.values() if camera.frame_mm}
            half_mm = {name: (width / 2.0, height / 2.0) for name, (width, height) in sizes.items()}
            own = adjust_marks(project, marks)
            choice = choose(
                replace(own, network=name_scanners(project, own.network)),
                adjustment_options(project),
                half_mm,
                lambda name, done: count(name, done, done + 1),
            )
        record = choice_record(choice, adjusted_from(project, marks))
        write_record(record, new.place(project.choice_path))
        new.publish()
    return choice, record


def print_choice(choice: Choice, console: Console, path: Path) -> None:
    """Print a table of the candidates, the verdict and the reasons."""
    columns = ("model", "unknowns", "redundancy", "sigma0", "v'Pv", "AIC", "AICc", "left out, µm", "correlated")
    table = Table(*columns, title="Candidates", title_justify="left")
    for each in choice.candidates:
        style = "bold green" if each is choice.chosen else ""
        table.add_row(Text(each.model.name), *_numbers(each), style=style)
    console.print(table)
    console.print(Text(choice.verdict, style="bold"))
    for reason in choice.reasons:
        console.print(Text(f"- {reason}"))
    console.print(f"choice: {path}", soft_wrap=True, markup=False, highlight=False)


def _numbers(candidate: Candidate) -> tuple[str, ...]:
    if candidate.problem:
        return ("no solution",)
    predicted = candidate.cross_validation
    return (
        str(candidate.unknowns),
        str(candidate.redundancy),
        f"{candidate.sigma0:.3f}",
        f"{candidate.vpv:.1f}",
        f"{candidate.aic:.1f}",
        f"{candidate.aicc:.1f}",
        "none" if predicted is None else f"{predicted.rms_um:.2f}",
        str(len(candidate.correlated)),
    )

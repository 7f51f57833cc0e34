"""`reseau choose`: which transformation and distortion the observations of a project ask for, to choose.json."""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from adjust.model_selection.candidates import Candidate
from adjust.model_selection.model_choice import Choice, choose
from adjust.model_selection.models import Model
from pipeline.adjusting.adjust_stage import adjust_marks, adjustment_options
from pipeline.adjusting.scanners import with_scanner_names
from pipeline.files.project_file import Project
from pipeline.progress import Reporter
from pipeline.publishing.made_from import adjusted_from
from pipeline.publishing.publishing import unpublished
from pipeline.results.comparator_file import read_comparator
from pipeline.text.atomic import write_atomically
from pipeline.text.text_file import without_nan

Json = dict[str, Any]


def run_choose(project: Project, reporter: Reporter) -> Choice:
    """Compare models on the observations that the project's own adjustment uses, disks corrected, and write the result.

    Raises InputError or AdjustmentError where the project cannot be adjusted at all.
    """
    with unpublished(project) as new:
        with reporter.stage("comparing") as count:
            marks = read_comparator(project.comparator)
            half_mm = {camera.name: _half(camera.frame_mm) for camera in project.cameras.values() if camera.frame_mm}
            own = adjust_marks(project, marks)
            choice = choose(
                replace(own, network=with_scanner_names(project, own.network)),
                adjustment_options(project),
                half_mm,
                lambda name, done: count(name, done, done + 1),
            )
        made_from = {"reseau": version("reseau"), "made_from": adjusted_from(project, marks)}
        text = json.dumps(made_from | without_nan(choice_json(choice)), indent=1, ensure_ascii=False, allow_nan=False)
        write_atomically(new.place(project.choice_path), text + "\n")
        new.publish()
    return choice


def choice_json(choice: Choice) -> Json:
    """The choice as choose.json holds it; numbers that mean nothing are still infinite."""
    return {
        "chosen": choice.chosen and _model(choice.chosen.model),
        "given": _model(choice.given),
        "verdict": choice.verdict,
        "reasons": list(choice.reasons),
        "candidates": [_candidate(each) for each in choice.candidates],
        "tests": [
            {
                "simpler": test.simpler.name,
                "richer": test.richer.name,
                "F": test.f,
                "degrees": list(test.degrees),
                "p": test.p,
            }
            for test in choice.tests
        ],
    }


def print_choice(choice: Choice, console: Console, path: Path) -> None:
    """The candidates as a table, then the verdict and a reason a line."""
    columns = ("model", "unknowns", "redundancy", "sigma0", "v'Pv", "AIC", "AICc", "left out, um", "correlated")
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


def _candidate(candidate: Candidate) -> Json:
    entry = {"name": candidate.model.name, **_model(candidate.model)}
    if candidate.problem:
        return entry | {"problem": candidate.problem}
    predicted = candidate.cross_validation
    return entry | {
        "problem": "",
        "observations": candidate.observations,
        "unknowns": candidate.unknowns,
        "redundancy": candidate.redundancy,
        "vpv": candidate.vpv,
        "sigma0": candidate.sigma0,
        "aic": candidate.aic,
        "aicc": candidate.aicc,
        "cross_validation": None if predicted is None else asdict(predicted),
        "correlated": [{"parameters": [a, b], "correlation": rho} for a, b, rho in candidate.correlated],
        "warnings": list(candidate.warnings),
    }


def _model(model: Model) -> Mapping[str, Any]:
    return {
        "transformation": model.transformation,
        "family": model.family,
        "parameters": list(model.parameters),
        "bends": {scanner: list(terms) for scanner, terms in model.bends},
    }


def _half(frame_mm: tuple[float, float]) -> tuple[float, float]:
    return (frame_mm[0] / 2.0, frame_mm[1] / 2.0)

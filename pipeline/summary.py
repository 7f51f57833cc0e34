"""Summary of a command: verdict, problems, main numbers, and where the files are."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from measure.flags import Status
from measure.results import ScanOrientation
from pipeline.archive.status import NAMED, ArchiveStatus, worst_named
from pipeline.archive.verdicts import NEXT_STEP, Verdict, scan_counts
from pipeline.report.data import ReportData, ReportedProblem, current_scans
from pipeline.report.data import frames as report_frames
from pipeline.report.fiducials import MarkDistance, correction_sentence, figure
from pipeline.report.load import frame_counts
from pipeline.report.numbers import typed, value_and_sigma
from pipeline.report.parameters import CameraValue, camera_values
from pipeline.report.verdict import Level, ReportVerdict, judge, sigma0_bounds
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.image_unit import FILM_UNIT, ImageUnit
from pipeline.results.measured_record import plain_json
from pipeline.results.stage_files import Check
from pipeline.text.wording import counted

WORDS = {"good": "Good", "look": "Needs a look", "failed": "No result"}
STYLES = {"good": "bold green", "look": "bold yellow", "failed": "bold red"}
FRAME_ROWS = 8  # rows of the table of frames in the terminal; the report has all
WHOLE_PROBLEMS = 6  # problems printed in full; if there are more, only the first sentence of each
NOTES = 3  # that are printed; the report has all
_MAIN = ("converged", "termination", "iterations", "observations", "unknowns", "redundancy", "sigma0")


@dataclass(frozen=True)
class Summary:
    """Summary of a command.

    Attributes
    ----------
    verdict : verdict with problems and notes.
    frames : numbers of marks by frame and status.
    poses : scan orientations with their evidence, as in measurement.db.
    files : files that were written, by a word for each.
    corrections : corrections to the fiducials of cameras without calibration, in words, and distances between them.
    values : of the calibrated cameras.
    unit : of lengths in images.
    parts : number of shards of the scans, if these are the scans of one.
    is_adjusted : whether adjustment.json, though not shown, is of the marks and settings.
    """

    verdict: ReportVerdict
    frames: Mapping[str, Mapping[str, int]]
    poses: Mapping[str, ScanOrientation]
    adjustment: AdjustmentRecord | None
    check: Check | None
    files: Mapping[str, Path] = field(default_factory=dict)
    corrections: Mapping[str, tuple[str, Sequence[MarkDistance]]] = field(default_factory=dict)
    values: Mapping[str, Sequence[CameraValue]] = field(default_factory=dict)
    unit: ImageUnit = FILM_UNIT
    verdicts: Mapping[Verdict, int] = field(default_factory=dict)
    parts: int = 0
    is_adjusted: bool = False

    @property
    def finds_no_frame(self) -> bool:
        """Whether scans of film were read and no mark was observed in any."""
        observed = (counts.get(status, 0) for counts in self.frames.values() for status in ("measured", "weak"))
        was_read = self.verdicts.get(Verdict.POOR, 0) + self.verdicts.get(Verdict.LOOK, 0) > 0
        return was_read and self.unit is FILM_UNIT and not any(observed)

    def as_json(self) -> dict[str, object]:
        return {
            "reseau": version("reseau"),
            "verdict": self.verdict.level,
            "sentence": self.verdict.sentence,
            "problems": [{"what": problem.what, "next_step": problem.next_step} for problem in self.verdict.problems],
            "notes": list(self.verdict.notes),
            "frames": {name: dict(counts) for name, counts in self.frames.items()},
            "poses": {name: plain_json(pose) for name, pose in self.poses.items()},
            "adjustment": self.adjustment
            and {name: getattr(self.adjustment, name) for name in _MAIN}
            | {"sigma0_from": self.adjustment.variance_factor, "cameras": self.adjustment.cameras},
            "check": self.check and {"verdict": self.check.verdict, "reason": self.check.reason},
            "files": {word: str(path) for word, path in self.files.items()},
        }


def summarise(data: ReportData, files: Mapping[str, Path]) -> Summary:
    """Summarise the data with the verdict of the report."""
    marks = defaultdict[str, Counter[str]](Counter)
    for mark in data.comparator:
        marks[mark.image][mark.status] += 1
    of_frames = data.totals.marks if data.totals else marks
    stored, covariance = data.adjustment, data.covariance
    cameras = stored.cameras if stored else {}
    corrections = dict[str, tuple[str, Sequence[MarkDistance]]]()
    if stored is not None and covariance is not None and stored.converged:
        for name, camera in cameras.items():
            if not camera.is_calibrated and (form := figure(name, stored, covariance)) is not None:
                sentence = correction_sentence(form, camera.fiducials, data.coordinates_source(name))
                corrections[name] = sentence, form.distances
    return Summary(
        judge(data),
        {name: {str(s): counts.get(s, 0) for s in Status} for name, counts in of_frames.items()},
        {name: scan.frame.pose for name, scan in current_scans(data).items() if scan.frame.pose},
        stored,
        data.check,
        files,
        corrections=corrections,
        values={name: camera_values(data, name) for name, camera in cameras.items() if camera.is_calibrated},
        unit=next(iter(data.image_units.values()), FILM_UNIT),
        verdicts=frame_counts(data, report_frames(data)) if data.measurement is not None else {},
        is_adjusted=data.stored_adjustment == "current",
    )


def print_summary(summary: Summary, console: Console) -> None:
    """Print the summary in the report's order; file paths are not wrapped."""
    console.print(Text(summary.verdict.sentence, style=STYLES[summary.verdict.level]))
    if summary.values and (figures := _verdict_figures(summary)):
        console.print(Text(f"{WORDS[summary.verdict.level]}: {figures}.", style=STYLES[summary.verdict.level]))
    if summary.adjustment and summary.values and summary.adjustment.converged:
        console.print(_camera_table(summary.adjustment, summary.values))
    is_brief = len(summary.verdict.problems) > WHOLE_PROBLEMS
    for remedy, problems in groupby(summary.verdict.problems, attrgetter("remedy")):
        for problem in problems:
            console.print(Text(" ".join(("-", problem.cause, "" if is_brief else problem.detail)).rstrip()))
        if remedy:
            console.print(Text(f"  {remedy}", style="dim"))
    if is_brief:
        console.print(Text("The report has more of each, with pictures.", style="dim"))
    if any(summary.verdicts.values()) and (counts := f"{scan_counts(summary.verdicts)}.") != summary.verdict.sentence:
        console.print(Text(counts))
    if summary.frames:
        console.print(_frame_table(summary))
    if summary.adjustment and summary.adjustment.converged and not summary.values:
        console.print(Text(f"Film transformations: {_quality(summary.adjustment)}."))
        for name, (sentence, distances) in summary.corrections.items():
            console.print(Text(f"{name}: {sentence}"))
            for each in distances[:FRAME_ROWS]:
                change = f"{each.change_um:+.3f} µm from the given one, standard deviation {each.sigma_um:.3f} µm"
                console.print(Text(f"{each.start} to {each.end}: {each.length_mm:.4f} mm, {change}"))
    notes = summary.verdict.notes
    for note in notes[:NOTES]:
        console.print(Text(note, style="dim"))
    if len(notes) > NOTES:
        console.print(Text(f"{counted(len(notes) - NOTES, 'more note')}: in the report.", style="dim"))
    for word, path in summary.files.items():
        if word == "report":  # mentioned as the next step
            continue
        console.print(f"{word}: {path}", soft_wrap=True, markup=False, highlight=False)


def _verdict_figures(summary: Summary) -> str:
    """What the verdict rests on: sigma0 with its bounds, and OpenCV's calibration; empty without a solution."""
    adjustment, check = summary.adjustment, summary.check
    if adjustment is None or not adjustment.converged or not adjustment.has_sigma0:
        return ""
    low, high = sigma0_bounds(adjustment.variance_factor.redundancy)
    opencv = f"; OpenCV's calibration {check.verdict}" if check and check.verdict in ("agrees", "differs") else ""
    return f"sigma0 {adjustment.sigma0:.2f} (usual {low:.2f} to {high:.2f}){opencv}"


def _frame_table(summary: Summary) -> Table:
    """Table of marks and residuals by frame, the worst first, without empty columns."""
    frames, poses, squares = summary.frames, summary.poses, defaultdict[str, list[float]](list)
    for residual in summary.adjustment.residuals if summary.adjustment else ():
        squares[residual.image] += [residual.vx_um**2, residual.vy_um**2]
    rms = {name: float(np.sqrt(np.mean(each))) for name, each in squares.items()}
    lost = {name: sum(counts.values()) - counts[Status.MEASURED] for name, counts in frames.items()}
    is_lost = {name: not (counts[Status.MEASURED] or counts[Status.WEAK]) for name, counts in frames.items()}
    worst = sorted(frames, key=lambda name: (is_lost[name], rms.get(name, 0.0), lost[name]), reverse=True)
    statuses = [status for status in Status if any(counts[status] for counts in frames.values())]
    title = "Frames, the worst first" + (f" ({FRAME_ROWS} of {len(worst)})" if len(worst) > FRAME_ROWS else "")
    unit = summary.unit.short_name
    columns = ["frame", *(["orientation"] if poses else []), *map(str, statuses), *([f"rms, {unit}"] if rms else [])]
    table = Table(*columns, title=title, title_justify="left")
    for name in worst[:FRAME_ROWS]:
        pose = poses.get(name)
        row = [("" if pose is None else pose.name + ("" if pose.decided else ", assumed"))] if poses else []
        row += [str(frames[name][status]) for status in statuses]
        if rms:
            known = rms.get(name)
            row.append("" if known is None else f"{known * summary.unit.per_um:.{summary.unit.decimals}f}")
        table.add_row(Text(name), *row)
    return table


def _camera_table(adjustment: AdjustmentRecord, values: Mapping[str, Sequence[CameraValue]]) -> Table:
    """Table of the values to cite, in mm or px, with sigma0 and its redundancy."""
    quality = _quality(adjustment)
    columns = ("parameter", "value", "standard deviation", "unit")
    table = Table(*(("camera", *columns) if len(values) > 1 else columns), title_justify="left")
    table.title = f"Camera {next(iter(values))} ({quality})" if len(values) == 1 else f"Cameras ({quality})"
    for name, rows in values.items():
        for each in rows:
            words = f"{each.name} {each.meaning}".strip()
            cells = (words, *map(typed, value_and_sigma(each.value, each.sigma)), each.unit)
            table.add_row(*([Text(name)] if len(values) > 1 else []), *cells)
    return table


def _quality(adjustment: AdjustmentRecord) -> str:
    """sigma0 with its redundancy; without any, that the standard deviations are a priori."""
    if not adjustment.has_sigma0:
        return "standard deviations a priori"
    return f"sigma0 {adjustment.sigma0:.3f}, redundancy {adjustment.variance_factor.redundancy:.0f}"


def archive_summary(status: ArchiveStatus, files: Mapping[str, Path]) -> Summary:
    """Summary of a measurement of many scans."""
    named, more = worst_named(status.scans, NAMED, False)
    problems = [ReportedProblem(f"{scan.image}: {scan.verdict}: {scan.why}", NEXT_STEP[scan.verdict]) for scan in named]
    problems += [ReportedProblem(f"decisions.jsonl, {line}", "It does not count.") for line in status.idle_decisions]
    if more:
        problems.append(ReportedProblem(f"{more} more need a look.", "Run `reseau status` with --verdict or --csv."))
    level: Level = "good" if status.all_good else "look"
    verdict = ReportVerdict(level, f"{status.sentence}.", tuple(problems), ())
    return Summary(verdict, {}, {}, None, None, files, verdicts=status.counts)

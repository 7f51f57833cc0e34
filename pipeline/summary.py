"""What a command says when it is done: the verdict, the problems, the main numbers, where the files are."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from itertools import groupby
from operator import attrgetter
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from measure.flags import Status
from measure.results import Pose
from pipeline.archive.status import NAMED, ArchiveStatus, archive_status, worst_named
from pipeline.archive.verdicts import NEXT_STEP, Verdict, scan_counts, scan_verdict
from pipeline.files.project_file import Project
from pipeline.report.data import Problem, ReportData
from pipeline.report.fiducials import Figure, figure
from pipeline.report.marks import current_scans
from pipeline.report.numbers import value_and_sigma
from pipeline.report.verdict import Level, ReportVerdict, judge
from pipeline.results.adjustment_record import AdjustmentRecord
from pipeline.results.check_file import Check
from pipeline.results.measured_record import pose_record

STYLES = {"good": "bold green", "look": "bold yellow", "failed": "bold red"}
FRAME_ROWS = 50  # of frames at most in a table in the terminal: the report has all


@dataclass(frozen=True)
class Summary:
    """The end of a command. poses: of the scans, each with its evidence, as measurement.db has them. files: what was
    written, by a word for it. forms: of the fiducials of cameras of which nothing else was adjusted. verdicts: numbers
    of scans. parts: in how many the scans are measured, where these are those of one."""

    verdict: ReportVerdict
    frames: Mapping[str, Mapping[str, int]]
    poses: Mapping[str, Pose]
    adjustment: AdjustmentRecord | None
    check: Check | None
    files: Mapping[str, Path] = field(default_factory=dict)
    forms: Mapping[str, Figure] = field(default_factory=dict)
    verdicts: Mapping[Verdict, int] = field(default_factory=dict)
    parts: int = 0

    def as_json(self) -> dict[str, object]:
        return {
            "reseau": version("reseau"),
            "verdict": self.verdict.level,
            "sentence": self.verdict.sentence,
            "problems": [{"what": problem.what, "next_step": problem.next_step} for problem in self.verdict.problems],
            "notes": list(self.verdict.notes),
            "frames": {name: dict(counts) for name, counts in self.frames.items()},
            "poses": {name: pose_record(pose) for name, pose in self.poses.items()},
            "adjustment": self.adjustment and _main_numbers(self.adjustment),
            "check": self.check and {"verdict": self.check.verdict, "reason": self.check.reason},
            "files": {word: str(path) for word, path in self.files.items()},
        }


def summarise(data: ReportData, files: Mapping[str, Path]) -> Summary:
    """Judge the data as the report does, and add where everything stands."""
    frames: dict[str, dict[str, int]] = {}
    for mark in data.comparator if not data.totals else ():
        counts = frames.setdefault(mark.image, {str(status): 0 for status in Status})
        counts[mark.status] += 1
    if data.totals:
        frames = {name: {str(s): counts.get(s, 0) for s in Status} for name, counts in data.totals.marks.items()}
    scans = current_scans(data)
    poses = {name: scan.frame.pose for name, scan in scans.items() if scan.frame.pose}
    verdicts = Counter(map(scan_verdict, scans.values()))
    if data.totals:
        verdicts = Counter({each: data.totals.count(each) for each in Verdict})
    return Summary(judge(data), frames, poses, data.adjustment, data.check, files, _forms(data), verdicts)


def _forms(data: ReportData) -> dict[str, Figure]:
    stored, covariance = data.adjustment, data.covariance
    if stored is None or covariance is None or not stored.converged:
        return {}
    uncalibrated = [name for name, camera in stored.cameras.items() if not camera.is_calibrated]
    found = {name: figure(name, stored, covariance) for name in uncalibrated}
    return {name: form for name, form in found.items() if form is not None}


def print_summary(summary: Summary, console: Console) -> None:
    """The summary for a person; file paths are never folded."""
    if any(summary.verdicts.values()) and (counts := f"{scan_counts(summary.verdicts)}.") != summary.verdict.sentence:
        console.print(Text(counts))
    console.print(Text(summary.verdict.sentence, style=STYLES[summary.verdict.level]))
    for next_step, problems in groupby(summary.verdict.problems, attrgetter("next_step")):
        for problem in problems:
            console.print(Text(f"- {problem.what}"))
        if next_step:
            console.print(Text(f"  {next_step}", style="dim"))
    if summary.frames:
        console.print(_frame_table(summary.frames, summary.poses))
        for name, pose in summary.poses.items():
            if pose.decided:
                console.print(Text(f"{name}: pose {pose.name}. {' '.join(pose.evidence)}", style="dim"))
    if summary.adjustment:
        calibrated = any(camera.is_calibrated for camera in summary.adjustment.cameras.values())
        console.print((_camera_table if calibrated else _film_table)(summary.adjustment))
        for name, form in summary.forms.items():
            console.print(_form_table(name, form))
    for note in summary.verdict.notes:
        console.print(Text(note, style="dim"))
    for word, path in summary.files.items():
        if word == "report":  # is the next step
            continue
        console.print(f"{word}: {path}", soft_wrap=True, markup=False, highlight=False)


def _main_numbers(adjustment: AdjustmentRecord) -> dict[str, object]:
    how = ("converged", "termination", "iterations", "observations", "unknowns", "redundancy", "sigma0")
    numbers = {key: getattr(adjustment, key) for key in how}
    return {**numbers, "sigma0_from": adjustment.variance_factor, "cameras": adjustment.cameras}


def _frame_table(frames: Mapping[str, Mapping[str, int]], poses: Mapping[str, Pose]) -> Table:
    columns = ("image", "pose", *Status) if poses else ("image", *Status)
    title, fewest_measured = "Marks", sorted(frames, key=lambda name: frames[name][str(Status.MEASURED)])
    shown = set(fewest_measured[:FRAME_ROWS])
    if len(shown) < len(frames):
        title += f"; the {len(shown)} of {len(frames)} frames with the fewest measured"
    table = Table(*(str(column) for column in columns), title=title, title_justify="left")
    for name, counts in frames.items():
        if name in shown:
            pose = poses.get(name)
            name_of_pose = "" if pose is None else pose.name + ("" if pose.decided else ", assumed")
            row = [name_of_pose] if poses else []
            table.add_row(Text(name), *row, *(str(counts[status]) for status in Status))
    return table


def _sigma0(adjustment: AdjustmentRecord) -> str:
    """sigma0 with the redundancy of what it comes from; without any, what standard deviations are."""
    if not adjustment.has_sigma0:
        return "standard deviations a priori"
    return f"sigma0 = {adjustment.sigma0:.3f}, redundancy {adjustment.variance_factor.redundancy:.0f}"


def _film_table(adjustment: AdjustmentRecord) -> Table:
    """What an adjustment of fiducials alone gives of every image."""
    title = f"Film transformations ({_sigma0(adjustment)})"
    datum = adjustment.groups.get("datum")
    if datum:
        title += f"; given fiducials: rms {datum.rms_x_um:.2f}, {datum.rms_y_um:.2f} µm"
    columns = ("image", "transformation", "fiducials", "rms x, µm", "rms y, µm")
    squares: dict[str, list[tuple[float, float]]] = {}
    for row in adjustment.residuals:
        squares.setdefault(row.image, []).append((row.vx_um**2, row.vy_um**2))
    rms = {name: np.sqrt(np.mean(of_image, axis=0)) for name, of_image in squares.items()}
    worst = sorted(rms, key=lambda name: -float(np.hypot(*rms[name])))[:FRAME_ROWS]
    shown = [name for name in adjustment.images if name in set(worst)]
    if len(shown) < len(rms):
        title += f"; the {len(shown)} of {len(rms)} frames with the largest residuals"
    table = Table(*columns, title=title, title_justify="left")
    for name in shown:
        kind = adjustment.images[name].transformation.kind
        table.add_row(Text(name), kind, str(len(squares[name])), *(f"{value:.2f}" for value in rms[name]))
    return table


def _form_table(name: str, form: Figure) -> Table:
    """Where marks stand otherwise than they are given, free of the datum, and the distances that films keep."""
    after = "" if form.transformation == "none" else f", after a transformation to these ({form.transformation})"
    title = f"Corrections to the given fiducials of {name}{after}"
    table = Table("mark", "x, µm", "sigma", "y, µm", "sigma", title=title, title_justify="left")
    for id, change, sigma in zip(form.ids, form.change_um, form.sigmas_um, strict=True):
        table.add_row(Text(id), *(f"{value:.3f}" for pair in zip(change, sigma, strict=True) for value in pair))
    for each in form.distances:
        between = Text(f"{each.start} to {each.end}: {each.length_mm:.4f} mm")
        table.add_row(between, f"{each.change_um:.3f}", f"{each.sigma_um:.3f}", "", "")
    return table


def _camera_table(adjustment: AdjustmentRecord) -> Table:
    title = f"Camera ({_sigma0(adjustment)})"
    table = Table("camera", "parameter", "value", "sigma", title=title, title_justify="left")
    words = {"c": "principal distance, mm", "x0": "principal point x', mm", "y0": "principal point y', mm"}
    for name, camera in adjustment.cameras.items():
        for word, each in camera.interior.items() if camera.is_calibrated else ():
            table.add_row(Text(name), words.get(word, word), *value_and_sigma(each.value, each.sigma))
    return table


def archive_summary(project: Project, files: Mapping[str, Path]) -> Summary:
    """What `measure` says of many scans."""
    return _scan_summary(archive_status(project), files)


def shard_summary(project: Project, path: Path, shard: tuple[int, int]) -> Summary:
    """What `measure --shard` says: of the scans of that part."""
    status = archive_status(project, path)
    own = tuple(scan for scan in status.scans if scan.verdict not in (Verdict.WAITING, Verdict.OLD))
    summary = _scan_summary(ArchiveStatus(own), {f"part {shard[0]} of {shard[1]}": path})
    return replace(summary, parts=shard[1])


def _scan_summary(status: ArchiveStatus, files: Mapping[str, Path]) -> Summary:
    sentence = f"{status.sentence}."
    named, more = worst_named(status.scans, NAMED, False)
    problems = [Problem(f"{scan.image}: {scan.verdict}: {scan.why}", NEXT_STEP[scan.verdict]) for scan in named]
    problems += [Problem(f"decisions.jsonl, {line}", "It does not count.") for line in status.idle_decisions]
    if more:
        problems.append(Problem(f"{more} more need a look.", "Run `reseau status` with --verdict or --csv."))
    level: Level = "good" if status.all_good else "look"
    return Summary(
        ReportVerdict(level, sentence, tuple(problems), ()), {}, {}, None, None, files, verdicts=status.counts
    )

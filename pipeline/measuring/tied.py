"""The third step of measuring: all scans of a project beside one another."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NewType

from pipeline.files.project_file import Project
from pipeline.measuring.joins import with_joins
from pipeline.measuring.natural_points import with_ties
from pipeline.measuring.sheet_check import with_checked_sheet
from pipeline.progress import Reporter
from pipeline.results.measured_scan import MeasuredScan

TiedScan = NewType("TiedScan", MeasuredScan)  # beside all others of its project


def tied(
    project: Project, scans: Sequence[MeasuredScan], reporter: Reporter, executor: Executor | None = None
) -> tuple[TiedScan, ...]:
    """Checked scans as all of the project together show them, in their order: points of a sheet or board that
    contradict its other pictures, what joins the parts of frames, and natural points."""
    seen = with_checked_sheet(project, [scan for scan in scans if not scan.failure])
    if project.has_parts:
        with reporter.stage("parts joined of") as count:
            seen = with_joins(project, seen, count, executor)
    if project.ties is not None:
        with reporter.stage("natural points sought in") as count:
            seen = with_ties(project, project.ties, seen, count, executor)
    told = {scan.frame.image: scan for scan in seen}
    return tuple(TiedScan(told.get(scan.frame.image, scan)) for scan in scans)

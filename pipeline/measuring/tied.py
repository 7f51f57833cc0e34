"""The third step of measuring: all scans of a project beside one another."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NewType

from pipeline.files.project_file import Project
from pipeline.measuring.camera_plate import with_plates
from pipeline.measuring.checked import CheckedScan
from pipeline.measuring.joins import with_joins
from pipeline.measuring.natural_points import with_ties
from pipeline.measuring.same_frames import with_same_frames
from pipeline.measuring.sheet_check import with_checked_sheet
from pipeline.progress import Reporter
from pipeline.results.measured_scan import MeasuredScan

TiedScan = NewType("TiedScan", MeasuredScan)  # beside all others of its project


def tied(
    project: Project, checked: Sequence[CheckedScan], reporter: Reporter, executor: Executor | None = None
) -> tuple[TiedScan, ...]:
    """The scans as all of the project together show them, in their order: what plates say of the cameras, frames that
    were scanned twice, points of a sheet or board that contradict its other pictures, what joins the parts of frames,
    and natural points."""
    seen = _with_plates(project, [scan for scan in checked if not scan.failure])
    seen = with_checked_sheet(project, with_same_frames(seen, project.part_of))
    if project.has_parts:
        with reporter.stage("parts joined of") as count:
            seen = with_joins(project, seen, count, executor)
    if project.ties is not None:
        with reporter.stage("natural points sought in") as count:
            seen = with_ties(project, project.ties, seen, count, executor)
    told = {scan.frame.image: scan for scan in seen}
    return tuple(TiedScan(told.get(scan.frame.image, scan)) for scan in checked)


def _with_plates(project: Project, scans: Sequence[CheckedScan]) -> Sequence[MeasuredScan]:
    told = dict[str, MeasuredScan]()
    for camera in project.cameras.values():
        own = [scan for scan in scans if project.camera_of(scan.frame.image) is camera]
        told |= {scan.frame.image: scan for scan in with_plates(camera, own, project.cameras)}
    return [told[scan.frame.image] for scan in scans]

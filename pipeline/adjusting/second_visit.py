"""The second visit to the scans: targets that were missed, sought where the adjustment says they are."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np

from adjust.problem.images import adjusted_image, adjusted_places
from adjust.solution.result import Adjustment
from measure.fiducials.frame_checks import without_lost
from measure.flags import Code, Reason, Status
from measure.results import ON_FILM, MarkMeasurement
from measure.scans.opening import open_scan
from measure.scans.remote import fetch_location, scan_path
from measure.targets.identification import TargetPrediction
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.measuring.target_field import Field, checked_places, measure_single_targets, target_field
from pipeline.measuring.target_stage import replace_targets
from pipeline.progress import Reporter
from pipeline.results.measured_record import MeasuredScan
from pipeline.workers import iterate_results

_SEARCH_PX = 2.0  # an adjusted orientation predicts to far less than that


@dataclass(frozen=True, eq=False)
class Visit:
    """A scan to be looked at again: the path or the address of its file, and what is sought in it."""

    image: str
    scan: str
    sought: tuple[TargetPrediction, ...]
    settings: TargetSettings
    max_pixels: int | None


def measure_again(
    project: Project,
    scans: Sequence[MeasuredScan],
    adjustment: Adjustment,
    reporter: Reporter,
    executor: Callable[[], AbstractContextManager[Executor]],
) -> tuple[MeasuredScan, ...] | None:
    """The scans with what was found on the second visit; None where there is nothing new.

    Only targets that no mark was given to before are sought: what has been measured is not measured anew. executor:
    what the scans are shared among, asked for where any is to be looked at.
    """
    settings = project.targets
    if settings is None or settings.board is not None or not adjustment.converged:
        return None
    field = _adjusted_field(target_field(project), adjustment)
    sought = {scan.frame.image: _missed(field, scan, adjustment, settings) for scan in scans}
    visits = [
        Visit(scan.frame.image, fetch_location(scan.scan), missed, settings, project.max_pixels)
        for scan in scans
        if (missed := sought[scan.frame.image])
    ]
    if not visits:
        return None
    found = dict[str, tuple[MarkMeasurement, ...] | str]()
    with executor() as workers, reporter.stage("second pass of") as count:
        for done, (visit, result) in enumerate(iterate_results(looked_again, visits, workers), 1):
            found[visit.image] = str(result) if isinstance(result, Exception) else result
            count(visit.image, done, len(visits))
    visited = [_visited(scan, found.get(scan.frame.image, ()), field, adjustment) for scan in scans]
    return tuple(visited) if any(new is not old for new, old in zip(visited, scans, strict=True)) else None


def looked_again(visit: Visit) -> tuple[MarkMeasurement, ...] | str:
    """What is seen there of what is sought, or why the scan cannot be looked at: this raises nothing but interrupts."""
    try:
        with open_scan(scan_path(visit.scan), visit.max_pixels) as opened:
            grey = opened if visit.settings.code is None else opened.green_channel()
            marks = without_lost(opened, measure_single_targets(grey, visit.sought, visit.settings))
    except Exception as error:
        return " ".join(str(error).split()) or type(error).__name__
    return tuple(mark for mark in marks if mark.status.is_observation)


def _adjusted_field(field: Field, adjustment: Adjustment) -> Field:
    """The field at its adjusted coordinates."""
    xyz = field.xyz.copy()
    known = [row for row, id in enumerate(field.ids) if id in adjustment.network.point_by_id]
    xyz[known] = adjusted_places(adjustment, [field.ids[row] for row in known])
    return replace(field, xyz=xyz)


def _missed(
    field: Field, scan: MeasuredScan, adjustment: Adjustment, settings: TargetSettings
) -> tuple[TargetPrediction, ...]:
    """The targets that are to be sought once more in a scan, where they should be."""
    network, image = adjustment.network, scan.frame.image
    if image not in network.image_by_name or image in network.unoriented:
        return ()
    targets = {mark.point: mark for mark in scan.frame.marks if mark.kind not in ON_FILM}
    return tuple(
        prediction
        for prediction in field.predictions(adjusted_image(adjustment, image), scan, _SEARCH_PX)
        if _is_inside(scan, prediction.center_px) and _is_missed(targets.get(prediction.point), settings)
    )


def _visited(
    scan: MeasuredScan, seen: Sequence[MarkMeasurement] | str, field: Field, adjustment: Adjustment
) -> MeasuredScan:
    """The scan with what was seen of it, the same object where that is nothing. What the first visit gave stays where a
    second one was not possible any more, and the frame says so."""
    if isinstance(seen, str):
        problem = Reason(f"The second pass failed: {seen}", Code.UNREACHABLE)
        return replace(scan, frame=replace(scan.frame, problems=(*scan.frame.problems, problem)))
    targets = {mark.point: mark for mark in scan.frame.marks if mark.kind not in ON_FILM}
    taken = [mark.center_px for mark in targets.values() if mark.status.is_observation and mark.center_px is not None]
    fresh = {mark.point: mark for mark in seen if _is_free(mark, np.array(taken).reshape(-1, 2))}
    if not fresh:
        return scan
    model = adjusted_image(adjustment, scan.frame.image)
    checked = checked_places(tuple((targets | fresh).values()), field, model, scan)
    fresh = {mark.point: mark for mark in checked if mark.point in fresh and mark.status.is_observation}
    return replace_targets(scan, tuple((targets | fresh).values())) if fresh else scan


def _is_missed(mark: MarkMeasurement | None, settings: TargetSettings) -> bool:
    """A coded target that was rejected has another one's ring at its place, and stays rejected; and so does what a
    person decided."""
    if mark is None:
        return True
    if Code.DECIDED in mark.reason.codes:
        return False
    return not mark.status.is_observation and not (settings.code is not None and mark.status is Status.REJECTED)


def _is_inside(scan: MeasuredScan, center_px: np.ndarray) -> bool:
    return bool(0 <= center_px[0] < scan.width_px and 0 <= center_px[1] < scan.height_px)


def _is_free(mark: MarkMeasurement, taken_px: np.ndarray) -> bool:
    """Whether no other target has been measured at that very place."""
    return mark.center_px is not None and not bool((np.hypot(*(taken_px - mark.center_px).T) < _SEARCH_PX).any())

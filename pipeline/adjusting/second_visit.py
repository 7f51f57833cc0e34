"""The second visit to the scans: targets that were missed, sought where the adjustment says they are."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from adjust.problem.images import adjusted_image
from adjust.problem.result import Adjustment
from measure.checks.lost_pixels import without_lost
from measure.errors import MeasurementError
from measure.reason import Code, Reason
from measure.results import MarkMeasurement
from measure.scans.addresses import scan_path
from measure.scans.scan import open_scan
from measure.status import Status
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.measuring.target_field import Field, measure_single_targets, target_field
from pipeline.measuring.target_places import checked_places
from pipeline.measuring.target_stage import with_targets
from pipeline.progress import Reporter
from pipeline.results.measured_scan import MeasuredScan

_SEARCH_PX = 2.0  # an adjusted orientation predicts to far less than that


def measure_again(
    project: Project, scans: Sequence[MeasuredScan], adjustment: Adjustment, reporter: Reporter
) -> tuple[MeasuredScan, ...] | None:
    """The scans with what was found on the second visit; None where there is nothing new.

    Only targets that no mark was given to before are sought: what has been measured is not measured anew.
    """
    settings = project.targets
    if settings is None or settings.board is not None or not adjustment.converged:
        return None
    field = _with_adjusted_points(target_field(project), adjustment)
    visited = []
    with reporter.stage("looking again at") as count:
        for done, scan in enumerate(scans):
            count(scan.frame.image, done, len(scans))
            visited.append(_visited(scan, lambda one: _visit(field, one, adjustment, settings, project.max_pixels)))
    return tuple(visited) if any(new is not old for new, old in zip(visited, scans, strict=True)) else None


def _visited(scan: MeasuredScan, visit: Callable[[MeasuredScan], MeasuredScan]) -> MeasuredScan:
    """What the first visit gave stays where a second one is not possible any more, and the frame says so."""
    try:
        return visit(scan)
    except MeasurementError as error:
        problem = Reason(f"It could not be looked at again: {error}", Code.DAMAGED_FILE)
        return replace(scan, frame=replace(scan.frame, problems=(*scan.frame.problems, problem)))


def _with_adjusted_points(field: Field, adjustment: Adjustment) -> Field:
    """The field at its adjusted coordinates."""
    xyz = field.xyz.copy()
    for row, id in enumerate(field.ids):
        if id in adjustment.network.point_by_id:
            xyz[row] = [adjustment.value(f"PT.{id}.{axis}") for axis in "XYZ"]
    return replace(field, xyz=xyz)


def _visit(
    field: Field, scan: MeasuredScan, adjustment: Adjustment, settings: TargetSettings, max_pixels: int | None
) -> MeasuredScan:
    """The same object where the visit brought nothing."""
    network = adjustment.network
    if scan.frame.image not in network.image_by_name or scan.frame.image in network.unoriented:
        return scan
    targets = {mark.point: mark for mark in scan.frame.marks if mark.kind != "fiducial"}
    model = adjusted_image(adjustment, scan.frame.image)
    missed = [
        prediction
        for prediction in field.predictions(model, scan, _SEARCH_PX)
        if _is_inside(scan, prediction.center_px) and _is_missed(targets.get(prediction.point), settings)
    ]
    if not missed:
        return scan
    with open_scan(scan_path(scan.scan), max_pixels) as opened:
        grey = opened if settings.code is None else opened.green()
        marks = without_lost(opened, measure_single_targets(grey, missed, settings))
    found = {mark.point: mark for mark in marks if mark.status.is_observation}
    taken = [mark.center_px for mark in targets.values() if mark.status.is_observation and mark.center_px is not None]
    fresh = {point: mark for point, mark in found.items() if _is_free(mark, np.array(taken).reshape(-1, 2))}
    checked = checked_places(tuple((targets | fresh).values()), field, model, scan)
    fresh = {mark.point: mark for mark in checked if mark.point in fresh and mark.status.is_observation}
    return with_targets(scan, tuple((targets | fresh).values())) if fresh else scan


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

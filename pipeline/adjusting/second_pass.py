"""Second pass over the scans: missed targets are sought where the adjustment predicts them."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np

from adjust.problem.estimates import adjusted_image, adjusted_places
from adjust.solution.result import Adjustment
from measure.fiducials.measurement import drop_lost_marks
from measure.flags import Code, Reason, Status
from measure.results import ON_FILM, MarkMeasurement
from measure.scans.opening import open_scan
from measure.scans.remote import fetch_location, scan_path
from measure.targets.identification import TargetPrediction
from pipeline.files.project_file import Project
from pipeline.files.target_table import TargetSettings
from pipeline.measuring.target_field import TargetField, checked_places, measure_single_targets, target_field
from pipeline.measuring.target_stage import replace_targets
from pipeline.results.measured_record import MeasuredScan
from pipeline.terminal import Reporter
from pipeline.workers import iterate_results

_SEARCH_PX = 2.0  # search radius: predictions of an adjusted orientation are far more precise


@dataclass(frozen=True, eq=False)
class RepeatedSearch:
    """Scan to be searched again.

    scan: path or address of its file; sought: predictions of the missed targets.
    """

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
    """Measure missed targets in a second pass; return the scans with new marks, or None where nothing is new.

    Targets that were measured before are not measured again. executor: function that returns an executor, called only
    if there is a scan to search.
    """
    settings = project.targets
    if settings is None or settings.board is not None or not adjustment.converged:
        return None
    field = target_field(project)
    known = [row for row, id in enumerate(field.ids) if id in adjustment.network.point_by_id]
    xyz = field.xyz.copy()
    xyz[known] = adjusted_places(adjustment, [field.ids[row] for row in known])
    field = replace(field, xyz=xyz)
    searches = [
        RepeatedSearch(scan.frame.image, fetch_location(scan.scan), missed, settings, project.max_pixels)
        for scan in scans
        if (missed := _missed_targets(field, scan, adjustment, settings))
    ]
    if not searches:
        return None
    found = dict[str, tuple[MarkMeasurement, ...] | str]()
    with executor() as workers, reporter.stage("second pass of scan") as count:
        for done, (search, result) in enumerate(iterate_results(search_again, searches, workers), 1):
            found[search.image] = str(result) if isinstance(result, Exception) else result
            count(search.image, done, len(searches))
    changed = [_add_targets(scan, found.get(scan.frame.image, ()), field, adjustment) for scan in scans]
    return tuple(changed) if any(new is not old for new, old in zip(changed, scans, strict=True)) else None


def search_again(search: RepeatedSearch) -> tuple[MarkMeasurement, ...] | str:
    """Measure the predicted targets of a scan; return those found, or why the scan cannot be searched. Raises nothing
    but interrupts."""
    try:
        with open_scan(scan_path(search.scan), search.max_pixels) as opened:
            grey = opened if search.settings.code is None else opened.green_channel()
            marks = drop_lost_marks(opened, measure_single_targets(grey, search.sought, search.settings))
    except Exception as error:
        return " ".join(str(error).split()) or type(error).__name__
    return tuple(mark for mark in marks if mark.status.is_observation)


def _missed_targets(
    field: TargetField, scan: MeasuredScan, adjustment: Adjustment, settings: TargetSettings
) -> tuple[TargetPrediction, ...]:
    """Predictions of the targets that were missed in a scan; not of those that a person decided about."""
    network, image = adjustment.network, scan.frame.image
    if image not in network.image_by_name or image in network.unoriented:
        return ()
    found = {
        mark.point
        for mark in scan.frame.marks
        if mark.kind not in ON_FILM
        if mark.status.is_observation
        or Code.DECIDED in mark.reason.codes
        # At the place of a rejected coded target is another one's ring.
        or (settings.code is not None and mark.status is Status.REJECTED)
    }
    return tuple(
        one
        for one in field.predictions(adjusted_image(adjustment, image), scan, _SEARCH_PX)
        if 0 <= one.center_px[0] < scan.width_px and 0 <= one.center_px[1] < scan.height_px
        if one.point not in found
    )


def _add_targets(
    scan: MeasuredScan, found: Sequence[MarkMeasurement] | str, field: TargetField, adjustment: Adjustment
) -> MeasuredScan:
    """Scan with the targets found in the second pass; the same object if there are none."""
    if isinstance(found, str):
        problem = Reason(f"The second pass failed: {found}", Code.UNREACHABLE)
        return scan.changed(problems=[problem])
    targets = {mark.point: mark for mark in scan.frame.marks if mark.kind not in ON_FILM}
    taken = [mark.center_px for mark in targets.values() if mark.status.is_observation and mark.center_px is not None]
    taken_px = np.array(taken).reshape(-1, 2)  # places at which another target has been measured
    fresh = {
        mark.point: mark
        for mark in found
        if mark.center_px is not None and not (np.hypot(*(taken_px - mark.center_px).T) < _SEARCH_PX).any()
    }
    if not fresh:
        return scan
    model = adjusted_image(adjustment, scan.frame.image)
    checked = checked_places(tuple((targets | fresh).values()), field, model, scan)
    fresh = {mark.point: mark for mark in checked if mark.point in fresh and mark.status.is_observation}
    if not fresh:
        return scan
    if not taken:  # the adjustment names what the scan by itself did not
        problems = tuple(each for each in scan.frame.problems if Code.UNNAMED not in each.codes)
        scan = replace(scan, frame=replace(scan.frame, problems=problems))
    return replace_targets(scan, tuple((targets | fresh).values()))

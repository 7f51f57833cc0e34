"""A frame measured at once from where a person points, to be looked at: nothing of it is kept but the clicks."""

from collections.abc import Sequence
from dataclasses import replace

from measure.fiducial_options import Click
from pipeline.errors import InputError
from pipeline.files.project_file import Project
from pipeline.measuring.measured import measured_scan
from pipeline.measuring.scan_task import scan_tasks
from pipeline.results.measured_scan import MeasuredScan


def measured_from_clicks(project: Project, image: str, clicks: Sequence[Click]) -> MeasuredScan:
    """The scan's fiducials, as `reseau measure` would find them with these decisions. project: with what was learned of
    its marks. Raises InputError for a mark that the camera does not have."""
    known = {mark.id for mark in project.camera_of(image).drawn}
    unknown = [click.point for click in clicks if click.point not in known]
    if unknown:
        raise InputError(f"{image}: its camera has no mark {', '.join(unknown)}.")
    (task,) = scan_tasks(project, [image])
    fiducials = replace(task.options.fiducials, clicks=tuple(clicks), writing="none")
    options = replace(task.options, fiducials=fiducials, targets=None, exterior=None)
    return measured_scan(replace(task, options=options))

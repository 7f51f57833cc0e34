"""A frame measured at once from where a person points, to be looked at: nothing of it is kept but the clicks."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from measure.fiducials.options import Click
from pipeline.errors import InputError
from pipeline.files.learned_table import Clicks
from pipeline.files.project_file import Project
from pipeline.measuring.first_pictures import first_pictures
from pipeline.measuring.measured import measured_scan
from pipeline.measuring.scan_task import ScanTask, scan_tasks
from pipeline.results.measured_scan import MeasuredScan


def measured_from_clicks(project: Project, image: str, clicks: Sequence[Click]) -> MeasuredScan:
    """The scan's fiducials, as `reseau measure` would find them with these decisions. project: with what was learned of
    its marks. Raises InputError for a mark that the camera does not have."""
    known = {mark.id for mark in project.camera_of(image).drawn}
    unknown = [click.point for click in clicks if click.point not in known]
    if unknown:
        raise InputError(f"{image}: its camera has no mark {', '.join(unknown)}.")
    (task,) = scan_tasks(project, [image])
    fiducials = replace(task.options.fiducials, clicks=tuple(clicks))
    return _tried(replace(task, options=replace(task.options, fiducials=fiducials)))


def measured_as_shown(project: Project, shown: str, px: Mapping[str, tuple[float, float]], image: str) -> MeasuredScan:
    """A scan's fiducials, found by the pictures of marks that are to be learned at places of one scan, which may be
    itself. shown: that scan; px: column and row of its camera's marks. Raises InputError for a mark that is missing."""
    camera = project.camera_of(shown)
    missing = [one.id for one in camera.learned if one.id not in px]
    if missing:
        raise InputError(f"{shown}: click {', '.join(missing)}, too.")
    (task,) = scan_tasks(project, [shown])
    start = first_pictures(replace(camera, clicks=Clicks(shown, px)), [task.fiducials_alone("linear")], None)
    own = {name: start if one.path == camera.path else one for name, one in project.cameras.items()}
    return _tried(scan_tasks(replace(project, cameras=own), [image])[0])


def _tried(task: ScanTask) -> MeasuredScan:
    fiducials = replace(task.options.fiducials, writing="none")
    return measured_scan(replace(task, options=replace(task.options, fiducials=fiducials, targets=None, exterior=None)))

"""One scan of a project, measured by itself."""

from pipeline.files.project_file import Project
from pipeline.measuring.scan_measurement import measured_scan
from pipeline.measuring.scan_task import scan_tasks
from pipeline.results.measured_record import MeasuredScan


def measure_scan(project: Project, name: str) -> MeasuredScan:
    (task,) = scan_tasks(project, [name])
    scan = measured_scan(task)
    assert not scan.failure
    return scan

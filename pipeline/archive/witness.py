"""One scan measured for the archive, in whatever process: with what tells it from any other, and what it took."""

import sys
from dataclasses import dataclass
from pathlib import Path

from measure.scans.addresses import TRAFFIC, scan_path
from pipeline.archive.identity import FileState, file_state, parts_hash
from pipeline.measuring.measured import measured_scan
from pipeline.measuring.scan_task import ScanTask
from pipeline.results.measured_scan import MeasuredScan

_COUNTED = Path("/proc/self/io")


@dataclass(frozen=True)
class Witnessed:
    """scan: as measured, or why not. parts_hash: of its file. bytes_read: from the file; -1 where nobody counts."""

    scan: MeasuredScan
    parts_hash: str
    bytes_read: int


def witnessed_scan(task: ScanTask) -> Witnessed:
    """Measure a scan. Raises nothing but interrupts, as `measured_scan` does."""
    before = _bytes_read()
    scan = measured_scan(task)
    bytes_read = _bytes_read() - before if before >= 0 else -1
    return Witnessed(scan, parts_hash(scan_path(task.scan), task.max_pixels) if task.scan else "", bytes_read)


def state_of(task: ScanTask, folder: Path) -> FileState:
    """The state of a task's file. folder: of the project."""
    return file_state(scan_path(task.scan), folder) if task.scan else FileState(f"(none) {task.name}", -1)


def _bytes_read() -> int:
    """By this process, of whatever file or address; mapped pages are not counted."""
    if not sys.platform.startswith("linux"):
        return -1
    try:
        return int(_COUNTED.read_text(encoding="ascii").split("rchar:")[1].split()[0]) + TRAFFIC.bytes
    except (OSError, IndexError, ValueError):
        return -1

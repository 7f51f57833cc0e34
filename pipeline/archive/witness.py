"""One scan measured for the archive, in whatever process: with what tells it from any other, and what it took."""

import sys
from dataclasses import dataclass
from pathlib import Path

from measure.scans.remote import TRAFFIC, scan_path
from pipeline.archive.file_state import FileState, FileStates
from pipeline.archive.identity import parts_hash
from pipeline.measuring.measured import measured_scan
from pipeline.measuring.scan_task import ScanTask
from pipeline.results.measured_scan import MeasuredScan
from pipeline.results.thumbnail import StoredThumbnail, TakenThumbnails

_COUNTED = Path("/proc/self/io")


@dataclass(frozen=True)
class Witnessed:
    """scan: as measured, or why not. parts_hash: of its file. bytes_read: from the file; -1 where nobody counts.
    thumbnails: cut from what was decoded for it."""

    scan: MeasuredScan
    parts_hash: str
    bytes_read: int
    thumbnails: tuple[StoredThumbnail, ...] = ()


def witnessed_scan(task: ScanTask) -> Witnessed:
    """Measure a scan. Raises nothing but interrupts, as `measured_scan` does."""
    before = _bytes_read()
    thumbnails = TakenThumbnails()
    scan = measured_scan(task, thumbnails.take)
    bytes_read = _bytes_read() - before if before >= 0 else -1
    parts = parts_hash(scan_path(task.scan), task.max_pixels) if task.scan else ""
    return Witnessed(scan, parts, bytes_read, tuple(thumbnails))


def state_of(task: ScanTask, files: FileStates) -> FileState:
    """The state of a task's file."""
    return files.of(scan_path(task.scan)) if task.scan else FileState(f"(none) {task.name}", -1)


def _bytes_read() -> int:
    """By this process, of whatever file or address; mapped pages are not counted."""
    if not sys.platform.startswith("linux"):
        return -1
    try:
        return int(_COUNTED.read_text(encoding="ascii").split("rchar:")[1].split()[0]) + TRAFFIC.bytes
    except (OSError, IndexError, ValueError):
        return -1

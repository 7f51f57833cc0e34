"""Which cameras an archive's scans are of: of each kind in each folder a few are held against the camera library."""

from collections.abc import Sequence
from concurrent.futures import as_completed
from functools import cache
from pathlib import Path

from rich.console import Console

from measure.errors import MeasurementError
from pipeline.archive.catalogue import Group
from pipeline.files.camera_file import CameraFile
from pipeline.files.library import read_library
from pipeline.measuring.camera_identification import Identification
from pipeline.measuring.camera_trials import identify
from pipeline.measuring.scan_kinds import ScanKind, spread
from pipeline.progress import Reporter
from pipeline.workers import worker_pool


def name_cameras(
    groups: Sequence[Group], reporter: Reporter, max_pixels: int | None
) -> tuple[list[ScanKind], dict[Path, str]]:
    """The groups, in their order, with what their samples say, which are tried in processes side by side; and why
    samples could not be read."""
    samples = [path for group in groups for path in spread(group.paths)]
    identified, unread = dict[Path, Identification](), dict[Path, str]()
    with reporter.stage("tried") as count, worker_pool(len(samples)) as workers:
        futures = {workers.submit(_identified, path, max_pixels): path for path in samples}
        for done, future in enumerate(as_completed(futures), 1):
            path, answer = futures[future], future.result()
            if isinstance(answer, Identification):
                identified[path] = answer
            else:
                unread[path] = answer
            count(f"{done} of {len(samples)} scans on the camera library", done, len(samples))
    kinds = [
        ScanKind(
            group.paths,
            group.head.width_px,
            group.head.height_px,
            tuple(identified[path] for path in spread(group.paths) if path in identified),
        )
        for group in groups
    ]
    return kinds, unread


def _identified(path: Path, max_pixels: int | None) -> Identification | str:
    """What the library says of a scan, or why it cannot be read."""
    try:
        return identify(path, library(), None, Reporter(Console(quiet=True)), max_pixels)
    except MeasurementError as error:
        return str(error)


@cache
def library() -> dict[str, CameraFile]:
    """Read once in each process."""
    return read_library()

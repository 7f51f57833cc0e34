"""The report of fifty thousand scans: its size, and what making it and a frame's page takes.

    python -m benchmarks archive_report [SCANS]

Stand-ins for measured scans, every hundredth with a fiducial lost, are put into a store as `reseau measure` would;
then `reseau report` runs in a process of its own.
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.archive_scale import told_of
from benchmarks.archive_stand_ins import stand_in, write_project
from measure.flags import Code, Reason, Status
from measure.results import MarkMeasurement
from pipeline.archive.checked_statuses import JudgedScan, judge, judged_marks, judging_of, tell_written
from pipeline.archive.measurement import pitches, tell_place
from pipeline.archive.results_database import Kept, Store
from pipeline.files.project_file import Project, read_project
from pipeline.measuring.scan_task import scan_tasks
from pipeline.provenance import Identity, file_state, parts_hash
from pipeline.publishing.made_from import measured_from
from pipeline.results.comparator_file import write_comparator
from pipeline.results.measured_record import record_of
from pipeline.results.measured_scan import MeasuredScan

_LOSES = 100  # one frame in so many has lost a fiducial


def main(scans: int) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        project = read_project(write_project(folder, scans))
        _keep(project)
        print(f"{scans} scans of eight marks")
        print(f"{'command':<28}{'clock s':>9}{'CPU s':>9}{'MB at most':>12}{'page, MB':>10}")
        name = sorted(project.scans)[1]
        for arguments, page in (([], "report.html"), (["--frames", name], f"frames/{name}.html")):
            start = time.monotonic()
            cpu_s, peak_mb = told_of(["report", str(project.path), *arguments])
            size_mb = (folder / "out" / page).stat().st_size / 1e6
            title = " ".join(["report", *arguments])
            print(f"{title:<28}{time.monotonic() - start:9.1f}{cpu_s:9.1f}{peak_mb:12.0f}{size_mb:10.2f}", flush=True)


def _keep(project: Project) -> None:
    home = project.path.resolve().parent
    with Store(project.measurement_path) as store:
        tell_place(store, home)
        digest = judge(store, measured_from(project), "kept", _frames(project, store, home))
        judging = judging_of(store, digest)
        assert judging is not None
        write_comparator(project.comparator, judged_marks(store, judging), pitches(store, digest), digest)
        tell_written(store, digest, project.comparator)


def _frames(project: Project, store: Store, home: Path) -> Iterator[JudgedScan]:
    for number, task in enumerate(scan_tasks(project, tuple(project.scans))):
        scan = stand_in(task).scan
        record, path = record_of(_with_loss(scan) if number % _LOSES == 1 else scan, home), Path(task.scan)
        identity = Identity(file_state(path, home), parts_hash(path))
        yield JudgedScan(task.name, store.keep(Kept(identity, "{}", record), task.name, current=True), record)


def _with_loss(scan: MeasuredScan) -> MeasuredScan:
    first, *others = scan.frame.marks
    lost = MarkMeasurement(first.point, first.kind, None, None, Status.ABSENT, Reason("it is covered", Code.COVERED))
    return replace(scan, frame=replace(scan.frame, marks=(lost, *others)))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50_000)

"""Where the scans of a project stand: counted by verdict, and those that need a look."""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from pipeline.archive.identity import file_state
from pipeline.archive.store import Store
from pipeline.archive.verdicts import MEANING, NEXT_STEP, Verdict
from pipeline.files.project_file import Project
from pipeline.report.data import Problem
from pipeline.report.verdict import Level
from pipeline.report.verdict import Verdict as ProjectVerdict
from pipeline.summary import Summary

_NAMED = 20  # scans that a summary names
_LOOK = (Verdict.FAILED, Verdict.POOR, Verdict.LOOK)  # the worst first


@dataclass(frozen=True)
class ScanStatus:
    """Where a scan stands, and why: the first thing that speaks against it. failure: its kind, where nothing was
    measured."""

    image: str
    scan: str
    camera: str
    verdict: Verdict
    why: str = ""
    failure: str = ""
    seconds: float | None = None
    finished: str = ""


@dataclass(frozen=True)
class ArchiveStatus:
    """Every scan of a project, by name. problem: of the store as a whole, such as that it is not there."""

    scans: tuple[ScanStatus, ...]

    @property
    def counts(self) -> Mapping[Verdict, int]:
        counts = Counter(scan.verdict for scan in self.scans)
        return {verdict: counts[verdict] for verdict in Verdict}

    @property
    def all_good(self) -> bool:
        return not any(scan.verdict.needs_look for scan in self.scans)

    def of(self, verdict: Verdict | None) -> "ArchiveStatus":
        """The scans of one verdict; None: all."""
        return self if verdict is None else ArchiveStatus(tuple(s for s in self.scans if s.verdict is verdict))


def archive_status(project: Project, path: Path | None = None) -> ArchiveStatus:
    """By the store, and by which files there are and how they look from outside: no scan is opened. path: of the store,
    if not that of the project. What was measured with other options is known once `measure` has begun with these."""
    path = path or project.measurement_path
    rows = {}
    if path.exists():
        with Store(path) as store:
            rows = {row[0]: row[1:] for row in store.connection.execute(_QUERY)}
    folder = project.path.resolve().parent
    scans = []
    for name, file in project.scans.items():
        state = file_state(file, folder)
        found = rows.get(state.uri)
        camera = project.camera_of(name).path.name
        if found is None or found[5] is None:
            scans.append(ScanStatus(name, state.uri, camera, Verdict.WAITING))
            continue
        bytes_, mtime_ns, etag, is_current, duplicate, verdict, problem, failure, reason, seconds, finished = found
        is_now = is_current and (bytes_, mtime_ns, etag) == (state.bytes, state.mtime_ns, state.etag)
        why = problem or (f"its file is a copy of that of {duplicate}" if duplicate else "") or reason or ""
        now = Verdict(verdict) if is_now else Verdict.OLD
        scans.append(ScanStatus(name, state.uri, camera, now, why, failure or "", seconds, finished))
    return ArchiveStatus(tuple(sorted(scans, key=lambda scan: scan.image)))


_QUERY = """
with latest as (select max(id) as id from judging where digest not like 'unfinished%')
select scan.uri, scan.bytes, scan.mtime_ns, scan.etag, scan.is_current, original.name,
    coalesce(judged_frame.verdict, result.verdict),
    coalesce(judged_frame.detail ->> '$.problems[0]', result.detail ->> '$.problems[0]'),
    result.detail ->> '$.failure.code',
    case when coalesce(judged_frame.verdict, result.verdict) in ('look', 'poor') then coalesce(
        (select point || ': ' || reason from judged where judged.judging = latest.id and judged.result = result.id
         and reason <> '' and reason_code not like 'decided%' order by number limit 1),
        (select point || ': ' || reason from mark where mark.result = result.id
         and reason <> '' order by number limit 1)
    ) end,
    result.seconds, result.finished
from scan left join result on result.id = scan.result left join scan original on original.id = scan.duplicate_of
left join latest left join judged_frame on judged_frame.judging = latest.id and judged_frame.scan = scan.id
    and judged_frame.result = scan.result
"""


def status_json(status: ArchiveStatus) -> dict[str, Any]:
    """For programs: the totals, and every scan that needs a look."""
    return {
        "scans": len(status.scans),
        "verdicts": {
            str(verdict): {"scans": count, "meaning": MEANING[verdict], "next_step": NEXT_STEP[verdict]}
            for verdict, count in status.counts.items()
        },
        "images": {
            scan.image: {
                "verdict": str(scan.verdict),
                "why": scan.why,
                "failure": scan.failure or None,
                "scan": scan.scan,
                "camera": scan.camera,
            }
            for scan in status.scans
            if scan.verdict.needs_look
        },
    }


def status_csv(status: ArchiveStatus) -> str:
    """A line a scan."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("image", "verdict", "why", "failure", "scan", "camera", "seconds", "finished"))
    for scan in status.scans:
        seconds = "" if scan.seconds is None else f"{scan.seconds:.2f}"
        writer.writerow(
            (scan.image, scan.verdict, scan.why, scan.failure, scan.scan, scan.camera, seconds, scan.finished)
        )
    return text.getvalue()


def print_status(status: ArchiveStatus, console: Console, every: bool = False) -> None:
    """Totals, and what to do; then the scans that need a look. every: name all of them."""
    table = Table("verdict", "scans", "what it means", "what to do next")
    for verdict, count in status.counts.items():
        if count:
            table.add_row(str(verdict), str(count), Text(MEANING[verdict]), Text(NEXT_STEP[verdict]))
    console.print(table)
    named, more = _named(status.scans, len(status.scans) if every else _NAMED, every)
    for scan in named:
        console.print(Text(f"{scan.verdict}: {scan.image}{f': {scan.why}' if scan.why else ''}"), soft_wrap=True)
    if more:
        console.print(Text(f"... and {more} more: --verdict names all of one verdict", style="dim"))


def archive_summary(project: Project, files: Mapping[str, Path]) -> Summary:
    """What `measure` says of many scans."""
    return _summary(archive_status(project), files)


def shard_summary(project: Project, path: Path, shard: tuple[int, int]) -> Summary:
    """What `measure --shard` says: of the scans of that part."""
    status = archive_status(project, path)
    own = tuple(scan for scan in status.scans if scan.verdict not in (Verdict.WAITING, Verdict.OLD))
    return _summary(ArchiveStatus(own), {f"part {shard[0]} of {shard[1]}": path})


def _summary(status: ArchiveStatus, files: Mapping[str, Path]) -> Summary:
    told = ", ".join(f"{count} {verdict}" for verdict, count in status.counts.items() if count) or "none"
    sentence = f"Measured: {len(status.scans)} scans: {told}."
    named, more = _named(status.scans, _NAMED, False)
    problems = [Problem(f"{scan.image}: {scan.verdict}: {scan.why}", NEXT_STEP[scan.verdict]) for scan in named]
    if more:
        problems.append(Problem(f"{more} more need a look.", "Run `reseau status` with --verdict or --csv."))
    level: Level = "good" if status.all_good else "look"
    return Summary(ProjectVerdict(level, sentence, tuple(problems), ()), {}, {}, None, None, files)


def _named(scans: Sequence[ScanStatus], most: int, every: bool) -> tuple[list[ScanStatus], int]:
    """The first of those that need a look, the worst first; and how many there are beside them."""
    look = [scan for verdict in _LOOK for scan in scans if scan.verdict is verdict] if not every else list(scans)
    return look[:most], max(len(look) - most, 0)

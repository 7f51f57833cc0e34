"""`reseau status`: scans of a project counted by verdict, with those that need a look and why."""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table
from rich.text import Text

from pipeline.archive.checked_results import latest
from pipeline.archive.results_database import ResultsDatabase
from pipeline.archive.review_decisions import (
    decisions_hash,
    group_decisions,
    inapplicable,
    request_hasher,
    shortened,
    unknown_images,
)
from pipeline.archive.schema import is_sound
from pipeline.archive.verdicts import NEXT_STEP, Verdict, scan_counts
from pipeline.files.project_file import Project
from pipeline.files.scan_files import as_named
from pipeline.provenance import FileState, FileStates, content_hash
from pipeline.results.measured_record import FailureCode

NAMED = 20  # scans that a summary names
_DAMAGED = "stored result damaged (digest differs): `reseau measure --retry` measures it again"
_LOOK = (Verdict.FAILED, Verdict.POOR, Verdict.LOOK)  # from the worst


class ScanStatus(NamedTuple):  # a tuple, since archives have many
    """Status of a scan. why: its first problem; failure: code, where nothing was measured; seconds: duration of the
    measurement; finished: time of its end."""

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
    """Status of every scan of a project, sorted by name. idle_decisions: lines of decisions.jsonl that do not apply,
    and why."""

    scans: tuple[ScanStatus, ...]
    idle_decisions: tuple[str, ...] = ()

    @property
    def counts(self) -> Mapping[Verdict, int]:
        counts = Counter(scan.verdict for scan in self.scans)
        return {verdict: counts[verdict] for verdict in Verdict}

    @property
    def sentence(self) -> str:
        """Sentence with the number of measured scans and of scans by verdict."""
        return scan_counts(self.counts)

    @property
    def all_good(self) -> bool:
        return not self.idle_decisions and not any(scan.verdict.needs_review for scan in self.scans)

    def select(self, verdict: Verdict | None) -> "ArchiveStatus":
        """Status of the scans of one verdict; None: all."""
        scans = self.scans if verdict is None else tuple(s for s in self.scans if s.verdict is verdict)
        return replace(self, scans=scans)


def archive_status(project: Project, path: Path | None = None) -> ArchiveStatus:
    """Status from the store and the files' sizes and times; of files of another time the content is compared.

    path: of the database; None for the project's.
    """
    if not project.scans:  # of a project whose marks are given, and perhaps are not drawn
        return ArchiveStatus(())
    path = path or project.measurement_path
    rows, idle = dict[str, list[Any]](), tuple[str, ...]()
    if path.exists():
        with ResultsDatabase(path) as database:
            check_run = latest(database)
            if check_run is not None:
                check_run.check()
            for *row, is_whole in database.connection.execute(_QUERY, (-1 if check_run is None else check_run.row,)):
                uri, *_, request, _ = row
                if not is_whole:  # a damaged row counts as a failure
                    row[_VERDICT:] = [str(Verdict.FAILED), _DAMAGED, str(FailureCode.DAMAGED), None, "", request, None]
                rows[uri] = row
            idle = inapplicable(check_run)
    files, scans = FileStates(project.path.resolve().parent), []
    request_hash, decisions = request_hasher(project), group_decisions(project.decisions)
    for name, file in as_named(project.scans).items():
        state, camera = files.get(file), project.image_camera(name).path.name
        found = rows.get(state.uri)
        if found is None or found[_VERDICT] is None:
            scans.append(ScanStatus(name, state.uri, camera, Verdict.WAITING))
            continue
        *earlier, content, is_current, verdict, why, failure, seconds, finished, request, taken_in = found
        before = FileState(*earlier)
        is_same = is_current and (
            state == before or (content and state.is_touched(before) and content_hash(Path(file)) == content)
        )
        is_now = is_same and request in (None, request_hash(name))
        now = Verdict(verdict) if is_now else Verdict.OLD
        if is_now and taken_in is not None and taken_in != decisions_hash(decisions.get(name, ())):
            now, why = Verdict.OLD, "review decisions not applied yet"
        scans.append(ScanStatus(name, state.uri, camera, now, why or "", failure or "", seconds, finished))
    unknown = shortened([f"line {number}: {why}" for number, why in sorted(unknown_images(project))])
    return ArchiveStatus(tuple(sorted(scans)), tuple(dict.fromkeys((*unknown, *idle))))


_VERDICT = 6  # its column in the query
_QUERY = f"""
select uri, bytes, mtime_ns, etag, content_hash, is_current,
    coalesce(f.verdict, result.verdict), coalesce(f.why, result.why),
    case when result.verdict = '{Verdict.FAILED}' then result.detail ->> '$.failure.code' end,
    seconds, finished, asked, f.decisions,
    {is_sound("scan")} and (scan.result is null or {is_sound("result")} and result.scan = scan.id)
    and (f.result is null or {is_sound("judged_frame", "f")})
from scan left join result on result.id = scan.result
left join judged_frame f on f.judging = ?1 and f.scan = scan.id and f.result = scan.result
"""


def status_json(status: ArchiveStatus) -> dict[str, object]:
    """JSON: totals, and every scan that needs a look."""
    return {
        "scans": len(status.scans),
        "verdicts": {
            str(verdict): {"scans": count, "meaning": verdict.meaning, "next_step": NEXT_STEP[verdict]}
            for verdict, count in status.counts.items()
        },
        "images": {
            scan.image: {name: getattr(scan, name) for name in ("verdict", "why", "scan", "camera")}
            | {"failure": scan.failure or None}
            for scan in status.scans
            if scan.verdict.needs_review
        },
        "decisions_that_do_not_apply": list(status.idle_decisions),
    }


def status_csv(status: ArchiveStatus) -> str:
    """CSV with one line per scan."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("image", "verdict", "why", "failure", "scan", "camera", "seconds", "finished"))
    for image, scan, camera, verdict, why, failure, seconds, finished in status.scans:
        seconds_text = "" if seconds is None else f"{seconds:.2f}"
        writer.writerow((image, verdict, why, failure, scan, camera, seconds_text, finished))
    return text.getvalue()


def print_status(status: ArchiveStatus, console: Console, every: bool = False) -> None:
    """Print totals with remedies, then the scans that need a look. every: name all scans."""
    table = Table("verdict", "scans", "what it means", "remedy")
    for verdict, count in status.counts.items():
        if count:
            table.add_row(str(verdict), str(count), Text(verdict.meaning), Text(NEXT_STEP[verdict]))
    if status.scans:
        console.print(Text(status.sentence))
        console.print(table)
    else:
        console.print("No scan has this verdict." if every else "The project names no scans.")
    named, more = worst_named(status.scans, len(status.scans) if every else NAMED, every)
    for scan in named:
        console.print(Text(f"{scan.verdict}: {scan.image}{f': {scan.why}' if scan.why else ''}"), soft_wrap=True)
    for line in status.idle_decisions:
        console.print(Text(f"decisions.jsonl, {line}"), soft_wrap=True)
    if more:
        console.print(Text(f"... and {more} more: --verdict names all of one verdict", style="dim"))


def worst_named(scans: Sequence[ScanStatus], most: int, every: bool) -> tuple[list[ScanStatus], int]:
    """The first of the scans that need a look, from the worst, and the number of the remaining ones."""
    to_name = [scan for verdict in _LOOK for scan in scans if scan.verdict is verdict] if not every else list(scans)
    return to_name[:most], max(len(to_name) - most, 0)
